//! Converts alarms to table rows. If many cells have the same alarm, the alarms share one row, which shows the number
//! of cells, the list of cells and the worst value.

use crate::alarm::{Alarm, Direction};
use crate::quantity::CellIndex;

/// If at least this many cells have the same alarm, their alarms share a row.
const MANY: usize = 4;
/// Length, in characters, at which a list of cells is cut.
const MAX_LIST: usize = 24;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct AlarmGroup {
    /// The alarm. In a row for several cells, the alarm with the worst value.
    pub(crate) alarm: Alarm,
    /// Cells of the row, ascending; empty for a single alarm.
    cells: Vec<CellIndex>,
}

impl AlarmGroup {
    /// Formats the cells of the row, for example `pack`, `7` or `96: 1-96`.
    pub(crate) fn cells(&self) -> String {
        match (self.alarm.cell, self.cells.len()) {
            (None, _) => "pack".to_owned(),
            (Some(cell), 0) => (u32::from(cell.0) + 1).to_string(),
            (Some(_), count) => format!("{count}: {}", ranges(self.cells.iter().map(|cell| cell.index() + 1))),
        }
    }

    /// Formats the owner of the alarm, for example `pack`, `cell 7` or `96 cells (1-96)`.
    pub(crate) fn owner(&self) -> String {
        match (self.alarm.cell, self.cells.len()) {
            (None, _) => "pack".to_owned(),
            (Some(_), 0) => format!("cell {}", self.cells()),
            (Some(_), count) => {
                format!("{count} cells ({})", ranges(self.cells.iter().map(|cell| cell.index() + 1)))
            }
        }
    }
}

/// Groups alarms of many cells that have the same rule, severity, state and acknowledgement. Keeps the order.
pub(crate) fn grouped(alarms: &[Alarm]) -> Vec<AlarmGroup> {
    let is_alike = |a: &Alarm, b: &Alarm| {
        let kind = |alarm: &Alarm| (alarm.rule, alarm.severity, alarm.state, alarm.is_acknowledged);
        kind(a) == kind(b) && a.cell.is_some() && b.cell.is_some()
    };
    let mut groups: Vec<AlarmGroup> = Vec::new();
    for (index, alarm) in alarms.iter().enumerate() {
        let alike: Vec<&Alarm> = alarms.iter().filter(|other| is_alike(alarm, other)).collect();
        if alike.len() < MANY {
            groups.push(AlarmGroup { alarm: *alarm, cells: Vec::new() });
        } else if !alarms[..index].iter().any(|earlier| is_alike(alarm, earlier)) {
            let mut cells: Vec<CellIndex> = alike.iter().filter_map(|alarm| alarm.cell).collect();
            cells.sort_unstable();
            groups.push(AlarmGroup { alarm: worst(&alike), cells });
        }
    }
    groups
}

/// Returns the alarm with the worst value. An alarm without a value is returned only if all alarms have no value.
fn worst(alarms: &[&Alarm]) -> Alarm {
    let badness = |alarm: &Alarm| match (alarm.value, alarm.rule.spec().direction) {
        (None, _) => f64::NEG_INFINITY,
        (Some(value), Direction::Below) => -value,
        (Some(value), Direction::Above) => value,
    };
    let first = *alarms[0];
    alarms.iter().fold(first, |worst, alarm| if badness(alarm) > badness(&worst) { **alarm } else { worst })
}

/// Formats ascending numbers as `1-3, 7`; cuts a long list.
pub(crate) fn ranges(numbers: impl Iterator<Item = usize>) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for number in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => runs.push((number, number)),
        }
    }
    let mut text = String::new();
    for (first, last) in runs {
        let run = if first == last { first.to_string() } else { format!("{first}-{last}") };
        if text.len() + run.len() > MAX_LIST {
            return text + ", ...";
        }
        text = if text.is_empty() { run } else { format!("{text}, {run}") };
    }
    text
}

/// Cell number from 1, or `pack`.
pub(crate) fn cell(cell: Option<CellIndex>) -> String {
    cell.map_or_else(|| "pack".to_owned(), |cell| (u32::from(cell.0) + 1).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{AlarmState, Rule, Severity};

    fn alarm(rule: Rule, cell: Option<u16>, value: f64) -> Alarm {
        Alarm {
            rule,
            severity: Severity::Severe,
            cell: cell.map(CellIndex),
            state: AlarmState::Active,
            value: Some(value),
            probability: None,
            threshold: 1.0,
            occurrences: 1,
            first_raised: None,
            last_raised: None,
            raised_value: None,
            is_acknowledged: false,
        }
    }

    #[test]
    fn equal_alarms_share_row_with_worst_value() {
        let missing = |cell| alarm(Rule::InputMissing, Some(cell), f64::from(cell));
        let mut alarms = vec![alarm(Rule::SocLow, None, 0.1)];
        alarms.extend((0..96).map(missing));
        alarms.extend([alarm(Rule::CapacityLow, Some(3), 1.0), alarm(Rule::CapacityLow, Some(5), 0.9)]);
        let groups = grouped(&alarms);
        let owners: Vec<String> = groups.iter().map(AlarmGroup::owner).collect();
        assert_eq!(owners, ["pack", "96 cells (1-96)", "cell 4", "cell 6"]);
        assert_eq!((groups[1].alarm.value, groups[1].cells()), (Some(95.0), "96: 1-96".to_owned()));
        // Alarms in another state get their own row. For a rule with a lower limit, the smallest value is the worst.
        let mut low: Vec<Alarm> =
            (0..8).map(|cell| alarm(Rule::CapacityLow, Some(cell), 2.0 - f64::from(cell))).collect();
        low[1].state = AlarmState::Clearing;
        let groups = grouped(&low);
        assert_eq!((groups.len(), groups[0].alarm.value, groups[0].cells()), (2, Some(-5.0), "7: 1, 3-8".to_owned()));
    }

    #[test]
    fn long_cell_list_is_cut() {
        assert_eq!(ranges((1..40).step_by(2)), "1, 3, 5, 7, 9, 11, 13, 15, ...");
    }
}
