//! Values for the alarm rules, what becomes of the alarms, and what people ask of them.
//!
//! Learned values go to the rules when they are learned; everything else is looked at every 0.1 s. A value some part of
//! which is not known goes in as a bound: it can raise an alarm, but never say that all is well.

use super::{Command, Event, EventKind, Monitor, MonitorConfig, Outputs, Source};
use crate::alarm::{Alarm, AlarmChange, AlarmInput, Observation, Outcome, Rule, Selector, Severity};
use crate::can::Frame;
use crate::can::encode::{self, CommandFields};
use crate::filter::ScalarGaussian;
use crate::health::RechargeAlarm;
use crate::quantity::{BusIndex, CellIndex, Channel, Timestamp};

/// Period of the work that only watches the clock (staleness, debounce), s.
pub(super) const HOUSEKEEPING_S: f64 = 0.1;
/// Values that change nothing are shown this often, s.
const SHOW_S: f64 = 1.0;
/// Command frames that are not obeyed are told at most this often, s.
const BAD_COMMAND_S: f64 = 1.0;

/// What the rules about inputs look at.
#[derive(Debug, Clone, Copy)]
struct InputState {
    silence_s: Observation,
    bad_share: Observation,
}

impl InputState {
    fn worst(self, other: Self) -> Self {
        Self { silence_s: worst(self.silence_s, other.silence_s), bad_share: worst(self.bad_share, other.bad_share) }
    }
}

/// The larger of two values; a bound where one is not known.
fn worst(a: Observation, b: Observation) -> Observation {
    let is_known = |seen: &Observation| seen.value.is_some() && !seen.is_bound;
    Observation {
        value: a.value.map_or(b.value, |a| Some(b.value.map_or(a, |b| a.max(b)))),
        std: None,
        is_bound: !is_known(&a) || !is_known(&b),
        is_new: a.is_new || b.is_new,
    }
}

/// The SOC of the emptiest and the fullest cell.
#[derive(Debug, Clone, Copy)]
struct Spread {
    lowest: ScalarGaussian,
    highest: ScalarGaussian,
    /// Whether every cell is among them.
    is_whole: bool,
}

/// Whether values that change nothing are to be shown again, last shown at `shown_at`; when they are, that is now.
pub(super) fn take_show_due(shown_at: &mut Timestamp, now: Timestamp) -> bool {
    let is_due = now.since(*shown_at).abs() >= SHOW_S;
    if is_due {
        *shown_at = now;
    }
    is_due
}

impl MonitorConfig {
    /// Silence that the strictest threshold calls missing, s.
    fn missing_after_s(&self) -> Option<f64> {
        let rules = self.rules.iter().filter(|rule| rule.rule == Rule::InputMissing);
        rules.map(|rule| rule.threshold).min_by(f64::total_cmp)
    }
}

impl Monitor {
    /// Everything the rules compare that is not learned at a transition.
    pub(super) fn watch(&mut self, out: &mut Outputs) {
        let any_lost = self.sampler.any_lost();
        let worst = self.sampler.worst_input(self.now);
        self.watch_inputs(worst, out);
        self.watch_learned(any_lost, out);
        self.watch_pack(worst.is_some() && !any_lost, out);
        let (fault_s, is_whole) = self.buses.worst_s(self.now, self.config.interfaces);
        let bus = Observation { is_bound: !is_whole, ..Observation::new(fault_s) };
        self.observe_alarm(Rule::BusFault, None, bus, out);
        let store = Observation::new(self.store.failing_s(self.now));
        self.observe_alarm(Rule::StoreFailed, None, store, out);
        self.tell_alarms(AlarmInput::Poll, out);
        self.report_alarms(out);
        // Whether every value is known may have changed without an alarm.
        self.tell_j1939();
    }

