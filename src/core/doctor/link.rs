//! How the cells' voltages follow the pack's current.
//!
//! In: voltage readings (V per cell) with the pack current (A, positive = discharge) that flowed. They are averaged over
//! blocks of [`BLOCKS_S`], so that a sensor's delay of a tenth of a second does not matter. Out:
//! * the largest steps of the current from block to block and what each cell's voltage did: dV = -R dI;
//! * runs of steady current and where the voltage drifted: dV = -(dOCV/dSOC) I t / C;
//! * rests: the voltage a current near zero leaves.
//!
//! Of steps and runs the largest are kept: what is chosen by its current alone does not bend the slope.

use crate::quantity::Timestamp;

/// Times over which readings are averaged, s: the first for a load that changes all the time, the second for one that
/// holds for a while under voltages that are rough.
pub(crate) const BLOCKS_S: [f64; 2] = [1.0, 10.0];
/// Blocks further apart than this do not belong together, s.
const MAX_GAP_S: f64 = 40.0;
/// Steps this many times the usual scatter off the line are left out.
const FAR: f64 = 8.0;
/// Fewer large steps than this are judged against the noise between them ...
const FEW_STEPS: usize = 5;
/// ... when the largest is so many times the tolerance.
const FEW_TIMES: f64 = 5.0;
/// Most steps kept: a slope from so many is good to a few per cent.
const MAX_STEPS: usize = 192;
/// Most runs kept.
const MAX_RUNS: usize = 128;
/// The first part of a run is not looked at: the circuit's branches settle, s.
const SETTLE_S: f64 = 20.0;
/// Shortest part of a run that is.
const MIN_RUN_S: f64 = 25.0;
/// Most rests kept.
const MAX_RESTS: usize = 256;

/// A step of the current and what came of it.
#[derive(Debug, Clone)]
struct Step {
    current_a: f64,
    voltage_v: f64,
    cells_v: Vec<f32>,
}

/// A slope through the origin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Slope {
    pub(crate) points: usize,
    /// -dV/dI, ohm.
    pub(crate) ohm: f64,
    /// Its standard deviation.
    pub(crate) std_ohm: f64,
    /// Share of the voltage's variance explained.
    pub(crate) r2: f64,
    /// Largest step of the current, A.
    pub(crate) largest_a: f64,
}

impl Slope {
    pub(crate) fn t(&self) -> f64 {
        self.ohm / self.std_ohm.max(1e-12)
    }

    /// How sure it is that the slope is not zero: 1 = enough. A few points can lie on a line by chance.
    pub(crate) fn certainty(&self) -> f64 {
        let needed = match self.points {
            0..=4 => 15.0,
            5..=7 => 8.0,
            _ => 6.0,
        };
        self.t().abs() / needed
    }

    /// Through the points without those far off the rest: a reading gone wrong must not decide.
    fn of(points: impl Iterator<Item = (f64, f64)>) -> Option<Self> {
        let all: Vec<(f64, f64)> = points.filter(|(x, y)| y.is_finite() && *x != 0.0).collect();
        let usual = median(all.iter().map(|(x, y)| y / x))?;
        let scatter = median(all.iter().map(|(x, y)| (y - usual * x).abs()))?;
        let near = |(x, y): &&(f64, f64)| (y - usual * x).abs() <= FAR * scatter + 1e-3;
        let kept: Vec<(f64, f64)> = all.iter().filter(near).copied().collect();
        Self::fit(if 5 * kept.len() >= 4 * all.len() { &kept } else { &all })
    }

    fn fit(points: &[(f64, f64)]) -> Option<Self> {
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
            // Readings have a resolution: a perfect fit of a few steps is not perfect knowledge.
            std_ohm: (rest / xx).sqrt().max(1e-7),
            r2,
            largest_a: largest,
        })
    }
}

/// A time of steady current.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Run {
    pub(crate) current_a: f64,
    /// The part looked at, s.
    pub(crate) seconds: f64,
    /// Mean voltage of a cell, V.
    pub(crate) voltage_v: f64,
    /// Drift over that time, V, and its standard deviation.
    pub(crate) drift_v: f64,
    pub(crate) drift_std_v: f64,
    /// Voltage at the end.
    pub(crate) end_v: f64,
}

#[derive(Debug, Clone, Default)]
struct Block {
    from: Option<Timestamp>,
    last: Timestamp,
    current_sum: f64,
    readings: u32,
    cells: Vec<(f64, u32)>,
}

#[derive(Debug, Clone)]
struct Mean {
    time: Timestamp,
    current_a: f64,
    voltage_v: f64,
    cells_v: Vec<f64>,
}

/// A run in the making; times from its start.
#[derive(Debug, Clone, Copy)]
struct Steady {
    from: Timestamp,
    last: Timestamp,
    current_sum: f64,
    blocks: u32,
    n: f64,
    t: f64,
    tt: f64,
    v: f64,
    vv: f64,
    tv: f64,
    first_s: f64,
    end_v: f64,
}

