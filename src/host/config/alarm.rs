//! The keys of `[[alarm]]`: thresholds as people write them, what must fit together, and the rules they make.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::convert::Raw;
use super::document::Faults;
use super::keys::{Alarm, Recharge};
use super::setting::{Allowed, Setting, Wrong};
use crate::alarm::{Comparison, Direction, Rule, RuleConfig, Severity, Unit};
use crate::health::RechargeAlarm;

/// Part of a threshold by which a value must be back on the healthy side, unless the file says otherwise.
const USUAL_HYSTERESIS: f64 = 0.02;

/// A value to compare with: in the rule's unit, or relative.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Level {
    /// In the rule's unit.
    Absolute(f64),
    /// A part of what a new cell has, from a text like "80 %".
    Relative(f64),
}

/// `2.08`, `"80 %"`, or `{ set = ..., clear = ... }` with either.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Threshold {
    pub set: Level,
    /// `None` = by the hysteresis.
    pub clear: Option<Level>,
}

impl Level {
    fn read(value: &Spanned<DeValue<'_>>, allowed: &Allowed) -> Result<Self, Wrong> {
        let DeValue::String(text) = value.get_ref() else {
            return f64::read(value, allowed).map(Self::Absolute);
        };
        let percent = text.trim().strip_suffix('%').and_then(|number| number.trim().parse::<f64>().ok());
        match percent {
            None => Err(Wrong::Type(value.span())),
            Some(percent) if (0.0..=1000.0).contains(&percent) => Ok(Self::Relative(percent / 100.0)),
            Some(_) => Err(Wrong::Range(value.span())),
        }
    }
}

impl Setting for Threshold {
    const KIND: &'static str = "a number, a text like \"80 %\", or { set = ..., clear = ... } of these";

    fn read(value: &Spanned<DeValue<'_>>, allowed: &Allowed) -> Result<Self, Wrong> {
        let DeValue::Table(table) = value.get_ref() else {
            return Level::read(value, allowed).map(|set| Self { set, clear: None });
        };
        if table.iter().any(|(key, _)| !matches!(key.get_ref().as_ref(), "set" | "clear")) {
            return Err(Wrong::Type(value.span()));
        }
        let set = table.get("set").ok_or_else(|| Wrong::Type(value.span()))?;
        let clear = table.get("clear").map(|clear| Level::read(clear, allowed)).transpose()?;
        Ok(Self { set: Level::read(set, allowed)?, clear })
    }
}

impl Setting for Comparison {
    const KIND: &'static str = "\"mean\", or { probability = ... } above 0 and below 1";

    fn read(value: &Spanned<DeValue<'_>>, _: &Allowed) -> Result<Self, Wrong> {
        match value.get_ref() {
            DeValue::String(text) if text.as_ref() == "mean" => Ok(Self::Mean),
            DeValue::Table(table) if table.len() == 1 => probability(table).ok_or_else(|| Wrong::Type(value.span())),
            _ => Err(Wrong::Type(value.span())),
        }
    }
}

fn probability(table: &DeTable<'_>) -> Option<Comparison> {
    let level = f64::read(table.get("probability")?, &Allowed::Any).ok()?;
    (level > 0.0 && level < 1.0).then_some(Comparison::Probability(level))
}

/// What relative thresholds are relative to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rated {
    /// Capacity on the label, Ah.
    pub capacity_ah: f64,
    /// What the reference charger needs for the recharge window of a cell with that capacity, s.
    pub recharge_period_s: f64,
}

impl Rated {
    /// From the rated capacity and the recharge window.
    pub(super) fn new(capacity_ah: f64, recharge: &Recharge) -> Self {
        let current_a = recharge.reference_current_a.unwrap_or(capacity_ah / 2.0);
        let window = recharge.to_soc - recharge.from_soc;
        Self { capacity_ah, recharge_period_s: 3600.0 * window * capacity_ah / current_a }
    }

