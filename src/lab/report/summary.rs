//! Creates the summary at the top of the page: the condition of the battery, how long this condition has lasted, and
//! what to do. If data are missing, the summary says "unknown".

use std::collections::BTreeSet;

use super::context::PageContext;
use super::data::{AlarmRecord, Data, Origin};
use super::forecast::Outlook;
use super::format::{alarm_text, length, moment};
use super::limits::{rank, rule};
use super::raised::{ActiveAlarm, doubt, raised, value};
use super::{forecast, series};
use crate::alarm::{Direction, Rule};

/// Condition of the battery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Condition {
    Good,
    Watch,
    Plan,
    Act,
    Unknown,
}

impl Condition {
    /// CSS class of the condition.
    pub(super) const fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Watch => "watch",
            Self::Plan => "plan",
            Self::Act => "act",
            Self::Unknown => "unknown",
        }
    }

    /// Sign that does not depend on colour.
    pub(super) const fn sign(self) -> &'static str {
        match self {
            Self::Good => "\u{2713}",
            Self::Watch => "i",
            Self::Plan => "!",
            Self::Act => "!!",
            Self::Unknown => "?",
        }
    }
}

/// A named figure.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tile {
    pub(super) name: &'static str,
    pub(super) value: String,
    pub(super) note: String,
    /// Untrusted cells on which the figure depends; `None` = all cells are trusted, or the figure is unknown
    /// or not an estimate.
    pub(super) doubt: Option<String>,
}

/// Content of the summary.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Summary {
    pub(super) verdict: Condition,
    pub(super) headline: String,
    pub(super) since: String,
    pub(super) advice: String,
    pub(super) tiles: Vec<Tile>,
}

/// Creates the summary.
pub(super) fn of(data: &Data, context: &PageContext<'_>, outlook: &Result<Outlook, String>) -> Summary {
    let raised = raised(data);
    let (battery, measuring): (Vec<_>, Vec<_>) = raised.iter().partition(|raised| concerns_battery(&raised.row.rule));
    let worst = worst(&battery, |alarm| value(alarm.row, data, context, outlook.as_ref().ok()));
    let unknown = unknown(data, context);
    let why = worst.or(measuring.first().copied()).map_or_else(String::new, |alarm| {
        match value(alarm.row, data, context, outlook.as_ref().ok()) {
            Some(now) => format!(" Now {}.", alarm_text(&AlarmRecord { value: Some(now), ..alarm.row.clone() }, "is")),
            None => format!(" When the alarm was raised, {}.", alarm_text(alarm.row, "was")),
        }
    });
    let verdict = match worst.map(|raised| raised.row.severity.as_str()) {
        Some("severe") => Condition::Act,
        Some("warning") => Condition::Plan,
        Some(_) => Condition::Watch,
        None if is_over(data, context, outlook) => Condition::Watch,
        None if unknown.is_some() => Condition::Unknown,
        None if !measuring.is_empty() => Condition::Watch,
        None => Condition::Good,
    };
    Summary {
        verdict,
        headline: headline(verdict, worst.or(measuring.first().copied()), data, unknown, &why),
        since: since(data, &battery, &measuring),
        advice: advice_text(verdict, worst, &measuring, knows_limits(data, context)),
        tiles: tiles(data, context, outlook, &raised),
    }
}

/// Returns the most severe alarm. If its rule has raised alarms of the same severity for several cells, returns the
/// alarm whose value is the worst at the end of the record.
fn worst<'a>(
    alarms: &[&'a ActiveAlarm<'a>],
    value: impl Fn(&ActiveAlarm<'_>) -> Option<f64>,
) -> Option<&'a ActiveAlarm<'a>> {
    let first = *alarms.iter().max_by_key(|alarm| rank(&alarm.row.severity))?;
    let is_below = rule(&first.row.rule).is_some_and(|rule| rule.spec().direction == Direction::Below);
    let badness =
        |alarm: &ActiveAlarm<'_>| value(alarm).map_or(f64::NEG_INFINITY, |value| if is_below { -value } else { value });
    let is_like_first =
        |alarm: &&&ActiveAlarm<'_>| (&alarm.row.rule, &alarm.row.severity) == (&first.row.rule, &first.row.severity);
    alarms.iter().filter(is_like_first).copied().max_by(|a, b| badness(a).total_cmp(&badness(b)))
}

