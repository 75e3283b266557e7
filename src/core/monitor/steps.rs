//! From samples to estimates: cells report in rounds, and the steps of a round are made together.
//!
//! A sample waits until every cell has one, or its own has its second, or anything asks for estimates. What an estimate is
//! does not depend on how long it waited: a step knows its sample's time and charge, and no other cell.

use super::alarms::take_show_due;
use super::{Consumed, Event, EventKind, Monitor, Outputs};
use crate::alarm::{Observation, Rule};
use crate::cell::{CellStep, EstimatorBank};
use crate::health::CellCondition;
use crate::quantity::CellIndex;
use crate::sample::CellSample;

/// Which cells have reported since the pack's values were last combined.
#[derive(Debug)]
pub(super) struct CellBatch {
    /// Samples that wait for their step, in the order in which they came, at most one of a cell.
    pub(super) waiting: Vec<CellSample>,
    has_reported: Vec<bool>,
    reported: usize,
}

impl CellBatch {
    pub(super) fn new(cells: usize) -> Self {
        Self { waiting: Vec::with_capacity(cells), has_reported: vec![false; cells], reported: 0 }
    }

    /// One that goes on: which cells have reported, and what of it waits.
    pub(super) fn resume(has_reported: Vec<bool>, waiting: Vec<CellSample>) -> Self {
        let reported = has_reported.iter().filter(|&&reported| reported).count();
        Self { waiting, has_reported, reported }
    }

    pub(super) fn has_reported(&self, cell: usize) -> bool {
        self.has_reported[cell]
    }

    /// How many have.
    pub(super) fn reported(&self) -> usize {
        self.reported
    }

    /// Whether a sample of the cell belongs to this round: it has sent none yet, and others have to send theirs.
    #[inline]
    pub(super) fn awaits(&self, cell: CellIndex) -> bool {
        !self.is_complete() && self.has_reported.get(cell.index()) == Some(&false)
    }

    /// Adds a sample that is [awaited](Self::awaits).
    #[inline]
    pub(super) fn add(&mut self, sample: CellSample) {
        debug_assert!(!self.has_reported[sample.cell.index()], "a second sample of {:?}", sample.cell);
        self.has_reported[sample.cell.index()] = true;
        self.reported += 1;
        self.waiting.push(sample);
    }

    #[inline]
    pub(super) fn is_complete(&self) -> bool {
        self.reported == self.has_reported.len()
    }

    /// The next begins; the steps of the last are made.
    pub(super) fn begin(&mut self) {
        debug_assert!(self.waiting.is_empty(), "{} samples whose step was not made", self.waiting.len());
        self.has_reported.fill(false);
        self.reported = 0;
    }
}

impl Monitor {
    /// Cells mostly report in rounds: their steps are made together once all have reported, or one does for the second time.
    pub(super) fn note_sample(&mut self, sample: CellSample, out: &mut Outputs) {
        if !self.round.awaits(sample.cell) {
            self.close_round(out);
        }
        self.round.add(sample);
        if self.round.is_complete() {
            self.close_round(out);
        }
    }

    /// The round is over: the pack's values.
    pub(super) fn close_round(&mut self, out: &mut Outputs) {
        self.make_steps(out);
        self.round.begin();
        self.combine_pack(out);
    }

    /// Makes the steps of the cells whose voltages have come since the last time, without waiting for the others. The
    /// core does so by itself before anything that asks for estimates; a driver does after its last input.
    pub fn settle(&mut self, out: &mut Outputs) {
        let told = out.events.len();
        self.make_steps(out);
        self.statistics.note_events(&out.events[told..]);
        self.due = self.find_due();
    }

    /// As [`settle`](Self::settle), within an input.
    pub(super) fn make_steps(&mut self, out: &mut Outputs) {
        self.step_waiting(true, out);
    }

