//! Values of one signal over a log, and what two of them have to do with each other.

/// Values kept of one signal: enough for a correlation, few enough for thousands of signals.
const MAX_VALUES: usize = 1500;
/// Two values of different messages belong together when they are at most so far apart, s.
const PAIR_WITHIN_S: f64 = 0.3;
/// Steps between pairs at most this far apart count, s: over longer ones the charge changes too.
const STEP_WITHIN_S: f64 = 15.0;
/// Fewest steps for a relation.
const MIN_STEPS: usize = 6;

/// Values of one signal with their times.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Series {
    /// s.
    pub(super) times: Vec<f64>,
    pub(super) values: Vec<f64>,
    /// Readings without a value: outside the range, too short, not available.
    pub(super) bad: usize,
    /// Time from one reading to the next, mean, s.
    pub(super) period_s: f64,
}

/// How one signal changes when another does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Relation {
    /// Change of the first per change of the second.
    pub(super) slope: f64,
    /// Of the changes, -1 to 1.
    pub(super) correlation: f64,
    /// Changes compared.
    pub(super) steps: usize,
}

impl Series {
    /// Collects readings; every one that is no value counts as bad. Long ones are thinned evenly.
    pub(super) fn collect(readings: impl Iterator<Item = (f64, Option<f64>)>, count: usize) -> Self {
        let every = count.div_ceil(MAX_VALUES).max(1);
        let mut series = Self::default();
        for (time_s, value) in readings.step_by(every) {
            match value.filter(|value| value.is_finite()) {
                Some(value) => {
                    series.times.push(time_s);
                    series.values.push(value);
                }
                None => series.bad += 1,
            }
        }
        if let (Some(first), Some(last), 2..) = (series.times.first(), series.times.last(), series.times.len()) {
            series.period_s = (last - first) / (every * (series.times.len() - 1)) as f64;
        }
        series
    }

    /// Share of readings that are values, 0 to 1.
    pub(super) fn valid_share(&self) -> f64 {
        let all = self.values.len() + self.bad;
        if all == 0 { 0.0 } else { self.values.len() as f64 / all as f64 }
    }

    pub(super) fn low(&self) -> f64 {
        self.values.iter().copied().fold(f64::INFINITY, f64::min)
    }

    pub(super) fn high(&self) -> f64 {
        self.values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
    }

    pub(super) fn mean(&self) -> f64 {
        self.values.iter().sum::<f64>() / self.values.len() as f64
    }

    /// Different values among the first hundred.
    pub(super) fn distinct(&self) -> usize {
        let values: std::collections::BTreeSet<u64> =
            self.values.iter().take(100).map(|value| value.to_bits()).collect();
        values.len()
    }

    pub(super) fn is_constant(&self) -> bool {
        self.low() == self.high()
    }

    /// Whether it counts: most steps are the same one, other than 0.
    pub(super) fn is_counter(&self) -> bool {
        let mut steps: std::collections::BTreeMap<u64, usize> = std::collections::BTreeMap::new();
        for pair in self.values.windows(2).take(200).filter(|pair| pair[0] != pair[1]) {
            *steps.entry((pair[1] - pair[0]).abs().to_bits()).or_default() += 1;
        }
        let most = steps.values().max().copied().unwrap_or(0);
        5 * most > 3 * self.values.len().saturating_sub(1).min(200)
    }

    /// Largest step between neighbours.
    pub(super) fn largest_step(&self) -> f64 {
        self.values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max)
    }

    /// How this signal changes with another; `None` when they have too little in common.
    pub(super) fn relation(&self, other: &Self) -> Option<Relation> {
        let pairs = self.pairs(other);
        let (mut steps, mut xx, mut xy, mut yy) = (0, 0.0, 0.0, 0.0);
        for pair in pairs.windows(2) {
            let (dy, dx) = (pair[1].1 - pair[0].1, pair[1].2 - pair[0].2);
            if pair[1].0 - pair[0].0 <= STEP_WITHIN_S {
                steps += usize::from(dx != 0.0);
                (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
            }
        }
        (steps >= MIN_STEPS && xx > 0.0 && yy > 0.0).then(|| Relation {
            slope: xy / xx,
            correlation: xy / (xx * yy).sqrt(),
            steps,
        })
    }

    /// Time, own value, the other's value: of the rarer series each one, with the nearest of the other.
    fn pairs(&self, other: &Self) -> Vec<(f64, f64, f64)> {
        if self.period_s < other.period_s {
            return other.pairs(self).into_iter().map(|(time_s, theirs, own)| (time_s, own, theirs)).collect();
        }
        let mut at = 0;
        let mut pairs = Vec::new();
        for (&time_s, &value) in self.times.iter().zip(&self.values) {
            let gap = |index: usize| (other.times[index] - time_s).abs();
            while at + 1 < other.times.len() && gap(at + 1) <= gap(at) {
                at += 1;
            }
            if at < other.times.len() && gap(at) <= PAIR_WITHIN_S {
                pairs.push((time_s, value, other.values[at]));
            }
        }
        pairs
    }
}
