//! The life of one alarm.
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
//! Rest is `cleared` when the alarm has been raised and nobody has acknowledged that, else `inactive`. The end is
//! `latched` for a rule that latches, else rest. An alarm is raised while it is active, clearing, suppressed or latched.
//!
//! Counting means time and new values; both must be reached. Time counts only between two looks at a known value on the
//! same side: what lies beside an unknown value counts for nothing, and takes nothing away either, or a flickering
//! input could keep an alarm from ever being raised.

use serde::{Deserialize, Serialize};

use super::judge::Verdict;
use super::{Observation, RuleConfig};
use crate::quantity::Timestamp;

/// Where an alarm is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Its value is not known: nobody can say whether it should be raised.
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
    /// Raised earlier, healthy again; stays until it is cleared by somebody.
    Latched,
    /// Raised earlier, healthy again; nobody has acknowledged it.
    Cleared,
}

impl State {
    /// Whether the alarm is raised in this state.
    pub const fn is_raised(self) -> bool {
        matches!(self, Self::Active | Self::Clearing | Self::Suppressed | Self::Latched)
    }

    /// The code on the wire (`State` of the alarm frame).
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

/// What an alarm is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MachineInput {
    Verdict(Verdict),
    Acknowledge,
    Clear,
}

/// What became of an alarm that others must hear of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// Raised, or raised again while latched.
    Raised,
    /// Raised, but its value is not known any more.
    Suppressed,
    /// Raised, and its value is known again.
    Resumed,
    /// Healthy again, kept until somebody clears it.
    Latched,
    /// Over.
    Cleared,
    /// Somebody has seen it.
    Acknowledged,
    /// Its past was forgotten on request.
    Forgotten,
}

/// Why a command changed nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Refusal {
    /// Cleared by nobody but its value: the alarm is raised, and its value is not healthy (or not known).
    NotHealthy,
    /// There was nothing to do.
    Nothing,
}

/// What to do in a state on what it is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Nothing changes.
    Stay,
    /// Count towards the other side.
    Count,
    /// Keep what was counted, count nothing.
    Hold,
    /// Forget what was counted, go there.
    Go(State),
    /// Forget what was counted, go to rest.
    Rest,
    /// Raised without a value; what was counted towards the end is kept.
    Suppress,
    /// Somebody has seen the raised alarm.
    Mark,
    /// Somebody has seen that the alarm was raised.
    Settle,
    /// That the alarm was raised is forgotten.
    Forget,
    /// Not possible.
    Refuse,
}

const fn step(state: State, told: MachineInput) -> Step {
    use State::{Active, Cleared, Clearing, Inactive, Latched, Pending, Suppressed, Unknown};
    match told {
        MachineInput::Verdict(verdict) => match (state, verdict) {
            (Unknown | Inactive | Pending | Latched | Cleared, Verdict::Beyond) => Step::Count,
            (Active, Verdict::Beyond | Verdict::Between) => Step::Stay,
            (Clearing | Suppressed, Verdict::Beyond | Verdict::Between) => Step::Go(Active),
            (Unknown | Pending, Verdict::Between | Verdict::Healthy) => Step::Rest,
            (Inactive | Cleared, Verdict::Between | Verdict::Healthy) => Step::Stay,
            (Latched, Verdict::Between | Verdict::Healthy) => Step::Go(Latched),
            (Active | Clearing | Suppressed, Verdict::Healthy) => Step::Count,
            (Unknown, Verdict::Unknown) => Step::Stay,
            (Inactive | Cleared, Verdict::Unknown) => Step::Go(Unknown),
            (Pending | Suppressed | Latched, Verdict::Unknown) => Step::Hold,
            (Active | Clearing, Verdict::Unknown) => Step::Suppress,
        },
        MachineInput::Acknowledge => match state {
            Unknown | Inactive | Pending | Cleared => Step::Settle,
            Active | Clearing | Suppressed | Latched => Step::Mark,
        },
        MachineInput::Clear => match state {
            Unknown | Inactive | Pending | Cleared => Step::Forget,
            Active | Clearing | Suppressed => Step::Refuse,
            Latched => Step::Rest,
        },
    }
}

