//! Alarming stage: the alarm engine, and what it needs to know of the rules and of the files.
//!
//! In: values of the rules, from the [`Publisher`](super::publisher::Publisher) and the periodic
//! [`watch`](super::watch). Out: raised alarms and their changes.

use serde::{Deserialize, Serialize};

use super::MonitorConfig;
use crate::alarm::{AlarmChange, AlarmEngine, Observation, Rule, RuleConfig};
use crate::quantity::{CellIndex, Timestamp};

/// Values that change no alarm are shown this often, s.
const SHOW_S: f64 = 1.0;

/// The alarming stage.
#[derive(Debug)]
pub(super) struct Alarming {
    pub(super) engine: AlarmEngine,
    /// Silence that the strictest threshold calls missing, s; `None` = no rule does.
    pub(super) missing_after_s: Option<f64>,
    /// Changes that wait to be published.
    pub(super) changes: Vec<AlarmChange>,
    /// When values of inputs, and innovations, that change no alarm were last shown.
    pub(super) inputs_shown_at: Timestamp,
    pub(super) innovations_shown_at: Timestamp,
    /// The engine knows that every learned value has valid inputs.
    pub(super) knows_all_valid: bool,
    /// Cells whose voltage channel is faulty: nothing is known of them. Follows from the diagnosis.
    pub(super) faulty_channels: Vec<CellIndex>,
    pub(super) store: StoreHealth,
}

impl Alarming {
    pub(super) fn new(config: &MonitorConfig) -> Self {
        Self {
            engine: AlarmEngine::new(config.rules.clone(), config.sample.cells),
            missing_after_s: missing_after_s(&config.rules),
            changes: Vec::new(),
            inputs_shown_at: Timestamp::from_nanos(i64::MIN),
            innovations_shown_at: Timestamp::from_nanos(i64::MIN),
            knows_all_valid: false,
            faulty_channels: Vec::new(),
            store: StoreHealth::default(),
        }
    }

    /// Whether the value of a rule is that of a cell whose channel is faulty.
    pub(super) fn is_of_faulty_channel(&self, rule: Rule, cell: Option<CellIndex>) -> bool {
        rule.is_of_cell_voltage() && cell.is_some_and(|cell| self.faulty_channels.contains(&cell))
    }

    /// Other rules; returns how many alarms, raised or past, ended by it.
    pub(super) fn reconfigure(&mut self, now: Timestamp, config: &MonitorConfig) -> usize {
        self.missing_after_s = missing_after_s(&config.rules);
        self.knows_all_valid = false;
        self.engine.reconfigure(now, config.rules.clone(), config.sample.cells, &mut self.changes)
    }
}

fn missing_after_s(rules: &[RuleConfig]) -> Option<f64> {
    let rules = rules.iter().filter(|rule| rule.rule == Rule::InputMissing);
    rules.map(|rule| rule.threshold).min_by(f64::total_cmp)
}

/// Whether values that change no alarm are to be shown again, last shown at `shown_at`; if so, that becomes `now`.
pub(super) fn take_show_due(shown_at: &mut Timestamp, now: Timestamp) -> bool {
    let is_due = now.since(*shown_at).abs() >= SHOW_S;
    if is_due {
        *shown_at = now;
    }
    is_due
}

/// Whether the files can be written; not known before the driver has reported.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(super) struct StoreHealth {
    is_known: bool,
    failing_since: Option<Timestamp>,
}

impl StoreHealth {
    /// Takes the driver's report; whether it is a change.
    pub(super) fn handle_report(&mut self, now: Timestamp, works: bool) -> bool {
        let was_failing = self.failing_since.is_some();
        let is_change = !self.is_known || was_failing == works;
        self.is_known = true;
        self.failing_since = if works { None } else { self.failing_since.or(Some(now)) };
        is_change
    }

    /// The value of the rule about files: for how long they cannot be written, s; 0 while they can.
    pub(super) fn failing(&self, now: Timestamp) -> Observation {
        let failing_s = self.failing_since.map_or(0.0, |since| now.since(since).max(0.0));
        Observation::new(self.is_known.then_some(failing_s))
    }
}
