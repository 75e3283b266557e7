//! Holds one alarm (a state machine) per rule, severity and cell, and reports changes of the alarms.
//!
//! Input: commands, and values in the unit of their rule, each with the time at which it is compared. Output:
//! [`AlarmChange`]s and the list of raised alarms in the order rule, severity, cell (the pack first). A rule may have
//! one threshold per severity; each threshold has its own alarms. If a rule is not configured or does not watch a cell,
//! values of the rule for this cell are ignored.

pub mod summary;

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::limit::{LimitCheck, Observation, RuleConfig};
use super::machine::{AlarmState, Change, IndexEntry, Machine, Refusal};
use super::rule::{Rule, Scope, Severity};
use super::selector::{CommandOutcome, Selector};
use crate::quantity::{CellIndex, Timestamp};

/// Present state of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Alarm {
    pub rule: Rule,
    pub severity: Severity,
    /// The cell; `None` = the pack.
    pub cell: Option<CellIndex>,
    pub state: AlarmState,
    /// The latest value, in the rule's unit; `None` = unknown.
    pub value: Option<f64>,
    /// Probability that the true value is beyond the threshold; `None` = the value has no standard deviation.
    pub probability: Option<f64>,
    /// The configured threshold, in the rule's unit.
    pub threshold: f64,
    /// How often the alarm was raised.
    pub occurrences: u32,
    /// Time of the comparison that raised the alarm for the first time; `None` = never raised.
    pub first_raised: Option<Timestamp>,
    /// Time of the comparison that raised the alarm last; `None` = never raised.
    pub last_raised: Option<Timestamp>,
    /// The value that raised the alarm last; `None` = never raised.
    pub raised_value: Option<f64>,
    /// Whether the alarm has been acknowledged since it was last raised.
    pub is_acknowledged: bool,
}

/// A change of an alarm, with the state of the alarm after the change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlarmChange {
    pub change: Change,
    pub alarm: Alarm,
}

/// Summary of all alarms of one threshold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThresholdState {
    pub rule: Rule,
    pub severity: Severity,
    /// Whether any alarm of the threshold is raised.
    pub is_raised: bool,
    /// Number of occurrences of the alarm that was raised most often.
    pub occurrences: u32,
}

/// One alarm of a stored state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredAlarm {
    pub rule: Rule,
    pub severity: Severity,
    /// The cell; `None` = the pack.
    pub cell: Option<CellIndex>,
    machine: Machine,
}

impl StoredAlarm {
    /// Whether the alarm is raised.
    pub fn is_raised(&self) -> bool {
        self.machine.state.is_raised()
    }

    /// How often the alarm was raised.
    pub fn occurrences(&self) -> u32 {
        self.machine.occurrences
    }
}

/// One alarm with its latest value, as stored in a snapshot from which the monitor resumes without a gap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningAlarm {
    #[serde(flatten)]
    alarm: StoredAlarm,
    is_known: bool,
    observation: Observation,
    probability: Option<f64>,
}

/// Stored part of an engine: every alarm that was raised or is pending.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct AlarmSnapshot {
    alarms: Vec<StoredAlarm>,
}

impl AlarmSnapshot {
    /// Applies a change that was published at `time`, after this state was taken. The alarm's debounce starts again.
    pub fn repeat(&mut self, time: Timestamp, AlarmChange { change, alarm }: &AlarmChange) {
        let Alarm { rule, severity, cell, occurrences, is_acknowledged, .. } = *alarm;
        let is_same = |stored: &StoredAlarm| (stored.rule, stored.severity, stored.cell) == (rule, severity, cell);
        let place = self.alarms.iter().position(is_same).unwrap_or_else(|| {
            self.alarms.push(StoredAlarm { rule, severity, cell, machine: Machine::default() });
            self.alarms.len() - 1
        });
        let machine = &mut self.alarms[place].machine;
        if machine.occurrences == 0 {
            (machine.first_raised, machine.last_raised) = (time, time);
        }
        if *change == Change::Raised {
            (machine.last_raised, machine.raised_value) = (time, alarm.value);
        }
        (machine.occurrences, machine.is_acknowledged) = (occurrences, is_acknowledged);
        machine.enter_shown(alarm.state);
        if !machine.is_worth_storing() {
            self.alarms.remove(place);
        }
    }

