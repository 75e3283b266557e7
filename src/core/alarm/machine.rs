//! State machine of one alarm.
//!
//! | state | beyond | between | healthy | unknown | acknowledge | clear |
//! | --- | --- | --- | --- | --- | --- | --- |
//! | unknown | count towards active | rest | rest | stay | mark | forget |
//! | inactive | count towards active | stay | stay | unknown | mark | forget |
//! | pending | count towards active | rest | rest | hold | mark | forget |
//! | active | stay | stay | count towards the end | suppressed | mark | refuse |
//! | clearing | active | active | count towards the end | suppressed | mark | refuse |
//! | suppressed | active | active | count towards the end | hold | mark | refuse |
//! | latched | count towards active | stay | stay | hold | mark | release |
//! | cleared | count towards active | stay | stay | unknown | mark, inactive | forget, inactive |
//!
//! The columns are the outcome of a comparison and the two commands. A value is `beyond` the set threshold, `healthy`
//! (on the good side of the clear threshold), or `between` the two thresholds.
//!
//! * The name of a state: enter this state.
//! * Rest: enter `cleared` if the alarm was raised and not acknowledged, else `inactive`.
//! * End: enter `latched` for a latching rule, else rest.
//! * Count: add up the time and the new values. The debounce of the rule sets a minimum for each of the two sums. When
//!   both sums have reached their minimum, enter the state that the table names, or apply "End". Until then, an alarm
//!   that is not raised is `pending`, a latched alarm stays `latched`, and any other alarm is `clearing`.
//! * Hold: stay, and keep the time and the number of values counted.
//! * Mark: acknowledge the latest occurrence. Forget: reset the number of occurrences. Refuse: change nothing.
//! * Release: refuse while counting; else enter `inactive`, or `unknown` if the value is unknown.
//!
//! An alarm is raised while it is active, clearing, suppressed or latched.
//!
//! Time counts only between two observations that are both beyond the threshold, or both healthy. The time between a
//! known and an unknown value does not count. For a learned value, time also counts up to each poll, because the value
//! stays valid. An unknown value does not reset the count, because otherwise an intermittent input could prevent an
//! alarm forever.
//!
//! An alarm may end, or change to `suppressed`, only [`QUICK_ENDS`] times in short succession and then once per
//! [`END_PERIOD_S`]. Until this is allowed, the alarm stays raised and no change is published. Cyclic frames still show
//! an unknown value as `suppressed`. An intermittent input therefore does not flood the bus or the history.

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;

use super::limit::{LimitCheck, Observation, RuleConfig};
use crate::quantity::Timestamp;

/// Number of ends (including changes to `suppressed`) in short succession. Work on the vehicle causes fewer ends.
const QUICK_ENDS: i64 = 120;
/// Time between further ends, s. An alarm then changes at most 288 times a day.
const END_PERIOD_S: f64 = 600.0;

/// State of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlarmState {
    /// The value is unknown, so it is also unknown whether the alarm should be raised.
    #[default]
    Unknown,
    /// The value is not beyond the threshold.
    Inactive,
    /// The value is beyond the threshold, but not for long enough.
    Pending,
    /// The alarm is raised.
    Active,
    /// The alarm is raised. The value is healthy again, but not for long enough.
    Clearing,
    /// The alarm is raised, but the value has become unknown.
    Suppressed,
    /// The alarm was raised earlier, and the value is healthy again. The alarm stays until a command clears it.
    Latched,
    /// The alarm was raised earlier, and the value is healthy again. The alarm is not acknowledged.
    Cleared,
}

impl AlarmState {
    /// Whether the alarm is raised in this state.
    pub const fn is_raised(self) -> bool {
        matches!(self, Self::Active | Self::Clearing | Self::Suppressed | Self::Latched)
    }

    /// The wire code (`AlarmState` of the alarm frame).
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

/// A published change of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Change {
    /// The alarm was raised, or raised again while latched.
    Raised,
    /// The alarm is still raised, but the value has become unknown.
    Suppressed,
    /// The alarm is still raised, and the value is known again.
    Resumed,
    /// The value is healthy again; the alarm stays until a command clears it.
    Latched,
    /// The alarm is no longer raised.
    Cleared,
    /// A command acknowledged the alarm.
    Acknowledged,
    /// The history of the alarm was forgotten: by a command, after a pack exchange, or because the alarm no longer has
    /// a threshold.
    Forgotten,
}

