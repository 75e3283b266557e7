//! Passes measured and estimated values to their alarm rules every 0.1 s. The learning stage passes the learned values.
//!
//! In: the states of all stages. Out: values for the [alarming](crate::monitor::stage::alarming) stage. If a value
//! combines several inputs or cells and some of them are unknown, the value is passed as a bound. A bound can raise an
//! alarm but not clear one. Fast path: if the worst value trips no threshold, the other values are only refreshed for
//! display, once a second.

use super::Stages;
use crate::alarm::{AlarmInput, Observation, Rule};
use crate::cell_faults::CellFaultKind;
use crate::filter::ScalarGaussian;
use crate::monitor::clock::HOUSEKEEPING_S;
use crate::monitor::message::{EventKind, Outputs};
use crate::monitor::stage::alarming::take_show_due;
use crate::monitor::stage::estimation::Estimation;
use crate::monitor::stage::publisher::learned;
use crate::quantity::{CellIndex, Channel, Reading, Timestamp};
use crate::sample::CellSample;

const CELL_LEARNED: [Rule; 5] =
    [Rule::CapacityLow, Rule::UsableCapacityLow, Rule::ResistanceHigh, Rule::CellLeak, Rule::ConnectionResistance];

/// Values for the two alarm rules about an input.
#[derive(Debug, Clone, Copy)]
struct InputObservation {
    silence_s: Observation,
    bad_share: Observation,
}

impl InputObservation {
    fn worst(self, other: Self) -> Self {
        Self { silence_s: worst(self.silence_s, other.silence_s), bad_share: worst(self.bad_share, other.bad_share) }
    }
}

/// The larger of two values. If either value is unknown or a bound, the result is a bound.
fn worst(a: Observation, b: Observation) -> Observation {
    let is_known = |observation: &Observation| observation.value.is_some() && !observation.is_bound;
    Observation {
        value: a.value.map_or(b.value, |a| Some(b.value.map_or(a, |b| a.max(b)))),
        std: None,
        is_bound: !is_known(&a) || !is_known(&b),
        is_new: a.is_new || b.is_new,
    }
}

/// The SOC of the emptiest and the fullest cell.
#[derive(Debug, Clone, Copy)]
struct SocSpread {
    lowest: ScalarGaussian,
    highest: ScalarGaussian,
    /// Whether every cell is included.
    is_whole: bool,
}

impl Stages {
    /// Passes the values of the inputs and the pack to their rules, and marks the learned values as valid or invalid.
    pub(crate) fn watch(&mut self, now: Timestamp, out: &mut Outputs) {
        let any_lost = self.sampling.sampler.any_lost();
        let worst = self.sampling.sampler.worst_input(now);
        self.watch_inputs(now, worst, out);
        self.watch_learned(now, any_lost, out);
        self.watch_pack(now, worst.is_some() && !any_lost, out);
        self.refresh_thermal(now, out);
    }

    /// Checks a reading for a thermal event, and passes new evidence to the rule at once.
    #[inline]
    pub(crate) fn watch_reading(&mut self, now: Timestamp, reading: &Reading, out: &mut Outputs) {
        if let Some((cell, evidence)) = self.findings.watch_reading(now, reading, (&self.sampling, &self.estimation)) {
            self.publisher(now, out).observe(Rule::ThermalEvent, Some(cell), Observation::new(Some(evidence)));
        }
    }

    /// Passes each cell's evidence of a thermal event to the rule, every half minute.
    fn refresh_thermal(&mut self, now: Timestamp, out: &mut Outputs) {
        for (cell, evidence) in self.findings.refresh_thermal(now, (&self.sampling, &self.estimation)) {
            self.publisher(now, out).observe(Rule::ThermalEvent, Some(cell), Observation::new(evidence));
        }
    }