    /// The same; `tells`: the rule about innovations hears of them.
    pub(super) fn step_waiting(&mut self, tells: bool, out: &mut Outputs) {
        if self.round.waiting.is_empty() {
            return;
        }
        let mut waiting = std::mem::take(&mut self.round.waiting);
        for sample in &waiting {
            let step = self.next_step(sample);
            self.estimators.add(sample.cell.index(), &step);
        }
        self.estimators.step();
        self.statistics.note_voltages(waiting.iter().map(|sample| self.estimators.result(sample.cell.index())));
        let is_quiet = self.all_trusted && !out.want_alarm_inputs && {
            let worst = self.estimators.worst_nis();
            worst <= self.config.estimator.consistency_limit && self.alarms.is_quiet(Rule::EstimateUntrusted, worst)
        };
        for sample in &waiting {
            self.take_estimate(sample, out);
            if !is_quiet {
                self.judge_trust(sample.cell, tells, out);
            }
        }
        if is_quiet && tells && take_show_due(&mut self.nis_shown_at, self.now) {
            self.show_trust(&waiting);
        }
        waiting.clear();
        self.round.waiting = waiting;
        let estimators = &self.estimators;
        self.scratch.after_gap.drain(..).for_each(|cell| self.learner.move_mark(cell, end_state(estimators, cell)));
    }

    /// What happened to a cell between the sample before and this one.
    fn next_step(&mut self, sample: &CellSample) -> CellStep {
        let index = sample.cell.index();
        let progress = &mut self.progress[index];
        let (charge, unmeasured) = (sample.charge_as, sample.unmeasured_s);
        let now = Consumed { time: sample.time, charge_as: charge, unmeasured_s: unmeasured };
        let (mut measured_s, mut charge_as, mut unmeasured_s) = (0.0, 0.0, 0.0);
        // Before the first reading, and where a record goes on after it is unknown how long, nobody measured for ever.
        let mut gap_s = f64::INFINITY;
        if let Some(before) = progress.consumed.replace(now) {
            charge_as = charge - before.charge_as;
            unmeasured_s = unmeasured - before.unmeasured_s;
            measured_s = (sample.time.since(before.time) - unmeasured_s).max(0.0);
            gap_s = unmeasured_s;
        }
        if self.learner.observe(index, sample.time, sample.temperature_c, measured_s, gap_s) {
            self.scratch.after_gap.push(index);
        }
        // What charges and discharges have shown to be the sensor's, not the cell's.
        let offset_a = self.learner.current_offset_a(index);
        CellStep {
            measured_s,
            charge_as: charge_as - offset_a * measured_s,
            unmeasured_s,
            current_a: sample.current_a.map(|current_a| current_a - offset_a),
            temperature_c: sample.temperature_c,
            ambient_c: self.config.sample.ambient_c,
            voltage_v: sample.voltage_v,
        }
    }

    /// What follows from a cell's step.
    fn take_estimate(&mut self, sample: &CellSample, out: &mut Outputs) {
        let index = sample.cell.index();
        self.progress[index].sample = Some(*sample);
        if self.estimators.result(index).reset {
            out.events.push(Event { time: self.now, kind: EventKind::FilterReset { cell: sample.cell } });
            // The SOC jumped: what it crosses on the way is no charging.
            self.recharge.discard();
        }
        self.note_taper(sample);
        if out.want_estimates {
            out.estimates.extend(self.estimate(index));
        }
    }

    /// Shows innovations that change no alarm.
    fn show_trust(&mut self, samples: &[CellSample]) {
        for cell in samples.iter().map(|sample| sample.cell) {
            if self.inputs_valid(cell) {
                self.alarms.show(Rule::EstimateUntrusted, Some(cell), self.estimators.mean_nis(cell.index()));
            }
        }
    }

    /// Whether the filter's innovations agree with its covariance; told on change.
    fn judge_trust(&mut self, cell: CellIndex, tells: bool, out: &mut Outputs) {
        let slot = &mut self.cells[cell.index()];
        let mean_nis = self.estimators.mean_nis(cell.index());
        let trusted = mean_nis <= self.config.estimator.consistency_limit;
        if trusted != slot.trusted {
            slot.trusted = trusted;
            self.all_trusted = self.cells.iter().all(|cell| cell.trusted);
            out.events.push(Event { time: self.now, kind: EventKind::Trust { cell, trusted, mean_nis } });
        }
        // Without a current the filter goes on, but its innovations say nothing about its model.
        if tells && self.inputs_valid(cell) {
            self.observe_alarm(Rule::EstimateUntrusted, Some(cell), Observation::new(Some(mean_nis)), out);
        }
    }
}

/// Where a half-cycle that begins or ends now would begin or end for a cell.
pub(super) fn end_state(estimators: &EstimatorBank, index: usize) -> CellCondition {
    CellCondition { soc: estimators.filtered_soc(index), load_v: estimators.load_v(index) }
}
