//! Counts missing frames of a cyclic signal.
//!
//! In: gaps, that is, times between two readings (s). Out: the share of missing readings. The median of the first
//! gaps is the cycle. A later gap of n cycles counts as n - 1 missing readings. The total is limited to the elapsed
//! cycles minus the received readings, so that readings sent late in a burst do not count as missing. If the gaps are
//! not multiples of one value, the sender has no cycle and the share is unknown.

use crate::filter::median;

#[derive(Debug, Clone, Default)]
pub(crate) struct LossCounter {
    first: Vec<f64>,
    cycle_s: Option<f64>,
    gaps: u32,
    regular: u32,
    missing: u32,
    /// Sum of the gaps, in cycles.
    elapsed: f64,
}

impl LossCounter {
    pub(crate) fn push(&mut self, gap_s: f64) {
        let Some(cycle_s) = self.cycle_s else {
            self.first.push(gap_s);
            if self.first.len() == 16 {
                self.cycle_s = median(self.first.drain(..)).filter(|cycle_s| *cycle_s > 0.0);
            }
            return;
        };
        let cycles = gap_s / cycle_s;
        // Skip pauses of the sender.
        if cycles > 5.5 {
            return;
        }
        self.gaps = self.gaps.saturating_add(1);
        self.elapsed += cycles;
        let whole = cycles.round();
        if whole >= 1.0 && (cycles - whole).abs() <= 0.4 {
            self.regular = self.regular.saturating_add(1);
            // `whole` is at most 5.
            self.missing = self.missing.saturating_add(whole as u32 - 1);
        }
    }

    /// Share of the missing readings, and the cycle (s); `None` if there are too few gaps or the sender has no cycle.
    pub(crate) fn share(&self) -> Option<(f64, f64)> {
        let gaps = f64::from(self.gaps);
        let missing = f64::from(self.missing).min((self.elapsed - gaps).max(0.0));
        let is_cyclic = self.gaps >= 30 && f64::from(self.regular) >= 0.9 * gaps;
        self.cycle_s.filter(|_| is_cyclic).map(|cycle_s| (missing / (gaps + missing), cycle_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(gaps: impl Iterator<Item = f64>) -> Option<f64> {
        let mut counter = LossCounter::default();
        gaps.for_each(|gap_s| counter.push(gap_s));
        counter.share().map(|(share, _)| share)
    }

    #[test]
    fn every_seventh_frame_missing_gives_one_seventh() {
        let found = share((0..700).map(|n| if n % 6 == 5 { 0.021 } else { 0.0099 }));
        assert!(found.is_some_and(|share| (share - 1.0 / 7.0).abs() < 0.01), "{found:?}");
    }

    #[test]
    fn jitter_and_pauses_do_not_count_as_loss() {
        let jitter = share((0..700).map(|n| 0.01 + 0.002 * f64::from(n % 3 - 1)));
        assert!(jitter.is_some_and(|share| share < 0.01), "{jitter:?}");
        // A busy computer delays two frames and then sends them in a burst.
        let late = share((0..700).map(|n| match n % 15 {
            7 => 0.03,
            8 | 9 => 0.0001,
            _ => 0.01,
        }));
        assert!(late.is_none_or(|share| share < 0.01), "{late:?}");
        assert_eq!(share((0..700).map(|n| if n % 100 == 50 { 3.0 } else { 0.01 })), Some(0.0));
        assert_eq!(share((0..700).map(|n| 0.01 * (1.0 + 0.13 * f64::from(n % 10)))), None);
        assert_eq!(share((0..20).map(|_| 0.01)), None);
    }
}
