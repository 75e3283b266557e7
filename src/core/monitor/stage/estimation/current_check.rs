//! Compares the steps of the measured current with the steps of the cells' voltages.
//!
//! In: *rounds* (the voltages of the cells, read one after another, and the current at that time), and the series
//! resistance according to the model. Out: whether the current is doubtful.
//!
//! A step of the current moves the voltages of all cells in the opposite direction, by the resistance times the step.
//! The check judges each clear step between two steady levels of the voltages. The step is *explained* if the current
//! has stepped in the opposite direction, and if the ratio of the two steps (a resistance) is at least 1/[`MAX_FACTOR`]
//! and at most [`MAX_FACTOR`] times the usual resistance. A step is the mean of two consecutive rounds minus the mean
//! of the two rounds before them. Such a step contains less noise than the difference of two readings. A current that
//! arrives one round earlier or later than the voltages still explains their step.
//!
//! Explained and unexplained steps are evidence for and against the sensor. How much they count depends on how many
//! steps the sensor has left unexplained so far. If a sensor has explained all steps, one unexplained step is enough
//! for a doubt, because the charge is wrong from the first second. A logger that reads current and voltages seconds
//! apart leaves many steps unexplained, so one more is only weak evidence.
//!
//! The check finds a current that is frozen, inverted, late or beyond the sensor's range, whether or not the last
//! digits of its readings change. While the load is constant, the check finds only a noisy sensor at its limit, because
//! the readings of this sensor then repeat. A sensor that has repeated readings of two sizes has no noise and is not
//! judged by its repeats. A current without sign is found at the first clear steps of a charging
//! current. If a doubted current has never flowed in both directions, the doubt only ends when it has. A current without
//! sign therefore stays doubtful.

use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp, bounds};
use crate::sample::CellSample;

/// Share of the steps that a faulty sensor leaves unexplained.
const FAULTY_SHARE: f64 = 0.7;
/// Initial counts of unexplained and of explained steps, for a sensor without history.
const FIRST_STEPS: [f64; 2] = [0.2, 20.0];
/// Part of the counts that remains after another step.
const FORGET_STEP: f64 = 0.98;
/// Largest share of unexplained steps that counts as usual for a good sensor.
const MAX_USUAL_SHARE: f64 = 0.1;
/// Evidence that makes the sensor doubtful, as ln of the odds against it.
const DOUBTFUL: f64 = 4.0;
/// Highest evidence. It limits how many steps a doubtful sensor must explain until the doubt ends.
const MAX_EVIDENCE: f64 = 8.0;
/// Largest movement of voltages and current just before and just after a step, as a part of the step.
const STEADY: f64 = 0.3;
/// Largest ratio of a step's resistance and the usual resistance, in either direction. Temperature, ageing and the time
/// between two rounds change the resistance by less.
const MAX_FACTOR: f64 = 4.0;
/// Smallest clear step of the voltages (V).
const MIN_STEP_V: f64 = 0.01;
/// Smallest clear step, as a multiple of the standard deviation of a reading and as a multiple of the cells' scatter.
const STEP_SIGMA: f64 = 5.0;
/// Smallest clear step, as a multiple of the resolution of the voltages.
const STEP_READINGS: f64 = 1.5;
/// Smallest clear step, as a multiple of the usual change between two rounds.
const STEP_MOVES: f64 = 9.0;
/// Factor by which each round raises or lowers the usual change, which thus follows the median.
const MOVE_GAIN: f64 = 1.02;
/// Range of the usual change between two rounds (V).
const MOVE_V: (f64, f64) = (1e-4, 0.05);
/// Usual change before the first rounds (V). It exceeds the noise of any sensor.
const FIRST_MOVE_V: f64 = 0.01;
/// Weight of an explained step in the usual resistance (as ln).
const RATIO_GAIN: f64 = 0.1;
/// Longest time between two rounds (s). After a longer pause, the steps are not compared.
const MAX_PAUSE_S: f64 = 60.0;
/// Part of the earlier doubts that remains after an explained step.
const FORGET_DOUBT: f64 = 0.97;
/// Weight of a round in the scatter of the cells, and of a steady round in the share of readings that differ by noise.
const NOISE_GAIN: f64 = 0.02;
/// Lowest probability that a good sensor repeats a reading exactly.
const MIN_REPEAT: f64 = 0.01;
/// Probability that a sensor at its limit repeats a reading.
const FAULTY_REPEAT: f64 = 0.5;
/// Changes of a reading above this multiple of the sensor's resolution are noise. A coarse sensor also changes by one
/// step.
const NOISE_STEPS: f64 = 1.5;
/// Resolution of the current before a change has been seen (A).
const MAX_RESOLUTION_A: f64 = 1e3;
/// Number of equal readings in a row that a noisy sensor only has at its limit.
const QUIET_READINGS: u32 = 20;
/// Limit of `repeated` (ln of the odds for a good sensor). At this limit, the sensor becomes doubtful.
const REPEATED: f64 = -10.0;
/// Common change of the cells (V) after which a voltage that has not changed is frozen. The limit is at least
/// [`FROZEN_STEPS`] times the resolution of the voltages.
const FROZEN_V: f64 = 0.03;
const FROZEN_STEPS: f64 = 2.5;
/// Resolution of the voltages before a change has been seen (V).
const COARSE_V: f64 = 0.05;
/// Maximum number of cells that are compared.
pub(crate) const MAX_CELLS: usize = 15;
const ROUNDS: usize = 4;