    /// Passes the states of the interfaces and the files to their rules, and publishes all alarms.
    pub(crate) fn watch_computer(&mut self, now: Timestamp, bus_fault: Observation, out: &mut Outputs) {
        let store = self.alarming.state.store.failing(now);
        let mut publisher = self.publisher(now, out);
        publisher.observe(Rule::BusFault, None, bus_fault);
        publisher.observe(Rule::StoreFailed, None, store);
        publisher.apply(AlarmInput::Poll);
        publisher.publish_alarms();
        // The trouble codes also report whether all values are known, which may change without an alarm.
        publisher.update_trouble_codes();
    }

    /// Passes the silence and the share of bad readings of every input to the two rules about inputs. A cell voltage
    /// counts for its cell, and every other input counts for the pack.
    fn watch_inputs(&mut self, now: Timestamp, worst: Option<(f64, f64)>, out: &mut Outputs) {
        let engine = &self.alarming.engine;
        let quiet = |(silence_s, share): (f64, f64)| {
            engine.is_quiet(Rule::InputMissing, silence_s) && engine.is_quiet(Rule::InputImplausible, share)
        };
        let has_second_sender = self.sampling.has_second_sender;
        if !out.want_alarm_inputs && !has_second_sender && worst.is_some_and(quiet) {
            if take_show_due(&mut self.alarming.state.inputs_shown_at, now) {
                self.show_inputs(now);
            }
            return;
        }
        let mut pack: Option<InputObservation> = None;
        for index in 0..self.sampling.sampler.channels().len() {
            let channel = self.sampling.sampler.channels()[index];
            let input = self.input_observation(now, channel);
            if let Channel::CellVoltage(cell) = channel {
                self.observe_input(now, Some(cell), input, out);
            } else {
                pack = Some(pack.map_or(input, |pack| pack.worst(input)));
            }
        }
        if let Some(mut pack) = pack {
            if has_second_sender {
                // If a second node sends a message of the pack, a reading may come from the wrong node, so no reading
                // counts as good.
                pack.bad_share = Observation::new(Some(1.0));
            }
            self.observe_input(now, None, pack, out);
        }
    }

    /// Refreshes the displayed values of the inputs. Called while no value changes an alarm.
    fn show_inputs(&mut self, now: Timestamp) {
        let (sampler, engine) = (&self.sampling.sampler, &mut self.alarming.engine);
        let (mut longest_s, mut worst_share) = (0.0_f64, 0.0_f64);
        for &channel in sampler.channels() {
            let silence_s = sampler.silence_s(channel, now).unwrap_or(0.0);
            let share = sampler.bad_share(channel).unwrap_or(0.0);
            if let Channel::CellVoltage(cell) = channel {
                engine.show(Rule::InputMissing, Some(cell), silence_s);
                engine.show(Rule::InputImplausible, Some(cell), share);
            } else {
                (longest_s, worst_share) = (longest_s.max(silence_s), worst_share.max(share));
            }
        }
        engine.show(Rule::InputMissing, None, longest_s);
        engine.show(Rule::InputImplausible, None, worst_share);
    }

    fn input_observation(&self, now: Timestamp, channel: Channel) -> InputObservation {
        let sampler = &self.sampling.sampler;
        let silence_s = sampler.silence_s(channel, now);
        // An input without a reading since the last waking may still be starting, so only a long silence counts.
        let has_reading = sampler.has_input_since_waking(channel);
        let is_missing = |silence: &f64| self.alarming.missing_after_s.is_some_and(|limit| *silence > limit);
        // During a silence, the share of bad readings is out of date.
        let share = sampler.bad_share(channel).filter(|_| has_reading && !sampler.is_silent(channel, now));
        InputObservation {
            silence_s: Observation::new(silence_s.filter(|silence| has_reading || is_missing(silence))),
            bad_share: Observation {
                value: share,
                is_new: silence_s.is_some_and(|silence_s| has_reading && silence_s <= HOUSEKEEPING_S),
                ..Observation::default()
            },
        }
    }