    /// Moves every time stamp by `by_nanos`, onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        for alarm in &mut self.alarms {
            alarm.machine.rebase(by_nanos);
        }
    }
}

/// The slots of one threshold. A slot is the index of an alarm in `machines`. The pack's slot, if the rule has one,
/// comes first; the cells' slots follow in order.
#[derive(Debug, Clone)]
struct RuleSlots {
    config: RuleConfig,
    first: usize,
    pack_slots: usize,
    cell_slots: usize,
    /// Number of alarms whose value is unknown.
    unknown: usize,
    /// Number of alarms that are not at rest ([`IndexEntry::is_at_rest`]).
    not_at_rest: usize,
}

impl RuleSlots {
    fn new(config: RuleConfig, first: usize, cells: usize) -> Self {
        let (pack_slots, cell_slots) = match config.rule.spec().scope {
            Scope::Pack => (1, 0),
            Scope::Cell => (0, cells),
            Scope::Both => (1, cells),
        };
        let all = pack_slots + cell_slots;
        Self { config, first, pack_slots, cell_slots, unknown: all, not_at_rest: all }
    }

    fn slots(&self) -> Range<usize> {
        self.first..self.first + self.pack_slots + self.cell_slots
    }

    fn slot(&self, cell: Option<CellIndex>) -> Option<usize> {
        match cell {
            None => (self.pack_slots == 1).then_some(self.first),
            Some(cell) => (cell.index() < self.cell_slots).then(|| self.first + self.pack_slots + cell.index()),
        }
    }

    fn cell(&self, slot: usize) -> Option<CellIndex> {
        let cell = (slot - self.first).checked_sub(self.pack_slots)?;
        u16::try_from(cell).ok().map(CellIndex)
    }
}

/// All alarms of a pack.
#[derive(Debug, Clone)]
pub struct AlarmEngine {
    /// Sorted by wire number, then severity.
    rules: Vec<RuleSlots>,
    /// For each rule, by wire number: the range of its thresholds in `rules`.
    by_rule: [Range<usize>; Rule::ALL.len() + 1],
    machines: Vec<Machine>,
    /// Raised slots in ascending order, for `raised`.
    raised: Vec<usize>,
    /// Slots with a running debounce in ascending order, for `poll`.
    counting: Vec<usize>,
}

impl AlarmEngine {
    /// Creates an engine in which every alarm is unknown.
    pub fn new(mut rules: Vec<RuleConfig>, cells: u16) -> Self {
        rules.sort_by_key(|config| (config.rule, config.severity));
        let mut slots: Vec<RuleSlots> = Vec::with_capacity(rules.len());
        for config in rules {
            let first = slots.last().map_or(0, |last| last.slots().end);
            slots.push(RuleSlots::new(config, first, usize::from(cells)));
        }
        let number = |rule: &RuleSlots| usize::from(rule.config.rule as u8);
        let by_rule = std::array::from_fn(|wanted| {
            slots.partition_point(|rule| number(rule) < wanted)..slots.partition_point(|rule| number(rule) <= wanted)
        });
        let total = slots.last().map_or(0, |last| last.slots().end);
        Self {
            rules: slots,
            by_rule,
            machines: vec![Machine::default(); total],
            raised: Vec::with_capacity(total),
            counting: Vec::with_capacity(total),
        }
    }

    /// Handles the value of `rule` for `cell` (`None` = the pack) at `now`.
    pub fn observe(
        &mut self,
        now: Timestamp,
        rule: Rule,
        cell: Option<CellIndex>,
        observation: &Observation,
        changes: &mut Vec<AlarmChange>,
    ) {
        self.each_threshold(rule, cell, changes, |machine, config| machine.observe(now, config, observation));
    }

