//! Checks the keys of `[[alarm]]` against each other, and builds the alarm rules of the core.

use crate::config::schema::RawTables;
use crate::config::schema::keys::{Alarm, Recharge, ReportedSocInput, ReportedSohInput, Usable};
use crate::config::schema::{Level, Threshold};

use crate::alarm::{Comparison, Direction, Rule, RuleConfig, Severity, Unit};
use crate::health::RechargeAlarm;

/// The values of a new cell. Relative thresholds such as "80 %" refer to these values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RatedCell {
    /// Rated capacity (Ah).
    pub capacity_ah: f64,
    /// Time in which the reference charger charges a cell of the rated capacity through the recharge window (a
    /// configured SOC range) (s).
    pub recharge_period_s: f64,
}

impl RatedCell {
    pub(crate) fn new(capacity_ah: f64, recharge: &Recharge) -> Self {
        let recharge = recharge.config(capacity_ah);
        let window = recharge.to_soc - recharge.from_soc;
        Self { capacity_ah, recharge_period_s: 3600.0 * window * capacity_ah / recharge.reference_current_a }
    }

    /// Returns the value that counts as 100 % for a rule; `None` if percentages are not defined for this rule.
    fn whole(&self, rule: Rule) -> Option<f64> {
        match (rule, rule.spec().unit) {
            (_, Unit::AmpereHours) => Some(self.capacity_ah),
            (Rule::RechargePeriodLow, _) => Some(self.recharge_period_s),
            (Rule::ResistanceHigh, _) | (_, Unit::Fraction | Unit::FractionPerDay) => Some(1.0),
            (_, Unit::Seconds | Unit::Ratio | Unit::Celsius | Unit::Cycles) => None,
        }
    }

    fn value(&self, rule: Rule, level: Level) -> Option<f64> {
        match level {
            Level::Absolute(value) => Some(value),
            Level::Relative(part) => self.whole(rule).map(|whole| part * whole),
        }
    }

    /// Formats a level for a message: `1.4 Ah`, or `80 % (2.08 Ah)` for a relative level.
    fn shown(&self, rule: Rule, level: Level) -> String {
        let with_unit = |value: f64| format!("{} {}", rounded(value), rule.spec().unit.symbol()).trim_end().to_owned();
        let value = self.value(rule, level).map(with_unit).unwrap_or_default();
        match level {
            Level::Absolute(_) => value,
            Level::Relative(part) => format!("{} % ({value})", rounded(100.0 * part)),
        }
    }
}

impl Alarm {
    /// The configured thresholds with their keys and severities.
    pub(crate) fn thresholds(&self) -> impl Iterator<Item = (&'static str, Severity, Threshold)> {
        let all = [
            ("info", Severity::Info, self.info),
            ("warning", Severity::Warning, self.warning),
            ("severe", Severity::Severe, self.severe),
        ];
        all.into_iter().filter_map(|(key, severity, threshold)| Some((key, severity, threshold?)))
    }

    /// Returns the value at which the alarm clears if its threshold is `set`.
    fn clear(&self, rated: &RatedCell, set: f64, threshold: &Threshold) -> Option<f64> {
        match threshold.clear {
            Some(clear) => rated.value(self.rule, clear),
            // The value is the duration of a fault, which is 0 only after the fault has ended.
            None if value_is_fault_duration(self.rule) => Some(0.0),
            None => {
                let hysteresis = self.hysteresis.unwrap_or(0.02 * set.abs());
                Some(set - beyond_sign(self.rule) * hysteresis)
            }
        }
    }

    /// The configured rules. Relative thresholds of rules without a 100 % value are left out; [`check`] has reported
    /// them.
    pub(crate) fn rules(&self, rated: &RatedCell) -> Vec<RuleConfig> {
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
                is_latching: self.latched.unwrap_or(self.rule == Rule::ThermalEvent),
            })
        };
        self.thresholds().filter_map(rule).collect()
    }
}

/// Whether the rule's value is the duration of a fault, so that only 0 means "no fault".
fn value_is_fault_duration(rule: Rule) -> bool {
    matches!(rule, Rule::BusFault | Rule::StoreFailed)
}

/// 1 if larger values are worse, -1 if smaller values are worse.
fn beyond_sign(rule: Rule) -> f64 {
    match rule.spec().direction {
        Direction::Below => -1.0,
        Direction::Above => 1.0,
    }
}

/// Reports alarms whose keys contradict each other.
pub(crate) fn check(raw: &RawTables, rated: Option<&RatedCell>) {
    for (index, alarm) in raw.alarms.iter().enumerate() {
        let place = &alarm.place;
        for (key, severity, _) in alarm.thresholds() {
            let same = |other: &&Alarm| other.rule == alarm.rule && other.thresholds().any(|(_, s, _)| s == severity);
            if let Some(twin) = raw.alarms[..index].iter().find(same) {
                let line = twin.place.at.beside(place.line_of(key));
                place.fault(
                    key,
                    format!("must be given once per rule, but {} in {line} also gives it", twin.place.path),
                );
            }
        }
        check_needs(alarm, raw);
        if alarm.thresholds().next().is_none() {
            place.table_fault("has no threshold, must have info, warning or severe");
        }
        if let Some(rated) = rated {
            check_thresholds(alarm, rated);
        }
    }
}

