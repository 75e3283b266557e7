//! Lists what is wrong with the battery, the worst first.
//!
//! The list is made from the findings about single cells, the raised alarms, the charge that imbalance makes unusable,
//! and the end of life. If a finding explains an alarm, both become one problem, so that the page cannot contradict
//! itself.

use std::collections::BTreeSet;

use super::context::PageContext;
use super::data::Data;
use super::forecast::{self, Outlook};
use super::format::{amount, capitalised, moment};
use super::limits::{rank, rule};
use super::raised::{ActiveAlarm, AlarmGroup, cells, grouped, raised, value};
use super::series;
use super::summary::Condition;
use crate::alarm::{Direction, Rule};
use crate::cell_faults::{CellFault, CellFaultKind, Imbalance};
use crate::quantity::{CellIndex, DAY_S};

/// A pack is out of balance if imbalance makes at least this fraction of its charge unusable, even after subtracting
/// two standard deviations.
const OUT_OF_BALANCE: f64 = 0.03;
/// A fault counts as present from the beginning of the record if it was found within this fraction of the record or
/// within [`STEADY_S`], because finding a fault takes days.
const BEGINNING: f64 = 0.25;
/// A contact counts as steady if its resistance has not grown for this time (s).
const STEADY_S: f64 = 7.0 * DAY_S;

/// Kinds of findings about cells, in the order of the page. Findings about sensors follow.
const CELL_KINDS: [CellFaultKind; 8] = [
    CellFaultKind::Leak,
    CellFaultKind::LowCharge,
    CellFaultKind::HighCharge,
    CellFaultKind::WeakCell,
    CellFaultKind::Contact,
    CellFaultKind::HighResistance,
    CellFaultKind::ForeignCell,
    CellFaultKind::Module,
];

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Problem {
    pub(super) condition: Condition,
    pub(super) what: String,
    pub(super) advice: String,
    pub(super) note: String,
    pub(super) is_alarm: bool,
}

impl Problem {
    /// Adds alarms that this problem explains. Raises the severity of the problem to that of the worst alarm.
    fn add_alarms(&mut self, alarms: &[&ActiveAlarm<'_>], data: &Data) {
        self.condition = alarms.iter().map(|alarm| condition_of(&alarm.row.severity)).fold(self.condition, Ord::max);
        self.note = format!("{}{}", self.note, alarm_notes(alarms, data)).trim_start().to_owned();
        self.is_alarm |= !alarms.is_empty();
    }
}

pub(super) fn problems(data: &Data, context: &PageContext<'_>, outlook: Option<&Outlook>) -> Vec<Problem> {
    let findings = context.diagnosis.map_or(&[][..], |diagnosis| diagnosis.findings());
    let mut problems = of_battery(findings, data, context, outlook);
    problems.extend(data.source.doubt.iter().map(|doubt| Problem {
        condition: Condition::Watch,
        what: format!("The figures may be wrong: {doubt}."),
        advice: "Do not rely on them.".to_owned(),
        note: String::new(),
        is_alarm: false,
    }));
    // Among problems of the same condition, those with a raised alarm come first. Otherwise, the order is kept.
    problems.sort_by_key(|problem| std::cmp::Reverse((problem.condition, problem.is_alarm)));
    problems
}

fn of_battery(
    findings: &[CellFault],
    data: &Data,
    context: &PageContext<'_>,
    outlook: Option<&Outlook>,
) -> Vec<Problem> {
    let raised = raised(data);
    let mut groups = of_findings(findings, data);
    groups.sort_by_key(|group| CELL_KINDS.iter().position(|kind| *kind == group[0].kind).unwrap_or(CELL_KINDS.len()));
    let mut problems: Vec<Problem> = groups.iter().map(|group| finding(group, &raised, data)).collect();
    let imbalance = context.imbalance.as_ref().and_then(|imbalance| imbalance.as_ref().ok());
    let is_charge = |kind| matches!(kind, CellFaultKind::LowCharge | CellFaultKind::HighCharge);
    // Index of the problem that explains an alarm about imbalance.
    let mut of_charge = groups.iter().position(|group| is_charge(group[0].kind));
    if let Some((pack, at)) = imbalance.zip(of_charge) {
        let (mean, std) = percent(pack);
        problems[at].what +=
            &format!(" Because of imbalance, {mean:.1} \u{b1} {std:.1} % of the pack's capacity cannot be used.");
    } else if let Some(pack) = imbalance.filter(|pack| is_unbalanced(pack)) {
        of_charge = Some(problems.len());
        problems.push(unbalanced(pack, findings.is_empty()));
    }
    if let Some(at) = of_charge {
        let is_imbalance = |alarm: &&ActiveAlarm<'_>| rule(&alarm.row.rule) == Some(Rule::CellImbalance);
        let alarms: Vec<&ActiveAlarm<'_>> = raised.iter().filter(is_imbalance).collect();
        problems[at].add_alarms(&alarms, data);
    }
    let is_explained = |alarm: &ActiveAlarm<'_>| match rule(&alarm.row.rule) {
        Some(Rule::CellImbalance) => of_charge.is_some(),
        Some(rule) => findings.iter().any(|found| explains(found, rule, alarm.row.cell)),
        None => false,
    };
    let no_limit = if raised.is_empty() { ", but no alarm is raised" } else { "" };
    let is_capacity_low = raised.iter().any(|alarm| rule(&alarm.row.rule) == Some(Rule::CapacityLow));
    let open: Vec<ActiveAlarm<'_>> = raised.into_iter().filter(|alarm| !is_explained(alarm)).collect();
    problems.extend(grouped(&open).iter().map(|group| alarm(group, data, context, outlook)));
    if is_over(data, context, outlook) && !is_capacity_low {
        problems.push(Problem {
            condition: Condition::Watch,
            what: format!("The capacity is below the end of life{no_limit}."),
            advice: "Plan its replacement.".to_owned(),
            note: String::new(),
            is_alarm: false,
        });
    }
    problems
}

