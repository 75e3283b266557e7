//! The life of one alarm: inactive, pending, active, clearing.
//!
//! | state | beyond | between | healthy | unknown |
//! | --- | --- | --- | --- | --- |
//! | inactive | count towards active | stay | stay | stay |
//! | pending | count towards active | inactive | inactive | hold |
//! | active | stay | stay | count towards inactive | stay |
//! | clearing | active | active | count towards inactive | hold |
//!
//! Counting means time and new values; both must be reached. Time counts only between two looks at a known
//! value on the same side: what lies beside an unknown value counts for nothing, and takes nothing away
//! either, or a flickering input could keep an alarm from ever being raised.

use serde::{Deserialize, Serialize};

use super::{Direction, RuleConfig};
use crate::quantity::Timestamp;

/// Where an alarm is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Nothing known to be wrong.
    #[default]
    Inactive,
    /// Beyond the threshold, not yet for long enough.
    Pending,
    /// Raised.
    Active,
    /// Raised, healthy again, not yet for long enough.
    Clearing,
}

impl State {
    /// Whether the alarm is raised in this state.
    pub const fn is_raised(self) -> bool {
        matches!(self, Self::Active | Self::Clearing)
    }

    /// Whether a debounce is running in this state.
    pub const fn is_counting(self) -> bool {
        matches!(self, Self::Pending | Self::Clearing)
    }
}

/// What a value says about a rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// On the bad side of the threshold.
    Beyond,
    /// On the good side, but by less than the hysteresis.
    Between,
    /// On the good side by at least the hysteresis.
    Healthy,
    /// No usable value (none, or not finite).
    Unknown,
}

impl Verdict {
    pub(super) fn of(rule: &RuleConfig, value: Option<f64>) -> Self {
        let Some(value) = value.filter(|value| value.is_finite()) else { return Self::Unknown };
        let above_by = value - rule.threshold;
        let good_by = match rule.rule.direction() {
            Direction::Below => above_by,
            Direction::Above => -above_by,
        };
        if good_by < 0.0 {
            Self::Beyond
        } else if good_by < rule.hysteresis {
            Self::Between
        } else {
            Self::Healthy
        }
    }
}

/// What to do in a state on a verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Nothing changes.
    Stay,
    /// Count towards the other side.
    Count,
    /// Keep what was counted, count nothing.
    Hold,
    /// Forget what was counted.
    Back,
}

const fn step(state: State, verdict: Verdict) -> Step {
    match (state, verdict) {
        (State::Inactive, Verdict::Beyond) => Step::Count,
        (State::Inactive, Verdict::Between | Verdict::Healthy | Verdict::Unknown) => Step::Stay,
        (State::Pending, Verdict::Beyond) => Step::Count,
        (State::Pending, Verdict::Between | Verdict::Healthy) => Step::Back,
        (State::Pending, Verdict::Unknown) => Step::Hold,
        (State::Active, Verdict::Healthy) => Step::Count,
        (State::Active, Verdict::Beyond | Verdict::Between | Verdict::Unknown) => Step::Stay,
        (State::Clearing, Verdict::Healthy) => Step::Count,
        (State::Clearing, Verdict::Beyond | Verdict::Between) => Step::Back,
        (State::Clearing, Verdict::Unknown) => Step::Hold,
    }
}

/// One alarm: its state and what its debounce has counted.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Machine {
    pub(super) state: State,
    /// The latest value; `None` = not known (any more).
    pub(super) value: Option<f64>,
    /// When it was raised; meaningful while raised.
    pub(super) raised: Timestamp,
    /// Time counted by the running debounce, ns.
    held_nanos: i64,
    /// New values counted by it.
    events: u32,
    /// From when on time counts; `None` = not counting.
    counted_to: Option<Timestamp>,
}

impl Machine {
    /// Takes a value; true when the alarm was raised or cleared by it.
    pub(super) fn observe(&mut self, now: Timestamp, rule: &RuleConfig, value: Option<f64>, new_value: bool) -> bool {
        let verdict = Verdict::of(rule, value);
        self.value = value.filter(|value| value.is_finite());
        match step(self.state, verdict) {
            Step::Stay => false,
            Step::Count => self.count(now, rule, new_value),
            Step::Hold => {
                self.counted_to = None;
                false
            }
            Step::Back => {
                self.enter(if self.state.is_raised() { State::Active } else { State::Inactive });
                false
            }
        }
    }