/// One round of voltages.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Round {
    time: Timestamp,
    /// Current of a cell (A).
    current_a: f64,
    /// Common change of the voltages since the previous round (V).
    move_v: f64,
}

/// State of the check; part of the stored state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CurrentCheck {
    /// Voltage of each compared cell in the latest round (V); `None` = no reading.
    voltages_v: [Option<f64>; MAX_CELLS],
    /// The latest rounds, the oldest first.
    rounds: [Round; ROUNDS],
    /// Number of valid rounds, counted from the latest.
    count: usize,
    /// Evidence against the sensor: ln of the odds, at least 0.
    evidence: f64,
    /// Numbers of unexplained and of explained steps. Later steps have more weight.
    steps: [f64; 2],
    /// ln of the usual resistance relative to the model.
    log_ratio: f64,
    /// Usual size of the voltage changes that the current does not explain (V).
    usual_v: f64,
    /// Usual difference between a cell's change since the previous round and the common change (V).
    scatter_v: f64,
    /// Share of readings of a steady current that differ from the previous reading by noise.
    noisy: f64,
    /// Smallest change of the current (A).
    resolution_a: f64,
    /// Sum of all common changes of the voltages (V).
    path_v: f64,
    /// Smallest change of a single voltage (V).
    resolution_v: f64,
    /// Evidence of the present run of equal readings: ln of the odds for a good sensor, at most 0.
    repeated: f64,
    /// Number of times that the present reading has repeated.
    #[serde(default)]
    equal: u32,
    /// Size of a current that the sensor has read [`QUIET_READINGS`] times in a row before it has shown noise (A); 0 =
    /// none.
    #[serde(default)]
    quiet_a: f64,
    /// Whether the sensor has repeated two currents of different size. Such a sensor has no noise. If its readings
    /// change under a steady load, the load changes: for example, a charger that holds the voltage.
    #[serde(default)]
    is_quiet: bool,
    /// Largest reading of discharge and of charge (A).
    largest_a: [f64; 2],
    /// Readings at which the sensor was at its limit, for discharge and for charge (A); 0 = never.
    limits_a: [f64; 2],
    /// Number of earlier doubts; explained steps reduce it.
    doubts: f64,
    /// Whether a jump of the SOC in a downtime waits for an explained step.
    is_unconfirmed: bool,
    /// Whether the current has been contradicted before it has flowed in both directions, and has not done so since.
    is_one_sided: bool,
}

