//! What the monitor finds wrong: a placeholder until the diagnosis exists. It translates the alarms of today.

use packwatch::alarm::Rule;
use packwatch::monitor::Monitor;
use packwatch::quantity::{CellIndex, Timestamp};
use packwatch::sim::FaultKind;

/// What is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FindingKind {
    Leak,
    Contact,
    Weak,
    Resistance,
    Module,
    CurrentOffset,
    CurrentGain,
    CurrentStuck,
    VoltageOffset,
    VoltageStuck,
    Swap,
    Double,
    TemperatureStuck,
    TemperatureOff,
    /// Alarm `cell_imbalance`: names no cell and no cause.
    Imbalance,
    /// Alarm `input_implausible` or `estimate_untrusted`.
    Distrust,
}

impl FindingKind {
    /// The finding that an injected fault asks for.
    pub(crate) fn of(fault: &FaultKind) -> Self {
        match fault {
            FaultKind::Leak { .. } => Self::Leak,
            FaultKind::Contact { .. } => Self::Contact,
            FaultKind::Weak { .. } => Self::Weak,
            FaultKind::Resistance { .. } => Self::Resistance,
            FaultKind::Module { .. } => Self::Module,
            FaultKind::CurrentOffset(_) => Self::CurrentOffset,
            FaultKind::CurrentGain(_) => Self::CurrentGain,
            FaultKind::CurrentStuck => Self::CurrentStuck,
            FaultKind::VoltageOffset { .. } => Self::VoltageOffset,
            FaultKind::VoltageStuck { .. } => Self::VoltageStuck,
            FaultKind::Swap(..) => Self::Swap,
            FaultKind::Double { .. } => Self::Double,
            FaultKind::TemperatureStuck(_) => Self::TemperatureStuck,
            FaultKind::TemperatureOff(_) => Self::TemperatureOff,
        }
    }
}

/// One finding.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Finding {
    pub(crate) kind: FindingKind,
    /// First and last cell; `None` = the pack.
    pub(crate) cells: Option<(CellIndex, CellIndex)>,
    pub(crate) since: Timestamp,
    pub(crate) probability: f64,
    /// In the unit of the kind.
    pub(crate) size: f64,
}

/// The findings that hold now.
pub(crate) fn findings(monitor: &Monitor) -> Vec<Finding> {
    let kind_of = |rule| match rule {
        Rule::CellImbalance => Some(FindingKind::Imbalance),
        Rule::InputImplausible | Rule::EstimateUntrusted => Some(FindingKind::Distrust),
        _ => None,
    };
    let raised = monitor.alarms().raised();
    raised
        .filter_map(|alarm| {
            Some(Finding {
                kind: kind_of(alarm.rule)?,
                cells: alarm.cell.map(|cell| (cell, cell)),
                since: monitor.now(),
                probability: alarm.probability.unwrap_or(1.0),
                size: alarm.value.unwrap_or(f64::NAN),
            })
        })
        .collect()
}
