//! One alarm machine per rule and cell, fed by rule; tells what was raised and cleared.
//!
//! In: values in each rule's unit with the time of the look. Out: [`AlarmChange`]s and the list of raised
//! alarms in the order rule, severity, cell (the pack first). One rule may be configured several times with
//! different severities; each has alarms of its own. A value for a rule that is not configured, or for a cell
//! a rule does not watch, concerns no alarm and is passed over.

use serde::{Deserialize, Serialize};

use super::machine::{Machine, State};
use super::{Rule, RuleConfig, Scope, Severity};
use crate::quantity::{CellIndex, Timestamp};

/// An alarm was raised or cleared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlarmChange {
    /// Which rule.
    pub rule: Rule,
    /// Which cell; `None` = the pack.
    pub cell: Option<CellIndex>,
    /// Raised (true) or cleared.
    pub active: bool,
    /// Its severity.
    pub severity: Severity,
    /// The value that decided, in the rule's unit.
    pub value: Option<f64>,
    /// What it is compared with.
    pub threshold: f64,
}

/// A raised alarm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActiveAlarm {
    /// Which rule.
    pub rule: Rule,
    /// Which cell; `None` = the pack.
    pub cell: Option<CellIndex>,
    /// Its severity.
    pub severity: Severity,
    /// The latest value, in the rule's unit; `None` = not known any more, the alarm stays.
    pub value: Option<f64>,
    /// What it is compared with.
    pub threshold: f64,
    /// When it was raised.
    pub raised: Timestamp,
}

/// One alarm of a stored state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct StoredAlarm {
    rule: Rule,
    severity: Severity,
    cell: Option<CellIndex>,
    machine: Machine,
}

/// What an engine remembers: every alarm that is not inactive.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct AlarmState {
    alarms: Vec<StoredAlarm>,
}

impl AlarmState {
    /// Moves every stamp by `by_nanos`, onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        for alarm in &mut self.alarms {
            alarm.machine.rebase(by_nanos);
        }
    }
}

/// The slots of one rule: the pack's first where it has one, then its cells in order.
#[derive(Debug, Clone)]
struct RuleSlots {
    config: RuleConfig,
    first: usize,
    pack_slots: usize,
    cell_slots: usize,
}

impl RuleSlots {
    fn new(config: RuleConfig, first: usize, cells: usize) -> Self {
        let (pack_slots, cell_slots) = match config.rule.scope() {
            Scope::Pack => (1, 0),
            Scope::Cell => (0, cells),
            Scope::Both => (1, cells),
        };
        Self { config, first, pack_slots, cell_slots }
    }

    fn end(&self) -> usize {
        self.first + self.pack_slots + self.cell_slots
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
    rules: Vec<RuleSlots>,
    machines: Vec<Machine>,
    /// Raised slots, rising: what `active` walks.
    raised: Vec<usize>,
    /// Slots whose debounce runs, rising: what `poll` walks.
    counting: Vec<usize>,
}

impl AlarmEngine {
    /// An engine with every alarm inactive. Rules are put in the order of wire number, then severity.
    pub fn new(mut rules: Vec<RuleConfig>, cells: u16) -> Self {
        rules.sort_by_key(|config| (config.rule, config.severity));
        let mut slots: Vec<RuleSlots> = Vec::with_capacity(rules.len());
        for config in rules {
            let first = slots.last().map_or(0, RuleSlots::end);
            slots.push(RuleSlots::new(config, first, usize::from(cells)));
        }
        let total = slots.last().map_or(0, RuleSlots::end);
        Self {
            rules: slots,
            machines: vec![Machine::default(); total],
            raised: Vec::with_capacity(total),
            counting: Vec::with_capacity(total),
        }
    }

    /// Takes the value of `rule` for `cell` (`None` = the pack) as it stands at `now`; `None` or a number that is
    /// not finite = not known. `new_value` says that it was measured anew, and so counts for `debounce_events`.
    pub fn observe(
        &mut self,
        now: Timestamp,
        rule: Rule,
        cell: Option<CellIndex>,
        value: Option<f64>,
        new_value: bool,
        changes: &mut Vec<AlarmChange>,
    ) {
        for index in 0..self.rules.len() {
            let slots = &self.rules[index];
            if slots.config.rule != rule {
                continue;
            }
            let Some(slot) = slots.slot(cell) else { continue };
            let changed = self.machines[slot].observe(now, &slots.config, value, new_value);
            self.file(slot);
            if changed {
                changes.push(self.change(index, slot));
            }
        }
    }

