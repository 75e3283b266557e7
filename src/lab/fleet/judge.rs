//! Scores the alarms of one threshold in one log: lead time before the end of life, missed alarms and false alarms.
//!
//! The terms come from `tests/alarm_tradeoff.md`. Here, they also cover logs that end before the end of life. If a
//! horizon (days or cycles) is given, an alarm is right only if the end of life follows within the horizon.
//!
//! * **end of life**: if the true capacities are known, the first time at which the capacity of a cell is below the
//!   limit. Otherwise, the time from which the weakest learned capacity stays below the limit until the end of the log.
//! * **true raise**: a raise before the end of life. With a horizon, the end of life must follow within the horizon.
//! * **false alarm**: with a horizon, a raise after which the end of life does not follow within the horizon. Without a
//!   horizon, any raise in a log without an end of life. Raises at or after the end of life are neither true nor false.
//! * **open**: with a horizon, a raise in a log without an end of life, if the log ends within the horizon after the
//!   raise. Open raises cannot be judged, so they are not false.
//! * **lead**: time from the first true raise to the end of life, in days and in equivalent full cycles.
//! * **missed**: the end of life was reached without a true raise.
//! * **false raise**: a raise of `capacity_low` while the true capacity of the cell is above the threshold. It is
//!   counted only if the true capacities come from a simulation, not from published data.
//! * **flickers**: clears before the end of life. Without an end of life, all clears count.
//!
//! Only rules about ageing (rules on learned values) are judged. For other rules, raises and clears are only counted.

use serde::Serialize;

use super::track::Track;
use super::truth::{EndOfLifeSource, Truth};
use super::variant_batch::{AlarmHistory, Raise};

use crate::alarm::{Rule, RuleConfig};
use crate::quantity::Timestamp;

/// Longest time from a true raise to the end of life.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Horizon {
    /// Number of equivalent full cycles.
    Cycles(f64),
    /// Number of days.
    Days(f64),
}

/// Data by which the alarms of a log are judged.
#[derive(Debug, Clone, Copy)]
pub struct LogLife<'a> {
    /// Charge moved, and learned capacities.
    pub track: &'a Track,
    /// True capacities; `None` = unknown.
    pub truth: Option<&'a Truth>,
    /// First and last stamp.
    pub span: (Timestamp, Timestamp),
    /// End of life; `None` = not reached.
    pub end: Option<Timestamp>,
    /// Longest time from a true raise to `end`; `None` = unlimited.
    pub horizon: Option<Horizon>,
}

/// First raise of a threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FirstRaise {
    /// Time of the raise on the clock of the log (s).
    pub time_s: f64,
    /// Days from the first stamp of the log to the raise.
    pub days: f64,
    /// Equivalent full cycles up to the raise.
    pub cycles: f64,
    /// Cell, counted from 0; `None` = the pack.
    pub cell: Option<u16>,
    /// Value that raised the alarm, in the unit of the rule.
    pub value: Option<f64>,
}

/// Score of one threshold's alarms in one log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlarmScore {
    /// First raise, even after the end of life; `None` = the alarm was never raised.
    pub first: Option<FirstRaise>,
    /// Number of all raises.
    pub raises: usize,
    /// Lead time (days).
    pub lead_days: Option<f64>,
    /// Lead time (equivalent full cycles).
    pub lead_cycles: Option<f64>,
    /// Whether the end of life was reached without a true raise. `None` = the end of life was not reached, the log
    /// starts after it, or the rule is not about ageing.
    pub missed: Option<bool>,
    /// Number of false alarms; `None` = the rule is not about ageing, or the log starts after the end of life.
    pub false_alarms: Option<usize>,
    /// Number of raises that cannot be judged; `None` as for `false_alarms`.
    pub open: Option<usize>,
    /// Number of raises while the true capacity was above the threshold. `None` = the rule is not `capacity_low`, or
    /// the true capacities do not come from a simulation.
    pub false_raises: Option<usize>,
    /// Number of clears before the end of life.
    pub flickers: usize,
    /// Number of raises and clears that were not stored.
    pub not_kept: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RaiseClass {
    True,
    False,
    Open,
    Late,
}

/// Judges the alarms of one threshold.
pub fn judge(config: &RuleConfig, history: &AlarmHistory, life: &LogLife<'_>) -> AlarmScore {
    let verdicts: Vec<(RaiseClass, &Raise)> = history.raises.iter().map(|raise| (life.verdict(raise), raise)).collect();
    let count = |wanted| verdicts.iter().filter(|(verdict, _)| *verdict == wanted).count();
    // If a log starts after the end of life, its alarms are not judged.
    let is_ageing = config.rule.spec().is_learned && life.end.is_none_or(|end| end > life.span.0);
    let first_true = verdicts.iter().find(|(verdict, _)| *verdict == RaiseClass::True).map(|(_, raise)| raise.time);
    let lead = life.end.zip(first_true).filter(|_| is_ageing);
    AlarmScore {
        first: history.raises.first().map(|raise| life.first(raise)),
        raises: history.raises.len(),
        lead_days: lead.map(|(end, raised)| end.since(raised) / 86_400.0),
        lead_cycles: lead.map(|(end, raised)| life.track.cycles_at(end) - life.track.cycles_at(raised)),
        missed: life.end.filter(|_| is_ageing).map(|_| first_true.is_none()),
        false_alarms: is_ageing.then(|| count(RaiseClass::False)),
        open: is_ageing.then(|| count(RaiseClass::Open)),
        false_raises: life.false_raises(config, history),
        flickers: history.clears.iter().filter(|time| life.end.is_none_or(|end| **time < end)).count(),
        not_kept: history.not_kept,
    }
}