    /// Whether all alarms of `rule` are at rest and `worst` is healthy. If so, `worst` and all better values leave
    /// these alarms unchanged. Returns true if the rule is not configured.
    pub fn is_quiet(&self, rule: Rule, worst: f64) -> bool {
        self.rules[self.by_rule[usize::from(rule as u8)].clone()].iter().all(|slots| {
            let is_beyond = || LimitCheck::of(&slots.config, &Observation::new(Some(worst))).0 != LimitCheck::Healthy;
            slots.not_at_rest == 0 && !is_beyond()
        })
    }

    /// Stores a value for display. The caller makes sure that [`is_quiet`](Self::is_quiet) is true for this value.
    #[inline]
    pub fn show(&mut self, rule: Rule, cell: Option<CellIndex>, value: f64) {
        for slots in &self.rules[self.by_rule[usize::from(rule as u8)].clone()] {
            if let Some(slot) = slots.slot(cell) {
                self.machines[slot].show(value);
            }
        }
    }

    /// Advances the debounce of alarms on learned values ([`RuleSpec::is_learned`](super::rule::RuleSpec::is_learned)).
    /// A learned value stays valid until the next value arrives.
    pub fn poll(&mut self, now: Timestamp, changes: &mut Vec<AlarmChange>) {
        let mut next = 0;
        while let Some(&slot) = self.counting.get(next) {
            let index = self.rule_of(slot);
            let is_learned = self.rules[index].config.rule.spec().is_learned;
            // A slot whose alarm changes is removed from `counting`.
            let has_changed =
                is_learned && self.change(index, slot, changes, |machine, config| machine.poll(now, config));
            next += usize::from(!has_changed);
        }
    }

    /// Handles a period without values (vehicle asleep, restart, gap in a log). The period does not count towards the
    /// debounce of measured values.
    pub fn handle_gap(&mut self) {
        let measured: Vec<usize> = self.counting.iter().copied().filter(|&slot| !self.is_learned(slot)).collect();
        for slot in measured {
            self.change(self.rule_of(slot), slot, &mut Vec::new(), |machine, _| {
                machine.handle_gap();
                None
            });
        }
    }

    /// Forgets alarms on learned values and their history. Called when another pack is connected.
    pub fn forget_learned(&mut self, changes: &mut Vec<AlarmChange>) {
        for index in 0..self.rules.len() {
            if !self.rules[index].config.rule.spec().is_learned {
                continue;
            }
            for slot in self.rules[index].slots() {
                let old = std::mem::take(&mut self.machines[slot]);
                self.update_index(index, slot, old.index_entry());
                if old.state.is_raised() {
                    changes.push(AlarmChange { change: Change::Forgotten, alarm: self.alarm(index, slot) });
                }
            }
        }
    }