    fn observe_input(&mut self, now: Timestamp, cell: Option<CellIndex>, input: InputObservation, out: &mut Outputs) {
        let mut publisher = self.publisher(now, out);
        publisher.observe(Rule::InputMissing, cell, input.silence_s);
        publisher.observe(Rule::InputImplausible, cell, input.bad_share);
    }

    /// Marks a cell's learned values as valid only while inputs can renew them: no input of the cell is lost, and the
    /// cell's channel is not faulty.
    fn watch_learned(&mut self, now: Timestamp, any_lost: bool, out: &mut Outputs) {
        if self.alarming.state.knows_all_valid && !out.want_alarm_inputs && !any_lost {
            return;
        }
        let (mut all_valid, mut all_started) = (true, true);
        for cell in self.estimation.cell_indices() {
            let valid = self.sampling.inputs_valid(cell, now);
            let is_started = self.estimation.bank.is_started(cell.index());
            all_valid &= valid;
            all_started &= is_started;
            let is_faulty = self.alarming.faulty_channels.contains(&cell);
            let mut publisher = self.publisher(now, out);
            for rule in CELL_LEARNED {
                publisher.apply(AlarmInput::InputsValid { rule, cell: Some(cell), valid: valid && !is_faulty });
            }
            if !valid || !is_started || is_faulty {
                publisher.restate(Rule::EstimateUntrusted, Some(cell), Observation::default());
            }
            if !valid {
                publisher.observe(Rule::ChannelFaulty, Some(cell), Observation::default());
            }
        }
        let mut publisher = self.publisher(now, out);
        for rule in [Rule::RechargePeriodLow, Rule::RemainingLifeLow] {
            publisher.apply(AlarmInput::InputsValid { rule, cell: None, valid: all_valid });
        }
        publisher.publish_alarms();
        self.alarming.state.knows_all_valid = all_valid && all_started;
    }

    fn watch_pack(&mut self, now: Timestamp, all_fresh: bool, out: &mut Outputs) {
        let spread = self.soc_spread(now, all_fresh);
        let soc_low = spread.map(|spread| learned(spread.lowest).of_part(!spread.is_whole));
        let imbalance = spread.filter(|_| self.estimation.cells() > 1).map(|spread| {
            let SocSpread { lowest, highest, is_whole } = spread;
            let std = (highest.variance + lowest.variance).sqrt();
            Observation::new(Some(highest.mean - lowest.mean)).with_std(std).of_part(!is_whole)
        });
        let hottest = self.sampling.sampler.temperature_range_c(now);
        let hottest = hottest.map(|it| Observation::new(Some(it.highest)).of_part(!it.is_whole));
        let disagreement = self.disagreement(now);
        let mut publisher = self.publisher(now, out);
        publisher.observe(Rule::SocLow, None, soc_low.unwrap_or_default());
        publisher.observe(Rule::CellImbalance, None, imbalance.unwrap_or_default());
        publisher.observe(Rule::TemperatureHigh, None, hottest.unwrap_or_default());
        publisher.observe(Rule::BmsDisagrees, None, disagreement);
    }

    /// Lowest and highest SOC of the cells with a fresh estimate and a channel without a fault; `None` if there is no
    /// such cell.
    fn soc_spread(&self, now: Timestamp, all_fresh: bool) -> Option<SocSpread> {
        let bank = &self.estimation.bank;
        if all_fresh
            && self.alarming.faulty_channels.is_empty()
            && let Some((lowest, highest)) = bank.extremes()
        {
            return Some(SocSpread { lowest, highest, is_whole: true });
        }
        let (mut spread, mut known): (Option<SocSpread>, usize) = (None, 0);
        for cell in self.estimation.cell_indices() {
            let is_fresh = self.sampling.sampler.is_fresh(self.sampling.voltage_channel(cell), now);
            // After a downtime, voltages are not used before the first current reading. Until then, the SOC dates from
            // before the downtime.
            let is_of_cell = !bank.is_carried_over(cell.index()) && !self.alarming.faulty_channels.contains(&cell);
            let is_present = is_fresh && is_of_cell;
            let Some(soc) = bank.soc(cell.index()).filter(|_| is_present) else { continue };
            known += 1;
            spread = Some(match spread {
                None => SocSpread { lowest: soc, highest: soc, is_whole: false },
                Some(so_far) => SocSpread {
                    lowest: if soc.mean < so_far.lowest.mean { soc } else { so_far.lowest },
                    highest: if soc.mean > so_far.highest.mean { soc } else { so_far.highest },
                    is_whole: false,
                },
            });
        }
        spread.map(|spread| SocSpread { is_whole: known == self.estimation.cells(), ..spread })
    }

