//! Determines how the cells' voltages follow the pack's current.
//!
//! In: voltage readings (V per cell) and the pack current (A, positive = discharge). Both are averaged over blocks of
//! [`BLOCKS_S`], so that a sensor delay of a tenth of a second does not matter. Out:
//! * the largest block-to-block steps of the current, with the step of each cell's voltage: dV = -R dI;
//! * runs of steady current with the drift of the voltage: dV = -(dOCV/dSOC) I t / C;
//! * rests: runs with a current near zero.
//!
//! Only the largest current steps and the longest runs are kept. Choosing by current and duration does not bias the
//! slope, because the choice does not depend on the voltages.

use super::equal_cells::EqualCells;
use super::slope::Slope;
use crate::filter::median;
use crate::quantity::Timestamp;

/// Block lengths over which readings are averaged (s). Short blocks suit a load that changes all the time. Long blocks
/// suit noisy voltages and a load that holds for a while.
pub(crate) const BLOCKS_S: [f64; 2] = [1.0, 10.0];
/// Maximum time between two compared blocks, and between a current and the voltage compared with it (s).
const MAX_GAP_S: f64 = 40.0;

#[derive(Debug, Clone)]
struct CurrentStep {
    current_a: f64,
    voltage_v: f64,
    cells_v: Vec<f32>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct SteadyRun {
    pub(crate) current_a: f64,
    /// Length of the evaluated part (s). The first 20 s are not evaluated.
    pub(crate) seconds: f64,
    /// Mean over time of the median cell's voltage (V).
    pub(crate) voltage_v: f64,
    /// Drift over `seconds` (V).
    pub(crate) drift_v: f64,
    pub(crate) drift_std_v: f64,
    pub(crate) end_v: f64,
}

#[derive(Debug, Clone, Default)]
struct Block {
    from: Option<Timestamp>,
    current_sum: f64,
    readings: u32,
    cells: Vec<(f64, u32)>,
}

#[derive(Debug, Clone)]
struct BlockMean {
    time: Timestamp,
    current_a: f64,
    voltage_v: f64,
    cells_v: Vec<f64>,
}

/// A run that is still growing. Time and voltage are relative to the first evaluated block, so that rounding errors
/// stay small.
#[derive(Debug, Clone, Copy, Default)]
struct OpenRun {
    from: Timestamp,
    last: Timestamp,
    current_sum: f64,
    blocks: u32,
    /// First evaluated block: time since `from` (s) and voltage (V).
    first: Option<(f64, f64)>,
    /// Sums over the evaluated blocks: 1, t, t^2, v, v^2, t v.
    n: f64,
    t: f64,
    tt: f64,
    v: f64,
    vv: f64,
    tv: f64,
}

impl OpenRun {
    fn current_a(&self) -> f64 {
        self.current_sum / f64::from(self.blocks)
    }

    fn push(&mut self, mean: &BlockMean) {
        self.last = mean.time;
        self.current_sum += mean.current_a;
        self.blocks += 1;
        let t = mean.time.since(self.from);
        // Skip the time in which the slow overvoltages of the cell settle.
        if t < 20.0 {
            return;
        }
        let (first_s, first_v) = *self.first.get_or_insert((t, mean.voltage_v));
        let (t, v) = (t - first_s, mean.voltage_v - first_v);
        self.n += 1.0;
        (self.t, self.tt) = (self.t + t, self.tt + t * t);
        (self.v, self.vv, self.tv) = (self.v + v, self.vv + v * v, self.tv + t * v);
    }

    fn finish(&self) -> Option<SteadyRun> {
        let (n, (first_s, first_v)) = (self.n, self.first?);
        let seconds = self.last.since(self.from) - first_s;
        let (tt, tv, vv) =
            (self.tt - self.t * self.t / n, self.tv - self.t * self.v / n, self.vv - self.v * self.v / n);
        if n < 5.0 || seconds < 25.0 || tt <= 0.0 {
            return None;
        }
        let slope = tv / tt;
        let residual = (vv - tv * tv / tt).max(0.0) / (n - 2.0);
        let voltage_v = first_v + self.v / n;
        Some(SteadyRun {
            current_a: self.current_a(),
            seconds,
            voltage_v,
            drift_v: slope * seconds,
            drift_std_v: (residual / tt).sqrt() * seconds,
            end_v: voltage_v + 0.5 * slope * seconds,
        })
    }
}

/// Relation of the voltages to the current, for one block length.
#[derive(Debug, Clone, Default)]
pub(crate) struct VoltageResponse {
    block_s: f64,
    /// Largest current change that does not count as a change of load (A).
    tolerance_a: f64,
    current: Option<(Timestamp, f64)>,
    block: Block,
    previous: Option<BlockMean>,
    open_run: Option<OpenRun>,
    steps: Vec<CurrentStep>,
    largest_a: f64,
    /// The three largest absolute voltage steps (V), largest first, regardless of the current.
    voltage_steps_v: [f64; 3],
    pub(crate) runs: Vec<SteadyRun>,
    pub(crate) rests: Vec<SteadyRun>,
    pub(crate) equal_cells: EqualCells,
}

/// The response whose slope is more certain.
pub(crate) fn best_response([fast, slow]: &[VoltageResponse; 2]) -> &VoltageResponse {
    let certainty = |response: &VoltageResponse| response.slope().map_or(0.0, |slope| slope.certainty());
    // Short blocks are preferred if they suffice, because they contain the load steps and no slower changes.
    let fast_certainty = certainty(fast);
    if fast_certainty >= 1.0 || fast_certainty >= certainty(slow) { fast } else { slow }
}

impl VoltageResponse {
    pub(crate) fn new(cells: usize, tolerance_a: f64, block_s: f64) -> Self {
        Self {
            block_s,
            tolerance_a,
            block: Block { cells: vec![(0.0, 0); cells], ..Block::default() },
            ..Self::default()
        }
    }

