//! Checks the current sensor: compares the steps of the measured current with the steps of the cells' voltages.
//!
//! In: samples of the compared cells, and the series resistance of the model. Out: whether the current is doubtful.
//!
//! A *round* contains one sample of each cell, and the mean current of these samples. A round is complete when all
//! cells of the previous round have reported. If a cell is missing, the round ends when another cell reports again,
//! after a pause ([`PAUSE_SHARE`]) or after [`MAX_ROUND_S`].
//!
//! A step of the current moves the voltages of all cells in the opposite direction, by the resistance times the step.
//! The check judges each clear step between two steady levels of the voltages. The step is *explained* if the current
//! has stepped in the opposite direction, and if the ratio of the two steps is a plausible resistance. A plausible
//! resistance differs from the usual resistance by at most the factor [`MAX_FACTOR`]. To reduce noise, a step is the
//! mean of two consecutive rounds minus the mean of the two rounds before them. A current that arrives one round
//! earlier or later than the voltages still explains their step.
//!
//! Explained and unexplained steps are evidence for and against the sensor. If a sensor has explained all steps so far,
//! one unexplained step makes the current doubtful, because a wrong current falsifies the counted charge at once. A
//! logger that reads current and voltages seconds apart leaves many steps unexplained. A further unexplained step is
//! then only weak evidence.
//!
//! The check finds a current that is frozen, inverted, late or beyond the sensor's range, even if the last digits of
//! its readings change. While the load is constant, it finds only a current beyond the range of a noisy sensor
//! ([`SensorLimit`]). A sensor that reports the current without its sign is found at the first clear steps of a
//! charging current. If a doubted current has flowed in only one direction, the doubt lasts until the current has
//! flowed in both. A current without sign therefore stays doubtful.

mod sensor_limit;

use sensor_limit::SensorLimit;
use serde::{Deserialize, Serialize};

use crate::quantity::{InvalidState, Timestamp, bounds};
use crate::sample::CellSample;

/// Share of the steps that a faulty sensor leaves unexplained.
const FAULTY_SHARE: f64 = 0.7;
/// Initial counts of unexplained and of explained steps, for a sensor without history.
const FIRST_STEPS: [f64; 2] = [0.2, 20.0];
/// Factor on the earlier counts at each new step.
const FORGET_STEP: f64 = 0.98;
/// Largest share of unexplained steps that counts as usual for a good sensor.
const MAX_USUAL_SHARE: f64 = 0.1;
/// If the evidence exceeds this value (ln of the odds against the sensor), the current is doubtful.
const DOUBTFUL: f64 = 4.0;
/// Highest evidence. It limits how many steps a doubtful sensor must explain until the doubt ends.
const MAX_EVIDENCE: f64 = 8.0;
/// Largest movement of voltages and current just before and just after a step, as a fraction of the step.
const STEADY: f64 = 0.3;
/// Largest ratio of a step's resistance to the usual resistance, or the reverse. Temperature, ageing and the time
/// between two rounds change the resistance by less.
const MAX_FACTOR: f64 = 4.0;
/// Smallest clear step of the voltages (V).
const MIN_STEP_V: f64 = 0.01;
/// Smallest clear step, as a multiple of the standard deviation of a reading and as a multiple of the cells' scatter.
const STEP_SIGMA: f64 = 5.0;
/// Smallest clear step, as a multiple of the resolution of the voltages.
const STEP_READINGS: f64 = 1.5;
/// Smallest clear step, as a multiple of the usual change that the current does not explain.
const STEP_MOVES: f64 = 9.0;
/// Factor by which each round raises or lowers the usual unexplained change, so that it follows the median.
const MOVE_GAIN: f64 = 1.02;
/// Range of the usual unexplained change (V).
const MOVE_V: (f64, f64) = (1e-4, 0.05);
/// Usual unexplained change before the first rounds (V). It exceeds the noise of any sensor.
const FIRST_MOVE_V: f64 = 0.01;
/// Weight of an explained step in the average of ln(resistance).
const RATIO_GAIN: f64 = 0.1;
/// Longest time from the first to the last sample of a round (s). In a longer round, the cells were read at different
/// currents.
const MAX_ROUND_S: f64 = 1.0;
/// A pause of this share of the time between two round starts ends a round, because the next frames belong to the next
/// round.
const PAUSE_SHARE: f64 = 0.75;
/// Longest time between two rounds (s). After a longer pause, the steps are not compared.
const MAX_PAUSE_S: f64 = 60.0;
/// Factor on the number of earlier doubts at each explained step.
const FORGET_DOUBT: f64 = 0.97;
/// Weight of a round in the scatter of the cells.
const SCATTER_GAIN: f64 = 0.02;
/// Common change of the cells (V) after which an unchanged voltage counts as frozen. The limit is at least
/// [`FROZEN_STEPS`] times the resolution of the voltages.
const FROZEN_V: f64 = 0.03;
const FROZEN_STEPS: f64 = 2.5;
/// Assumed resolution of the voltages before the first change (V).
const COARSE_V: f64 = 0.05;
/// Maximum number of cells that are compared.
pub(crate) const MAX_CELLS: usize = 15;
const ROUNDS: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OpenRound {
    /// Voltage of each compared cell (V); `None` = not reported yet.
    voltages_v: [Option<f64>; MAX_CELLS],
    /// Time of the first sample; `None` = no sample yet.
    began: Option<Timestamp>,
    /// Time of the latest sample.
    time: Timestamp,
    latest_a: Option<f64>,
    /// Sum and number of the known currents of the samples (A).
    sum_a: f64,
    known: u32,
}

