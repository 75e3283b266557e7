//! Determines which alarms are raised at the end of the record, with their values, and which cells are then untrusted.

use std::collections::BTreeMap;

use super::context::PageContext;
use super::data::{AlarmRecord, Data};
use super::forecast::Outlook;
use super::limits::{rank, rule};
use super::series;
use crate::alarm::Rule;
use crate::health::RechargeAlarm;

/// Maximum number of cells or ranges in a list; more are only counted.
const MAX_NAMED: usize = 8;

pub(super) struct ActiveAlarm<'a> {
    pub(super) row: &'a AlarmRecord,
    pub(super) since_s: f64,
}

pub(super) struct AlarmGroup<'a> {
    pub(super) alarms: Vec<&'a ActiveAlarm<'a>>,
}

/// Returns the alarms raised at the end: one per rule, severity and cell.
pub(super) fn raised(data: &Data) -> Vec<ActiveAlarm<'_>> {
    let mut last: BTreeMap<(&str, &str, Option<usize>), ActiveAlarm<'_>> = BTreeMap::new();
    for row in &data.alarms {
        let key = (row.rule.as_str(), row.severity.as_str(), row.cell);
        // Keep the row that raised the alarm, because only this row certainly contains the value.
        if row.is_active {
            last.entry(key).or_insert(ActiveAlarm { row, since_s: row.time_s });
        } else {
            last.remove(&key);
        }
    }
    last.into_values().collect()
}

pub(super) fn grouped<'a>(raised: &'a [ActiveAlarm<'a>]) -> Vec<AlarmGroup<'a>> {
    let mut groups: Vec<AlarmGroup<'a>> = Vec::new();
    for alarm in raised {
        let is_same = |group: &&mut AlarmGroup<'a>| {
            let first = group.alarms[0].row;
            (&first.rule, &first.severity) == (&alarm.row.rule, &alarm.row.severity)
        };
        match groups.iter_mut().find(is_same) {
            Some(group) => group.alarms.push(alarm),
            None => groups.push(AlarmGroup { alarms: vec![alarm] }),
        }
    }
    groups.sort_by_key(|group| std::cmp::Reverse(rank(&group.alarms[0].row.severity)));
    groups
}

/// Formats cell numbers (from 1) of ascending indices: `cell 3`, `cells 1, 2 and 5`, `cells 1 to 96`, `cells 1, 3, 5,
/// 7, 9, 11, 13, 15 and 88 more`, or `pack` without cells.
pub(super) fn cells(cells: impl Iterator<Item = usize>) -> String {
    let numbers: Vec<usize> = cells.map(|cell| cell + 1).collect();
    let parts_of = |run: &[usize]| match *run {
        [first, _, .., last] => vec![(format!("{first} to {last}"), run.len())],
        _ => run.iter().map(|number| (number.to_string(), 1)).collect(),
    };
    let parts: Vec<(String, usize)> = numbers.chunk_by(|a, b| a + 1 == *b).flat_map(parts_of).collect();
    let (named, others) = parts.split_at(parts.len().min(MAX_NAMED));
    let rest: usize = others.iter().map(|part| part.1).sum();
    let mut words: Vec<String> = named.iter().map(|part| part.0.clone()).collect();
    words.extend((rest > 0).then(|| format!("{rest} more")));
    let noun = if numbers.len() == 1 { "cell" } else { "cells" };
    match words.pop() {
        None => "pack".to_owned(),
        Some(only) if words.is_empty() => format!("{noun} {only}"),
        Some(last) => format!("{noun} {} and {last}", words.join(", ")),
    }
}