impl Default for CurrentCheck {
    fn default() -> Self {
        Self {
            voltages_v: [None; MAX_CELLS],
            rounds: [Round::default(); ROUNDS],
            count: 0,
            evidence: 0.0,
            steps: FIRST_STEPS,
            log_ratio: 0.0,
            usual_v: FIRST_MOVE_V,
            scatter_v: FIRST_MOVE_V,
            noisy: 0.0,
            resolution_a: MAX_RESOLUTION_A,
            path_v: 0.0,
            resolution_v: COARSE_V,
            repeated: 0.0,
            equal: 0,
            quiet_a: 0.0,
            is_quiet: false,
            largest_a: [0.0; 2],
            limits_a: [0.0; 2],
            doubts: 0.0,
            is_unconfirmed: false,
            is_one_sided: false,
        }
    }
}

impl CurrentCheck {
    /// Whether the current is doubtful: the evidence is against it, or was against it and the current has never flowed
    /// in both directions.
    pub(crate) fn is_doubtful(&self) -> bool {
        self.is_contradicted() || self.is_one_sided
    }

    fn is_contradicted(&self) -> bool {
        self.evidence > DOUBTFUL
    }

    /// Handles a jump of the SOC in a downtime: the cells may have been used, or a sensor may have failed. The next
    /// explained step of the current decides. If no step has ever been judged, the check waits for none.
    pub(crate) fn demand_step(&mut self) {
        self.is_unconfirmed = self.steps != FIRST_STEPS;
    }

    /// Whether the SOC has jumped in a downtime, and no step of the current has been explained since.
    pub(crate) fn is_unconfirmed(&self) -> bool {
        self.is_unconfirmed
    }

    /// Handles a round. `samples`: the compared cells that have reported, each with its place (below [`MAX_CELLS`]).
    /// `noise_v`: standard deviation of a reading. `ohm`: the model's series resistance. `rest_a`: largest current at
    /// rest.
    pub(crate) fn handle<'a>(
        &mut self,
        samples: impl Iterator<Item = (usize, &'a CellSample)>,
        noise_v: f64,
        ohm: f64,
        rest_a: f64,
    ) {
        let (mut moves_v, mut moves, mut latest) = ([0.0; MAX_CELLS], 0, None);
        // Skips cells without a reading in the previous round: their change spans more than one round.
        let before_v = std::mem::replace(&mut self.voltages_v, [None; MAX_CELLS]);
        for (place, sample) in samples {
            latest = Some(sample);
            self.voltages_v[place] = Some(sample.voltage_v);
            if let Some(before_v) = before_v[place] {
                moves_v[moves] = sample.voltage_v - before_v;
                if moves_v[moves] != 0.0 {
                    self.resolution_v = self.resolution_v.min(moves_v[moves].abs());
                }
                moves += 1;
            }
        }
        let Some(&CellSample { time, current_a, .. }) = latest else { return };
        let move_v = common_move(&mut moves_v[..moves]);
        self.path_v += move_v;
        if moves > 1 {
            self.scatter_v += NOISE_GAIN * (scatter(&mut moves_v[..moves], move_v) - self.scatter_v);
        }
        let is_late = self.count > 0 && time.since(self.rounds[ROUNDS - 1].time) > MAX_PAUSE_S;
        let Some(current_a) = current_a.filter(|_| !is_late && moves > 0) else {
            self.count = 0;
            return;
        };
        self.rounds.rotate_left(1);
        self.rounds[ROUNDS - 1] = Round { time, current_a, move_v };
        self.count = (self.count + 1).min(ROUNDS);
        if self.count == ROUNDS {
            self.judge(noise_v, ohm * libm::exp(self.log_ratio));
        }
        if self.count >= 2 {
            self.judge_repeat();
        }
        let has_both = self.largest_a.iter().all(|&a| a > rest_a);
        self.is_one_sided = !has_both && (self.is_one_sided || self.is_contradicted());
    }