/// Reports inputs and tables that the alarm's rule requires but the file does not contain. If the key `when` requires a
/// standard deviation and the rule's value has none, reports the key.
fn check_needs(alarm: &Alarm, raw: &RawTables) {
    let cells = raw.pack.as_ref().map_or(2, |pack| if raw.is_pack_total() { 1 } else { pack.cells });
    let is_reported = raw.is_written::<ReportedSocInput>() || raw.is_written::<ReportedSohInput>();
    let missing = match alarm.rule {
        Rule::UsableCapacityLow if !raw.is_written::<Usable>() => "requires a table [usable], which states the load",
        Rule::TemperatureHigh if raw.temperatures.is_empty() && !raw.broken => "requires an [[input.temperature]]",
        Rule::CellImbalance if cells < 2 => "requires the voltages of at least two cells",
        Rule::CellLeak | Rule::ConnectionResistance | Rule::ChannelFaulty if cells < 3 => {
            "requires the voltages of at least three cells"
        }
        Rule::ThermalEvent if cells < 3 && raw.temperatures.is_empty() && !raw.broken => {
            "requires the voltages of at least three cells or an [[input.temperature]]"
        }
        Rule::BmsDisagrees if !is_reported => "requires [input.reported_soc] or [input.reported_soh]",
        _ => "",
    };
    if !missing.is_empty() {
        alarm.place.fault("rule", missing);
    }
    let is_raw_period = alarm.rule == Rule::RechargePeriodLow
        && raw.recharge.as_ref().is_some_and(|recharge| recharge.alarm_on == RechargeAlarm::Raw);
    if alarm.when != Comparison::Mean && (!alarm.rule.spec().has_deviation || is_raw_period) {
        let what = if is_raw_period {
            "must be \"mean\" with recharge.alarm_on = \"raw\": the raw period has no standard deviation"
        } else {
            "must be \"mean\": the value of this rule has no standard deviation"
        };
        alarm.place.fault("when", what);
    }
}

/// Checks that each clear threshold lies on the healthy side of its set threshold. Also checks that a more severe
/// threshold lies farther from the healthy side than a milder threshold.
fn check_thresholds(alarm: &Alarm, rated: &RatedCell) {
    let (place, sign) = (&alarm.place, beyond_sign(alarm.rule));
    let side = if sign > 0.0 { "below" } else { "above" };
    let shown = |level| rated.shown(alarm.rule, level);
    let mut milder: Option<(&str, f64, Level)> = None;
    for (key, _, threshold) in alarm.thresholds() {
        let Some(set) = rated.value(alarm.rule, threshold.set) else {
            place.fault(key, "must be a number: percentages are not defined for this rule");
            continue;
        };
        check_unit(alarm, key, set);
        match threshold.clear.map(|level| (level, rated.value(alarm.rule, level))) {
            Some((_, None)) => place.fault(key, "must clear at a number: percentages are not defined for this rule"),
            Some((level, Some(clear))) if sign * (clear - set) > 0.0 => {
                let [set, clear] = [threshold.set, level].map(shown);
                place.fault(key, format!("must clear at {set} or {side}, not at {clear}"));
            }
            Some((_, Some(_))) | None => {}
        }
        check_reachable(alarm, key, rated, set, &threshold);
        if let Some((other, _, level)) = milder.filter(|(_, value, _)| sign * (set - value) <= 0.0) {
            let (beyond, value) = (if sign > 0.0 { "above" } else { "below" }, shown(level));
            place.fault(key, format!("must be {beyond} {other} = {value}: it is the more severe threshold"));
        }
        milder = Some((key, set, threshold.set));
    }
}

/// Reports a threshold whose alarm would stay raised for ever, because no value can clear it.
fn check_reachable(alarm: &Alarm, key: &str, rated: &RatedCell, set: f64, threshold: &Threshold) {
    let written = if threshold.clear.is_some() { key } else { "hysteresis" };
    if value_is_fault_duration(alarm.rule) {
        if alarm.hysteresis.is_some() || threshold.clear.is_some_and(|clear| clear != Level::Absolute(0.0)) {
            alarm.place.fault(written, "must not be given: the alarm clears when the fault has ended");
        }
        return;
    }
    let Some(clear) = alarm.clear(rated, set, threshold) else { return };
    let (low, high) = match alarm.rule.spec().unit {
        Unit::Fraction | Unit::FractionPerDay => (0.0, 1.0),
        Unit::AmpereHours | Unit::Seconds | Unit::Ratio | Unit::Cycles => (0.0, f64::INFINITY),
        Unit::Celsius => return,
    };
    // If `set` is outside this range, another check reports it, or no value reaches it.
    let is_within = (0.0..=high).contains(&set);
    if is_within && !(low..=high).contains(&clear) {
        let range = if high.is_finite() { format!("{low} to {high}") } else { format!("{low} or more") };
        alarm.place.fault(written, format!("must clear {key} at {range}, not at {}", rounded(clear)));
    }
}

/// Rounds a value for a message, so that the message shows no rounding errors of the computation.
fn rounded(value: f64) -> f64 {
    format!("{value:.9e}").parse().unwrap_or(value)
}

/// Reports a threshold outside 0 to 1 for a value that is a fraction. Probably its percent sign is missing.
fn check_unit(alarm: &Alarm, key: &str, set: f64) {
    let is_fraction = matches!(alarm.rule.spec().unit, Unit::Fraction | Unit::FractionPerDay);
    if is_fraction && !(0.0..=1.0).contains(&set) {
        alarm.place.fault(key, "must be 0 to 1, or a string like \"20 %\"");
    }
}
