//! Alarming stage: the alarm engine, and what it needs to know of the rules and of the files.
//!
//! In: values of the rules, from the [`Publisher`](super::publisher::Publisher) and the periodic
//! [`watch`](crate::monitor::stages::watch). Out: raised alarms and their changes.

use serde::{Deserialize, Serialize};

use crate::alarm::{AlarmChange, AlarmEngine, AlarmSnapshot, Observation, Rule, RuleConfig, RunningAlarm};
use crate::monitor::config::MonitorConfig;
use crate::quantity::{CellIndex, Timestamp};

/// Values that change no alarm are shown this often, s.
const SHOW_S: f64 = 1.0;

/// The alarming stage.
#[derive(Debug)]
pub(crate) struct Alarming {
    pub(crate) engine: AlarmEngine,
    /// Silence that the strictest threshold calls missing, s; `None` = no rule does.
    pub(crate) missing_after_s: Option<f64>,
    /// Changes that wait to be published.
    pub(crate) changes: Vec<AlarmChange>,
    /// Cells whose voltage channel is faulty: nothing is known of them. Follows from the diagnosis.
    pub(crate) faulty_channels: Vec<CellIndex>,
    pub(crate) state: AlarmingState,
}

/// What is known of the values that the rules have seen.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AlarmingState {
    /// When values of inputs, and innovations, that change no alarm were last shown.
    pub(crate) inputs_shown_at: Option<Timestamp>,
    pub(crate) innovations_shown_at: Option<Timestamp>,
    /// The engine knows that every learned value has valid inputs.
    pub(crate) knows_all_valid: bool,
    pub(crate) store: StoreHealth,
}

/// What continues of the stage.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredAlarming {
    /// Alarms that were raised or are about to be.
    pub(crate) alarms: AlarmSnapshot,
    /// Every alarm, also those at rest, with the latest value; empty in a state for a restart.
    running: Vec<RunningAlarm>,
    state: AlarmingState,
}

impl StoredAlarming {
    /// What a program that is started again knows: every value is compared again.
    pub(crate) fn restart(&mut self) {
        self.running.clear();
        self.state = AlarmingState::default();
    }
}

impl Alarming {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        Self {
            engine: AlarmEngine::new(config.rules.clone(), config.sample.cells),
            missing_after_s: missing_after_s(&config.rules),
            changes: Vec::new(),
            faulty_channels: Vec::new(),
            state: AlarmingState::default(),
        }
    }

    /// Whether the value of a rule comes from a cell whose channel is faulty.
    pub(crate) fn depends_on_faulty_channel(&self, rule: Rule, cell: Option<CellIndex>) -> bool {
        rule.depends_on_cell_voltage() && cell.is_some_and(|cell| self.faulty_channels.contains(&cell))
    }

    /// What continues.
    pub(crate) fn snapshot(&self) -> StoredAlarming {
        StoredAlarming { alarms: self.engine.snapshot(), running: self.engine.running(), state: self.state }
    }

    /// Continues with the latest value of every alarm; those that were raised are restored before.
    pub(crate) fn resume(&mut self, stored: &StoredAlarming) {
        self.engine.resume(&stored.running);
        self.state = stored.state;
    }

    /// Other rules; returns how many alarms, raised or past, ended by it.
    pub(crate) fn reconfigure(&mut self, now: Timestamp, config: &MonitorConfig) -> usize {
        self.missing_after_s = missing_after_s(&config.rules);
        self.state.knows_all_valid = false;
        self.engine.reconfigure(now, config.rules.clone(), config.sample.cells, &mut self.changes)
    }
}

fn missing_after_s(rules: &[RuleConfig]) -> Option<f64> {
    let rules = rules.iter().filter(|rule| rule.rule == Rule::InputMissing);
    rules.map(|rule| rule.threshold).min_by(f64::total_cmp)
}

/// Whether values that change no alarm are to be shown again, last shown at `shown_at`; if so, that becomes `now`.
pub(crate) fn take_show_due(shown_at: &mut Option<Timestamp>, now: Timestamp) -> bool {
    let is_due = shown_at.is_none_or(|shown_at| now.since(shown_at).abs() >= SHOW_S);
    if is_due {
        *shown_at = Some(now);
    }
    is_due
}

/// Whether the files can be written; not known before the driver has reported.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(crate) struct StoreHealth {
    is_known: bool,
    failing_since: Option<Timestamp>,
}

impl StoreHealth {
    /// Takes the driver's report; whether it is a change.
    pub(crate) fn handle_report(&mut self, now: Timestamp, works: bool) -> bool {
        let was_failing = self.failing_since.is_some();
        let is_change = !self.is_known || was_failing == works;
        self.is_known = true;
        self.failing_since = if works { None } else { self.failing_since.or(Some(now)) };
        is_change
    }

    /// The value of the rule about files: for how long they cannot be written, s; 0 while they can.
    pub(crate) fn failing(&self, now: Timestamp) -> Observation {
        let failing_s = self.failing_since.map_or(0.0, |since| now.since(since).max(0.0));
        Observation::new(self.is_known.then_some(failing_s))
    }
}