/// Reason why a command changed nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Refusal {
    /// The alarm is raised, and its value is unhealthy or unknown, or has not been healthy for long enough.
    NotHealthy,
    /// There is nothing to acknowledge or to clear.
    Nothing,
}

/// One alarm: its state, its history and the progress of its debounce.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Machine {
    pub(super) state: AlarmState,
    /// Whether the latest observation could be compared.
    #[serde(skip)]
    pub(super) is_known: bool,
    /// The latest observation. A learned value is kept while its inputs are lost.
    #[serde(skip)]
    pub(super) observation: Observation,
    /// Probability that the true value is beyond the threshold; `None` = unknown.
    #[serde(skip)]
    pub(super) probability: Option<f64>,
    pub(super) occurrences: u32,
    /// Times of the comparisons that raised the alarm first and last, and the value that raised it last.
    pub(super) first_raised: Timestamp,
    pub(super) last_raised: Timestamp,
    pub(super) raised_value: Option<f64>,
    /// Whether the last occurrence was acknowledged.
    pub(super) is_acknowledged: bool,
    /// Time counted by the running debounce, ns.
    held_nanos: i64,
    /// New values counted by the running debounce.
    events: u32,
    /// Time up to which the debounce has counted; `None` = not counting.
    counted_to: Option<Timestamp>,
    /// Whether the inputs of a learned value are invalid now.
    is_suspended: bool,
    /// Time from which all [`QUICK_ENDS`] are available again.
    #[serde(default)]
    rested_at: Timestamp,
}