    /// Lets time pass for the values that hold until the next one ([`Rule::holds_between_values`]).
    pub fn poll(&mut self, now: Timestamp, changes: &mut Vec<AlarmChange>) {
        let mut next = 0;
        while let Some(&slot) = self.counting.get(next) {
            let index = self.rule_of(slot);
            let config = &self.rules[index].config;
            if config.rule.holds_between_values() && self.machines[slot].poll(now, config) {
                // The slot leaves `counting`, so the next one moves into its place.
                self.file(slot);
                changes.push(self.change(index, slot));
            } else {
                next += 1;
            }
        }
    }

    /// Nobody looked until the next value (asleep, restarted, log with a hole): for values that do not hold
    /// between looks the time up to then does not count.
    pub fn handle_gap(&mut self) {
        for position in 0..self.counting.len() {
            let slot = self.counting[position];
            if !self.rules[self.rule_of(slot)].config.rule.holds_between_values() {
                self.machines[slot].handle_gap();
            }
        }
    }

    /// Raised alarms in stable order: rule, severity, cell (the pack first).
    pub fn active(&self) -> impl Iterator<Item = ActiveAlarm> + '_ {
        self.raised.iter().map(|&slot| {
            let slots = &self.rules[self.rule_of(slot)];
            let machine = &self.machines[slot];
            ActiveAlarm {
                rule: slots.config.rule,
                cell: slots.cell(slot),
                severity: slots.config.severity,
                value: machine.value,
                threshold: slots.config.threshold,
                raised: machine.raised,
            }
        })
    }

    /// The worst severity of the raised alarms; `None` = none is raised.
    pub fn highest_severity(&self) -> Option<Severity> {
        self.active().map(|alarm| alarm.severity).max()
    }

    /// Raised alarms.
    pub fn count(&self) -> usize {
        self.raised.len()
    }

    /// Where the alarm of a rule and cell is in its life (the worst severity's, when the rule is configured
    /// several times); `None` = nothing watches it.
    pub fn state(&self, rule: Rule, cell: Option<CellIndex>) -> Option<State> {
        let slots = self.rules.iter().rfind(|slots| slots.config.rule == rule)?;
        slots.slot(cell).map(|slot| self.machines[slot].state)
    }

    /// What is to be stored.
    pub fn snapshot(&self) -> AlarmState {
        let of_rule = |slots: &RuleSlots| {
            let (rule, severity) = (slots.config.rule, slots.config.severity);
            let stored = move |slots: &RuleSlots, slot| StoredAlarm {
                rule,
                severity,
                cell: slots.cell(slot),
                machine: self.machines[slot],
            };
            let kept = (slots.first..slots.end()).filter(|&slot| self.machines[slot].state != State::Inactive);
            kept.map(|slot| stored(slots, slot)).collect::<Vec<_>>()
        };
        AlarmState { alarms: self.rules.iter().flat_map(of_rule).collect() }
    }

    /// Takes up a stored state (rebased by the caller); returns how many of its alarms no configured rule
    /// watches any more: they are gone, and the caller says so.
    pub fn restore(&mut self, state: &AlarmState) -> usize {
        self.machines.fill(Machine::default());
        self.raised.clear();
        self.counting.clear();
        let mut orphans = 0;
        for alarm in &state.alarms {
            match self.stored_slot(alarm) {
                Some(slot) => {
                    self.machines[slot] = alarm.machine;
                    self.file(slot);
                }
                None => orphans += 1,
            }
        }
        orphans
    }

    fn stored_slot(&self, alarm: &StoredAlarm) -> Option<usize> {
        let same = |slots: &&RuleSlots| slots.config.rule == alarm.rule && slots.config.severity == alarm.severity;
        self.rules.iter().find(same)?.slot(alarm.cell)
    }

    fn rule_of(&self, slot: usize) -> usize {
        self.rules.partition_point(|slots| slots.end() <= slot)
    }

    fn change(&self, index: usize, slot: usize) -> AlarmChange {
        let (slots, machine) = (&self.rules[index], &self.machines[slot]);
        AlarmChange {
            rule: slots.config.rule,
            cell: slots.cell(slot),
            active: machine.state.is_raised(),
            severity: slots.config.severity,
            value: machine.value,
            threshold: slots.config.threshold,
        }
    }

    /// Keeps the two lists of slots in step with a machine's state.
    fn file(&mut self, slot: usize) {
        let state = self.machines[slot].state;
        set_member(&mut self.raised, slot, state.is_raised());
        set_member(&mut self.counting, slot, state.is_counting());
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