    /// Silence and plausibility of every input, for the rules about them: a cell's own voltage under its number,
    /// what belongs to no cell under the pack.
    fn watch_inputs(&mut self, worst: Option<(f64, f64)>, out: &mut Outputs) {
        let quiet = |(silence_s, share): (f64, f64)| {
            self.alarms.is_quiet(Rule::InputMissing, silence_s) && self.alarms.is_quiet(Rule::InputImplausible, share)
        };
        if !out.want_alarm_inputs && worst.is_some_and(quiet) {
            if take_show_due(&mut self.inputs_shown_at, self.now) {
                self.show_inputs();
            }
            return;
        }
        let mut pack: Option<InputState> = None;
        for index in 0..self.sampler.channels().len() {
            let channel = self.sampler.channels()[index];
            let state = self.input_state(channel);
            if let Channel::CellVoltage(cell) = channel {
                self.observe_input(Some(cell), state, out);
            } else {
                pack = Some(pack.map_or(state, |pack| pack.worst(state)));
            }
        }
        if let Some(pack) = pack {
            self.observe_input(None, pack, out);
        }
    }

    /// The same while something has come of every input, and nothing of it changes an alarm.
    fn show_inputs(&mut self) {
        let (mut longest_s, mut worst_share) = (0.0_f64, 0.0_f64);
        for &channel in self.sampler.channels() {
            let silence_s = self.sampler.silence_s(channel, self.now).unwrap_or(0.0);
            let share = self.sampler.bad_share(channel).unwrap_or(0.0);
            if let Channel::CellVoltage(cell) = channel {
                self.alarms.show(Rule::InputMissing, Some(cell), silence_s);
                self.alarms.show(Rule::InputImplausible, Some(cell), share);
            } else {
                (longest_s, worst_share) = (longest_s.max(silence_s), worst_share.max(share));
            }
        }
        self.alarms.show(Rule::InputMissing, None, longest_s);
        self.alarms.show(Rule::InputImplausible, None, worst_share);
    }

    fn input_state(&self, channel: Channel) -> InputState {
        let silence_s = self.sampler.silence_s(channel, self.now);
        // Since waking nothing may have come yet: that is neither silence nor its end.
        let heard = self.sampler.has_input_since_waking(channel);
        let beyond = |silence: &f64| heard || self.config.missing_after_s().is_some_and(|limit| *silence > limit);
        // The share of what came before the silence says nothing about what does not come.
        let share = self.sampler.bad_share(channel).filter(|_| heard && !self.sampler.is_silent(channel, self.now));
        InputState {
            silence_s: Observation::new(silence_s.filter(beyond)),
            bad_share: Observation {
                value: share,
                is_new: silence_s.is_some_and(|silence_s| heard && silence_s <= HOUSEKEEPING_S),
                ..Observation::default()
            },
        }
    }

    fn observe_input(&mut self, cell: Option<CellIndex>, state: InputState, out: &mut Outputs) {
        self.observe_alarm(Rule::InputMissing, cell, state.silence_s, out);
        self.observe_alarm(Rule::InputImplausible, cell, state.bad_share, out);
    }

    /// What was learned of a cell stands only while its inputs can renew it.
    fn watch_learned(&mut self, any_lost: bool, out: &mut Outputs) {
        if self.all_valid_told && !out.want_alarm_inputs && !any_lost {
            return;
        }
        let (mut all_valid, mut all_started) = (true, true);
        for (index, cell) in (0..self.config.sample.cells).map(CellIndex).enumerate() {
            let valid = self.inputs_valid(cell);
            all_valid &= valid;
            for rule in [Rule::CapacityLow, Rule::UsableCapacityLow, Rule::ResistanceHigh] {
                self.tell_alarms(AlarmInput::InputsValid { rule, cell: Some(cell), valid }, out);
            }
            let is_started = self.estimators.is_started(index);
            all_started &= is_started;
            if !valid || !is_started {
                self.observe_alarm(Rule::EstimateUntrusted, Some(cell), Observation::default(), out);
            }
        }
        for rule in [Rule::RechargePeriodLow, Rule::RemainingLifeLow] {
            self.tell_alarms(AlarmInput::InputsValid { rule, cell: None, valid: all_valid }, out);
        }
        self.report_alarms(out);
        self.all_valid_told = all_valid && all_started;
    }