    /// Judges whether the last reading of a flowing current repeats the reading before. If the last digits of a sensor
    /// usually change under a steady load, but now stay the same, the sensor is at its limit. A coarse sensor repeats
    /// its readings, or changes them by one step.
    fn judge_repeat(&mut self) {
        let [.., before, now] = self.rounds;
        let change_a = (now.current_a - before.current_a).abs();
        let direction = usize::from(now.current_a < 0.0);
        self.largest_a[direction] = self.largest_a[direction].max(now.current_a.abs());
        if self.limits_a.contains(&now.current_a) && now.current_a != 0.0 {
            self.add_evidence(DOUBTFUL);
        }
        if change_a > 0.0 {
            self.resolution_a = self.resolution_a.min(change_a);
            self.equal = 0;
        } else if now.current_a != 0.0 {
            self.note_equal(now.current_a.abs());
        }
        if now.current_a == 0.0 {
            self.repeated = 0.0;
            return;
        }
        // A limit is the largest reading of its direction.
        let is_largest = now.current_a.abs() >= self.largest_a[direction];
        if change_a > 0.0 || !is_largest || self.is_quiet {
            self.repeated = 0.0;
        } else {
            self.repeated += libm::log((1.0 - self.noisy).max(MIN_REPEAT) / FAULTY_REPEAT).min(0.0);
            // The run may still show that the sensor is quiet.
            let is_open = self.quiet_a > 0.0 && self.equal < QUIET_READINGS;
            if self.repeated <= REPEATED && !is_open {
                self.repeated = 0.0;
                self.limits_a[direction] = now.current_a;
                self.add_evidence(MAX_EVIDENCE);
            }
        }
        let is_steady = now.move_v.abs() <= self.usual_v.max(self.resolution_v);
        if is_steady && !is_largest {
            let is_noise = change_a > NOISE_STEPS * self.resolution_a;
            self.noisy += NOISE_GAIN * (f64::from(u8::from(is_noise)) - self.noisy);
        }
    }

    /// Notes that a reading of this size (A) has repeated.
    fn note_equal(&mut self, size_a: f64) {
        self.equal = self.equal.saturating_add(1);
        if self.equal < QUIET_READINGS {
            return;
        }
        if self.quiet_a > 0.0 {
            // The limits of both directions differ by one step at most.
            self.is_quiet |= (size_a - self.quiet_a).abs() > NOISE_STEPS * self.resolution_a;
        } else if 1.0 - self.noisy >= FAULTY_REPEAT {
            self.quiet_a = size_a;
        }
    }

    /// Sum of all changes that the cells have in common (V). Only its differences are meaningful.
    pub(crate) fn path_v(&self) -> f64 {
        self.path_v
    }

    /// Whether the cells have clearly changed in common since the path was `path_v`. If a voltage has not changed
    /// since, it is frozen.
    pub(crate) fn is_frozen_since(&self, path_v: f64) -> bool {
        (self.path_v - path_v).abs() >= FROZEN_V.max(FROZEN_STEPS * self.resolution_v)
    }

    /// Judges the step in the middle of the last four rounds, from the mean of two rounds to the mean of the next two.
    /// `ohm`: the usual resistance.
    fn judge(&mut self, noise_v: f64, ohm: f64) {
        let [r0, r1, r2, r3] = self.rounds;
        let moved_v = 0.5 * r1.move_v + r2.move_v + 0.5 * r3.move_v;
        let moved_a = 0.5 * (r2.current_a + r3.current_a - r0.current_a - r1.current_a);
        let clear_v = MIN_STEP_V
            .max(STEP_SIGMA * noise_v)
            .max(STEP_SIGMA * self.scatter_v)
            .max(STEP_READINGS * self.resolution_v)
            .max(STEP_MOVES * self.usual_v);
        let factor = if (moved_v + ohm * moved_a).abs() > self.usual_v { MOVE_GAIN } else { 1.0 / MOVE_GAIN };
        self.usual_v = (self.usual_v * factor).clamp(MOVE_V.0, MOVE_V.1);
        let (before_a, after_a) = (r1.current_a - r0.current_a, r3.current_a - r2.current_a);
        let is_steady = |before: f64, after: f64| before.abs().max(after.abs()) <= STEADY * moved_v.abs();
        if moved_v.abs() < clear_v || !is_steady(r1.move_v, r3.move_v) {
            return;
        }
        let factor = -moved_v / (ohm * moved_a);
        let is_explained = (1.0 / MAX_FACTOR..=MAX_FACTOR).contains(&factor);
        if is_explained {
            self.log_ratio = (self.log_ratio + RATIO_GAIN * libm::log(factor)).clamp(-2.0, 2.0);
        }
        // A current that changes all the time may have been read at another moment than the voltages. An unexplained
        // step then does not count.
        if is_explained || is_steady(ohm * before_a, ohm * after_a) {
            self.weigh(is_explained);
        }
    }