fn is_over(data: &Data, context: &PageContext<'_>, outlook: Option<&Outlook>) -> bool {
    let least = series::steps(data, series::capacity, false).last().map(|step| step.worst.0);
    let is_below = least.zip(forecast::end_of_life_ah(data, context)).is_some_and(|(least, end)| least < end);
    is_below || outlook.is_some_and(Outlook::is_over)
}

/// Groups findings by kind. Contacts are also grouped by whether their resistance grows. A finding about a pair of
/// channels is its own group.
fn of_findings<'a>(findings: &'a [CellFault], data: &Data) -> Vec<Vec<&'a CellFault>> {
    let key = |found: &CellFault| (found.kind, Growth::of(found, data));
    let mut groups: Vec<Vec<&CellFault>> = Vec::new();
    for found in findings {
        match groups.iter_mut().find(|group| !found.kind.is_of_pair() && key(group[0]) == key(found)) {
            Some(group) => group.push(found),
            None => groups.push(vec![found]),
        }
    }
    groups
}

/// Whether a finding explains an alarm of this rule and cell.
fn explains(found: &CellFault, rule: Rule, cell: Option<usize>) -> bool {
    let is_reason = match rule {
        Rule::CellLeak => found.kind == CellFaultKind::Leak,
        Rule::ConnectionResistance => found.kind == CellFaultKind::Contact,
        Rule::ChannelFaulty => found.kind.is_channel_fault(),
        Rule::CapacityLow => found.kind == CellFaultKind::WeakCell,
        _ => false,
    };
    is_reason && cell.and_then(|cell| u16::try_from(cell).ok()).is_some_and(|cell| found.is_of(CellIndex(cell)))
}

fn finding(group: &[&CellFault], raised: &[ActiveAlarm<'_>], data: &Data) -> Problem {
    let kind = group[0].kind;
    let expanded = group.iter().filter_map(|found| found.cells).flat_map(|(first, last)| {
        let between = if kind.is_of_pair() {
            vec![first.index(), last.index()]
        } else {
            (first.index()..=last.index()).collect()
        };
        between.into_iter()
    });
    let numbers: BTreeSet<usize> = expanded.collect();
    let is_explained = |alarm: &&ActiveAlarm<'_>| {
        rule(&alarm.row.rule).is_some_and(|rule| group.iter().any(|found| explains(found, rule, alarm.row.cell)))
    };
    let alarms: Vec<&ActiveAlarm<'_>> = raised.iter().filter(is_explained).collect();
    let growth = Growth::of(group[0], data);
    let is_of_cells = CELL_KINDS.contains(&kind);
    let own = match kind {
        CellFaultKind::HighResistance | CellFaultKind::ForeignCell | CellFaultKind::Module => Condition::Watch,
        CellFaultKind::Contact if growth == Some(Growth::Steady) => Condition::Watch,
        _ if is_of_cells => Condition::Plan,
        _ => Condition::Watch,
    };
    let worst = alarms.iter().map(|alarm| condition_of(&alarm.row.severity)).max().filter(|_| is_of_cells);
    let subject = capitalised(&cells(numbers.iter().copied()));
    let found_s = group.iter().map(|found| found.reported.secs()).fold(f64::INFINITY, f64::min);
    Problem {
        condition: worst.map_or(own, |worst| worst.max(own)),
        what: sentence(kind, &subject, numbers.len() > 1, &sizes(group)) + growth.map_or("", Growth::words),
        advice: growth.and_then(Growth::advice).map_or_else(|| capitalised(kind.advice()) + ".", str::to_owned),
        note: format!("Found {}.{}", moment(data, found_s), alarm_notes(&alarms, data)),
        is_alarm: !alarms.is_empty(),
    }
}

