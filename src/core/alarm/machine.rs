//! State machine of one alarm.
//!
//! | state | beyond | between | healthy | unknown | acknowledge | clear |
//! | --- | --- | --- | --- | --- | --- | --- |
//! | unknown | count towards active | rest | rest | stay | settle | forget |
//! | inactive | count towards active | stay | stay | unknown | settle | forget |
//! | pending | count towards active | rest | rest | hold | settle | forget |
//! | active | stay | stay | count towards the end | suppressed | mark | refuse |
//! | clearing | active | active | count towards the end | suppressed | mark | refuse |
//! | suppressed | active | active | count towards the end | hold | mark | refuse |
//! | latched | count towards active | stay | stay | hold | mark | rest |
//! | cleared | count towards active | stay | stay | unknown | inactive | inactive, forget |
//!
//! Rest is `cleared` when the alarm has been raised and not been acknowledged, else `inactive`. The end is
//! `latched` for a rule that latches, else rest. An alarm is raised while it is active, clearing, suppressed or latched.
//!
//! Counting means time and new values; both must be reached. Time counts only between two observations of a known value on the
//! same side. Time next to an unknown value does not count, and resets nothing either: otherwise a flickering input could
//! keep an alarm from ever being raised.

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;

use super::limit::{LimitCheck, Observation, RuleConfig};
use crate::quantity::Timestamp;

/// State of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlarmState {
    /// Its value is not known, nor whether it should be raised.
    #[default]
    Unknown,
    /// Nothing wrong.
    Inactive,
    /// Beyond the threshold, not yet for long enough.
    Pending,
    /// Raised.
    Active,
    /// Raised, healthy again, not yet for long enough.
    Clearing,
    /// Raised, and its value is not known any more.
    Suppressed,
    /// Raised earlier, healthy again; stays until a command clears it.
    Latched,
    /// Raised earlier, healthy again, not acknowledged.
    Cleared,
}

impl AlarmState {
    /// Whether the alarm is raised in this state.
    pub const fn is_raised(self) -> bool {
        matches!(self, Self::Active | Self::Clearing | Self::Suppressed | Self::Latched)
    }

    /// The code on the wire (`AlarmState` of the alarm frame).
    pub const fn wire_code(self) -> u8 {
        match self {
            Self::Inactive => 0,
            Self::Active | Self::Clearing => 1,
            Self::Cleared => 2,
            Self::Pending => 3,
            Self::Latched => 4,
            Self::Suppressed => 5,
            Self::Unknown => 6,
        }
    }
}

/// A change of an alarm that is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Change {
    /// Raised, or raised again while latched.
    Raised,
    /// Raised, but its value is not known any more.
    Suppressed,
    /// Raised, and its value is known again.
    Resumed,
    /// Healthy again, kept until a command clears it.
    Latched,
    /// Over.
    Cleared,
    /// Acknowledged by a command.
    Acknowledged,
    /// Its past was forgotten on request.
    Forgotten,
}

/// Why a command changed nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Refusal {
    /// The alarm is raised, and its value is not healthy (or not known): only the value can clear it.
    NotHealthy,
    /// There was nothing to do.
    Nothing,
}

/// One alarm: its state, its past, and what its debounce has counted.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Machine {
    pub(super) state: AlarmState,
    /// Whether the latest observation could be compared.
    #[serde(skip)]
    pub(super) is_known: bool,
    /// The latest value, standard deviation and probability; the value of a learned rule outlives its input.
    #[serde(skip)]
    pub(super) observation: Observation,
    #[serde(skip)]
    pub(super) probability: Option<f64>,
    /// Times it was raised since its past was last forgotten.
    pub(super) occurrences: u32,
    /// Comparison it was raised for the first and the last of these times, and the value that raised it last.
    pub(super) first_raised: Timestamp,
    pub(super) last_raised: Timestamp,
    pub(super) raised_value: Option<f64>,
    /// Whether the last of them was acknowledged.
    pub(super) is_acknowledged: bool,
    /// Time counted by the running debounce, ns.
    held_nanos: i64,
    /// New values counted by it.
    events: u32,
    /// From when on time counts; `None` = not counting.
    counted_to: Option<Timestamp>,
    /// The inputs a learned value came from are not valid now.
    is_suspended: bool,
}

/// The facts about an alarm that the engine counts and lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct IndexEntry {
    pub(super) is_known: bool,
    pub(super) is_raised: bool,
    /// Whether time is being counted.
    pub(super) is_counting: bool,
    /// Whether only a value beyond its threshold, or one that is not known, changes anything.
    pub(super) is_at_rest: bool,
}

