//! Describes channels and commands in words, for log lines. Cells and sensors are counted from 1, as in all texts for
//! users.

use crate::alarm::Selector;
use crate::monitor::Command;
use crate::quantity::Channel;

/// Name of an enumeration value, as in JSON and on the command line.
pub fn word(value: impl serde::Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "?".to_owned(),
    }
}

/// The channel in words, such as `cell voltage 73`.
pub(super) fn channel(channel: Channel) -> String {
    match channel {
        Channel::Contactor => "contactor".to_owned(),
        Channel::CurrentDirection => "direction of the current".to_owned(),
        Channel::Current => "current".to_owned(),
        Channel::Temperature(sensor) => format!("temperature {}", u32::from(sensor.0) + 1),
        Channel::PackVoltage => "pack voltage".to_owned(),
        Channel::CellVoltage(cell) => format!("cell voltage {}", super::number(cell)),
        Channel::ReportedSoc => "reported SOC".to_owned(),
        Channel::ReportedSoh => "reported SOH".to_owned(),
        Channel::Balancing(cell) => format!("balancing of cell {}", super::number(cell)),
        Channel::SupplyVoltage => "supply voltage".to_owned(),
        Channel::PackIdentity => "pack identity".to_owned(),
    }
}

/// The command in words, such as `clear capacity_low of cell 73`.
pub fn command(command: &Command) -> String {
    match command {
        Command::Acknowledge(which) => format!("acknowledge {}", selected(which)),
        Command::Clear(which) => format!("clear {}", selected(which)),
        Command::PackReplaced => "pack replaced".to_owned(),
        Command::Poll { standby: true } => "poll standby".to_owned(),
        Command::Poll { standby: false } => "poll".to_owned(),
        Command::Test { rule, seconds } => format!("test {} for {seconds} s", rule.name()),
    }
}

fn selected(which: &Selector) -> String {
    let rule = which.rule.map_or("all alarms", |rule| rule.name());
    let severity = which.severity.map(|severity| format!(" of severity {}", severity.name()));
    let cell = which.cell.map(|cell| format!(" of cell {}", super::number(cell)));
    format!("{rule}{}{}", severity.unwrap_or_default(), cell.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{Rule, Severity};
    use crate::quantity::{CellIndex, SensorIndex};

    #[test]
    fn cells_and_sensors_count_from_one() {
        assert_eq!(channel(Channel::CellVoltage(CellIndex(72))), "cell voltage 73");
        assert_eq!(channel(Channel::Temperature(SensorIndex(0))), "temperature 1");
    }

    #[test]
    fn command_words_name_selection() {
        let rule = Some(Rule::CapacityLow);
        let which = Selector { rule, severity: Some(Severity::Severe), cell: Some(CellIndex(72)) };
        assert_eq!(command(&Command::Clear(which)), "clear capacity_low of severity severe of cell 73");
        assert_eq!(command(&Command::Acknowledge(Selector::default())), "acknowledge all alarms");
    }
}