impl OpenRound {
    fn is_empty(&self) -> bool {
        self.began.is_none()
    }

    fn add(&mut self, place: usize, sample: &CellSample) {
        self.voltages_v[place] = Some(sample.voltage_v);
        self.began.get_or_insert(sample.time);
        (self.time, self.latest_a) = (sample.time, sample.current_a);
        if let Some(current_a) = sample.current_a {
            (self.sum_a, self.known) = (self.sum_a + current_a, self.known + 1);
        }
    }

    fn has_all_of(&self, others: &[Option<f64>; MAX_CELLS]) -> bool {
        self.voltages_v.iter().zip(others).all(|(found, other)| found.is_some() || other.is_none())
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Round {
    time: Timestamp,
    current_a: f64,
    /// Latest current of a cell (A).
    #[serde(default)]
    latest_a: f64,
    /// Common change of the voltages since the previous round (V).
    move_v: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CurrentCheck {
    /// Voltage of each compared cell in the latest round (V); `None` = no reading.
    voltages_v: [Option<f64>; MAX_CELLS],
    /// Time of the first sample of the latest round; `None` = no round.
    #[serde(default)]
    began: Option<Timestamp>,
    #[serde(default, skip_serializing_if = "OpenRound::is_empty")]
    open: OpenRound,
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
    /// Sum of all common changes of the voltages (V).
    path_v: f64,
    /// Smallest change of a single voltage (V).
    resolution_v: f64,
    /// Limit of the sensor, found from repeated readings.
    limit: SensorLimit,
    /// Number of earlier doubts; explained steps reduce it.
    doubts: f64,
    /// Number of cells whose SOC has jumped since all cells last reported.
    #[serde(default)]
    jumped: usize,
    /// Whether the SOC has jumped in a downtime, and an explained step must still confirm the current.
    is_unconfirmed: bool,
    /// Whether the current was contradicted and has still not flowed in both directions.
    is_one_sided: bool,
}

impl Default for CurrentCheck {
    fn default() -> Self {
        Self {
            voltages_v: [None; MAX_CELLS],
            began: None,
            open: OpenRound::default(),
            rounds: [Round::default(); ROUNDS],
            count: 0,
            evidence: 0.0,
            steps: FIRST_STEPS,
            log_ratio: 0.0,
            usual_v: FIRST_MOVE_V,
            scatter_v: FIRST_MOVE_V,
            path_v: 0.0,
            resolution_v: COARSE_V,
            limit: SensorLimit::default(),
            doubts: 0.0,
            jumped: 0,
            is_unconfirmed: false,
            is_one_sided: false,
        }
    }
}

impl CurrentCheck {
    /// Whether the current is doubtful. It is doubtful while it is contradicted. After a contradiction, it stays
    /// doubtful until it has flowed in both directions.
    pub(crate) fn is_doubtful(&self) -> bool {
        self.is_contradicted() || self.is_one_sided
    }

    fn is_contradicted(&self) -> bool {
        self.evidence > DOUBTFUL
    }

    /// Demands an explained step of the current, because the SOC has jumped in a downtime. The cells may have been
    /// used, or a sensor may have failed. Until the step is explained, the SOC is unconfirmed. If no step has ever been
    /// judged, no step is demanded.
    fn demand_step(&mut self) {
        self.is_unconfirmed = self.steps != FIRST_STEPS;
    }

    /// Notes that the SOC of `count` cells has jumped. If the SOC of more than half of all `cells` has jumped since all
    /// cells last reported, demands a step.
    pub(crate) fn note_jumps(&mut self, count: usize, cells: usize) {
        self.jumped = self.jumped.saturating_add(count);
        if count > 0 && 2 * self.jumped.min(cells) > cells {
            self.demand_step();
        }
    }

    /// Called when all cells have reported.
    pub(crate) fn forget_jumps(&mut self) {
        self.jumped = 0;
    }

    /// Whether the SOC has jumped in a downtime, and no step of the current has been explained since.
    pub(crate) fn is_unconfirmed(&self) -> bool {
        self.is_unconfirmed
    }

    /// Handles samples of a round, or of a part of a round. `samples`: the compared cells that have reported, each with
    /// its place (below [`MAX_CELLS`]). `noise_v`: standard deviation of a reading. `ohm`: the model's series
    /// resistance. `rest_a`: largest current at rest.
    pub(crate) fn handle<'a>(
        &mut self,
        samples: impl Iterator<Item = (usize, &'a CellSample)>,
        noise_v: f64,
        ohm: f64,
        rest_a: f64,
    ) {
        let mut has_samples = false;
        for (place, sample) in samples {
            // A late sample of a cell that is missing in the latest round still belongs to that round.
            let is_recent = |began: Timestamp| (0.0..MAX_ROUND_S).contains(&sample.time.since(began));
            if self.open.began.is_none() && self.voltages_v[place].is_none() && self.began.is_some_and(is_recent) {
                self.voltages_v[place] = Some(sample.voltage_v);
                continue;
            }
            let has_paused = |began: Timestamp| {
                let cycle_s = self.began.map_or(f64::INFINITY, |before| began.since(before));
                sample.time.since(self.open.time) > PAUSE_SHARE * cycle_s
            };
            let has_ended = |began: Timestamp| !is_recent(began) || has_paused(began);
            if self.open.voltages_v[place].is_some() || self.open.began.is_some_and(has_ended) {
                self.end_round(noise_v, ohm, rest_a);
            }
            self.open.add(place, sample);
            has_samples = true;
        }
        if has_samples && self.voltages_v != [None; MAX_CELLS] && self.open.has_all_of(&self.voltages_v) {
            self.end_round(noise_v, ohm, rest_a);
        }
    }

    /// Ends the open round and compares it with the rounds before it.
    fn end_round(&mut self, noise_v: f64, ohm: f64, rest_a: f64) {
        let OpenRound { voltages_v, began, time, latest_a, sum_a, known } = std::mem::take(&mut self.open);
        let before_v = std::mem::replace(&mut self.voltages_v, voltages_v);
        self.began = began;
        let (mut moves_v, mut moves) = ([0.0; MAX_CELLS], 0);
        // Skips cells without a reading in the previous round: their change spans more than one round.
        for (before_v, voltage_v) in before_v.into_iter().zip(voltages_v).filter_map(|(a, b)| a.zip(b)) {
            moves_v[moves] = voltage_v - before_v;
            if moves_v[moves] != 0.0 {
                self.resolution_v = self.resolution_v.min(moves_v[moves].abs());
            }
            moves += 1;
        }
        let move_v = common_move(&mut moves_v[..moves]);
        self.path_v += move_v;
        if moves > 1 {
            self.scatter_v += SCATTER_GAIN * (scatter(&mut moves_v[..moves], move_v) - self.scatter_v);
        }
        // If the clock was set back, the time between the rounds is unknown.
        let is_late = self.count > 0 && !(0.0..=MAX_PAUSE_S).contains(&time.since(self.rounds[ROUNDS - 1].time));
        let Some(latest_a) = latest_a.filter(|_| !is_late && moves > 0) else {
            self.count = 0;
            if is_late {
                self.limit.pause();
            }
            return;
        };
        self.rounds.rotate_left(1);
        let current_a = sum_a / f64::from(known);
        self.rounds[ROUNDS - 1] = Round { time, current_a, latest_a, move_v };
        self.count = (self.count + 1).min(ROUNDS);
        if self.count == ROUNDS {
            self.judge(noise_v, ohm * libm::exp(self.log_ratio));
        }
        if self.count >= 2 {
            let is_steady = move_v.abs() <= self.usual_v.max(self.resolution_v);
            let evidence = self.limit.judge(self.rounds[ROUNDS - 2].latest_a, latest_a, is_steady);
            self.add_evidence(evidence);
        }
        self.is_one_sided = !self.limit.has_seen_both(rest_a) && (self.is_one_sided || self.is_contradicted());
    }

    /// Sum of all changes that the cells have in common (V). Only its differences are meaningful.
    pub(crate) fn path_v(&self) -> f64 {
        self.path_v
    }

    /// Whether the voltages have clearly changed in common since [`Self::path_v`] had the value `path_v`. A voltage
    /// that has not changed since then is frozen.
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
        // A current that changes all the time may have been read at another moment than the voltages. In this case, an
        // unexplained step does not count.
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
        (self.voltages_v, self.began, self.open) = ([None; MAX_CELLS], None, OpenRound::default());
        (self.rounds, self.count) = ([Round::default(); ROUNDS], 0);
        self.limit.pause();
    }

    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        let voltages_v = self.voltages_v.into_iter().chain(self.open.voltages_v).flatten();
        bounds::VOLTAGE_V.check_all("a voltage of the check of the current", voltages_v)?;
        let OpenRound { latest_a, sum_a, .. } = self.open;
        bounds::NUMBER.check_all("a current of the check of the current", [sum_a])?;
        let currents_a = self.rounds.iter().flat_map(|round| [round.current_a, round.latest_a]).chain(latest_a);
        bounds::CURRENT_A.check_all("a current of the check of the current", currents_a)?;
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
            self.path_v,
            self.resolution_v,
            self.doubts,
        ];
        bounds::NUMBER.check_all("the check of the current", state)?;
        self.limit.check()?;
        InvalidState::unless(self.count <= ROUNDS, "rounds of the check of the current", self.count as f64, "at most 4")
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.began = self.began.map(|began| began.plus_nanos(by_nanos));
        self.open.began = self.open.began.map(|began| began.plus_nanos(by_nanos));
        self.open.time = self.open.time.plus_nanos(by_nanos);
        self.rounds.iter_mut().for_each(|round| round.time = round.time.plus_nanos(by_nanos));
    }
}

/// The change that at least two thirds of the cells reach or exceed in the same direction (V); 0 = there is no such
/// change.
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
mod tests;