    pub(crate) fn handle_current(&mut self, time: Timestamp, current_a: f64) {
        self.current = Some((time, current_a));
    }

    pub(crate) fn handle_voltage(&mut self, time: Timestamp, cell: usize, voltage_v: f64) {
        let Some((_, current_a)) = self.current.filter(|(at, _)| time.since(*at) <= MAX_GAP_S) else { return };
        if self.block.from.is_some_and(|from| time.since(from) >= self.block_s - 1e-3 || time < from) {
            self.close_block();
        }
        let block = &mut self.block;
        block.from.get_or_insert(time);
        block.current_sum += current_a;
        block.readings += 1;
        if let Some((sum, n)) = block.cells.get_mut(cell) {
            (*sum, *n) = (*sum + voltage_v, *n + 1);
        }
    }

    /// Closes the open block of readings and the open run of steady current. The observer calls this function at each
    /// gap and at the end of the observation.
    pub(crate) fn pause(&mut self) {
        self.close_block();
        self.close_run();
        (self.current, self.previous) = (None, None);
    }

    fn close_block(&mut self) {
        let Some(from) = self.block.from.take() else { return };
        let cells_v: Vec<f64> = self.block.cells.iter().map(|(sum, n)| sum / f64::from(*n)).collect();
        self.block.cells.iter_mut().for_each(|cell| *cell = (0.0, 0));
        let current_a = std::mem::take(&mut self.block.current_sum) / f64::from(self.block.readings.max(1));
        self.block.readings = 0;
        self.equal_cells.push(&cells_v);
        let Some(voltage_v) = median(cells_v.iter().copied()) else { return };
        let mean = BlockMean { time: from, current_a, voltage_v, cells_v };
        self.largest_a = self.largest_a.max(current_a.abs());
        let near = self.previous.take().filter(|before| (0.0..=MAX_GAP_S).contains(&mean.time.since(before.time)));
        match near {
            Some(before) => self.note_step(&before, &mean),
            None => self.close_run(),
        }
        self.note_steady(&mean);
        self.previous = Some(mean);
    }

    fn note_step(&mut self, before: &BlockMean, after: &BlockMean) {
        let cells_v: Vec<f32> =
            before.cells_v.iter().zip(&after.cells_v).map(|(before, after)| (after - before) as f32).collect();
        let voltage_v = median(cells_v.iter().map(|v| f64::from(*v))).unwrap_or(f64::NAN);
        let step = CurrentStep { current_a: after.current_a - before.current_a, voltage_v, cells_v };
        if voltage_v.abs() > self.voltage_steps_v[2] {
            self.voltage_steps_v[2] = voltage_v.abs();
            self.voltage_steps_v.sort_by(|a, b| b.total_cmp(a));
        }
        // With 192 steps, the slope is accurate to a few per cent.
        if self.steps.len() < 192 {
            self.steps.push(step);
            return;
        }
        let smallest = self.steps.iter_mut().min_by(|a, b| a.current_a.abs().total_cmp(&b.current_a.abs()));
        if let Some(smallest) = smallest.filter(|s| s.current_a.abs() < step.current_a.abs()) {
            *smallest = step;
        }
    }

    fn note_steady(&mut self, mean: &BlockMean) {
        let continues = self.open_run.is_some_and(|run| {
            (mean.current_a - run.current_a()).abs() <= self.tolerance_a + 0.05 * run.current_a().abs()
        });
        if !continues {
            self.close_run();
        }
        self.open_run.get_or_insert_with(|| OpenRun { from: mean.time, ..OpenRun::default() }).push(mean);
    }

