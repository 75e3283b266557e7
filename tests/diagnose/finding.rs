//! States the finding that packwatch should report for an injected fault.

use packwatch_core::cell_faults::CellFaultKind;
use packwatch_core::sim::FaultKind;

/// The expected kind of finding.
pub(crate) fn kind_of(fault: &FaultKind) -> Option<CellFaultKind> {
    match fault {
        FaultKind::Leak { .. } => Some(CellFaultKind::Leak),
        FaultKind::Contact { .. } => Some(CellFaultKind::Contact),
        FaultKind::Weak { .. } => Some(CellFaultKind::WeakCell),
        FaultKind::Resistance { .. } => Some(CellFaultKind::HighResistance),
        FaultKind::Module { .. } => Some(CellFaultKind::Module),
        FaultKind::CurrentOffset(_) => Some(CellFaultKind::CurrentOffset),
        FaultKind::CurrentGain(_) => Some(CellFaultKind::CurrentGain),
        FaultKind::CurrentStuck => Some(CellFaultKind::CurrentFrozen),
        FaultKind::VoltageOffset { .. } => Some(CellFaultKind::VoltageChannel),
        FaultKind::VoltageStuck { .. } => Some(CellFaultKind::VoltageFrozen),
        FaultKind::Swap(..) => Some(CellFaultKind::SwappedChannels),
        FaultKind::Double { .. } => Some(CellFaultKind::DoubledChannels),
        FaultKind::TemperatureStuck(_) | FaultKind::TemperatureOff(_) => Some(CellFaultKind::TemperatureSensor),
    }
}