    /// What 100 % means for a rule; `None` = nothing.
    fn whole(&self, rule: Rule) -> Option<f64> {
        match (rule, rule.spec().unit) {
            (_, Unit::AmpereHours) => Some(self.capacity_ah),
            (Rule::RechargePeriodLow, _) => Some(self.recharge_period_s),
            (Rule::ResistanceHigh, _) | (_, Unit::Fraction) => Some(1.0),
            (_, Unit::Seconds | Unit::Ratio | Unit::Celsius | Unit::Cycles) => None,
        }
    }

    fn value(&self, rule: Rule, level: Level) -> Option<f64> {
        match level {
            Level::Absolute(value) => Some(value),
            Level::Relative(part) => self.whole(rule).map(|whole| part * whole),
        }
    }
}

impl Alarm {
    /// The thresholds that are written, by severity, with their keys.
    pub(super) fn thresholds(&self) -> impl Iterator<Item = (&'static str, Severity, Threshold)> {
        let all = [
            ("info", Severity::Info, self.info),
            ("warning", Severity::Warning, self.warning),
            ("severe", Severity::Severe, self.severe),
        ];
        all.into_iter().filter_map(|(key, severity, threshold)| Some((key, severity, threshold?)))
    }

    /// The value back at which an alarm clears.
    fn clear(&self, rated: &Rated, set: f64, threshold: &Threshold) -> Option<f64> {
        match threshold.clear {
            Some(clear) => rated.value(self.rule, clear),
            // A fault that has only just begun is no end of the one before.
            None if lasts_only_while_there(self.rule) => Some(0.0),
            None => {
                let hysteresis = self.hysteresis.unwrap_or(USUAL_HYSTERESIS * set.abs());
                Some(set - beyond_sign(self.rule) * hysteresis)
            }
        }
    }

    /// The rules it makes; relative thresholds of a rule that has no whole were noted by [`check`].
    pub(super) fn rules(&self, rated: &Rated) -> Vec<RuleConfig> {
        let rule = |(_, severity, threshold): (_, _, Threshold)| {
            let set = rated.value(self.rule, threshold.set)?;
            Some(RuleConfig {
                rule: self.rule,
                severity,
                threshold: set,
                clear: self.clear(rated, set, &threshold)?,
                when: self.when,
                debounce_s: self.debounce_s,
                debounce_events: self.debounce_events,
                is_latching: self.latched,
            })
        };
        self.thresholds().filter_map(rule).collect()
    }
}

/// Whether the value of a rule is for how long something has been out of order: only 0 says that it is in order.
fn lasts_only_while_there(rule: Rule) -> bool {
    matches!(rule, Rule::BusFault | Rule::StoreFailed)
}

/// 1 where larger values are worse, -1 where smaller ones are.
fn beyond_sign(rule: Rule) -> f64 {
    match rule.spec().direction {
        Direction::Below => -1.0,
        Direction::Above => 1.0,
    }
}

/// Notes what does not fit together in the alarms.
pub(super) fn check(raw: &Raw, rated: Option<&Rated>, faults: &mut Faults) {
    for (index, alarm) in raw.alarms.iter().enumerate() {
        let place = &alarm.place;
        for (key, severity, _) in alarm.thresholds() {
            let same = |other: &&Alarm| other.rule == alarm.rule && other.thresholds().any(|(_, s, _)| s == severity);
            if let Some(twin) = raw.alarms[..index].iter().find(same) {
                let what = format!("must be one per rule, {} in line {} has one", twin.place.path, twin.place.line);
                place.fault(faults, key, &what);
            }
        }
        check_needs(alarm, raw, faults);
        if alarm.thresholds().next().is_none() {
            let text = format!("{} has no threshold, must have info, warning or severe", place.path);
            faults.add(&place.file, place.line, text);
        }
        if let Some(rated) = rated {
            check_thresholds(alarm, rated, faults);
        }
    }
}