    /// Disagreement with the BMS: the larger of the absolute differences between reported and estimated SOC, and
    /// between reported and estimated SOH.
    fn disagreement(&self, now: Timestamp) -> Observation {
        let config = self.sampling.sampler.config();
        let soc = self.learning.state.pack.map(|pack| ScalarGaussian::from_std(pack.soc, pack.soc_std));
        let weakest = if config.reported_soh.is_some() { self.learning.weakest() } else { None };
        let soh = weakest.map(|(cell, capacity)| {
            let rated_ah = self.estimation.bank.model(cell).rated_capacity_ah;
            ScalarGaussian::from_std(capacity.mean / rated_ah, capacity.std() / rated_ah)
        });
        let pairs = [
            (config.reported_soc.is_some(), Channel::ReportedSoc, soc),
            (config.reported_soh.is_some(), Channel::ReportedSoh, soh),
        ];
        let mut worst = Observation::default();
        for (_, channel, ours) in pairs.into_iter().filter(|(configured, ..)| *configured) {
            let reported = self.sampling.sampler.reported(channel, now);
            let Some((reported, ours)) = reported.zip(ours) else {
                worst.is_bound = true;
                continue;
            };
            let difference = (reported - ours.mean).abs();
            if worst.value.is_none_or(|value| difference > value) {
                worst.value = Some(difference);
                worst.std = Some(ours.std());
            }
        }
        Observation { is_new: true, ..worst }
    }

    /// Whether the innovations of all cells change neither an alarm nor the trust in a cell. If so, the innovations
    /// only need to be displayed.
    pub(crate) fn are_innovations_quiet(&self, out: &Outputs) -> bool {
        let Estimation { all_trusted, any_mismatched, .. } = self.estimation;
        let is_known_good = all_trusted && !any_mismatched && !self.estimation.is_doubtful();
        is_known_good && !out.want_alarm_inputs && {
            let bank = &self.estimation.bank;
            let worst = bank.worst_nis();
            worst <= bank.own_config().consistency.limit
                && bank.are_all_plausible()
                && self.alarming.engine.is_quiet(Rule::EstimateUntrusted, worst)
        }
    }

    /// Refreshes the displayed innovations at most once a second. The caller makes sure that they change no alarm.
    pub(crate) fn show_innovations(&mut self, now: Timestamp, samples: &[CellSample]) {
        if !take_show_due(&mut self.alarming.state.innovations_shown_at, now) {
            return;
        }
        for cell in samples.iter().map(|sample| sample.cell) {
            if self.sampling.inputs_valid(cell, now) {
                let contradiction = self.estimation.contradiction(cell.index());
                self.alarming.engine.show(Rule::EstimateUntrusted, Some(cell), contradiction);
            }
        }
    }