/// Whether the capacity is below the end of life, regardless of alarms.
fn is_over(data: &Data, context: &PageContext<'_>, outlook: &Result<Outlook, String>) -> bool {
    let least = series::steps(data, series::capacity, false).last().map(|step| step.worst.0);
    let is_below = least.zip(forecast::end_of_life_ah(data, context)).is_some_and(|(least, end)| least < end);
    is_below || outlook.as_ref().is_ok_and(Outlook::is_over)
}

/// Whether the record or a configuration defines limits.
fn knows_limits(data: &Data, context: &PageContext<'_>) -> bool {
    context.config.is_some() || !data.alarms.is_empty()
}

/// Returns why the battery cannot be called good, regardless of alarms; `None` = there is no such reason.
fn unknown(data: &Data, context: &PageContext<'_>) -> Option<String> {
    let cells = context.config.map_or(0, |config| usize::from(config.monitor.sample.cells)).max(data.cells());
    let measured: BTreeSet<usize> =
        data.learned.iter().filter(|row| row.measured_ah.is_some()).map(|row| row.cell).collect();
    if let Some(doubt) = &data.source.doubt {
        return Some(format!("Unknown: {doubt}."));
    }
    if measured.is_empty() {
        return Some("Unknown: nothing has been learned about this battery yet.".to_owned());
    }
    if measured.len() < cells {
        return Some(format!(
            "Unknown: nothing has been learned yet about {} of {cells} cells.",
            cells - measured.len()
        ));
    }
    (!knows_limits(data, context)).then(|| "Unknown: no alarm is raised, but this record states no limit.".to_owned())
}

/// Whether a rule is about the battery itself, not about its measurement.
fn concerns_battery(name: &str) -> bool {
    !matches!(
        rule(name),
        Some(
            Rule::InputMissing
                | Rule::InputImplausible
                | Rule::EstimateUntrusted
                | Rule::BmsDisagrees
                | Rule::StoreFailed
                | Rule::BusFault
                | Rule::ChannelFaulty
        )
    )
}

fn headline(
    verdict: Condition,
    alarm: Option<&ActiveAlarm<'_>>,
    data: &Data,
    unknown: Option<String>,
    why: &str,
) -> String {
    let head = match verdict {
        Condition::Good => "Good: no limit is exceeded.",
        Condition::Watch if alarm.is_none() => "No limit is exceeded, but the capacity is below the end of life.",
        Condition::Watch if alarm.is_some_and(|alarm| !concerns_battery(&alarm.row.rule)) => {
            "The battery exceeds no limit, but its measurements are faulty."
        }
        Condition::Watch => "Worth watching.",
        Condition::Plan => "Worn: plan a visit to the workshop.",
        Condition::Act => "Past its limit: act now.",
        Condition::Unknown => unknown.as_deref().unwrap_or("Unknown."),
    };
    let lost = data.trace.health().coverage().filter(|share| *share < 0.8);
    let doubt = lost.map_or(String::new(), |_| {
        " The estimator's intervals are too narrow (see its health below): use the figures with care.".to_owned()
    });
    let changed = data.source.doubt.iter().filter(|_| verdict != Condition::Unknown);
    let changed: String = changed.map(|changed| format!(" But {changed}.")).collect();
    format!("{head}{why}{doubt}{changed}")
}