impl LogLife<'_> {
    fn verdict(&self, raise: &Raise) -> RaiseClass {
        let within = |until: Timestamp| match self.horizon {
            None => None,
            Some(Horizon::Days(days)) => Some(until.since(raise.time) / 86_400.0 <= days),
            Some(Horizon::Cycles(cycles)) => {
                Some(self.track.cycles_at(until) - self.track.cycles_at(raise.time) <= cycles)
            }
        };
        match self.end {
            Some(end) if raise.time >= end => RaiseClass::Late,
            Some(end) if within(end).unwrap_or(true) => RaiseClass::True,
            Some(_) => RaiseClass::False,
            None if within(self.span.1).unwrap_or(false) => RaiseClass::Open,
            None => RaiseClass::False,
        }
    }

    fn first(&self, raise: &Raise) -> FirstRaise {
        FirstRaise {
            time_s: raise.time.secs(),
            days: raise.time.since(self.span.0) / 86_400.0,
            cycles: self.track.cycles_at(raise.time),
            cell: raise.cell.map(|cell| cell.0),
            value: raise.value,
        }
    }

    fn false_raises(&self, config: &RuleConfig, history: &AlarmHistory) -> Option<usize> {
        let truth = self.truth.filter(|truth| truth.kind == EndOfLifeSource::Truth)?;
        let is_false = |raise: &&Raise| {
            let true_ah = raise.cell.and_then(|cell| truth.capacity_ah(cell, raise.time));
            true_ah.is_some_and(|true_ah| true_ah > config.threshold)
        };
        (config.rule == Rule::CapacityLow).then(|| history.raises.iter().filter(is_false).count())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{Comparison, Severity};
    use crate::monitor::{Event, EventKind};
    use crate::quantity::{CellIndex, DAY_S, Mode};

    fn day(day: f64) -> Timestamp {
        Timestamp::from_secs(day * DAY_S)
    }

    /// Creates a track with one equivalent full cycle per day.
    fn track() -> Track {
        let mut track = Track::new(1.0, EndOfLifeSource::Learned);
        for end in 1..=100 {
            let kind = EventKind::HalfCycle {
                cell: CellIndex(0),
                mode: Mode::Discharge,
                charge_ah: 2.0,
                swing: None,
                swing_std: None,
                duration_s: 1.0,
                mean_current_a: 1.0,
                mean_temperature_c: None,
            };
            track.observe(&[Event { time: day(f64::from(end)), kind }]);
        }
        track
    }

    fn rule(rule: Rule) -> RuleConfig {
        RuleConfig {
            rule,
            severity: Severity::Warning,
            threshold: 0.8,
            clear: 0.9,
            when: Comparison::Mean,
            debounce_s: 0.0,
            debounce_events: 1,
            is_latching: false,
        }
    }

    fn history(raised: &[f64], cleared: &[f64]) -> AlarmHistory {
        let raise = |at: &f64| Raise { time: day(*at), cell: Some(CellIndex(0)), value: Some(0.79) };
        AlarmHistory {
            raises: raised.iter().map(raise).collect(),
            clears: cleared.iter().map(|at| day(*at)).collect(),
            not_kept: 0,
        }
    }

    fn judged(raised: &[f64], end: Option<f64>, horizon: Option<Horizon>) -> AlarmScore {
        let track = track();
        let life = LogLife { track: &track, truth: None, span: (day(0.0), day(100.0)), end: end.map(day), horizon };
        judge(&rule(Rule::CapacityLow), &history(raised, &[20.0, 95.0]), &life)
    }

    #[test]
    fn lead_runs_from_first_true_raise_to_end() {
        let found = judged(&[10.0, 60.0], Some(90.0), None);
        assert_eq!((found.lead_days, found.lead_cycles, found.missed), (Some(80.0), Some(80.0), Some(false)));
        assert_eq!((found.false_alarms, found.flickers, found.raises), (Some(0), 1, 2));
        // With a horizon of 40, the raise at 10 is false, and the lead starts at the raise at 60.
        for horizon in [Horizon::Days(40.0), Horizon::Cycles(40.0)] {
            let found = judged(&[10.0, 60.0], Some(90.0), Some(horizon));
            assert_eq!((found.lead_days, found.false_alarms, found.missed), (Some(30.0), Some(1), Some(false)));
        }
    }

    #[test]
    fn end_without_earlier_raise_is_missed() {
        for raised in [&[][..], &[90.0, 95.0]] {
            let found = judged(raised, Some(90.0), None);
            assert_eq!((found.missed, found.lead_days, found.false_alarms), (Some(true), None, Some(0)), "{raised:?}");
        }
        assert_eq!(judged(&[10.0], Some(90.0), Some(Horizon::Days(5.0))).missed, Some(true));
    }

    #[test]
    fn raise_without_end_is_false_or_open() {
        let found = judged(&[10.0, 80.0], None, None);
        assert_eq!((found.false_alarms, found.open, found.missed), (Some(2), Some(0), None));
        let found = judged(&[10.0, 80.0], None, Some(Horizon::Days(40.0)));
        assert_eq!((found.false_alarms, found.open), (Some(1), Some(1)));
    }

    #[test]
    fn raises_of_other_rules_are_only_counted() {
        let track = track();
        let life =
            LogLife { track: &track, truth: None, span: (day(0.0), day(100.0)), end: Some(day(90.0)), horizon: None };
        let found = judge(&rule(Rule::SocLow), &history(&[10.0], &[]), &life);
        assert_eq!((found.raises, found.lead_days, found.false_alarms, found.missed), (1, None, None, None));
        assert_eq!(found.first.map(|first| (first.days, first.cycles)), Some((10.0, 10.0)));
    }
}