    fn close_run(&mut self) {
        let Some(run) = self.open_run.take().and_then(|run| run.finish()) else { return };
        let (list, limit) =
            if run.current_a.abs() <= 2.0 * self.tolerance_a { (&mut self.rests, 256) } else { (&mut self.runs, 128) };
        if list.len() < limit {
            list.push(run);
        } else if let Some(shortest) = list.iter_mut().min_by(|a, b| a.seconds.total_cmp(&b.seconds))
            && shortest.seconds < run.seconds
        {
            *shortest = run;
        }
    }

    pub(crate) fn block_s(&self) -> f64 {
        self.block_s
    }

    /// Slope of the median cell's voltage against the current, from the largest steps.
    pub(crate) fn slope(&self) -> Option<Slope> {
        self.slope_over(|step| Some(step.voltage_v))
    }

    /// Slope of one cell's voltage against the current, from the largest steps.
    pub(crate) fn slope_of(&self, cell: usize) -> Option<Slope> {
        self.slope_over(|step| step.cells_v.get(cell).map(|v| f64::from(*v)))
    }

    /// Slope from the large current steps (at least a fifth of the largest step), because smaller steps are mostly
    /// noise. If there are fewer than five large steps, all steps are used, so that the small steps show the noise.
    fn slope_over(&self, voltage_v: impl Fn(&CurrentStep) -> Option<f64>) -> Option<Slope> {
        let largest = self.steps.iter().map(|step| step.current_a.abs()).fold(0.0, f64::max);
        // A charger with constant power or a tapering current lowers the current slowly as the voltage rises. Then
        // the voltage drives the current, so the steps do not show a resistance.
        if largest < 0.05 * self.largest_a {
            return None;
        }
        let points = |least_a: f64| {
            let steps = self.steps.iter().filter(move |step| step.current_a.abs() >= least_a);
            steps.filter_map(|step| Some((step.current_a, voltage_v(step)?))).filter(|(_, v)| v.is_finite())
        };
        if points(0.2 * largest).count() >= 5 {
            return Slope::of(points(0.2 * largest));
        }
        let all: Vec<(f64, f64)> = points(0.0).collect();
        // Exception: if even the largest step is small for this pack, the steps are noise or the unit is wrong. In this
        // case, only the large steps are used, without outliers.
        if largest < 5.0 * self.tolerance_a { Slope::of(points(0.2 * largest)) } else { Slope::fit(&all) }
    }

    /// Largest step of the median cell's voltage (V).
    pub(crate) fn largest_voltage_step(&self) -> f64 {
        self.voltage_steps_v[0]
    }

    /// Third largest step of the median cell's voltage (V). A wrong reading can cause the two larger steps.
    pub(crate) fn large_voltage_step(&self) -> f64 {
        self.voltage_steps_v[2]
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    /// Simulates a cell of 3.7 V and 50 mOhm with a current of `current_a`, once a second.
    fn response(seconds: u32, current_a: impl Fn(u32) -> f64) -> VoltageResponse {
        let mut response = VoltageResponse::new(1, 0.05, BLOCKS_S[0]);
        for second in 0..seconds {
            let (time, current_a) = (Timestamp::from_secs(f64::from(second)), current_a(second));
            response.handle_current(time, current_a);
            response.handle_voltage(time, 0, 3.7 - 0.05 * current_a);
        }
        response.pause();
        response
    }

    #[test]
    fn current_steps_give_signed_resistance() {
        let steps = |second: u32| if (second / 7).is_multiple_of(2) { 2.0 } else { -1.0 };
        let slope = response(60, steps).slope().unwrap();
        assert!((slope.ohm - 0.05).abs() < 1e-6 && slope.certainty() > 1.0, "{slope:?}");
        let turned = Slope::of((0..9).map(|n| (f64::from(n) - 4.0, 0.03 * (f64::from(n) - 4.0)))).unwrap();
        assert!((turned.ohm + 0.03).abs() < 1e-9, "{turned:?}");
    }

    #[test]
    fn steady_current_gives_run_without_slope() {
        let steady = response(120, |_| 2.0);
        assert!(steady.slope().is_none_or(|slope| slope.certainty() < 1.0));
        let one_step = response(40, |second| if second < 20 { 0.0 } else { 2.0 }).slope();
        assert!(one_step.is_some_and(|slope| (slope.ohm - 0.05).abs() < 1e-6 && slope.certainty() > 1.0));
        assert_eq!((steady.runs.len(), steady.rests.len()), (1, 0));
        assert!(steady.runs[0].drift_v.abs() < 1e-9 && steady.runs[0].seconds > 90.0);
        let rest = response(120, |_| 0.01);
        assert_eq!((rest.runs.len(), rest.rests.len()), (0, 1));
        assert!((rest.rests[0].end_v - 3.6995).abs() < 1e-6);
    }
}