    /// Whether what an estimate of a cell is made of comes in.
    pub(super) fn inputs_valid(&self, cell: CellIndex) -> bool {
        let is_lost = |channel| self.sampler.is_lost(channel, self.now);
        !is_lost(Channel::Current) && !is_lost(self.voltage_channel(cell))
    }

    /// The channel a cell's voltage comes on.
    pub(super) fn voltage_channel(&self, cell: CellIndex) -> Channel {
        match self.config.sample.voltage_source {
            crate::sample::VoltageSource::Cells => Channel::CellVoltage(cell),
            crate::sample::VoltageSource::PackTotal { .. } => Channel::PackVoltage,
        }
    }

    fn watch_pack(&mut self, all_fresh: bool, out: &mut Outputs) {
        let spread = self.spread(all_fresh);
        let soc_low = spread.map_or(Observation::default(), |spread| Observation {
            is_bound: !spread.is_whole,
            ..Observation::new(Some(spread.lowest.mean)).with_std(spread.lowest.std())
        });
        self.observe_alarm(Rule::SocLow, None, soc_low, out);
        let imbalance = spread.filter(|_| self.cells.len() > 1).map_or(Observation::default(), |spread| Observation {
            is_bound: !spread.is_whole,
            ..Observation::new(Some(spread.highest.mean - spread.lowest.mean))
                .with_std((spread.highest.variance + spread.lowest.variance).sqrt())
        });
        self.observe_alarm(Rule::CellImbalance, None, imbalance, out);
        let hottest = self.sampler.hottest_c(self.now).map_or(Observation::default(), |(hottest_c, is_whole)| {
            Observation { is_bound: !is_whole, ..Observation::new(Some(hottest_c)) }
        });
        self.observe_alarm(Rule::TemperatureHigh, None, hottest, out);
        let disagreement = self.disagreement();
        self.observe_alarm(Rule::BmsDisagrees, None, disagreement, out);
    }

    /// SOC of the emptiest and the fullest of the cells whose estimate is fresh; `None` = of no cell.
    fn spread(&self, all_fresh: bool) -> Option<Spread> {
        if all_fresh && let Some((lowest, highest)) = self.estimators.extremes() {
            return Some(Spread { lowest, highest, is_whole: true });
        }
        let (mut spread, mut known): (Option<Spread>, usize) = (None, 0);
        for cell in (0..self.config.sample.cells).map(CellIndex) {
            let is_fresh = self.sampler.is_fresh(self.voltage_channel(cell), self.now);
            // A voltage that came before the first current says nothing yet.
            let is_present = is_fresh && !self.estimators.is_carried_over(cell.index());
            let Some(soc) = self.estimators.soc(cell.index()).filter(|_| is_present) else { continue };
            known += 1;
            spread = Some(match spread {
                None => Spread { lowest: soc, highest: soc, is_whole: false },
                Some(so_far) => Spread {
                    lowest: if soc.mean < so_far.lowest.mean { soc } else { so_far.lowest },
                    highest: if soc.mean > so_far.highest.mean { soc } else { so_far.highest },
                    is_whole: false,
                },
            });
        }
        spread.map(|spread| Spread { is_whole: known == self.cells.len(), ..spread })
    }