/// One alarm: its state, its past, and what its debounce has counted.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Machine {
    pub(super) state: State,
    /// Whether the latest look could be judged.
    #[serde(skip)]
    pub(super) is_known: bool,
    /// The latest value, standard deviation and probability; the value of a learned rule outlives its input.
    #[serde(skip)]
    pub(super) seen: Observation,
    #[serde(skip)]
    pub(super) probability: Option<f64>,
    /// Times it was raised since its past was last forgotten.
    pub(super) occurrences: u32,
    /// When it was raised for the first and the last of these times, and the value that raised it last.
    pub(super) first_raised: Timestamp,
    pub(super) last_raised: Timestamp,
    pub(super) raised_value: Option<f64>,
    /// Whether somebody has seen the last of them.
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

/// What is counted and listed of an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Standing {
    pub(super) is_known: bool,
    pub(super) is_raised: bool,
    /// Whether time is being counted.
    pub(super) is_counting: bool,
    /// Whether only a value beyond its threshold, or one that is not known, changes anything.
    pub(super) is_at_rest: bool,
}

impl Machine {
    pub(super) fn standing(&self) -> Standing {
        let is_counting = self.counted_to.is_some();
        let is_rest = matches!(self.state, State::Inactive | State::Cleared);
        Standing {
            is_known: self.is_known,
            is_raised: self.state.is_raised(),
            is_counting,
            is_at_rest: is_rest && self.is_known && !is_counting && !self.is_suspended,
        }
    }

    /// Shows a value that changes nothing, without a deviation.
    #[inline]
    pub(super) fn show(&mut self, value: f64) {
        (self.seen, self.probability) = (Observation { value: Some(value), ..Observation::default() }, None);
    }

    /// Takes a value. One that is learned while its inputs are lost (their loss ends the half-cycle before) may raise the
    /// alarm; to one that is raised already it says nothing before they are back: it would clear, or look fresh.
    pub(super) fn observe(&mut self, now: Timestamp, rule: &RuleConfig, seen: &Observation) -> Option<Change> {
        self.seen = *seen;
        if self.is_suspended && self.state == State::Suppressed {
            return None;
        }
        self.is_suspended = false;
        self.judge(now, rule)
    }

    /// Lets time pass over a value that still holds.
    pub(super) fn poll(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.counted_to.is_some() { self.count(now, rule, false) } else { None }
    }

    /// What the value was learned from is not valid now: the value cannot be renewed.
    pub(super) fn suspend(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if self.is_suspended {
            return None;
        }
        self.is_suspended = true;
        self.tell(now, rule, Verdict::Unknown, false)
    }

    /// It is valid again: the value stands as it was, or as it was learned since.
    pub(super) fn resume(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        if !std::mem::take(&mut self.is_suspended) {
            return None;
        }
        self.judge(now, rule)
    }

    /// The time up to the next look is not known or nobody looked: it does not count.
    pub(super) fn handle_gap(&mut self) {
        self.counted_to = None;
    }

    /// Its threshold is another one: what was counted towards the old one does not count, and a value that is known is
    /// new to it.
    pub(super) fn retarget(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        (self.held_nanos, self.events, self.counted_to) = (0, 0, None);
        if !self.is_known {
            return None;
        }
        self.seen.is_new = true;
        self.judge(now, rule)
    }

    /// Somebody has seen the alarm.
    pub(super) fn acknowledge(&mut self) -> Result<Change, Refusal> {
        match step(self.state, MachineInput::Acknowledge) {
            Step::Mark | Step::Settle if self.occurrences == 0 || self.is_acknowledged => Err(Refusal::Nothing),
            _ => {
                self.is_acknowledged = true;
                if self.state == State::Cleared {
                    self.enter(State::Inactive);
                }
                Ok(Change::Acknowledged)
            }
        }
    }

    /// Somebody clears it: a latched alarm ends, a past one is forgotten, one that is beyond or not known stays.
    pub(super) fn clear(&mut self) -> Result<Change, Refusal> {
        match step(self.state, MachineInput::Clear) {
            Step::Refuse => Err(Refusal::NotHealthy),
            // Beyond again, only not for long enough yet.
            Step::Rest if self.events > 0 || self.counted_to.is_some() => Err(Refusal::NotHealthy),
            Step::Rest => {
                self.is_acknowledged = true;
                self.enter(if self.is_known { State::Inactive } else { State::Unknown });
                Ok(Change::Cleared)
            }
            _ if self.occurrences == 0 => Err(Refusal::Nothing),
            _ => {
                (self.occurrences, self.is_acknowledged) = (0, true);
                if self.state == State::Cleared {
                    self.enter(State::Inactive);
                }
                Ok(Change::Forgotten)
            }
        }
    }

