//! Summarises the estimates of a replay in time bins: SOC, temperature, and consistency of the estimator.

use super::bins::{Bin, Bins};
use crate::cell::Coverage;
use crate::monitor::Estimate;

#[derive(Debug, Clone)]
pub(super) struct TraceBin {
    pub(super) soc: (f64, f64),
    /// Lowest and highest end of the cells' 95 % intervals, fraction.
    pub(super) soc_band: (f64, f64),
    pub(super) temperature_c: (f64, f64),
    pub(super) innovation_v: (f64, f64),
    pub(super) health: Consistency,
}

/// Consistency of the innovations with the variance that the filter states.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Consistency {
    pub(super) count: u64,
    /// Number of innovations within their own 95 % interval.
    pub(super) inside: u64,
    /// Number of innovations rejected by the gate.
    pub(super) gated: u64,
    /// Sum of (innovation / standard deviation) squared.
    pub(super) squares: f64,
}

const NOTHING: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);

impl Default for TraceBin {
    fn default() -> Self {
        let health = Consistency::default();
        Self { soc: NOTHING, soc_band: NOTHING, temperature_c: NOTHING, innovation_v: NOTHING, health }
    }
}

fn grow(range: &mut (f64, f64), (low, high): (f64, f64)) {
    *range = (range.0.min(low), range.1.max(high));
}

impl TraceBin {
    fn take(&mut self, e: &Estimate) {
        let [soc, temperature_c, innovation_v] =
            [e.soc, e.measured.temperature_c, e.innovation_v].map(|value| (value, value));
        let soc_band = (e.soc - crate::OF_95 * e.soc_std, e.soc + crate::OF_95 * e.soc_std);
        self.join(&Self { soc, soc_band, temperature_c, innovation_v, health: Consistency::of(e) });
    }
}

impl Bin for TraceBin {
    fn join(&mut self, later: &Self) {
        grow(&mut self.soc, later.soc);
        grow(&mut self.soc_band, later.soc_band);
        grow(&mut self.temperature_c, later.temperature_c);
        grow(&mut self.innovation_v, later.innovation_v);
        self.health.add(&later.health);
    }
}

impl Consistency {
    fn of(e: &Estimate) -> Self {
        let parts = e.innovation_v / e.innovation_std_v;
        if !parts.is_finite() {
            return Self::default();
        }
        let (inside, gated) = (u64::from(parts.abs() <= crate::OF_95), u64::from(!e.accepted));
        Self { count: 1, inside, gated, squares: parts * parts }
    }

    fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.inside += other.inside;
        self.gated += other.gated;
        self.squares += other.squares;
    }

    pub(super) fn coverage(&self) -> Option<f64> {
        (self.count > 0).then(|| self.inside as f64 / self.count as f64)
    }

    /// Returns the mean normalised innovation squared, which is 1 if the variance of the filter is right.
    pub(super) fn mean_nis(&self) -> Option<f64> {
        (self.count > 0).then(|| self.squares / self.count as f64)
    }
}

#[derive(Debug, Clone, Default)]
pub(super) struct Trace {
    pub(super) life: Option<Bins<TraceBin>>,
    pub(super) cells: Vec<Consistency>,
    pub(super) seen: Coverage,
}

impl Trace {
    pub(super) fn take(&mut self, estimate: &Estimate) {
        let time_s = estimate.time.secs();
        self.life.get_or_insert_with(|| Bins::new(time_s)).at(time_s).take(estimate);
        self.seen.note(estimate.soc, estimate.measured.temperature_c);
        let cell = estimate.cell.index();
        if self.cells.len() <= cell {
            self.cells.resize(cell + 1, Consistency::default());
        }
        self.cells[cell].add(&Consistency::of(estimate));
    }

    pub(super) fn health(&self) -> Consistency {
        self.cells.iter().fold(Consistency::default(), |mut all, cell| {
            all.add(cell);
            all
        })
    }
}