impl Machine {
    pub(super) fn index_entry(&self) -> IndexEntry {
        let is_counting = self.counted_to.is_some();
        let is_rest = matches!(self.state, AlarmState::Inactive | AlarmState::Cleared);
        IndexEntry {
            is_known: self.is_known,
            is_raised: self.state.is_raised(),
            is_counting,
            is_at_rest: is_rest && self.is_known && !is_counting && !self.is_suspended,
        }
    }

    /// Shows a value that changes nothing, without a deviation.
    #[inline]
    pub(super) fn show(&mut self, value: f64) {
        (self.observation, self.probability) = (Observation { value: Some(value), ..Observation::default() }, None);
    }

    /// Takes a value. A value learned while its inputs are lost (their loss ends the half-cycle before) may raise the alarm.
    /// It does not change an alarm that is raised already until the inputs are back: it would clear it, or look fresh.
    pub(super) fn observe(&mut self, now: Timestamp, rule: &RuleConfig, observation: &Observation) -> Option<Change> {
        self.observation = *observation;
        if self.is_suspended && self.state == AlarmState::Suppressed {
            return None;
        }
        self.is_suspended = false;
        self.judge(now, rule)
    }

    /// Lets time pass over a value that still holds.
    pub(super) fn poll(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.counted_to.is_some() { self.count(now, rule, false) } else { None }
    }

    /// The inputs of the learned value are not valid now: the value cannot be renewed.
    pub(super) fn suspend(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.is_suspended {
            return None;
        }
        self.is_suspended = true;
        self.handle_check(now, rule, LimitCheck::Unknown, false)
    }

    /// The inputs are valid again: the value holds as before, or as learned since.
    pub(super) fn resume(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if !std::mem::take(&mut self.is_suspended) {
            return None;
        }
        self.judge(now, rule)
    }

    /// The time up to the next observation does not count.
    pub(super) fn handle_gap(&mut self) {
        self.counted_to = None;
    }

    /// Takes another threshold: counts towards the old one are dropped, and a known value is new to it.
    pub(super) fn retarget(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        (self.held_nanos, self.events, self.counted_to) = (0, 0, None);
        if !self.is_known {
            return None;
        }
        self.observation.is_new = true;
        self.judge(now, rule)
    }

    /// Acknowledges the alarm.
    pub(super) fn acknowledge(&mut self) -> Result<Change, Refusal> {
        if self.occurrences == 0 || self.is_acknowledged {
            return Err(Refusal::Nothing);
        }
        self.is_acknowledged = true;
        if self.state == AlarmState::Cleared {
            self.enter(AlarmState::Inactive);
        }
        Ok(Change::Acknowledged)
    }

    /// Clears it: a latched alarm ends, a past one is forgotten, one that is beyond or not known stays.
    pub(super) fn clear(&mut self) -> Result<Change, Refusal> {
        match self.state {
            AlarmState::Active | AlarmState::Clearing | AlarmState::Suppressed => Err(Refusal::NotHealthy),
            // Beyond again, only not for long enough yet.
            AlarmState::Latched if self.events > 0 || self.counted_to.is_some() => Err(Refusal::NotHealthy),
            AlarmState::Latched => {
                self.is_acknowledged = true;
                self.enter(if self.is_known { AlarmState::Inactive } else { AlarmState::Unknown });
                Ok(Change::Cleared)
            }
            _ if self.occurrences == 0 => Err(Refusal::Nothing),
            _ => {
                (self.occurrences, self.is_acknowledged) = (0, true);
                if self.state == AlarmState::Cleared {
                    self.enter(AlarmState::Inactive);
                }
                Ok(Change::Forgotten)
            }
        }
    }

    /// Its published state: an unknown value is shown as such, also before the first observation after a restart.
    pub(super) fn shown(&self) -> AlarmState {
        match self.state {
            AlarmState::Inactive | AlarmState::Cleared if !self.is_known => AlarmState::Unknown,
            AlarmState::Active | AlarmState::Clearing if !self.is_known => AlarmState::Suppressed,
            state => state,
        }
    }

    /// The latest value, unless it is not known (any more).
    pub(super) fn value(&self) -> Option<f64> {
        self.observation.value.filter(|value| self.is_known && value.is_finite())
    }

    /// Whether a restart must not forget it.
    pub(super) fn is_worth_storing(&self) -> bool {
        self.occurrences > 0 || self.state == AlarmState::Pending
    }