    /// Lets time pass over a value that still holds; true when the alarm was raised or cleared by it.
    pub(super) fn poll(&mut self, now: Timestamp, rule: &RuleConfig) -> bool {
        self.state.is_counting() && self.counted_to.is_some() && self.count(now, rule, false)
    }

    /// The time up to the next look is not known or nobody looked: it does not count.
    pub(super) fn handle_gap(&mut self) {
        self.counted_to = None;
    }

    /// Moves the stamps onto another clock.
    pub(super) fn rebase(&mut self, by_nanos: i64) {
        self.raised = self.raised.plus_nanos(by_nanos);
        self.counted_to = self.counted_to.map(|stamp| stamp.plus_nanos(by_nanos));
    }

    fn count(&mut self, now: Timestamp, rule: &RuleConfig, new_value: bool) -> bool {
        let passed = self.counted_to.map_or(0, |from| now.nanos().saturating_sub(from.nanos()).max(0));
        self.held_nanos = self.held_nanos.saturating_add(passed);
        self.events = self.events.saturating_add(u32::from(new_value));
        self.counted_to = Some(now);
        let raised = self.state.is_raised();
        let held_long_enough = self.held_nanos >= Timestamp::from_secs(rule.debounce_s).nanos();
        if !(held_long_enough && self.events >= rule.debounce_events) {
            self.state = if raised { State::Clearing } else { State::Pending };
            return false;
        }
        self.enter(if raised { State::Inactive } else { State::Active });
        self.raised = now;
        true
    }

    fn enter(&mut self, state: State) {
        self.state = state;
        self.held_nanos = 0;
        self.events = 0;
        self.counted_to = None;
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Rule, Severity};
    use super::*;

    const STATES: [State; 4] = [State::Inactive, State::Pending, State::Active, State::Clearing];
    const VERDICTS: [Verdict; 4] = [Verdict::Beyond, Verdict::Between, Verdict::Healthy, Verdict::Unknown];

    fn rule() -> RuleConfig {
        RuleConfig {
            rule: Rule::CapacityLow,
            threshold: 1.4,
            hysteresis: 0.1,
            debounce_s: 10.0,
            debounce_events: 2,
            severity: Severity::Warning,
        }
    }

    fn value(verdict: Verdict) -> Option<f64> {
        match verdict {
            Verdict::Beyond => Some(1.3),
            Verdict::Between => Some(1.45),
            Verdict::Healthy => Some(1.6),
            Verdict::Unknown => None,
        }
    }

    fn machine_in(state: State) -> Machine {
        let mut machine = Machine::default();
        let looks: &[(f64, f64)] = match state {
            State::Inactive => &[],
            State::Pending => &[(0.0, 1.3)],
            State::Active => &[(0.0, 1.3), (10.0, 1.3)],
            State::Clearing => &[(0.0, 1.3), (10.0, 1.3), (20.0, 1.6)],
        };
        for &(time, v) in looks {
            machine.observe(Timestamp::from_secs(time), &rule(), Some(v), true);
        }
        assert_eq!(machine.state, state);
        machine
    }

    /// State after one more look, before and after the debounce has run out.
    fn expected(state: State, verdict: Verdict) -> (State, State) {
        match (state, verdict) {
            (State::Inactive, Verdict::Beyond) => (State::Pending, State::Pending),
            (State::Inactive, Verdict::Between) => (State::Inactive, State::Inactive),
            (State::Inactive, Verdict::Healthy) => (State::Inactive, State::Inactive),
            (State::Inactive, Verdict::Unknown) => (State::Inactive, State::Inactive),
            (State::Pending, Verdict::Beyond) => (State::Pending, State::Active),
            (State::Pending, Verdict::Between) => (State::Inactive, State::Inactive),
            (State::Pending, Verdict::Healthy) => (State::Inactive, State::Inactive),
            (State::Pending, Verdict::Unknown) => (State::Pending, State::Pending),
            (State::Active, Verdict::Beyond) => (State::Active, State::Active),
            (State::Active, Verdict::Between) => (State::Active, State::Active),
            (State::Active, Verdict::Healthy) => (State::Clearing, State::Clearing),
            (State::Active, Verdict::Unknown) => (State::Active, State::Active),
            (State::Clearing, Verdict::Beyond) => (State::Active, State::Active),
            (State::Clearing, Verdict::Between) => (State::Active, State::Active),
            (State::Clearing, Verdict::Healthy) => (State::Clearing, State::Inactive),
            (State::Clearing, Verdict::Unknown) => (State::Clearing, State::Clearing),
        }
    }