/// Writes one sentence for each rule, severity and day. The sentence states since when the alarms are raised.
fn alarm_notes(alarms: &[&ActiveAlarm<'_>], data: &Data) -> String {
    let day = |since_s: f64| (since_s / DAY_S).floor();
    let mut notes: Vec<((&str, &str), f64, Vec<usize>)> = Vec::new();
    for alarm in alarms {
        let key = (alarm.row.rule.as_str(), alarm.row.severity.as_str());
        match notes.iter_mut().find(|note| note.0 == key && day(note.1) == day(alarm.since_s)) {
            Some((_, since_s, numbers)) => {
                *since_s = since_s.min(alarm.since_s);
                numbers.extend(alarm.row.cell);
            }
            None => notes.push((key, alarm.since_s, alarm.row.cell.into_iter().collect())),
        }
    }
    let note = |((rule, severity), since_s, numbers): ((&str, &str), f64, Vec<usize>)| {
        format!(" Alarm {rule} ({severity}) of {} since {}.", cells(numbers.into_iter()), moment(data, since_s))
    };
    notes.into_iter().map(note).collect()
}

/// Formats the sizes of the findings in the unit that [`sentence`] uses. One finding gives its size and standard
/// deviation, several findings give the smallest and the largest size.
fn sizes(group: &[&CellFault]) -> String {
    let (scale, digits) = match group[0].kind {
        CellFaultKind::Contact => (100.0, 0),
        CellFaultKind::VoltageChannel => (1e3, 0),
        CellFaultKind::Leak | CellFaultKind::CurrentOffset => (100.0, 2),
        _ => (100.0, 1),
    };
    let size = |found: &&CellFault| scale * found.size.mean.abs();
    let (least, most) =
        (group.iter().map(size).fold(f64::INFINITY, f64::min), group.iter().map(size).fold(0.0, f64::max));
    let [low, high] = [least, most].map(|size| format!("{size:.digits$}"));
    match group {
        [only] => format!("{low} \u{b1} {:.digits$}", scale * only.size.std()),
        _ if low == high => low,
        _ => format!("{low} to {high}"),
    }
}

/// Describes a finding. `subject` names the cells, and `size` is in the unit of the sentence.
fn sentence(kind: CellFaultKind, subject: &str, are_many: bool, size: &str) -> String {
    let has = if are_many { "have" } else { "has" };
    match kind {
        CellFaultKind::Leak => {
            let loses = if are_many { "lose" } else { "loses" };
            format!("{subject} {loses} {size} % of the capacity per day without a load.")
        }
        CellFaultKind::Contact => format!("{subject} {has} {size} % more contact resistance than the others."),
        CellFaultKind::WeakCell => format!("{subject} {has} {size} % less capacity than the others."),
        CellFaultKind::HighResistance => format!("{subject} {has} {size} % more resistance than the others."),
        CellFaultKind::ForeignCell | CellFaultKind::Module => {
            format!("{subject} {has} been replaced: {size} % more capacity than the others.")
        }
        CellFaultKind::LowCharge => format!("{subject} {has} {size} points less charge than the others."),
        CellFaultKind::HighCharge => format!("{subject} {has} {size} points more charge than the others."),
        CellFaultKind::VoltageChannel => format!("The voltage of {} is measured {size} mV wrong.", lower(subject)),
        CellFaultKind::VoltageFrozen => format!("The measured voltage of {} does not change.", lower(subject)),
        CellFaultKind::DoubledChannels => format!("{subject} show the voltage of one and the same cell."),
        CellFaultKind::SwappedChannels => format!("The voltage channels of {} are exchanged.", lower(subject)),
        CellFaultKind::TemperatureSensor => {
            format!("The temperature sensor of {} does not follow the load.", lower(subject))
        }
        CellFaultKind::CurrentOffset => {
            format!("The current sensor is off by {size} % of the rated capacity per hour.")
        }
        CellFaultKind::CurrentFrozen => "The measured current does not change.".to_owned(),
        CellFaultKind::CurrentGain => format!("The current sensor shows {size} % too much."),
    }
}

fn lower(subject: &str) -> String {
    subject.to_lowercase()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Growth {
    /// The resistance has grown, or was not high at the beginning.
    Grows,
    /// The resistance was high from the beginning and has not grown.
    Steady,
    /// The record is too short, or does not contain earlier values.
    Unknown,
}

impl Growth {
    /// Returns the growth of a contact; `None` = the finding is not about a contact.
    fn of(found: &CellFault, data: &Data) -> Option<Self> {
        if found.kind != CellFaultKind::Contact {
            return None;
        }
        let Some((first_s, last_s)) = data.ends_s() else { return Some(Self::Unknown) };
        let since_s = found.since.secs();
        let is_late = since_s - first_s > (BEGINNING * (last_s - first_s)).max(STEADY_S);
        // The resistance has grown if it exceeds the first reported value by more than two standard deviations of the
        // difference.
        let first = found.cells.and_then(|cells| data.first_sizes.get(&(found.kind, cells.0)));
        let has_grown = first.map(|first| found.size.mean - first.mean > 2.0 * found.size.std().hypot(first.std()));
        if is_late || has_grown == Some(true) {
            Some(Self::Grows)
        } else if last_s - since_s >= STEADY_S && has_grown == Some(false) {
            Some(Self::Steady)
        } else {
            Some(Self::Unknown)
        }
    }

    const fn words(self) -> &'static str {
        match self {
            Self::Grows => " The resistance grows, as in a contact that comes loose.",
            Self::Steady => {
                " The resistance was high from the beginning and has not grown, as in longer links between modules."
            }
            Self::Unknown => " Whether the resistance grows is not known yet.",
        }
    }

    /// Returns the advice; `None` = the advice of the finding applies.
    const fn advice(self) -> Option<&'static str> {
        match self {
            Self::Grows => None,
            Self::Steady => {
                Some("Nothing if a longer link ends at these cells; otherwise tighten and clean their connections.")
            }
            Self::Unknown => Some(
                "Look whether a longer link ends at these cells. If not, tighten and clean their connections: a loose one \
                 heats under load.",
            ),
        }
    }
}