    /// Raised alarms in the order rule, severity, cell (the pack first).
    pub fn raised(&self) -> impl ExactSizeIterator<Item = Alarm> + '_ {
        self.raised.iter().map(|&slot| self.alarm(self.rule_of(slot), slot))
    }

    /// Every alarm of every rule, in the order of [`raised`](Self::raised).
    pub fn all(&self) -> impl Iterator<Item = Alarm> + '_ {
        self.rules
            .iter()
            .enumerate()
            .flat_map(move |(index, rule)| rule.slots().map(move |slot| self.alarm(index, slot)))
    }

    /// Number of raised alarms.
    pub fn count(&self) -> usize {
        self.raised.len()
    }

    /// The alarm of a rule and cell (of the worst severity if the rule has several thresholds); `None` = not watched.
    pub fn get(&self, rule: Rule, cell: Option<CellIndex>) -> Option<Alarm> {
        let index = self.by_rule[usize::from(rule as u8)].clone().next_back()?;
        self.rules[index].slot(cell).map(|slot| self.alarm(index, slot))
    }

    /// The state to store.
    pub fn snapshot(&self) -> AlarmSnapshot {
        let of_rule = |rule: &RuleSlots| {
            let kept = rule.slots().filter(|&slot| self.machines[slot].is_worth_storing());
            let stored = |slot| StoredAlarm {
                rule: rule.config.rule,
                severity: rule.config.severity,
                cell: rule.cell(slot),
                machine: self.machines[slot],
            };
            kept.map(stored).collect::<Vec<_>>()
        };
        AlarmSnapshot { alarms: self.rules.iter().flat_map(of_rule).collect() }
    }

    /// Restores a stored state whose times the caller has rebased. If an alarm was raised later than `now`, that time
    /// is set to `now`. Returns the alarms that no configured threshold watches any longer; the caller reports them.
    pub fn restore(&mut self, now: Timestamp, state: &AlarmSnapshot) -> Vec<StoredAlarm> {
        let cells = self.cells();
        *self = Self::new(self.rules.drain(..).map(|rule| rule.config).collect(), cells);
        let mut orphans = Vec::new();
        for alarm in &state.alarms {
            let Some((index, slot)) = self.locate(alarm.rule, alarm.severity, alarm.cell) else {
                orphans.push(alarm.clone());
                continue;
            };
            // The value arrives with the next observation.
            self.machines[slot] = alarm.machine.restored(now);
            self.update_index(index, slot, Machine::default().index_entry());
        }
        orphans
    }

    /// Every alarm that differs from its initial state.
    pub fn running(&self) -> Vec<RunningAlarm> {
        let of_rule = |rule: &RuleSlots| {
            let used = rule.slots().filter(|&slot| self.machines[slot] != Machine::default());
            let running = |slot: usize| {
                let (machine, RuleConfig { rule: name, severity, .. }) = (self.machines[slot], &rule.config);
                RunningAlarm {
                    alarm: StoredAlarm { rule: *name, severity: *severity, cell: rule.cell(slot), machine },
                    is_known: machine.is_known,
                    observation: machine.observation,
                    probability: machine.probability,
                }
            };
            used.map(running).collect::<Vec<_>>()
        };
        self.rules.iter().flat_map(of_rule).collect()
    }

    /// Restores alarms with their values. Ignores alarms without a configured threshold.
    pub fn resume(&mut self, alarms: &[RunningAlarm]) {
        for RunningAlarm { alarm, is_known, observation, probability } in alarms {
            let Some((index, slot)) = self.locate(alarm.rule, alarm.severity, alarm.cell) else { continue };
            let before = self.machines[slot].index_entry();
            let mut machine = alarm.machine;
            (machine.is_known, machine.observation, machine.probability) = (*is_known, *observation, *probability);
            self.machines[slot] = machine;
            self.update_index(index, slot, before);
        }
    }

    /// Replaces the rules. An alarm whose rule, severity and cell are still watched is kept; if any setting of its
    /// threshold changed, its value is compared again. All other alarms are forgotten. Returns how many of the
    /// forgotten alarms were pending or had been raised.
    pub fn reconfigure(
        &mut self,
        now: Timestamp,
        rules: Vec<RuleConfig>,
        cells: u16,
        changes: &mut Vec<AlarmChange>,
    ) -> usize {
        let mut old = std::mem::replace(self, Self::new(rules, cells));
        let mut ended = 0;
        for before in 0..old.rules.len() {
            for slot in old.rules[before].slots() {
                let rule = &old.rules[before];
                if let Some((index, place)) = self.locate(rule.config.rule, rule.config.severity, rule.cell(slot)) {
                    self.machines[place] = old.machines[slot];
                    self.update_index(index, place, Machine::default().index_entry());
                } else if std::mem::take(&mut old.machines[slot]).is_worth_storing() {
                    ended += 1;
                    changes.push(AlarmChange { change: Change::Forgotten, alarm: old.alarm(before, slot) });
                }
            }
        }
        for index in 0..self.rules.len() {
            if !old.rules.iter().any(|before| before.config == self.rules[index].config) {
                for slot in self.rules[index].slots() {
                    self.change(index, slot, changes, |machine, config| machine.retarget(now, config));
                }
            }
        }
        ended
    }

    fn locate(&self, rule: Rule, severity: Severity, cell: Option<CellIndex>) -> Option<(usize, usize)> {
        let same = |slots: &RuleSlots| (slots.config.rule, slots.config.severity) == (rule, severity);
        let index = self.rules.iter().position(same)?;
        Some((index, self.rules[index].slot(cell)?))
    }

    fn cells(&self) -> u16 {
        let most = self.rules.iter().map(|rule| rule.cell_slots).max().unwrap_or(0);
        u16::try_from(most).unwrap_or(u16::MAX)
    }

    pub(super) fn each_threshold(
        &mut self,
        rule: Rule,
        cell: Option<CellIndex>,
        changes: &mut Vec<AlarmChange>,
        mut act: impl FnMut(&mut Machine, &RuleConfig) -> Option<Change>,
    ) {
        for index in self.by_rule[usize::from(rule as u8)].clone() {
            let Some(slot) = self.rules[index].slot(cell) else { continue };
            self.change(index, slot, changes, &mut act);
        }
    }

    /// Applies `act` to one machine and updates the lists and counts; returns whether the alarm changed.
    #[inline]
    fn change(
        &mut self,
        index: usize,
        slot: usize,
        changes: &mut Vec<AlarmChange>,
        act: impl FnOnce(&mut Machine, &RuleConfig) -> Option<Change>,
    ) -> bool {
        let before = self.machines[slot].index_entry();
        let change = act(&mut self.machines[slot], &self.rules[index].config);
        self.update_index(index, slot, before);
        if let Some(change) = change {
            changes.push(AlarmChange { change, alarm: self.alarm(index, slot) });
        }
        change.is_some()
    }

    pub(super) fn command(
        &mut self,
        which: &Selector,
        changes: &mut Vec<AlarmChange>,
        act: impl Fn(&mut Machine) -> Result<Change, Refusal>,
    ) -> CommandOutcome {
        let mut outcome = CommandOutcome::default();
        for index in 0..self.rules.len() {
            let (rule, severity) = (self.rules[index].config.rule, self.rules[index].config.severity);
            for slot in self.rules[index].slots() {
                if !which.matches(rule, severity, self.rules[index].cell(slot)) {
                    continue;
                }
                let has_changed = self.change(index, slot, changes, |machine, _| {
                    let result = act(machine);
                    outcome.refused += u32::from(result == Err(Refusal::NotHealthy));
                    result.ok()
                });
                outcome.changed += u32::from(has_changed);
            }
        }
        outcome
    }

    fn rule_of(&self, slot: usize) -> usize {
        self.rules.partition_point(|rule| rule.slots().end <= slot)
    }

    fn is_learned(&self, slot: usize) -> bool {
        self.rules[self.rule_of(slot)].config.rule.spec().is_learned
    }

    fn alarm(&self, index: usize, slot: usize) -> Alarm {
        let (rule, machine) = (&self.rules[index], &self.machines[slot]);
        let was_raised = machine.occurrences > 0;
        Alarm {
            rule: rule.config.rule,
            severity: rule.config.severity,
            cell: rule.cell(slot),
            state: machine.shown(),
            value: machine.value(),
            probability: machine.probability.filter(|_| machine.is_known),
            threshold: rule.config.threshold,
            occurrences: machine.occurrences,
            first_raised: was_raised.then_some(machine.first_raised),
            last_raised: was_raised.then_some(machine.last_raised),
            raised_value: machine.raised_value.filter(|_| was_raised),
            is_acknowledged: machine.is_acknowledged,
        }
    }

    fn update_index(&mut self, index: usize, slot: usize, before: IndexEntry) {
        let now = self.machines[slot].index_entry();
        if now == before {
            return;
        }
        let rule = &mut self.rules[index];
        rule.unknown = rule.unknown + usize::from(!now.is_known) - usize::from(!before.is_known);
        rule.not_at_rest = rule.not_at_rest + usize::from(!now.is_at_rest) - usize::from(!before.is_at_rest);
        set_member(&mut self.raised, slot, now.is_raised);
        set_member(&mut self.counting, slot, now.is_counting);
    }
}

fn set_member(list: &mut Vec<usize>, slot: usize, member: bool) {
    match (list.binary_search(&slot), member) {
        (Err(place), true) => list.insert(place, slot),
        (Ok(place), false) => {
            list.remove(place);
        }
        (Ok(_), true) | (Err(_), false) => {}
    }
}

#[cfg(test)]
mod tests;