/// What a rule needs from the rest of the file.
fn check_needs(alarm: &Alarm, raw: &Raw, faults: &mut Faults) {
    let cells = raw.pack.as_ref().map_or(2, |pack| if raw.voltages_written.1 { 1 } else { pack.cells });
    let missing = match alarm.rule {
        Rule::UsableCapacityLow if !raw.usable_written => "must have a table [usable] that states the load",
        Rule::TemperatureHigh if raw.temperatures.is_empty() && !raw.broken => "must have an [[input.temperature]]",
        Rule::CellImbalance if cells < 2 => "must have the voltages of at least two cells",
        Rule::BmsDisagrees if !raw.reported_written => "must have [input.reported_soc] or [input.reported_soh]",
        _ => "",
    };
    if !missing.is_empty() {
        alarm.place.fault(faults, "rule", missing);
    }
    let is_raw_period = alarm.rule == Rule::RechargePeriodLow
        && raw.recharge.as_ref().is_some_and(|recharge| recharge.alarm_on == RechargeAlarm::Raw);
    if alarm.when != Comparison::Mean && (!alarm.rule.spec().has_deviation || is_raw_period) {
        let what = if is_raw_period {
            "must be \"mean\" with recharge.alarm_on = \"raw\": that period has no standard deviation"
        } else {
            "must be \"mean\": the value of this rule has no standard deviation"
        };
        alarm.place.fault(faults, "when", what);
    }
}

/// Each clear threshold on the healthy side, each graver threshold further out.
fn check_thresholds(alarm: &Alarm, rated: &Rated, faults: &mut Faults) {
    let (place, sign) = (&alarm.place, beyond_sign(alarm.rule));
    let side = if sign > 0.0 { "below" } else { "above" };
    let mut milder: Option<(&str, f64)> = None;
    for (key, _, threshold) in alarm.thresholds() {
        let Some(set) = rated.value(alarm.rule, threshold.set) else {
            place.fault(faults, key, "must be a number: nothing is 100 % for this rule");
            continue;
        };
        check_unit(alarm, key, set, faults);
        match threshold.clear.map(|clear| rated.value(alarm.rule, clear)) {
            Some(None) => place.fault(faults, key, "must clear at a number: nothing is 100 % for this rule"),
            Some(Some(clear)) if sign * (clear - set) > 0.0 => {
                let what = format!("must clear at {set} or {side} it, on the healthy side, not at {clear}");
                place.fault(faults, key, &what);
            }
            Some(Some(_)) | None => {}
        }
        check_reachable(alarm, key, rated, set, &threshold, faults);
        if let Some((other, value)) = milder.filter(|(_, value)| sign * (set - value) <= 0.0) {
            let beyond = if sign > 0.0 { "above" } else { "below" };
            place.fault(faults, key, &format!("must be {beyond} {other} = {value}: it is the graver one"));
        }
        milder = Some((key, set));
    }
}

/// An alarm that no value can clear would stay for ever.
fn check_reachable(alarm: &Alarm, key: &str, rated: &Rated, set: f64, threshold: &Threshold, faults: &mut Faults) {
    let written = if threshold.clear.is_some() { key } else { "hysteresis" };
    if lasts_only_while_there(alarm.rule) {
        if alarm.hysteresis.is_some() || threshold.clear.is_some_and(|clear| clear != Level::Absolute(0.0)) {
            alarm.place.fault(faults, written, "must not be given: it is cleared at 0, when all is in order again");
        }
        return;
    }
    let Some(clear) = alarm.clear(rated, set, threshold) else { return };
    let (low, high) = match alarm.rule.spec().unit {
        Unit::Fraction => (0.0, 1.0),
        Unit::AmpereHours | Unit::Seconds | Unit::Ratio | Unit::Cycles => (0.0, f64::INFINITY),
        Unit::Celsius => return,
    };
    let is_within = (0.0..=high).contains(&set); // otherwise there is a fault already, or it is never raised
    if is_within && !(low..=high).contains(&clear) {
        let range = if high.is_finite() { format!("{low} to {high}") } else { format!("{low} or more") };
        alarm.place.fault(
            faults,
            written,
            &format!("must leave a value that clears {key} within {range}, not {clear}"),
        );
    }
}

/// A percent written without its sign would be a threshold that is never or always passed.
fn check_unit(alarm: &Alarm, key: &str, set: f64, faults: &mut Faults) {
    if alarm.rule.spec().unit == Unit::Fraction && !(0.0..=1.0).contains(&set) {
        alarm.place.fault(faults, key, "must be 0 to 1, or a text like \"20 %\"");
    }
}