/// See the module.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    block_s: f64,
    /// Current changes up to this are no change of load, A.
    tolerance_a: f64,
    current: Option<(Timestamp, f64)>,
    block: Block,
    before: Option<Mean>,
    steady: Option<Steady>,
    steps: Vec<Step>,
    pub(crate) runs: Vec<Run>,
    pub(crate) rests: Vec<Run>,
}

impl Link {
    pub(crate) fn new(cells: usize, tolerance_a: f64, block_s: f64) -> Self {
        Self {
            block_s,
            tolerance_a,
            current: None,
            block: Block { cells: vec![(0.0, 0); cells], ..Block::default() },
            before: None,
            steady: None,
            steps: Vec::new(),
            runs: Vec::new(),
            rests: Vec::new(),
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
        block.last = time;
        block.current_sum += current_a;
        block.readings += 1;
        if let Some((sum, n)) = block.cells.get_mut(cell) {
            (*sum, *n) = (*sum + voltage_v, *n + 1);
        }
    }

    /// Nobody listened.
    pub(crate) fn pause(&mut self) {
        self.close_block();
        self.close_run();
        (self.current, self.before) = (None, None);
    }

    fn close_block(&mut self) {
        let Some(from) = self.block.from.take() else { return };
        let cells_v: Vec<f64> = self.block.cells.iter().map(|(sum, n)| sum / f64::from(*n)).collect();
        self.block.cells.iter_mut().for_each(|cell| *cell = (0.0, 0));
        let current_a = std::mem::take(&mut self.block.current_sum) / f64::from(self.block.readings.max(1));
        self.block.readings = 0;
        let Some(voltage_v) = median(cells_v.iter().copied()) else { return };
        let mean = Mean { time: from, current_a, voltage_v, cells_v };
        let near = self.before.take().filter(|before| (0.0..=MAX_GAP_S).contains(&mean.time.since(before.time)));
        match near {
            Some(before) => self.note_step(&before, &mean),
            None => self.close_run(),
        }
        self.note_steady(&mean);
        self.before = Some(mean);
    }

    fn note_step(&mut self, before: &Mean, after: &Mean) {
        let cells_v: Vec<f32> =
            before.cells_v.iter().zip(&after.cells_v).map(|(before, after)| (after - before) as f32).collect();
        let voltage_v = median(cells_v.iter().map(|v| f64::from(*v))).unwrap_or(f64::NAN);
        let step = Step { current_a: after.current_a - before.current_a, voltage_v, cells_v };
        if self.steps.len() < MAX_STEPS {
            self.steps.push(step);
            return;
        }
        let smallest = self.steps.iter_mut().min_by(|a, b| a.current_a.abs().total_cmp(&b.current_a.abs()));
        if let Some(smallest) = smallest.filter(|s| s.current_a.abs() < step.current_a.abs()) {
            *smallest = step;
        }
    }

    fn note_steady(&mut self, mean: &Mean) {
        let goes_on = self.steady.is_some_and(|run| {
            let usual = run.current_sum / f64::from(run.blocks);
            (mean.current_a - usual).abs() <= self.tolerance_a + 0.05 * usual.abs()
        });
        if !goes_on {
            self.close_run();
        }
        let run = self.steady.get_or_insert(Steady {
            from: mean.time,
            last: mean.time,
            current_sum: 0.0,
            blocks: 0,
            n: 0.0,
            t: 0.0,
            tt: 0.0,
            v: 0.0,
            vv: 0.0,
            tv: 0.0,
            first_s: f64::NAN,
            end_v: mean.voltage_v,
        });
        run.last = mean.time;
        run.current_sum += mean.current_a;
        run.blocks += 1;
        let t = mean.time.since(run.from);
        if t < SETTLE_S {
            return;
        }
        if run.n == 0.0 {
            run.first_s = t;
            run.end_v = mean.voltage_v;
        }
        // From the first voltage on: small numbers keep their digits.
        let v = mean.voltage_v - run.end_v;
        let t = t - run.first_s;
        run.n += 1.0;
        (run.t, run.tt, run.v, run.vv, run.tv) = (run.t + t, run.tt + t * t, run.v + v, run.vv + v * v, run.tv + t * v);
    }

    fn close_run(&mut self) {
        let Some(run) = self.steady.take() else { return };
        let seconds = run.last.since(run.from) - run.first_s;
        if run.n < 5.0 || seconds < MIN_RUN_S {
            return;
        }
        let (tt, tv, vv) =
            (run.tt - run.t * run.t / run.n, run.tv - run.t * run.v / run.n, run.vv - run.v * run.v / run.n);
        if tt <= 0.0 {
            return;
        }
        let slope = tv / tt;
        let rest = (vv - tv * tv / tt).max(0.0) / (run.n - 2.0);
        let voltage_v = run.end_v + run.v / run.n;
        let run = Run {
            current_a: run.current_sum / f64::from(run.blocks),
            seconds,
            voltage_v,
            drift_v: slope * seconds,
            drift_std_v: (rest / tt).sqrt() * seconds,
            end_v: voltage_v + 0.5 * slope * seconds,
        };
        let (list, limit) = if run.current_a.abs() <= 2.0 * self.tolerance_a {
            (&mut self.rests, MAX_RESTS)
        } else {
            (&mut self.runs, MAX_RUNS)
        };
        if list.len() < limit {
            list.push(run);
        } else if let Some(shortest) = list.iter_mut().min_by(|a, b| a.seconds.total_cmp(&b.seconds))
            && shortest.seconds < run.seconds
        {
            *shortest = run;
        }
    }

    /// The pack's slope over the largest steps.
    pub(crate) fn slope(&self) -> Option<Slope> {
        self.slope_over(|step| Some(step.voltage_v))
    }

    /// One cell's.
    pub(crate) fn slope_of(&self, cell: usize) -> Option<Slope> {
        self.slope_over(|step| step.cells_v.get(cell).map(|v| f64::from(*v)))
    }

    /// Over steps of at least a fifth of the largest: below, it is mostly noise that moves. Where these are few, the others
    /// say how large that noise is.
    fn slope_over(&self, voltage_v: impl Fn(&Step) -> Option<f64>) -> Option<Slope> {
        let largest = self.steps.iter().map(|step| step.current_a.abs()).fold(0.0, f64::max);
        let points = |least_a: f64| {
            let steps = self.steps.iter().filter(move |step| step.current_a.abs() >= least_a);
            steps.filter_map(|step| Some((step.current_a, voltage_v(step)?))).filter(|(_, v)| v.is_finite())
        };
        if points(0.2 * largest).count() >= FEW_STEPS {
            return Slope::of(points(0.2 * largest));
        }
        let all: Vec<(f64, f64)> = points(0.0).collect();
        // Small for this pack: of the noise, or in another unit. Only steps that agree among themselves count.
        if largest < FEW_TIMES * self.tolerance_a { Slope::of(points(0.2 * largest)) } else { Slope::fit(&all) }
    }

    /// Whether the voltage moves with a load rather than with its noise: changes that are not taken back by the next one.
    pub(crate) fn largest_voltage_step(&self) -> f64 {
        self.steps.iter().map(|step| step.voltage_v.abs()).filter(|v| v.is_finite()).fold(0.0, f64::max)
    }
}

/// The middle of the finite ones.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    let middle = sorted.len() / 2;
    if sorted.is_empty() {
        return None;
    }
    let (_, found, _) = sorted.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*found)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "in a test a panic is the message")]