    /// Its state as others see it: what is not known is shown so, also before the first look after a restart.
    pub(super) fn shown(&self) -> State {
        match self.state {
            State::Inactive | State::Cleared if !self.is_known => State::Unknown,
            State::Active | State::Clearing if !self.is_known => State::Suppressed,
            state => state,
        }
    }

    /// The latest value, unless it is not known (any more).
    pub(super) fn value(&self) -> Option<f64> {
        self.seen.value.filter(|value| self.is_known && value.is_finite())
    }

    /// Whether a restart must not forget it.
    pub(super) fn is_worth_storing(&self) -> bool {
        self.occurrences > 0 || self.state == State::Pending
    }

    /// As it is stored: its value is not known before the next look.
    pub(super) fn without_value(self) -> Self {
        Self { is_known: false, seen: Observation::default(), probability: None, ..self }
    }

    /// Moves the stamps onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.first_raised = self.first_raised.plus_nanos(by_nanos);
        self.last_raised = self.last_raised.plus_nanos(by_nanos);
        self.counted_to = self.counted_to.map(|stamp| stamp.plus_nanos(by_nanos));
    }

    fn judge(&mut self, now: Timestamp, rule: &RuleConfig) -> Option<Change> {
        let (verdict, probability) = Verdict::of(rule, &self.seen);
        self.probability = probability;
        // New only once, however often it is judged.
        let is_new = std::mem::take(&mut self.seen.is_new);
        self.tell(now, rule, verdict, is_new)
    }

    fn tell(&mut self, now: Timestamp, rule: &RuleConfig, verdict: Verdict, is_new: bool) -> Option<Change> {
        self.is_known = verdict != Verdict::Unknown;
        match step(self.state, MachineInput::Verdict(verdict)) {
            Step::Count => return self.count(now, rule, is_new),
            Step::Hold => self.counted_to = None,
            Step::Suppress => {
                (self.state, self.counted_to) = (State::Suppressed, None);
                return Some(Change::Suppressed);
            }
            Step::Go(state) => {
                let was_suppressed = self.state == State::Suppressed;
                self.enter(state);
                return was_suppressed.then_some(Change::Resumed);
            }
            Step::Rest => self.enter(self.rest()),
            Step::Stay | Step::Mark | Step::Settle | Step::Forget | Step::Refuse => {}
        }
        None
    }

    /// Where an alarm is that is not raised and whose value is known.
    fn rest(&self) -> State {
        if self.occurrences > 0 && !self.is_acknowledged { State::Cleared } else { State::Inactive }
    }

    fn count(&mut self, now: Timestamp, rule: &RuleConfig, is_new: bool) -> Option<Change> {
        let passed = self.counted_to.map_or(0, |from| now.nanos().saturating_sub(from.nanos()).max(0));
        self.held_nanos = self.held_nanos.saturating_add(passed);
        self.events = self.events.saturating_add(u32::from(is_new));
        self.counted_to = Some(now);
        let held_long_enough = self.held_nanos >= Timestamp::from_secs(rule.debounce_s).nanos();
        let is_over = held_long_enough && self.events >= rule.debounce_events;
        match (self.state, is_over) {
            (State::Unknown | State::Inactive | State::Pending | State::Cleared, false) => {
                self.state = State::Pending;
                None
            }
            (State::Latched, false) => None,
            (State::Active | State::Clearing, false) => {
                self.state = State::Clearing;
                None
            }
            (State::Suppressed, false) => {
                self.state = State::Clearing;
                Some(Change::Resumed)
            }
            (State::Unknown | State::Inactive | State::Pending | State::Cleared | State::Latched, true) => {
                self.raise(now);
                Some(Change::Raised)
            }
            (State::Active | State::Clearing | State::Suppressed, true) => {
                self.enter(if rule.is_latching { State::Latched } else { self.rest() });
                Some(if rule.is_latching { Change::Latched } else { Change::Cleared })
            }
        }
    }

    fn raise(&mut self, now: Timestamp) {
        self.enter(State::Active);
        if self.occurrences == 0 {
            self.first_raised = now;
        }
        self.occurrences = self.occurrences.saturating_add(1);
        (self.last_raised, self.raised_value, self.is_acknowledged) = (now, self.value(), false);
    }

    fn enter(&mut self, state: State) {
        self.state = state;
        self.held_nanos = 0;
        self.events = 0;
        self.counted_to = None;
    }
}

#[cfg(test)]
mod tests;