fn percent(pack: &Imbalance) -> (f64, f64) {
    (100.0 * pack.lost_by_imbalance.mean, 100.0 * pack.lost_by_imbalance.std())
}

fn is_unbalanced(pack: &Imbalance) -> bool {
    pack.lost_by_imbalance.mean - 2.0 * pack.lost_by_imbalance.std() >= OUT_OF_BALANCE
}

fn unbalanced(pack: &Imbalance, is_only: bool) -> Problem {
    let (mean, std) = percent(pack);
    let [empty, full] = [&pack.discharge_limit, &pack.charge_limit].map(|limit| limit.cell.index() + 1);
    let no_other = if is_only { " No failing cell was found." } else { "" };
    Problem {
        condition: Condition::Plan,
        what: format!(
            "The pack is out of balance: {mean:.1} \u{b1} {std:.1} % of its capacity cannot be used. Cell {empty} is empty first, \
             and cell {full} is full first.{no_other}"
        ),
        advice:
            "Balance the pack: this restores the lost capacity. Then create the report again: if a cell drifts away \
                 again, it is failing."
                .to_owned(),
        note: String::new(),
        is_alarm: false,
    }
}

fn alarm(group: &AlarmGroup<'_>, data: &Data, context: &PageContext<'_>, outlook: Option<&Outlook>) -> Problem {
    let row = group.alarms[0].row;
    let rule = rule(&row.rule);
    let is_measuring = rule.is_some_and(concerns_measurement);
    let condition = if is_measuring { Condition::Watch } else { condition_of(&row.severity) };
    Problem {
        condition,
        what: alarm_sentence(group, data, context, outlook),
        advice: rule.map_or("Read the manual of this alarm.", |rule| alarm_advice(rule, condition)).to_owned(),
        note: alarm_notes(&group.alarms, data).trim_start().to_owned(),
        is_alarm: true,
    }
}

