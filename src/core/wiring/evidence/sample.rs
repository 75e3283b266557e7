//! Keeps statistics of a stream of values in bounded memory: extent, roughness (mean absolute change from value to
//! value) and a thinned sample.

/// A sample of a stream. It keeps every value until it is full, then every second value, then every fourth, and so
/// on. If two samples have the same maximum size and receive the same number of values, they keep the same positions.
#[derive(Debug, Clone)]
pub struct ThinnedSample {
    values: Vec<f64>,
    most: usize,
    stride: u64,
    seen: u64,
}

impl Default for ThinnedSample {
    /// Creates a sample of at most 512 values, whose quartiles are accurate to a few per cent.
    fn default() -> Self {
        Self::of_at_most(512)
    }
}

impl ThinnedSample {
    pub(super) fn of(values: Vec<f64>) -> Self {
        Self { most: values.len(), seen: values.len() as u64, stride: 1, values }
    }

    fn of_at_most(most: usize) -> Self {
        Self { values: Vec::new(), most, stride: 1, seen: 0 }
    }

    /// The kept values, in order.
    pub fn kept(&self) -> &[f64] {
        &self.values
    }

    pub(crate) fn push(&mut self, value: f64) {
        if self.seen.is_multiple_of(self.stride) {
            if self.values.len() == self.most {
                let mut keep = false;
                self.values.retain(|_| {
                    keep = !keep;
                    keep
                });
                self.stride *= 2;
            }
            if self.seen.is_multiple_of(self.stride) {
                self.values.push(value);
            }
        }
        self.seen += 1;
    }

    /// The value below which the share `q` of the values lies; `None` without values.
    pub(crate) fn quantile(&self, q: f64) -> Option<f64> {
        let mut sorted = self.values.clone();
        sorted.sort_by(f64::total_cmp);
        let at = (q * (sorted.len().max(1) - 1) as f64).round() as usize;
        sorted.get(at).copied()
    }

    pub(crate) fn median(&self) -> Option<f64> {
        self.quantile(0.5)
    }

    /// Share of the values for which `has` is true; 0 without values.
    pub(crate) fn share(&self, has: impl Fn(f64) -> bool) -> f64 {
        self.values.iter().filter(|value| has(**value)).count() as f64 / self.values.len().max(1) as f64
    }

    /// The 2 % and 98 % quantiles.
    pub(crate) fn bulk(&self) -> Option<(f64, f64)> {
        Some((self.quantile(0.02)?, self.quantile(0.98)?))
    }
}

/// Extent and roughness of a stream.
#[derive(Debug, Clone, Copy)]
pub struct Extent {
    pub(crate) count: u64,
    /// Smallest value; infinite without values.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    pub(crate) last: f64,
    pub(crate) changes: u64,
    sum: f64,
    travel: f64,
}

impl Default for Extent {
    fn default() -> Self {
        let (min, max) = (f64::INFINITY, f64::NEG_INFINITY);
        Self { count: 0, min, max, last: f64::NAN, changes: 0, sum: 0.0, travel: 0.0 }
    }
}

impl Extent {
    pub(crate) fn push(&mut self, value: f64) {
        if self.count > 0 && value != self.last {
            self.changes += 1;
            self.travel += (value - self.last).abs();
        }
        self.count += 1;
        self.sum += value;
        self.last = value;
        self.min = self.min.min(value);
        self.max = self.max.max(value);
    }

    /// Mean of the values; NaN without values.
    pub fn mean(&self) -> f64 {
        self.sum / self.count as f64
    }

    /// Largest minus smallest value; 0 without values.
    pub fn range(&self) -> f64 {
        (self.max - self.min).max(0.0)
    }

    /// Mean absolute change from one value to the next.
    pub(crate) fn step(&self) -> f64 {
        self.travel / (self.count.max(2) - 1) as f64
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    #[test]
    fn thinned_sample_keeps_quantiles_and_size() {
        let mut sample = ThinnedSample::default();
        (0..100_000).for_each(|n| sample.push(f64::from(n)));
        assert!(sample.values.len() <= 512);
        for q in [0.1, 0.5, 0.9] {
            let found = sample.quantile(q).unwrap();
            assert!((found - q * 1e5).abs() < 1000.0, "{q}: {found}");
        }
        assert_eq!(ThinnedSample::default().median(), None);
    }
}