    /// The larger of the differences between what the pack reports of itself and what we estimate.
    fn disagreement(&self) -> Observation {
        let config = &self.config.sample;
        let soc = self.pack.map(|pack| ScalarGaussian::from_std(pack.soc, pack.soc_std));
        let rated_ah = self.config.model.rated_capacity_ah;
        let weakest = if config.reported_soh.is_some() { self.weakest_capacity() } else { None };
        let soh = weakest.map(|c| ScalarGaussian::from_std(c.mean / rated_ah, c.std() / rated_ah));
        let pairs = [
            (config.reported_soc.is_some(), Channel::ReportedSoc, soc),
            (config.reported_soh.is_some(), Channel::ReportedSoh, soh),
        ];
        let mut worst = Observation::default();
        for (_, channel, ours) in pairs.into_iter().filter(|(configured, ..)| *configured) {
            let reported = self.sampler.reported(channel, self.now);
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

    /// Capacity of the cell with the lowest; `None` until half-cycles have taught something about every cell.
    pub(super) fn weakest_capacity(&self) -> Option<ScalarGaussian> {
        let cells = 0..self.cells.len();
        let capacities = cells.map(|index| self.learner.capacity(&self.config.health.capacity, index));
        capacities.min_by(|a, b| a.mean.total_cmp(&b.mean)).filter(|_| self.learner.has_learned_all())
    }

    /// After a restart: what was known stands, though it is not known anew.
    pub(super) fn restate_known(&mut self, was_away_briefly: bool, out: &mut Outputs) {
        let old = |belief: ScalarGaussian| Observation { is_new: false, ..learned(belief) };
        for index in 0..self.cells.len() {
            let cell = Some(CellIndex(u16::try_from(index).unwrap_or(u16::MAX)));
            if self.learner.has_learned(index) {
                let capacity = self.learner.capacity(&self.config.health.capacity, index);
                self.observe_alarm(Rule::CapacityLow, cell, old(capacity), out);
            }
            // A measured value is as old as the state; after a moment only it may still be taken for the present one.
            if was_away_briefly && self.estimators.soc(index).is_some() {
                let mean_nis = Observation { value: Some(self.estimators.mean_nis(index)), ..Observation::default() };
                self.observe_alarm(Rule::EstimateUntrusted, cell, mean_nis, out);
            }
            if let Some(resistance) = self.cells[index].discharge_resistance {
                self.observe_alarm(Rule::ResistanceHigh, cell, old(resistance), out);
            }
            if let Some(usable) = self.cells[index].usable {
                self.observe_alarm(Rule::UsableCapacityLow, cell, old(usable), out);
            }
        }
        if let Some(period) = self.known_recharge_period() {
            let period = Observation { is_new: false, ..period };
            self.observe_alarm(Rule::RechargePeriodLow, None, period, out);
        }
        self.observe_life(false, out);
    }

    /// The last recharge period, of the kind the rule about it compares.
    pub(super) fn known_recharge_period(&self) -> Option<Observation> {
        match self.config.health.recharge.alarm_on {
            RechargeAlarm::Raw => self.recharge_period_s.map(|seconds| Observation::new(Some(seconds))),
            RechargeAlarm::Normalised => self.normalised_recharge.map(learned),
        }
    }

    /// Takes a value into the rules; what becomes of it goes out at once.
    pub(super) fn observe_alarm(&mut self, rule: Rule, cell: Option<CellIndex>, seen: Observation, out: &mut Outputs) {
        self.tell_alarms(AlarmInput::Observe { rule, cell, seen }, out);
        self.report_alarms(out);
    }

    /// Tells the alarms, and whoever wants to know what they were told; the changes wait to be reported.
    pub(super) fn tell_alarms(&mut self, input: AlarmInput, out: &mut Outputs) -> Outcome {
        if out.want_alarm_inputs {
            out.alarm_inputs.push((self.now, input));
        }
        self.alarms.apply(self.now, &input, &mut self.scratch.alarm_changes)
    }

    /// Tells what became of alarms, and sends each as it stands now.
    pub(super) fn report_alarms(&mut self, out: &mut Outputs) {
        if self.scratch.alarm_changes.is_empty() {
            return;
        }
        let mut changes = std::mem::take(&mut self.scratch.alarm_changes);
        for change in changes.drain(..) {
            out.events.push(Event { time: self.now, kind: alarm_event(&change) });
            self.send_alarm(&change.alarm, out);
        }
        self.scratch.alarm_changes = changes;
        self.tell_j1939();
        self.poll_j1939(out);
    }

    /// A command from the bus; one that is not intact, or that has no meaning, is told and not obeyed.
    pub(super) fn handle_command_frame(&mut self, bus: BusIndex, frame: &Frame, is_intact: bool, out: &mut Outputs) {
        let fields = self.config.commands.as_ref().and_then(|commands| commands.plan.decode(frame).ok());
        match fields.and_then(|fields| command_of(&fields)) {
            Some(command) if is_intact => return self.handle_command(Source::Bus(bus), command, out),
            // Told once a second, counted always.
            Some(_) | None if self.bad_command_told.is_some_and(|told| self.now.since(told) < BAD_COMMAND_S) => {}
            Some(_) | None => {
                self.bad_command_told = Some(self.now);
                out.events.push(Event { time: self.now, kind: EventKind::BadCommand { bus, intact: is_intact } })
            }
        }
        self.statistics.bad_commands += 1;
    }

    /// Does what somebody asks for.
    pub(super) fn handle_command(&mut self, source: Source, command: Command, out: &mut Outputs) {
        self.make_steps(out);
        let (changed, refused) = match command {
            Command::Acknowledge(which) => {
                let outcome = self.tell_alarms(AlarmInput::Acknowledge(which), out);
                (outcome.changed, outcome.refused)
            }
            Command::Clear(which) => {
                let outcome = self.tell_alarms(AlarmInput::Clear(which), out);
                (outcome.changed, outcome.refused)
            }
            Command::PackReplaced => {
                self.replace_pack(out);
                (u32::try_from(self.scratch.alarm_changes.len()).unwrap_or(u32::MAX), 0)
            }
            Command::Test { rule, seconds } => (0, u32::from(!self.start_test(rule, seconds, out))),
        };
        out.events.push(Event { time: self.now, kind: EventKind::Command { source, command, changed, refused } });
        self.report_alarms(out);
        self.due = self.find_due();
    }

    /// What was learned of the old pack is told once more and does not hold for the new one.
    fn replace_pack(&mut self, out: &mut Outputs) {
        let capacity = self.weakest_capacity();
        let kind = EventKind::PackReplaced {
            capacity_ah: capacity.map(|capacity| capacity.mean),
            capacity_std_ah: capacity.as_ref().map(ScalarGaussian::std),
        };
        out.events.push(Event { time: self.now, kind });
        self.forget_learned();
        self.tell_alarms(AlarmInput::ForgetLearned, out);
    }
}

/// A frame's command; `None` = it names a rule or severity that there is not.
fn command_of(fields: &CommandFields) -> Option<Command> {
    let which = Selector {
        rule: fields.rule.map(|number| Rule::from_number(number).ok_or(())).transpose().ok()?,
        severity: fields
            .severity
            .map(|code| Severity::ALL.into_iter().find(|s| *s as u8 == code).ok_or(()))
            .transpose()
            .ok()?,
        cell: fields.cell,
    };
    Some(match fields.command {
        encode::Command::Acknowledge => Command::Acknowledge(which),
        encode::Command::Clear => Command::Clear(which),
        encode::Command::PackReplaced => Command::PackReplaced,
    })
}

/// A value learned anew.
pub(super) fn learned(belief: ScalarGaussian) -> Observation {
    Observation::new(Some(belief.mean)).with_std(belief.std())
}

fn alarm_event(change: &AlarmChange) -> EventKind {
    let Alarm { rule, cell, state, severity, value, probability, threshold, occurrences, is_acknowledged, .. } =
        change.alarm;
    EventKind::Alarm {
        rule,
        cell,
        change: change.change,
        state,
        active: state.is_raised(),
        severity,
        value,
        probability,
        threshold,
        occurrences,
        acknowledged: is_acknowledged,
    }
}

/// Since when files cannot be written; not known before the driver has said.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct StoreState {
    is_known: bool,
    failing_since: Option<Timestamp>,
}

impl StoreState {
    /// Notes what the driver says; true when it is news.
    pub(super) fn note(&mut self, now: Timestamp, works: bool) -> bool {
        let was_failing = self.failing_since.is_some();
        let is_news = !self.is_known || was_failing == works;
        self.is_known = true;
        self.failing_since = if works { None } else { self.failing_since.or(Some(now)) };
        is_news
    }

    /// For how long they cannot be written, s; 0 while they can.
    fn failing_s(&self, now: Timestamp) -> Option<f64> {
        self.is_known.then(|| self.failing_since.map_or(0.0, |since| now.since(since).max(0.0)))
    }
}
