//! Fits a line through the origin to voltage steps against current steps. Returns the slope with its certainty.
//!
//! In: steps of a current (A) and of a voltage (V). They come from blocks of a stream ([`response`](super::response))
//! or from the kept readings of two recorded signals. Out: the resistance with its sign, its standard deviation, and
//! the share of the voltage's variance that the current explains.

use super::series::Series;
use crate::filter::median;

/// If the current hardly explains the steps between consecutive readings ([`LEAST_R2`]), steps of at least this duration
/// (s) are used. A car's load changes within a second.
const LEAST_STEP_S: f64 = 1.0;
/// If the current explains less than this share of the voltage changes between consecutive readings, longer steps are
/// used.
const LEAST_R2: f64 = 0.25;

/// A slope through the origin.
#[derive(Debug, Clone, Copy)]
pub struct Slope {
    /// Number of steps.
    pub points: usize,
    /// Resistance: -dV/dI (ohm).
    pub ohm: f64,
    pub(crate) std_ohm: f64,
    /// Share of the voltage's variance that the current explains, 0 to 1.
    pub(crate) r2: f64,
    pub(crate) largest_a: f64,
}

impl Slope {
    pub(crate) fn t(&self) -> f64 {
        self.ohm / self.std_ohm.max(1e-12)
    }

    /// Certainty that the slope is not zero; 1 is sufficient. A slope from few points must be more significant, because
    /// few points can lie on a line by chance.
    pub(crate) fn certainty(&self) -> f64 {
        let needed = match self.points {
            0..=4 => 15.0,
            5..=7 => 8.0,
            _ => 6.0,
        };
        self.t().abs() / needed
    }

    /// Correlation of the voltage with the current: negative if a discharge counts as positive.
    pub fn correlation(&self) -> f64 {
        -self.ohm.signum() * self.r2.sqrt()
    }

    /// Significance of the correlation, in standard deviations of a random correlation: the correlation times the
    /// square root of the number of steps.
    pub fn strength(&self) -> f64 {
        self.correlation().abs() * (self.points as f64).sqrt()
    }

    /// Slope of a recorded voltage against a recorded current, or of any two signals; `None` if there are too few
    /// steps.
    pub fn between(voltage: &Series, current: &Series) -> Option<Self> {
        let mut pairs = pairs(voltage, current);
        let of_each = Self::of_steps(&pairs);
        if of_each.is_some_and(|slope| slope.r2 >= LEAST_R2) {
            return of_each;
        }
        // Between two fast readings, the voltage may change by less than its resolution.
        let mut latest_s = f64::NEG_INFINITY;
        pairs.retain(|pair| {
            let is_later = pair.0 - latest_s >= LEAST_STEP_S;
            latest_s = if is_later { pair.0 } else { latest_s };
            is_later
        });
        Self::of_steps(&pairs).or(of_each)
    }

    /// Slope of the steps from one pair (time, voltage, current) to the next.
    fn of_steps(pairs: &[(f64, f64, f64)]) -> Option<Self> {
        // Over longer times, the state of charge also changes the voltage.
        let near = pairs.windows(2).filter(|pair| pair[1].0 - pair[0].0 <= 15.0);
        let steps: Vec<(f64, f64)> = near.map(|pair| (pair[1].2 - pair[0].2, pair[1].1 - pair[0].1)).collect();
        let moved = steps.iter().filter(|(current_a, _)| *current_a != 0.0).count();
        let slope = Self::fit(&steps).filter(|slope| moved >= 6 && slope.r2 > 0.0)?;
        Some(Self { points: moved, ..slope })
    }

    /// Slope through the points without outliers, so that a single wrong reading does not change the slope.
    pub(super) fn of(points: impl Iterator<Item = (f64, f64)>) -> Option<Self> {
        let all: Vec<(f64, f64)> = points.filter(|(x, y)| y.is_finite() && *x != 0.0).collect();
        let ratio = median(all.iter().map(|(x, y)| y / x))?;
        let scatter = median(all.iter().map(|(x, y)| (y - ratio * x).abs()))?;
        let near = |(x, y): &&(f64, f64)| (y - ratio * x).abs() <= 8.0 * scatter + 1e-3;
        let kept: Vec<(f64, f64)> = all.iter().filter(near).copied().collect();
        Self::fit(if 5 * kept.len() >= 4 * all.len() { &kept } else { &all })
    }