    /// Judges whether a cell's innovations agree with their covariance, and reports a change as an event. If the
    /// innovations are recent (`is_current`), also passes them to their rule.
    pub(crate) fn judge_trust(&mut self, now: Timestamp, cell: CellIndex, is_current: bool, out: &mut Outputs) {
        let mean_nis = self.estimation.contradiction(cell.index());
        let change = self.estimation.judge_trust(cell);
        // Without current readings, the filter continues, but its innovations do not test the cell's model.
        let is_observed = is_current && self.sampling.inputs_valid(cell, now);
        let mut publisher = self.publisher(now, out);
        if let Some(trusted) = change {
            publisher.event(EventKind::Trust { cell, trusted, mean_nis });
        }
        if is_observed {
            publisher.observe(Rule::EstimateUntrusted, Some(cell), Observation::new(Some(mean_nis)));
        }
    }

    /// Passes restored values to their rules. Measured values are included only if the downtime was short
    /// (`was_brief`). `is_new`: true for a pack that returned, because its values are new to the rules; false after a
    /// restart.
    pub(crate) fn restate_known(&mut self, now: Timestamp, was_brief: bool, is_new: bool, out: &mut Outputs) {
        let old = |value: ScalarGaussian| Observation { is_new, ..learned(value) };
        for index in self.estimation.cell_indices() {
            let (cell, index) = (Some(index), index.index());
            let capacity = self.learning.learned_capacity(index);
            let is_estimated = was_brief && self.estimation.bank.soc(index).is_some();
            let mean_nis = is_estimated.then(|| self.estimation.contradiction(index));
            let health = &self.learning.cells[index];
            let known = [
                (Rule::CapacityLow, capacity.map(old)),
                (
                    Rule::EstimateUntrusted,
                    mean_nis.map(|nis| Observation { is_new: false, ..Observation::new(Some(nis)) }),
                ),
                (Rule::ResistanceHigh, health.discharge_resistance.map(old)),
                (Rule::UsableCapacityLow, health.usable.map(old)),
            ];
            let mut publisher = self.publisher(now, out);
            for (rule, observation) in known {
                if let Some(observation) = observation {
                    publisher.restate(rule, cell, observation);
                }
            }
        }
        self.publish_diagnosis(now, is_new, out);
        let period = self.learning.known_recharge_period();
        let (learning, mut publisher) = self.learning_and_publisher(now, out);
        if let Some(period) = period {
            publisher.observe(Rule::RechargePeriodLow, None, Observation { is_new, ..period });
        }
        learning.lives.observe(is_new, &mut publisher);
    }

    /// Passes the cell-fault detector's results for a row (a few minutes of samples) to the rules about single cells.
    /// If the results are new (`is_new`), skips the cells whose inputs are lost. The rules of these cells wait for the
    /// next row.
    pub(crate) fn publish_diagnosis(&mut self, now: Timestamp, is_new: bool, out: &mut Outputs) {
        self.note_faulty_channels();
        let diagnosis = &self.findings.diagnosis;
        let sizes = diagnosis.sizes([CellFaultKind::Leak, CellFaultKind::Contact]);
        for (cell, [leak, contact]) in (0..).map(CellIndex).zip(sizes) {
            if is_new && !self.sampling.inputs_valid(cell, now) {
                continue;
            }
            let fault = self.findings.diagnosis.has_channel_fault(cell);
            let fault = Observation::new(fault.map(|is_faulty| if is_faulty { 1.0 } else { 0.0 }));
            let mut publisher = self.publisher(now, out);
            publisher.observe(Rule::ChannelFaulty, Some(cell), Observation { is_new, ..fault });
            for (rule, size) in [(Rule::CellLeak, leak), (Rule::ConnectionResistance, contact)] {
                let value = Observation { is_new, ..size.map_or_else(Observation::default, learned) };
                publisher.observe(rule, Some(cell), value);
            }
        }
    }

    /// Updates the list of cells with a faulty channel. Rules that depend on a cell's voltage ignore these cells.
    pub(crate) fn note_faulty_channels(&mut self) {
        let faulty = self.findings.faulty_channels();
        if faulty != self.alarming.faulty_channels {
            self.alarming.faulty_channels = faulty;
            self.alarming.state.knows_all_valid = false;
        }
    }
}
