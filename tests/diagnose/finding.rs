//! The finding that an injected fault asks for.

use packwatch::cell_faults::FindingKind;
use packwatch::sim::FaultKind;

/// The finding of a fault; `None` = packwatch has none for it.
pub(crate) fn kind_of(fault: &FaultKind) -> Option<FindingKind> {
    match fault {
        FaultKind::Leak { .. } => Some(FindingKind::Leak),
        FaultKind::Contact { .. } => Some(FindingKind::Contact),
        FaultKind::Weak { .. } => Some(FindingKind::WeakCell),
        FaultKind::Resistance { .. } => Some(FindingKind::HighResistance),
        FaultKind::Module { .. } => Some(FindingKind::Module),
        FaultKind::CurrentOffset(_) => Some(FindingKind::CurrentOffset),
        FaultKind::CurrentGain(_) => Some(FindingKind::CurrentGain),
        FaultKind::CurrentStuck => Some(FindingKind::CurrentFrozen),
        FaultKind::VoltageOffset { .. } => Some(FindingKind::VoltageChannel),
        FaultKind::VoltageStuck { .. } => Some(FindingKind::VoltageFrozen),
        FaultKind::Swap(..) => Some(FindingKind::SwappedChannels),
        FaultKind::Double { .. } => Some(FindingKind::DoubledChannels),
        FaultKind::TemperatureStuck(_) | FaultKind::TemperatureOff(_) => Some(FindingKind::TemperatureSensor),
    }
}