    #[test]
    fn every_state_and_verdict_leads_where_the_table_says() {
        for state in STATES {
            for verdict in VERDICTS {
                let (early, late) = expected(state, verdict);
                for (time, want) in [(21.0, early), (40.0, late)] {
                    // Pending began at 0, clearing at 20: look 1 s or 20 s later.
                    let time = if state == State::Pending { time - 20.0 } else { time };
                    let mut machine = machine_in(state);
                    let changed = machine.observe(Timestamp::from_secs(time), &rule(), value(verdict), true);
                    assert_eq!(machine.state, want, "{state:?} {verdict:?} at {time}");
                    assert_eq!(changed, state.is_raised() != want.is_raised(), "{state:?} {verdict:?} at {time}");
                    assert_eq!(machine.value, value(verdict));
                }
            }
        }
    }

    #[test]
    fn time_alone_or_values_alone_do_not_raise() {
        let mut by_time = machine_in(State::Pending);
        assert!(!by_time.poll(Timestamp::from_secs(1e6), &rule()), "one value, endless time");
        let mut by_values = machine_in(State::Pending);
        for _ in 0..1000 {
            assert!(!by_values.observe(Timestamp::from_secs(9.9), &rule(), Some(1.0), true), "many values, 9.9 s");
        }
        assert!(by_values.poll(Timestamp::from_secs(10.0), &rule()), "and 0.1 s later both hold");
    }

    #[test]
    fn time_beside_an_unknown_value_does_not_count() {
        let mut machine = machine_in(State::Pending);
        machine.observe(Timestamp::from_secs(4.0), &rule(), None, true);
        assert!(!machine.poll(Timestamp::from_secs(100.0), &rule()));
        assert!(!machine.observe(Timestamp::from_secs(200.0), &rule(), Some(1.3), true));
        assert!(!machine.poll(Timestamp::from_secs(209.0), &rule()), "the time before the unknown value is not known");
        assert!(machine.poll(Timestamp::from_secs(210.0), &rule()));
    }

    #[test]
    fn time_in_a_gap_does_not_count() {
        let mut machine = machine_in(State::Pending);
        machine.handle_gap();
        assert!(!machine.observe(Timestamp::from_secs(500.0), &rule(), Some(1.3), true));
        assert!(machine.observe(Timestamp::from_secs(510.0), &rule(), Some(1.3), true));
    }

    #[test]
    fn a_clock_that_goes_back_takes_nothing_away() {
        let mut machine = machine_in(State::Pending);
        assert!(!machine.observe(Timestamp::from_secs(-50.0), &rule(), Some(1.3), true));
        assert!(machine.observe(Timestamp::from_secs(-40.0), &rule(), Some(1.3), true));
    }

    #[test]
    fn the_threshold_itself_is_not_beyond_in_either_direction() {
        let low = RuleConfig { hysteresis: 0.0, ..rule() };
        assert_eq!(Verdict::of(&low, Some(1.4)), Verdict::Healthy);
        let high = RuleConfig { rule: Rule::InputMissing, threshold: 5.0, hysteresis: 1.0, ..rule() };
        assert_eq!(Verdict::of(&high, Some(5.1)), Verdict::Beyond);
        assert_eq!(Verdict::of(&high, Some(5.0)), Verdict::Between);
        assert_eq!(Verdict::of(&high, Some(4.0)), Verdict::Healthy);
    }

    #[test]
    fn values_that_are_not_finite_are_unknown() {
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(Verdict::of(&rule(), Some(odd)), Verdict::Unknown);
        }
    }
}