    pub(super) fn fit(points: &[(f64, f64)]) -> Option<Self> {
        let (mut xx, mut xy, mut yy, mut largest) = (0.0, 0.0, 0.0, 0.0_f64);
        for (x, y) in points {
            (xx, xy, yy) = (xx + x * x, xy + x * y, yy + y * y);
            largest = largest.max(x.abs());
        }
        if points.len() < 3 || xx <= 0.0 {
            return None;
        }
        let n = points.len() as f64;
        let rest = (yy - xy * xy / xx).max(0.0) / (n - 1.0);
        let r2 = if yy > 0.0 { xy * xy / (xx * yy) } else { 0.0 };
        Some(Self {
            points: points.len(),
            ohm: -xy / xx,
            // The minimum is necessary because readings have a limited resolution: a few steps may lie exactly on a
            // line by chance.
            std_ohm: (rest / xx).sqrt().max(1e-7),
            r2,
            largest_a: largest,
        })
    }
}

/// Returns tuples of time (s), voltage and current. Each reading of the slower series is paired with the nearest
/// reading of the faster series, if the two are at most 0.3 s apart.
fn pairs(voltage: &Series, current: &Series) -> Vec<(f64, f64, f64)> {
    let period_s = |series: &Series| series.period_s().unwrap_or(0.0);
    if period_s(voltage) < period_s(current) {
        return pairs(current, voltage).into_iter().map(|(time_s, a, v)| (time_s, v, a)).collect();
    }
    let (times_s, values) = (current.times_s.kept(), current.values.kept());
    let mut at = 0;
    let mut pairs = Vec::new();
    for (&time_s, &value) in voltage.times_s.kept().iter().zip(voltage.values.kept()) {
        let gap_s = |index: usize| (times_s[index] - time_s).abs();
        while at + 1 < times_s.len() && gap_s(at + 1) <= gap_s(at) {
            at += 1;
        }
        if at < times_s.len() && gap_s(at) <= 0.3 {
            pairs.push((time_s, value, values[at]));
        }
    }
    pairs
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    #[test]
    fn slope_ignores_a_wrong_reading() {
        let points = (1..20).map(|n| (f64::from(n), if n == 19 { 5.0 } else { -0.05 * f64::from(n) }));
        assert!((Slope::of(points).unwrap().ohm - 0.05).abs() < 1e-6);
    }

    #[test]
    fn coarse_voltage_shows_slope_of_fast_readings() {
        let current = |time_s: f64| 60.0 * (0.5 * time_s).sin();
        let times = || (0..3000).map(|n| f64::from(n) * 0.01);
        let amperes = Series::of(times().map(|t| (t, Ok(current(t)))));
        let volts = Series::of(times().map(|t| (t, Ok((2.0 * (385.0 - 0.07 * current(t))).round() / 2.0))));
        let slope = Slope::between(&volts, &amperes).unwrap();
        assert!((slope.ohm - 0.07).abs() < 0.01 && slope.correlation() < -0.9, "{slope:?}");
    }

    #[test]
    fn slope_is_found_between_signals_of_different_rates() {
        let current = |time_s: f64| (3.0 * time_s).sin() * 40.0;
        let fast = Series::of((0..2000).map(|n| f64::from(n) * 0.01).map(|t| (t, Ok(current(t)))));
        let slow = Series::of((0..100).map(|n| f64::from(n) * 0.2).map(|t| (t + 0.001, Ok(380.0 - 0.1 * current(t)))));
        let slope = Slope::between(&slow, &fast).unwrap();
        assert!((slope.ohm - 0.1).abs() < 0.005 && slope.correlation() < -0.99, "{slope:?}");
        let turned = Slope::between(&fast, &slow).unwrap();
        assert_eq!((turned.points, turned.correlation() < -0.99), (slope.points, true));
    }
}