fn since(data: &Data, battery: &[&ActiveAlarm<'_>], measuring: &[&ActiveAlarm<'_>]) -> String {
    let first = battery.iter().chain(if battery.is_empty() { measuring } else { &[] }).map(|raised| raised.since_s);
    match (first.reduce(f64::min), data.ends_s()) {
        (Some(time_s), _) => format!("The first alarm that is still raised came {}.", moment(data, time_s)),
        (None, Some((first, last))) if data.is_dated() => {
            format!("No alarm is raised. Watched from {} to {}.", moment(data, first), moment(data, last))
        }
        (None, Some((first, last))) => format!("No alarm is raised. Watched for {}.", length(last - first)),
        (None, None) => "Unknown: there is no record.".to_owned(),
    }
}

fn advice_text(
    verdict: Condition,
    worst: Option<&ActiveAlarm<'_>>,
    measuring: &[&ActiveAlarm<'_>],
    knows_limits: bool,
) -> String {
    let advice = worst.and_then(|raised| rule(&raised.row.rule)).map(|rule| match rule {
        Rule::TemperatureHigh => "Check cooling and load before the next use.",
        Rule::SocLow => "Charge it.",
        Rule::CellImbalance => {
            "Have the cells balanced; if the imbalance returns, have the weakest cell checked."
        }
        Rule::CellLeak => {
            "Measure the rest voltage of the named cell over a week; if it falls relative to the others, replace the cell."
        }
        Rule::ConnectionResistance => "Have the connections of the named cell tightened and cleaned.",
        _ if verdict == Condition::Act => "Replace the battery or the named cell, or take it out of service.",
        _ => "Order a replacement, and have its capacity measured at the next visit.",
    });
    let measure = measuring.first().map(|raised| match rule(&raised.row.rule) {
        Some(Rule::EstimateUntrusted) => {
            "Do not rely on these figures before the sensors and the cell model have been checked."
        }
        Some(Rule::ChannelFaulty) => "Check the sense wire and the channel of the named cell: its figures are wrong.",
        Some(Rule::StoreFailed) => "Check the disk of the vehicle computer: learned values may be lost.",
        _ => "Check sensors, wiring and bus: some inputs are missing or implausible.",
    });
    match (advice, measure) {
        (None, None) if verdict == Condition::Unknown && !knows_limits => {
            "Create the report with the configuration (-c), which defines the limits.".to_owned()
        }
        (None, None) if verdict == Condition::Unknown => {
            "Use the battery through a deep discharge and a full charge, then create the report again.".to_owned()
        }
        (None, None) if verdict == Condition::Watch => "Plan its replacement.".to_owned(),
        (None, None) => "Nothing.".to_owned(),
        (advice, measure) => advice.into_iter().chain(measure).collect::<Vec<_>>().join(" "),
    }
}

fn tile(name: &'static str, value: Option<String>, note: impl Into<String>) -> Tile {
    Tile { name, value: value.unwrap_or_else(|| "unknown".to_owned()), note: note.into(), doubt: None }
}

fn tiles(
    data: &Data,
    context: &PageContext<'_>,
    outlook: &Result<Outlook, String>,
    raised: &[ActiveAlarm<'_>],
) -> Vec<Tile> {
    let last = |pick, high_is_bad| series::steps(data, pick, high_is_bad).last().copied();
    let of_cell =
        |step: &series::CellStep| if data.cells() > 1 { format!(", cell {}", step.cell + 1) } else { String::new() };
    let (capacity, usable) = (last(series::capacity, false), last(series::usable, false));
    let resistance = last(series::resistance, true);
    let figure = |step: &series::CellStep| format!("{:.3} Ah", step.worst.0);
    let rated = capacity.and_then(|step| Some((step, context.rated_ah(step.cell)?)));
    let health = rated.map(|(step, rated)| format!("{:.0} %", 100.0 * step.worst.0 / rated));
    let health_note = match rated {
        Some((step, rated)) => format!("of {rated} Ah rated{}{}", of_cell(&step), assumed(data, step.cell)),
        None if context.config.is_none() => "rated capacity unknown without -c".to_owned(),
        None => "no capacity learned yet".to_owned(),
    };
    let note = |step: Option<series::CellStep>, none: &str| {
        let std = |step: series::CellStep| {
            format!("\u{b1} {:.3}{}{}", step.worst.1, of_cell(&step), assumed(data, step.cell))
        };
        step.map_or_else(|| none.to_owned(), std)
    };
    let mut estimates = vec![
        tile("State of health", health, health_note),
        tile("Capacity", capacity.as_ref().map(figure), note(capacity, "no capacity learned yet")),
        tile("Usable capacity", usable.as_ref().map(figure), note(usable, "no load configured, or none learned yet")),
        losses_tile(data),
        tile(
            "Resistance",
            resistance.map(|step| format!("{:.2} \u{d7} new", step.worst.0)),
            note(resistance, "not learned yet"),
        ),
        recharge_tile(data),
        tile(
            "Remaining life",
            outlook.as_ref().ok().map(Outlook::value),
            outlook.as_ref().map_or_else(Clone::clone, |outlook| outlook.note(data.cells())),
        ),
    ];
    // The figure is the worst of all cells, and an untrusted cell may be the worst.
    let doubt = doubt(data, raised);
    estimates.iter_mut().filter(|tile| tile.value != "unknown").for_each(|tile| tile.doubt.clone_from(&doubt));
    estimates.extend([
        tile(
            "Use so far",
            series::full_cycles(data, context.config.map(|it| it.monitor.model.rated_capacity_ah))
                .map(|cycles| format!("{cycles:.0} cycles")),
            "equivalent full cycles in this record",
        ),
        tile("Alarms raised now", Some(raised.len().to_string()), format!("{} entries in all", data.alarms.len())),
    ]);
    estimates
}

/// Returns a remark for the capacity of a cell. If no half-cycle has measured the capacity, the capacity is the
/// configured value minus the assumed fade, and the remark says so. Otherwise, the remark is empty.
fn assumed(data: &Data, cell: usize) -> &'static str {
    let is_measured = data.learned.iter().any(|row| row.cell == cell && row.measured_ah.is_some());
    if is_measured { "" } else { "; assumed, not measured yet" }
}

/// Returns the tile of the losses of lithium and of both electrodes. Each loss is the largest of all cells.
fn losses_tile(data: &Data) -> Tile {
    let last = |pick| series::steps(data, pick, true).last().copied();
    let figure = |step: series::CellStep| format!("{:.0} \u{b1} {:.0} %", step.worst.0, step.worst.1);
    let material = last(series::negative_lost).zip(last(series::positive_lost));
    let note = material.map_or_else(
        || "not learned, or no electrodes in the cell model".to_owned(),
        |(negative, positive)| format!("negative electrode {}, positive {}", figure(negative), figure(positive)),
    );
    tile("Lithium lost", last(series::lithium_lost).map(figure), note)
}

/// Returns the tile of the latest recharge period, normalised if known, with the first recharge period for comparison.
fn recharge_tile(data: &Data) -> Tile {
    let normalised = || data.recharges.iter().filter_map(|row| row.normalised_s.map(|(mean, _)| mean));
    let raw = || data.recharges.iter().filter_map(|row| row.raw_s);
    let minutes = |seconds: f64| format!("{:.1} min", seconds / 60.0);
    let (first, last, how) = match normalised().next_back() {
        Some(last) => (normalised().next(), Some(last), "normalised; "),
        None => (raw().next(), raw().next_back(), "as measured; "),
    };
    let note = match (first, data.source.origin) {
        (Some(first), _) => format!("{how}{} at first", minutes(first)),
        (None, Origin::Store) => "not in the history".to_owned(),
        (None, Origin::Replay) => "no charge covered enough of the window".to_owned(),
    };
    tile("Recharge period", last.map(minutes), note)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::data::CapacityRecord;
    use crate::report::examples;

    fn alarm(time_s: f64, rule: &str, severity: &str, is_active: bool) -> AlarmRecord {
        let (rule, severity, change) = (rule.to_owned(), severity.to_owned(), "raised".to_owned());
        AlarmRecord {
            time_s,
            rule,
            severity,
            cell: Some(2),
            change,
            is_active,
            value: Some(1.38),
            threshold: Some(1.4),
        }
    }

    fn summary(alarms: Vec<AlarmRecord>) -> Summary {
        let mut data = Data::new(Origin::Store);
        data.alarms = alarms;
        of(&data, &PageContext::default(), &Err("too little".into()))
    }

    #[test]
    fn summary_without_data_is_unknown() {
        let summary = summary(Vec::new());
        assert_eq!(summary.verdict, Condition::Unknown);
        assert!(summary.tiles.iter().filter(|tile| tile.value == "unknown").count() >= 5, "{:?}", summary.tiles);
        assert!(summary.since.starts_with("Unknown"));
    }

    #[test]
    fn worst_raised_alarm_decides_and_cleared_one_does_not() {
        let over = vec![alarm(1.0, "capacity_low", "severe", true), alarm(2.0, "capacity_low", "severe", false)];
        assert_eq!(summary(over.clone()).verdict, Condition::Unknown);
        let mut both = over;
        both.push(alarm(3.0e8, "usable_capacity_low", "warning", true));
        let plan = summary(both.clone());
        assert_eq!(plan.verdict, Condition::Plan);
        assert!(
            plan.headline.contains("a cell's usable capacity was 1.38 Ah, limit 1.4 Ah (cell 3)"),
            "{}",
            plan.headline
        );
        both.push(alarm(4.0e8, "resistance_high", "severe", true));
        assert_eq!(summary(both).verdict, Condition::Act);
    }

    fn learned(time_s: f64, cell: usize, measured_ah: Option<f64>) -> CapacityRecord {
        let (measured_std_ah, usable_ah, resistance) = (measured_ah.map(|_| 0.01), None, (1.0, 0.1));
        CapacityRecord {
            time_s,
            cell,
            measured_ah,
            measured_std_ah,
            capacity_ah: (1.2, 0.01),
            usable_ah,
            losses: None,
            resistance,
        }
    }

    #[test]
    fn good_needs_every_cell_and_a_limit() {
        let verdict = |rows: &[CapacityRecord], alarms: Vec<AlarmRecord>, doubt: Option<&str>| {
            let mut data = Data::new(Origin::Store);
            (data.learned, data.alarms) = (rows.to_vec(), alarms);
            doubt.into_iter().for_each(|doubt| data.doubt(doubt.to_owned()));
            of(&data, &PageContext::default(), &Err("too little".into()))
        };
        let cell = |cell: usize| learned(3.0, cell, Some(1.2));
        let limit =
            |threshold: f64| AlarmRecord { threshold: Some(threshold), ..alarm(4.0, "capacity_low", "severe", false) };
        assert_eq!(verdict(&[cell(0), cell(1)], vec![limit(1.0)], None).verdict, Condition::Good);
        let no_limit = verdict(&[cell(0), cell(1)], Vec::new(), None);
        assert_eq!(no_limit.verdict, Condition::Unknown);
        assert!(no_limit.headline.contains("states no limit") && no_limit.advice.contains("-c"), "{no_limit:?}");
        let one_missing = verdict(&[cell(1)], vec![limit(1.0)], None);
        assert_eq!(one_missing.headline, "Unknown: nothing has been learned yet about 1 of 2 cells.");
        assert_eq!(verdict(&[cell(0), learned(3.0, 1, None)], vec![limit(1.0)], None).verdict, Condition::Unknown);
        // The capacity is below the end of life, although no alarm is raised.
        assert_eq!(verdict(&[cell(0), cell(1)], vec![limit(1.6)], None).verdict, Condition::Watch);
        let changed = verdict(&[cell(0), cell(1)], vec![limit(1.0)], Some("the history was changed"));
        assert_eq!(changed.headline, "Unknown: the history was changed.");
    }

    #[test]
    fn missing_input_does_not_make_the_battery_bad() {
        let summary = summary(vec![alarm(1.0, "input_missing", "severe", true)]);
        assert_eq!(summary.verdict, Condition::Unknown);
        assert!(summary.advice.contains("Check sensors"), "{}", summary.advice);
    }

    #[test]
    fn headline_has_current_value_and_cards_have_doubts() {
        let mut data = Data::new(Origin::Replay);
        data.alarms = vec![alarm(1.7e9, "usable_capacity_low", "severe", true)];
        data.learned = vec![CapacityRecord { usable_ah: Some((0.9, 0.01)), ..learned(1.71e9, 2, Some(1.0)) }];
        let of = |data: &Data| of(data, &PageContext::default(), &Err("too little".into()));
        let said = of(&data);
        assert_eq!(
            said.headline,
            "Past its limit: act now. Now a cell's usable capacity is 0.9 Ah, limit 1.4 Ah (cell 3)."
        );
        let capacity = |summary: &Summary| summary.tiles.iter().find(|tile| tile.name == "Capacity").cloned().unwrap();
        assert_eq!((capacity(&said).note.as_str(), capacity(&said).doubt), ("\u{b1} 0.010, cell 3", None));
        data.learned = vec![learned(1.71e9, 2, None)];
        data.untrusted.insert(2);
        let doubted = capacity(&of(&data));
        assert_eq!(doubted.note, "\u{b1} 0.010, cell 3; assumed, not measured yet");
        assert_eq!(doubted.doubt.as_deref(), Some("not trusted: cell 3"));
    }

    #[test]
    fn only_estimates_are_marked_as_untrusted() {
        let config = examples::config();
        let context = PageContext { config: Some(&config), ..PageContext::default() };
        let mut data = examples::worn(3);
        let of = |data: &Data| of(data, &context, &forecast::outlook(data, &context)).tiles;
        let trusted = of(&data);
        assert!(trusted.iter().all(|tile| tile.value != "unknown" && tile.doubt.is_none()), "{trusted:?}");
        data.untrusted.insert(2);
        let (marked, unmarked): (Vec<Tile>, _) = of(&data).into_iter().partition(|tile| tile.doubt.is_some());
        assert!(marked.iter().all(|tile| tile.doubt.as_deref() == Some("not trusted: cell 3")), "{marked:?}");
        let names = |tiles: Vec<Tile>| tiles.into_iter().map(|tile| tile.name).collect::<Vec<_>>();
        let estimates =
            ["State of health", "Capacity", "Usable capacity", "Lithium lost", "Resistance", "Recharge period"];
        assert_eq!(names(marked), [&estimates[..], &["Remaining life"]].concat());
        assert_eq!(names(unmarked), ["Use so far", "Alarms raised now"]);
    }

    #[test]
    fn headline_has_the_worst_of_many_cells() {
        let mut data = Data::new(Origin::Replay);
        for (cell, usable_ah) in [1.1, 0.9, 1.0].into_iter().enumerate() {
            data.alarms.push(AlarmRecord { cell: Some(cell), ..alarm(1.7e9, "usable_capacity_low", "severe", true) });
            let usable_ah = Some((usable_ah, 0.01));
            data.learned.push(CapacityRecord { usable_ah, ..learned(1.71e9, cell, Some(1.0)) });
        }
        let said = of(&data, &PageContext::default(), &Err("too little".into())).headline;
        assert!(said.ends_with("Now a cell's usable capacity is 0.9 Ah, limit 1.4 Ah (cell 2)."), "{said}");
    }
}