mod tests {
    use super::*;

    /// A cell of 3.7 V and 50 mOhm whose current follows `current_a`, once a second.
    fn link(seconds: u32, current_a: impl Fn(u32) -> f64) -> Link {
        let mut link = Link::new(1, 0.05, BLOCKS_S[0]);
        for second in 0..seconds {
            let (time, current_a) = (Timestamp::from_secs(f64::from(second)), current_a(second));
            link.handle_current(time, current_a);
            link.handle_voltage(time, 0, 3.7 - 0.05 * current_a);
        }
        link.pause();
        link
    }

    #[test]
    fn steps_of_the_current_give_the_resistance_with_its_sign() {
        let steps = |second: u32| if (second / 7).is_multiple_of(2) { 2.0 } else { -1.0 };
        let slope = link(60, steps).slope().unwrap();
        assert!((slope.ohm - 0.05).abs() < 1e-6 && slope.certainty() > 1.0, "{slope:?}");
        let turned = Slope::of((0..9).map(|n| (f64::from(n) - 4.0, 0.03 * (f64::from(n) - 4.0)))).unwrap();
        assert!((turned.ohm + 0.03).abs() < 1e-9, "{turned:?}");
    }

    #[test]
    fn a_reading_gone_wrong_does_not_decide_the_slope() {
        let points = (1..20).map(|n| (f64::from(n), if n == 19 { 5.0 } else { -0.05 * f64::from(n) }));
        assert!((Slope::of(points).unwrap().ohm - 0.05).abs() < 1e-6);
    }

    #[test]
    fn a_current_that_stands_still_gives_a_run_and_no_slope() {
        let steady = link(120, |_| 2.0);
        assert!(steady.slope().is_none_or(|slope| slope.certainty() < 1.0));
        let one_step = link(40, |second| if second < 20 { 0.0 } else { 2.0 }).slope();
        assert!(one_step.is_some_and(|slope| (slope.ohm - 0.05).abs() < 1e-6 && slope.certainty() > 1.0));
        assert_eq!((steady.runs.len(), steady.rests.len()), (1, 0));
        assert!(steady.runs[0].drift_v.abs() < 1e-9 && steady.runs[0].seconds > 90.0);
        let rest = link(120, |_| 0.01);
        assert_eq!((rest.runs.len(), rest.rests.len()), (0, 1));
        assert!((rest.rests[0].end_v - 3.6995).abs() < 1e-6);
    }
}