/// Properties of an alarm that the engine counts and lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct IndexEntry {
    pub(super) is_known: bool,
    pub(super) is_raised: bool,
    pub(super) is_counting: bool,
    /// Whether only a value beyond the threshold or an unknown value can change the alarm.
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

    /// Stores a value that cannot change the alarm and has no standard deviation.
    #[inline]
    pub(super) fn show(&mut self, value: f64) {
        (self.observation, self.probability) = (Observation { value: Some(value), ..Observation::default() }, None);
    }

    /// Handles a value. When the inputs of a learned value are lost, the half-cycle in progress ends, and its result
    /// may still arrive as a new value. This late value may raise the alarm. If the alarm is suppressed, it stays
    /// suppressed, because the late value would clear the alarm, or would look as if the inputs had returned.
    pub(super) fn observe(&mut self, now: Timestamp, rule: &RuleConfig, observation: &Observation) -> Option<Change> {
        self.observation = *observation;
        if self.is_suspended && self.shown() == AlarmState::Suppressed {
            return None;
        }
        self.is_suspended = false;
        self.judge(now, rule)
    }

    /// Advances the debounce for a value that is still valid.
    pub(super) fn poll(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.counted_to.is_some() { self.count(now, rule, false) } else { None }
    }

    /// Handles the loss of the inputs of a learned value.
    pub(super) fn suspend(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.is_suspended {
            return None;
        }
        self.is_suspended = true;
        self.handle_check(now, rule, LimitCheck::Unknown, false)
    }

    /// Handles the return of the inputs: the latest learned value is valid again.
    pub(super) fn resume(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if !std::mem::take(&mut self.is_suspended) {
            return None;
        }
        self.judge(now, rule)
    }

    /// Stops counting time until the next observation.
    pub(super) fn handle_gap(&mut self) {
        self.counted_to = None;
    }

    /// Switches to another threshold: resets the debounce and compares the known value again.
    pub(super) fn retarget(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        (self.held_nanos, self.events, self.counted_to) = (0, 0, None);
        if !self.is_known {
            return None;
        }
        self.observation.is_new = true;
        self.judge(now, rule)
    }

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

    /// Handles the command "clear": ends a latched alarm, or forgets the history of a past alarm. Refuses if the alarm
    /// is raised and not latched, or latched and beyond its threshold again.
    pub(super) fn clear(&mut self) -> Result<Change, Refusal> {
        match self.state {
            AlarmState::Active | AlarmState::Clearing | AlarmState::Suppressed => Err(Refusal::NotHealthy),
            // The value is beyond the threshold again, but not for long enough.
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

    /// The published state. While the value is unknown, an inactive or cleared alarm is published as `Unknown`, and an
    /// active or clearing alarm as `Suppressed`. The value is also unknown between a restart and the first observation.
    pub(super) fn shown(&self) -> AlarmState {
        match self.state {
            AlarmState::Inactive | AlarmState::Cleared if !self.is_known => AlarmState::Unknown,
            AlarmState::Active | AlarmState::Clearing if !self.is_known => AlarmState::Suppressed,
            state => state,
        }
    }

    /// The latest value; `None` = unknown.
    pub(super) fn value(&self) -> Option<f64> {
        self.observation.value.filter(|value| self.is_known && value.is_finite())
    }

    /// Whether the alarm must survive a restart.
    pub(super) fn is_worth_storing(&self) -> bool {
        self.occurrences > 0 || self.state == AlarmState::Pending
    }

    /// Returns the machine as it continues after a restore at the time `now`. The value is unknown until the next
    /// observation. If a stored time of a raise is later than `now`, it becomes `now`.
    pub(super) fn restored(self, now: Timestamp) -> Self {
        let (first_raised, last_raised) = (self.first_raised.min(now), self.last_raised.min(now));
        let value = Observation::default();
        let rested_at = self.rested_at.min(now.plus_secs(QUICK_ENDS as f64 * END_PERIOD_S));
        Self { is_known: false, observation: value, probability: None, first_raised, last_raised, rested_at, ..self }
    }

    /// Enters a state that fits the published state `shown`. The debounce starts again.
    pub(super) fn enter_shown(&mut self, shown: AlarmState) {
        self.enter(match shown {
            AlarmState::Active | AlarmState::Clearing | AlarmState::Suppressed => AlarmState::Active,
            AlarmState::Latched => AlarmState::Latched,
            AlarmState::Inactive | AlarmState::Pending | AlarmState::Cleared | AlarmState::Unknown => self.rest(),
        });
    }

    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.first_raised = self.first_raised.plus_nanos(by_nanos);
        self.last_raised = self.last_raised.plus_nanos(by_nanos);
        self.counted_to = self.counted_to.map(|stamp| stamp.plus_nanos(by_nanos));
        self.rested_at = self.rested_at.plus_nanos(by_nanos);
    }

    /// Whether the alarm may end now. If so, counts the end.
    fn take_end(&mut self, now: Timestamp) -> bool {
        let latest = now.plus_secs(QUICK_ENDS as f64 * END_PERIOD_S);
        // After a backward step of the clock, the stored time may be far ahead.
        self.rested_at = self.rested_at.min(latest);
        let rested_at = self.rested_at.max(now).plus_secs(END_PERIOD_S);
        let is_allowed = rested_at <= latest;
        if is_allowed {
            self.rested_at = rested_at;
        }
        is_allowed
    }

    fn judge(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        let (check, probability) = LimitCheck::of(rule, &self.observation);
        self.probability = probability;
        // A value counts as new only at its first comparison.
        let is_new = std::mem::take(&mut self.observation.is_new);
        self.handle_check(now, rule, check, is_new)
    }

    /// The transition table: every state with every outcome of a comparison.
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
            // Keep the count, but stop counting.
            (Pending | Suppressed | Latched, LimitCheck::Unknown) => self.counted_to = None,
            // Keep the count towards the end.
            (Active | Clearing, LimitCheck::Unknown) => {
                self.counted_to = None;
                if self.take_end(now) {
                    self.state = Suppressed;
                    return Some(Change::Suppressed);
                }
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
            (false, true) if self.take_end(now) => {
                self.enter(if rule.is_latching { AlarmState::Latched } else { self.rest() });
                Some(if rule.is_latching { Change::Latched } else { Change::Cleared })
            }
            (false, _) => {
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