    /// Adds a step of the voltages to the evidence.
    fn weigh(&mut self, is_explained: bool) {
        let [unexplained, explained] = self.steps;
        let usual_share = (unexplained / (unexplained + explained)).min(MAX_USUAL_SHARE);
        if is_explained {
            self.is_unconfirmed = false;
            self.add_evidence(libm::log((1.0 - FAULTY_SHARE) / (1.0 - usual_share)));
            self.doubts *= FORGET_DOUBT;
        } else {
            self.add_evidence(libm::log(FAULTY_SHARE / usual_share));
        }
        self.steps = self.steps.map(|count| FORGET_STEP * count);
        self.steps[usize::from(is_explained)] += 1.0;
    }

    /// Adds `log_odds` to the evidence. If a doubt starts, also adds the number of earlier doubts.
    fn add_evidence(&mut self, log_odds: f64) {
        let was_contradicted = self.is_contradicted();
        self.evidence = (self.evidence + log_odds).clamp(0.0, MAX_EVIDENCE);
        if self.is_contradicted() && !was_contradicted {
            self.evidence = (self.evidence + self.doubts).min(MAX_EVIDENCE);
            self.doubts += 1.0;
        }
    }

    /// Forgets the latest rounds, because the next reading comes after a pause. The evidence stays.
    pub(crate) fn interrupt(&mut self) {
        (self.voltages_v, self.rounds, self.count) = ([None; MAX_CELLS], [Round::default(); ROUNDS], 0);
        (self.equal, self.repeated) = (0, 0.0);
    }

    /// Checks a stored state; the error is the first impossible number.
    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        bounds::VOLTAGE_V.check_all("a voltage of the check of the current", self.voltages_v.into_iter().flatten())?;
        bounds::CURRENT_A.check_all(
            "a current of the check of the current",
            self.rounds.map(|round| round.current_a).into_iter().chain(self.limits_a).chain(self.largest_a),
        )?;
        let numbers = self.rounds.map(|round| round.move_v);
        bounds::NUMBER.check_all("a voltage step of the check of the current", numbers)?;
        let [unexplained, explained] = self.steps;
        let state = [
            self.evidence,
            unexplained,
            explained,
            self.log_ratio,
            self.usual_v,
            self.scatter_v,
            self.noisy,
            self.resolution_a,
            self.path_v,
            self.resolution_v,
            self.repeated,
            self.doubts,
            self.quiet_a,
        ];
        bounds::NUMBER.check_all("the check of the current", state)?;
        InvalidState::unless(self.count <= ROUNDS, "rounds of the check of the current", self.count as f64, "at most 4")
    }

    /// Shifts all timestamps by `by_nanos`, to another clock.
    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.rounds.iter_mut().for_each(|round| round.time = round.time.plus_nanos(by_nanos));
    }
}

/// The change that at least two thirds of the cells reach or exceed in the same direction (V); otherwise 0.
fn common_move(moves_v: &mut [f64]) -> f64 {
    moves_v.sort_unstable_by(f64::total_cmp);
    let Some(last) = moves_v.len().checked_sub(1) else { return 0.0 };
    let others = moves_v.len() / 3;
    let (low, high) = (moves_v[others], moves_v[last - others]);
    if low > 0.0 {
        low
    } else if high < 0.0 {
        high
    } else {
        0.0
    }
}

