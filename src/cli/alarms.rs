//! `packwatch alarms`: lists the alarms of the running daemon as a table or as JSON.

use std::fmt::Write as _;

use super::common::alarms::{AlarmGroup, grouped};
use super::common::control::ControlArgs;
use super::common::output;
use super::common::output::{print, word};
use crate::control::protocol::{AlarmList, Request, contents};
use crate::io::stamp;
use packwatch_host::failure::Failure;

/// Arguments of `alarms`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Print the daemon's answer as a line of JSON (cells from 0, times in ns since 1970)
    #[arg(long)]
    json: bool,
    /// Also list inactive and unknown alarms
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    control: ControlArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let line = args.control.client().ask_line(Request::Alarms { all: args.all }).map_err(Failure::new)?;
    let list: AlarmList = contents(&line).map_err(Failure::new)?;
    if args.json { print(&String::from_utf8_lossy(&line)) } else { print(&table(&list)) }
}

const HEAD: [&str; 11] = [
    "rule",
    "severity",
    "cell",
    "state",
    "value",
    "threshold",
    "probability",
    "raised",
    "first",
    "last",
    "acknowledged",
];

fn table(list: &AlarmList) -> String {
    let mut text = String::new();
    if list.alarms.is_empty() {
        text.push_str("no alarm\n");
    } else {
        text.push_str(&output::table(&HEAD, grouped(&list.alarms).iter().map(row), HEAD.len()));
    }
    if list.omitted > 0 {
        let _ = writeln!(text, "and {} more, which do not fit in an answer", list.omitted);
    }
    let _ = write!(text, "{} thresholds", list.thresholds);
    if list.unknown.is_empty() {
        text.push_str(", all known\n");
    } else {
        let names = list
            .unknown
            .iter()
            .map(|unknown| format!("{} {} ({})", unknown.rule.name(), unknown.severity.name(), unknown.alarms));
        let names: Vec<String> = names.collect();
        let _ = writeln!(text, ", {} of them unknown (number of alarms): {}", names.len(), names.join(", "));
    }
    text
}

fn row(group: &AlarmGroup) -> Vec<String> {
    let alarm = &group.alarm;
    let stamp = |time: Option<_>| time.map_or_else(|| "-".to_owned(), stamp::format_utc);
    let has_been = alarm.occurrences > 0;
    vec![
        alarm.rule.name().to_owned(),
        alarm.severity.name().to_owned(),
        group.cells(),
        word(alarm.state),
        alarm.value.map_or_else(|| "unknown".to_owned(), |value| alarm.rule.with_unit(value)),
        alarm.rule.with_unit(alarm.threshold),
        alarm.probability.map_or_else(|| "-".to_owned(), |probability| format!("{:.1} %", 100.0 * probability)),
        alarm.occurrences.to_string(),
        stamp(alarm.first_raised),
        stamp(alarm.last_raised),
        match (has_been, alarm.is_acknowledged) {
            (false, _) => "-",
            (true, true) => "yes",
            (true, false) => "no",
        }
        .to_owned(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::Rule;
    use crate::alarm::{Alarm, AlarmState, Severity};
    use crate::control::protocol::UnknownAlarms;
    use crate::quantity::CellIndex;
    use crate::quantity::Timestamp;

    fn alarm() -> Alarm {
        Alarm {
            rule: Rule::SocLow,
            severity: Severity::Warning,
            cell: None,
            state: AlarmState::Active,
            value: Some(0.084),
            probability: Some(0.973),
            threshold: 0.1,
            occurrences: 2,
            first_raised: Some(Timestamp::from_secs(0.0)),
            last_raised: Some(Timestamp::from_secs(86_400.5)),
            raised_value: Some(0.09),
            is_acknowledged: false,
        }
    }

    #[test]
    fn table_counts_cells_from_1_and_names_unknown_thresholds() {
        let missing = Alarm {
            rule: Rule::InputMissing,
            cell: Some(CellIndex(0)),
            state: AlarmState::Suppressed,
            value: None,
            probability: None,
            threshold: 2.0,
            is_acknowledged: true,
            ..alarm()
        };
        let unknown = UnknownAlarms { rule: Rule::CapacityLow, severity: Severity::Severe, alarms: 96 };
        let list = AlarmList {
            time: Timestamp::ZERO,
            thresholds: 3,
            unknown: vec![unknown],
            alarms: vec![missing, alarm()],
            omitted: 0,
        };
        let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>().join(" ");
        let lines: Vec<String> = table(&list).lines().map(words).collect();
        assert_eq!(
            lines,
            [
                "rule severity cell state value threshold probability raised first last acknowledged",
                "input_missing warning 1 suppressed unknown 2.0 s - 2 1970-01-01T00:00:00Z 1970-01-02T00:00:00Z yes",
                "soc_low warning pack active 8.4 % 10.0 % 97.3 % 2 1970-01-01T00:00:00Z 1970-01-02T00:00:00Z no",
                "3 thresholds, 1 of them unknown (number of alarms): capacity_low severe (96)",
            ]
        );
    }

    #[test]
    fn empty_list_prints_no_alarm() {
        let list = AlarmList { time: Timestamp::ZERO, thresholds: 2, unknown: vec![], alarms: vec![], omitted: 0 };
        assert_eq!(table(&list), "no alarm\n2 thresholds, all known\n");
    }
}