/// Returns the value that the alarm's rule compares with the threshold at the end of the record; `None` = unknown.
pub(super) fn value(
    row: &AlarmRecord,
    data: &Data,
    context: &PageContext<'_>,
    outlook: Option<&Outlook>,
) -> Option<f64> {
    let last = |pick: series::ValueSelector, high_is_bad: bool| match row.cell {
        Some(cell) => data.learned.iter().rev().filter(|row| row.cell == cell).find_map(|row| Some(pick(row)?.0)),
        None => series::steps(data, pick, high_is_bad).last().map(|step| step.worst.0),
    };
    match rule(&row.rule)? {
        Rule::CapacityLow => last(series::capacity, false),
        Rule::UsableCapacityLow => last(series::usable, false),
        Rule::ResistanceHigh => last(series::resistance, true),
        Rule::RechargePeriodLow => {
            let is_raw = context.config.is_some_and(|it| it.monitor.health.recharge.alarm_on == RechargeAlarm::Raw);
            let normalised = || data.recharges.iter().rev().find_map(|row| Some(row.normalised_s?.0));
            let raw = || data.recharges.iter().rev().find_map(|row| row.raw_s);
            if is_raw { raw() } else { normalised().or_else(raw) }
        }
        Rule::RemainingLifeLow => {
            let outlook = outlook.filter(|outlook| row.cell.is_none_or(|cell| cell == outlook.cell))?;
            outlook.life.cycles.map(|left| left.median)
        }
        _ => None,
    }
}

/// Names the untrusted cells; `None` = all estimates are trusted.
pub(super) fn doubt(data: &Data, raised: &[ActiveAlarm<'_>]) -> Option<String> {
    let alarms = raised.iter().filter(|alarm| rule(&alarm.row.rule) == Some(Rule::EstimateUntrusted));
    let mut doubtful: Vec<Option<usize>> = alarms.map(|alarm| alarm.row.cell).collect();
    doubtful.extend(data.untrusted.iter().map(|cell| Some(*cell)));
    doubtful.sort_unstable();
    doubtful.dedup();
    if doubtful.is_empty() {
        return None;
    }
    let named = doubtful.iter().copied().flatten();
    Some(if data.cells() > 1 { format!("not trusted: {}", cells(named)) } else { "not trusted".to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Origin;
    use crate::report::data::CapacityRecord;

    fn alarm(rule: &str, cell: Option<usize>) -> AlarmRecord {
        AlarmRecord {
            time_s: 1.7e9,
            rule: rule.to_owned(),
            severity: "severe".to_owned(),
            cell,
            change: "raised".to_owned(),
            is_active: true,
            value: Some(1.809),
            threshold: Some(1.82),
        }
    }

    fn worn(cells: usize) -> Data {
        let mut data = Data::new(Origin::Store);
        for cell in 0..cells {
            data.alarms.push(alarm("capacity_low", Some(cell)));
            data.learned.push(CapacityRecord {
                time_s: 1.71e9,
                cell,
                measured_ah: Some(0.252),
                measured_std_ah: Some(0.01),
                capacity_ah: (0.252 + 0.1 * cell as f64, 0.01),
                usable_ah: None,
                losses: None,
                resistance: (1.0, 0.1),
            });
        }
        data
    }

    #[test]
    fn value_is_that_of_the_record_end() {
        let data = worn(2);
        let value = |cell| value(&alarm("capacity_low", cell), &data, &PageContext::default(), None);
        assert_eq!((value(Some(1)), value(None), value(Some(7))), (Some(0.352), Some(0.252), None));
        let hot = alarm("temperature_high", None);
        assert_eq!(super::value(&hot, &data, &PageContext::default(), None), None);
    }

    #[test]
    fn cells_are_counted_from_1_and_joined_to_ranges() {
        let text = |numbers: &[usize]| cells(numbers.iter().copied());
        assert_eq!([text(&[]), text(&[2]), text(&[0, 1])], ["pack", "cell 3", "cells 1 and 2"]);
        assert_eq!(text(&[1, 80]), "cells 2 and 81");
        assert_eq!(text(&(0..96).collect::<Vec<_>>()), "cells 1 to 96");
        assert_eq!(text(&[0, 4, 5, 6, 9]), "cells 1, 5 to 7 and 10");
        let odd: Vec<usize> = (0..20).step_by(2).collect();
        assert_eq!(text(&odd), "cells 1, 3, 5, 7, 9, 11, 13, 15 and 2 more");
    }

    #[test]
    fn doubt_lists_untrusted_cells() {
        let mut data = worn(3);
        assert_eq!(doubt(&data, &raised(&data)), None);
        data.untrusted.insert(1);
        assert_eq!(doubt(&data, &raised(&data)).as_deref(), Some("not trusted: cell 2"));
        data.alarms.push(alarm("estimate_untrusted", Some(2)));
        assert_eq!(doubt(&data, &raised(&data)).as_deref(), Some("not trusted: cells 2 and 3"));
    }
}
