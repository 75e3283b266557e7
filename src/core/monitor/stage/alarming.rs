//! Alarming stage: holds the alarm engine, and the state that is needed to compare values with the alarm rules.
//!
//! In: values of the rules, from the [`Publisher`](super::publisher::Publisher) and the periodic
//! [`watch`](crate::monitor::stages::watch). Out: raised alarms and their changes.

use serde::{Deserialize, Serialize};

use crate::alarm::{AlarmChange, AlarmEngine, AlarmSnapshot, Observation, Rule, RuleConfig, RunningAlarm};
use crate::monitor::config::MonitorConfig;
use crate::quantity::{CellIndex, Timestamp};

/// Values that change no alarm are only displayed. Period in which the displayed values are refreshed (s).
const SHOW_S: f64 = 1.0;

#[derive(Debug)]
pub(crate) struct Alarming {
    pub(crate) engine: AlarmEngine,
    /// Lowest threshold of the rule `input_missing` (s): a longer silence of an input is reported. `None` = the rule is
    /// not configured.
    pub(crate) missing_after_s: Option<f64>,
    /// Changes that wait to be published.
    pub(crate) changes: Vec<AlarmChange>,
    /// Cells whose voltage channel is faulty according to the cell-fault detector. New values that depend on these
    /// voltages are not passed to the rules.
    pub(crate) faulty_channels: Vec<CellIndex>,
    pub(crate) state: AlarmingState,
}

#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AlarmingState {
    /// Time of the last refresh of the displayed input values.
    pub(crate) inputs_shown_at: Option<Timestamp>,
    /// Time of the last refresh of the displayed innovations.
    pub(crate) innovations_shown_at: Option<Timestamp>,
    /// Whether the engine has every learned value marked as valid, because its inputs are received.
    pub(crate) knows_all_valid: bool,
    pub(crate) store: StoreHealth,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredAlarming {
    /// Pending, raised and past alarms.
    pub(crate) alarms: AlarmSnapshot,
    /// Every alarm that is not in its initial state, with its latest value. Empty after [`Self::restart`].
    running: Vec<RunningAlarm>,
    state: AlarmingState,
}

impl StoredAlarming {
    /// Drops the latest values, so that a restarted process compares every value again.
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

    pub(crate) fn snapshot(&self) -> StoredAlarming {
        StoredAlarming { alarms: self.engine.snapshot(), running: self.engine.running(), state: self.state }
    }

    /// Resumes with the latest value of every alarm. The caller has already restored the raised alarms.
    pub(crate) fn resume(&mut self, stored: &StoredAlarming) {
        self.engine.resume(&stored.running);
        self.state = stored.state;
    }

    /// Replaces the rules, and drops the alarms of removed rules. Returns how many of these alarms were pending or had
    /// been raised.
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

/// Whether a refresh of displayed values is due. If so, sets `shown_at` to `now`.
pub(crate) fn take_show_due(shown_at: &mut Option<Timestamp>, now: Timestamp) -> bool {
    let is_due = shown_at.is_none_or(|shown_at| now.since(shown_at).abs() >= SHOW_S);
    if is_due {
        *shown_at = Some(now);
    }
    is_due
}

/// Whether the files can be written; unknown before the first report about the files.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(crate) struct StoreHealth {
    is_known: bool,
    failing_since: Option<Timestamp>,
}

impl StoreHealth {
    /// Handles a report on whether the files can be written. Returns whether it is the first report or differs from the
    /// previous report.
    pub(crate) fn handle_report(&mut self, now: Timestamp, works: bool) -> bool {
        let was_failing = self.failing_since.is_some();
        let is_change = !self.is_known || was_failing == works;
        self.is_known = true;
        self.failing_since = if works { None } else { self.failing_since.or(Some(now)) };
        is_change
    }

    /// Value for the rule about files: how long the files could not be written (s); 0 while they can be written.
    pub(crate) fn failing(&self, now: Timestamp) -> Observation {
        let failing_s = self.failing_since.map_or(0.0, |since| now.since(since).max(0.0));
        Observation::new(self.is_known.then_some(failing_s))
    }
}