    /// As it is restored: its value is not known before the next observation.
    pub(super) fn without_value(self) -> Self {
        Self { is_known: false, observation: Observation::default(), probability: None, ..self }
    }

    /// Moves the stamps onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.first_raised = self.first_raised.plus_nanos(by_nanos);
        self.last_raised = self.last_raised.plus_nanos(by_nanos);
        self.counted_to = self.counted_to.map(|stamp| stamp.plus_nanos(by_nanos));
    }

    fn judge(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        let (check, probability) = LimitCheck::of(rule, &self.observation);
        self.probability = probability;
        // New only once, however often it is judged.
        let is_new = std::mem::take(&mut self.observation.is_new);
        self.handle_check(now, rule, check, is_new)
    }

    /// The table of the machine: every state with every outcome of a comparison.
    fn handle_check(&mut self, now: Timestamp, rule: &RuleConfig, check: LimitCheck, is_new: bool) -> Option<Change> {
        use AlarmState::{Active, Cleared, Clearing, Inactive, Latched, Pending, Suppressed, Unknown};
        use LimitCheck::{Between, Beyond, Healthy};
        self.is_known = check != LimitCheck::Unknown;
        match (self.state, check) {
            (Unknown | Inactive | Pending | Latched | Cleared, Beyond) | (Active | Clearing | Suppressed, Healthy) => {
                return self.count(now, rule, is_new);
            }
            (Active, Beyond | Between) | (Inactive | Cleared, Between | Healthy) => {}
            (Clearing, Beyond | Between) => self.enter(Active),
            (Suppressed, Beyond | Between) => {
                self.enter(Active);
                return Some(Change::Resumed);
            }
            (Unknown | Pending, Between | Healthy) => self.enter(self.rest()),
            (Latched, Between | Healthy) => self.enter(Latched),
            (Unknown, LimitCheck::Unknown) => {}
            (Inactive | Cleared, LimitCheck::Unknown) => self.enter(Unknown),
            // What was counted is kept, and nothing is counted.
            (Pending | Suppressed | Latched, LimitCheck::Unknown) => self.counted_to = None,
            // What was counted towards the end is kept.
            (Active | Clearing, LimitCheck::Unknown) => {
                (self.state, self.counted_to) = (Suppressed, None);
                return Some(Change::Suppressed);
            }
        }
        None
    }

    /// State of an alarm that is not raised and has a known value.
    fn rest(&self) -> AlarmState {
        if self.occurrences > 0 && !self.is_acknowledged { AlarmState::Cleared } else { AlarmState::Inactive }
    }

    fn count(&mut self, now: Timestamp, rule: &RuleConfig, is_new: bool) -> Option<Change> {
        let passed = self.counted_to.map_or(0, |from| now.nanos().saturating_sub(from.nanos()).max(0));
        self.held_nanos = self.held_nanos.saturating_add(passed);
        self.events = self.events.saturating_add(u32::from(is_new));
        self.counted_to = Some(now);
        let held_long_enough = self.held_nanos >= Timestamp::from_secs(rule.debounce_s).nanos();
        let is_over = held_long_enough && self.events >= rule.debounce_events;
        let is_healthy_side = !self.state.is_raised() || self.state == AlarmState::Latched;
        match (is_healthy_side, is_over) {
            (true, true) => {
                self.raise(now);
                Some(Change::Raised)
            }
            (true, false) => {
                if self.state != AlarmState::Latched {
                    self.state = AlarmState::Pending;
                }
                None
            }
            (false, true) => {
                self.enter(if rule.is_latching { AlarmState::Latched } else { self.rest() });
                Some(if rule.is_latching { Change::Latched } else { Change::Cleared })
            }
            (false, false) => {
                let before = std::mem::replace(&mut self.state, AlarmState::Clearing);
                (before == AlarmState::Suppressed).then_some(Change::Resumed)
            }
        }
    }

    fn raise(&mut self, now: Timestamp) {
        self.enter(AlarmState::Active);
        if self.occurrences == 0 {
            self.first_raised = now;
        }
        self.occurrences = self.occurrences.saturating_add(1);
        (self.last_raised, self.raised_value, self.is_acknowledged) = (now, self.value(), false);
    }

    fn enter(&mut self, state: AlarmState) {
        self.state = state;
        self.held_nanos = 0;
        self.events = 0;
        self.counted_to = None;
    }
}

#[cfg(test)]
mod tests;