fn alarm_sentence(group: &AlarmGroup<'_>, data: &Data, context: &PageContext<'_>, outlook: Option<&Outlook>) -> String {
    let (name, now) =
        (group.alarms[0].row.rule.as_str(), |alarm: &ActiveAlarm<'_>| value(alarm.row, data, context, outlook));
    let numbers = group.alarms.iter().filter_map(|alarm| alarm.row.cell);
    let of_pack = numbers.clone().next().is_none();
    let whose = if of_pack { "the pack".to_owned() } else { cells(numbers) };
    let Some(rule) = rule(name) else { return format!("The alarm {name} of {whose} is raised.") };
    match rule {
        Rule::EstimateUntrusted => return format!("The estimates of {whose} contradict the measured voltages."),
        Rule::InputMissing => return format!("Readings of {whose} are missing."),
        Rule::InputImplausible => return format!("Readings of {whose} are implausible."),
        Rule::ChannelFaulty => return format!("The voltage channel of {whose} does not show its cell."),
        Rule::ThermalEvent => return format!("The readings of {whose} show a thermal event{}.", evidence(group)),
        _ => {}
    }
    let spec = rule.spec();
    let quantity = spec.about.strip_prefix("a cell's ").map(|quantity| format!("The {quantity} of {whose}"));
    let subject = quantity.unwrap_or_else(|| capitalised(spec.about));
    let is_below = spec.direction == Direction::Below;
    let side = if is_below { "below" } else { "above" };
    let badness = |value: f64| if is_below { -value } else { value };
    let first = group.alarms[0].row;
    let limit =
        first.threshold.map_or_else(|| "its limit".to_owned(), |it| format!("the limit of {}", amount(it, name)));
    let known = group.alarms.iter().filter_map(|alarm| Some((alarm.row, now(alarm)?)));
    let Some((row, value)) = known.max_by(|a, b| badness(a.1).total_cmp(&badness(b.1))) else {
        let raised = first.value.filter(|_| group.alarms.len() == 1);
        let raised = raised.map_or_else(String::new, |value| format!("{}, ", amount(value, name)));
        return format!("{subject} was {raised}{side} {limit} when the alarm was raised.");
    };
    let is_beyond = row.threshold.is_none_or(|limit| badness(value) >= badness(limit));
    let cell = row.cell.filter(|_| group.alarms.len() > 1);
    let cell = cell.map_or_else(String::new, |cell| format!(" in cell {}", cell + 1));
    let value = amount(value, name);
    match is_beyond {
        true if cell.is_empty() => format!("{subject} is {value}, {side} {limit}."),
        true => format!("{subject} is {side} {limit}: {value}{cell}."),
        false => format!("{subject} was {side} {limit}; now it is {value}{cell}."),
    }
}

/// Describes the evidence on which the alarms of a thermal event were raised.
fn evidence(group: &AlarmGroup<'_>) -> String {
    let values: Vec<f64> = group.alarms.iter().filter_map(|alarm| alarm.row.value).collect();
    let has = |kind: u8| values.iter().any(|value| *value as u8 & kind != 0);
    let value = u8::from(has(1)) + 2 * u8::from(has(2));
    if value == 0 { String::new() } else { format!(": {}", Rule::ThermalEvent.with_unit(f64::from(value))) }
}

fn condition_of(severity: &str) -> Condition {
    [Condition::Watch, Condition::Plan, Condition::Act][rank(severity).min(2)]
}

const fn concerns_measurement(rule: Rule) -> bool {
    matches!(
        rule,
        Rule::InputMissing
            | Rule::InputImplausible
            | Rule::EstimateUntrusted
            | Rule::BmsDisagrees
            | Rule::StoreFailed
            | Rule::BusFault
            | Rule::ChannelFaulty
    )
}

const fn alarm_advice(rule: Rule, condition: Condition) -> &'static str {
    match rule {
        Rule::ThermalEvent => {
            "Leave the vehicle, keep people away, and call the fire brigade. Do not charge or drive it again before the \
             named cell has been examined."
        }
        Rule::TemperatureHigh => "Check cooling and load before the next use.",
        Rule::SocLow => "Charge it.",
        Rule::CellImbalance => "Have the cells balanced; if the imbalance returns, have the weakest cell checked.",
        Rule::CellLeak => {
            "Measure the rest voltage of the named cell over a week; if it falls relative to the others, replace the cell."
        }
        Rule::ConnectionResistance => "Have the connections of the named cell tightened and cleaned.",
        Rule::EstimateUntrusted => {
            "Do not rely on these figures before the sensors and the cell model have been checked."
        }
        Rule::ChannelFaulty => "Check the sense wire and the channel of the named cell: its figures are wrong.",
        Rule::StoreFailed => "Check the disk of the vehicle computer: learned values may be lost.",
        Rule::InputMissing | Rule::InputImplausible | Rule::BusFault | Rule::BmsDisagrees => {
            "Check sensors, wiring and bus."
        }
        _ if matches!(condition, Condition::Act) => "Replace the battery or the named cell, or take it out of service.",
        _ => "Order a replacement, and have its capacity measured at the next visit.",
    }
}

#[cfg(test)]
mod tests;