/// Median difference between the cells' changes and the common change (V).
fn scatter(moves_v: &mut [f64], common_v: f64) -> f64 {
    moves_v.iter_mut().for_each(|move_v| *move_v = (*move_v - common_v).abs());
    moves_v.sort_unstable_by(f64::total_cmp);
    moves_v[moves_v.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::CellIndex;

    /// Name of a fault, and the reading for a load and a time.
    type Fault = (&'static str, fn(f64, u32) -> f64);

    const OHM: f64 = 2e-3;
    const CELLS: usize = 5;

    /// Load of a drive (A): a new level every 10 s.
    fn load_a(time_s: u32) -> f64 {
        let level = (time_s / 10).wrapping_mul(2_654_435_761) >> 24;
        f64::from(level) / 2.0 - 30.0
    }

    /// Noise of a reading (A): 0 to 0.06 A in steps of 0.001 A.
    fn noise_a(time_s: u32) -> f64 {
        f64::from(time_s.wrapping_mul(time_s) % 61) / 1000.0
    }

    /// Handles a round of all cells. `voltage_v` returns the voltage of a cell.
    fn round(check: &mut CurrentCheck, time_s: u32, current_a: Option<f64>, voltage_v: impl Fn(usize) -> f64) {
        let samples: Vec<CellSample> = (0..CELLS)
            .map(|cell| CellSample {
                time: Timestamp::from_secs(f64::from(time_s)),
                cell: CellIndex(cell as u16),
                voltage_v: voltage_v(cell),
                current_a,
                charge_as: 0.0,
                offset_s: 0.0,
                unmeasured_s: 0.0,
                temperature_c: None,
            })
            .collect();
        check.handle(samples.iter().enumerate(), 0.001, OHM, 1.0);
    }

    /// Runs a drive of `seconds`, one round every 2 s. `measured` returns the reading for the load and the time.
    /// Returns the share of rounds in doubt.
    fn drive(check: &mut CurrentCheck, seconds: u32, measured: impl Fn(f64, u32) -> Option<f64>) -> f64 {
        let mut doubtful = 0;
        for time_s in (0..seconds).step_by(2) {
            let current_a = measured(load_a(time_s), time_s).map(|current_a| current_a + noise_a(time_s));
            round(check, time_s, current_a, |cell| {
                3.7 - 1.2 * OHM * load_a(time_s) + 1e-4 * ((time_s as usize + cell) % 5) as f64
            });
            doubtful += u32::from(check.is_doubtful());
        }
        f64::from(doubtful) / f64::from(seconds / 2)
    }

    fn share_in_doubt(measured: impl Fn(f64, u32) -> Option<f64>) -> f64 {
        drive(&mut CurrentCheck::default(), 3600, measured)
    }

    #[test]
    fn good_current_is_never_doubted() {
        assert_eq!(share_in_doubt(|load_a, _| Some(load_a)), 0.0);
        // First, a gateway sends the current one round late. Second, the apparent resistance is 2.4 times the model's.
        assert_eq!(share_in_doubt(|_, time_s| Some(load_a(time_s.saturating_sub(2)))), 0.0);
        assert_eq!(share_in_doubt(|load_a, _| Some(0.5 * load_a)), 0.0);
        // One reading in four is lost.
        assert_eq!(share_in_doubt(|load_a, time_s| (time_s % 8 != 0).then_some(load_a)), 0.0);
    }

    #[test]
    fn wrong_current_is_doubted_within_seconds() {
        let faults: [Fault; 5] = [
            ("zero", |_, _| 0.0),
            ("inverted", |load_a, _| -load_a),
            ("late by 20 s", |_, time_s| load_a(time_s.saturating_sub(20))),
            ("overflow", |load_a, _| (load_a + 20.0).rem_euclid(40.0) - 20.0),
            ("without sign", |load_a, _| load_a.abs()),
        ];
        for (name, fault) in faults {
            let share = share_in_doubt(|load_a, time_s| Some(fault(load_a, time_s)));
            assert!(share > 0.85, "{name}: {share}");
        }
    }

    #[test]
    fn repeated_reading_of_noisy_sensor_is_its_limit() {
        let mut check = CurrentCheck::default();
        // The reading without the noise that `drive` adds: exactly 60 A while the load is larger.
        let limited = |load_a: f64, time_s: u32| Some(if load_a >= 60.0 { 60.0 - noise_a(time_s) } else { load_a });
        drive(&mut check, 1200, |load_a, _| (load_a < 60.0).then_some(load_a));
        let share = drive(&mut check, 3600, limited);
        assert!(share > 0.5, "{share} {check:?}");
        assert!((check.limits_a[0] - 60.0).abs() < 1e-9, "{:?}", check.limits_a);
    }

    #[test]
    fn regulated_current_of_quiet_sensor_is_no_limit() {
        // A laboratory charges with a constant current and then at a constant voltage, which moves the current. Then it
        // discharges with a constant current, the largest of all.
        let charge_then_discharge = |discharge_a: f64| {
            let mut check = CurrentCheck::default();
            for time_s in 0..600 {
                let held_v = 1e-4 * f64::from(time_s % 3);
                let (current_a, voltage_v) = match time_s {
                    0..200 => (-50.0, 3.9 + 1e-4 * f64::from(time_s)),
                    200..450 => (-20.0 + 100.0 * noise_a(time_s), 4.1 + held_v),
                    _ => (discharge_a, 3.9 - 1e-4 * f64::from(time_s)),
                };
                round(&mut check, 2 * time_s, Some(current_a), |_| voltage_v);
            }
            check
        };
        let of_quiet = charge_then_discharge(50.5);
        assert_eq!((of_quiet.limits_a, of_quiet.is_doubtful()), ([0.0; 2], false), "{of_quiet:?}");
        // Both directions end at the same reading: this is the limit.
        let of_limited = charge_then_discharge(50.0);
        assert!(of_limited.limits_a.contains(&50.0) && of_limited.is_doubtful(), "{of_limited:?}");
    }

    #[test]
    fn doubt_ends_after_explained_steps_and_lasts_longer_each_time() {
        let mut check = CurrentCheck::default();
        drive(&mut check, 600, |load_a, _| Some(load_a));
        let mut shares = Vec::new();
        for _ in 0..3 {
            check.add_evidence(DOUBTFUL + 1.0);
            shares.push(drive(&mut check, 1200, |load_a, _| Some(load_a)));
            assert!(!check.is_doubtful());
        }
        assert!(shares.is_sorted() && shares[0] < 0.1 && shares[2] < 0.5, "{shares:?}");
    }

    #[test]
    fn jump_waits_for_explained_step() {
        let mut check = CurrentCheck::default();
        check.demand_step();
        assert!(!check.is_unconfirmed(), "no step has been judged");
        drive(&mut check, 600, |load_a, _| Some(load_a));
        check.demand_step();
        check.interrupt();
        assert!(check.is_unconfirmed());
        drive(&mut check, 60, |load_a, _| Some(-load_a));
        assert!(check.is_unconfirmed());
        drive(&mut check, 60, |load_a, _| Some(load_a));
        assert!(!check.is_unconfirmed());
    }

    #[test]
    fn frozen_voltage_shows_against_common_path() {
        let mut check = CurrentCheck::default();
        drive(&mut check, 600, |load_a, _| Some(load_a));
        let path_v = check.path_v();
        assert!(!check.is_frozen_since(path_v));
        assert!(check.is_frozen_since(path_v - 0.05));
    }

    #[test]
    fn relaxation_after_load_is_not_a_step() {
        let mut check = CurrentCheck::default();
        for k in 0..20_u32 {
            let since_load = k.checked_sub(5).map(f64::from);
            let (voltage_v, current_a) = match since_load {
                None => (3.7 - 0.102, 30.0),
                Some(rounds) => (3.7 - 0.03 * libm::exp(-rounds / 3.0), 0.0),
            };
            round(&mut check, 600 + 2 * k, Some(current_a), |_| voltage_v);
        }
        assert!(!check.is_doubtful(), "{check:?}");
    }
}
