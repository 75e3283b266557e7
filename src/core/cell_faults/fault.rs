//! Kinds of findings, and the limits at which a finding is reported or withdrawn.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, Timestamp};

/// Kind of a finding. Each kind states the unit of the finding's size. Events, reports and the stored state contain
/// the name of the kind. The number of a kind must never change and never be reused, because it is the position (from
/// 1) in a stored array.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum CellFaultKind {
    /// The cell loses more charge than the other cells. Size: fraction of its capacity per day.
    Leak = 1,
    /// The contact resistance of the cell is higher than in the other cells. Size: difference, fraction of the mean
    /// cell's series resistance at SOC 0.5 and 25 degrees C.
    Contact = 2,
    /// The cell's capacity is lower than the other cells' capacity. Size: difference (negative), fraction of the
    /// capacity.
    WeakCell = 3,
    /// The cell's resistance is higher than the other cells' resistance, as in an aged cell. Size: difference, fraction
    /// of the resistance.
    HighResistance = 4,
    /// The cell's capacity is higher than the other cells' capacity, because the cell was replaced. Size: difference,
    /// fraction of the capacity.
    ForeignCell = 5,
    /// The capacities of neighbouring cells have been higher than the other cells' capacity since about the same time,
    /// because a module was replaced. Size: mean difference, fraction of the capacity.
    Module = 6,
    /// The cell's voltage channel has a constant offset. Size: V.
    VoltageChannel = 7,
    /// The cell's voltage channel stays at one value. The size is 1.
    VoltageFrozen = 8,
    /// Two voltage channels show the voltage of the same cell. The size is 1.
    DoubledChannels = 9,
    /// Two voltage channels have been exchanged. The size is 1.
    SwappedChannels = 10,
    /// The current sensor has a constant offset. Size: fraction of the rated capacity per hour.
    CurrentOffset = 11,
    /// The current reading stays at one value. The size is 1.
    CurrentFrozen = 12,
    /// The temperature sensor of these cells does not follow the load. The size is 1.
    TemperatureSensor = 13,
    /// The gain of the current sensor has risen. Size: fraction.
    CurrentGain = 14,
    /// The cell has less charge than the other cells, by a constant amount. Size: difference in SOC (negative),
    /// fraction.
    LowCharge = 15,
    /// The cell has more charge than the other cells, by a constant amount. Size: difference in SOC, fraction.
    HighCharge = 16,
}

impl CellFaultKind {
    /// All kinds, ordered by their numbers.
    pub const ALL: [Self; 16] = [
        Self::Leak,
        Self::Contact,
        Self::WeakCell,
        Self::HighResistance,
        Self::ForeignCell,
        Self::Module,
        Self::VoltageChannel,
        Self::VoltageFrozen,
        Self::DoubledChannels,
        Self::SwappedChannels,
        Self::CurrentOffset,
        Self::CurrentFrozen,
        Self::TemperatureSensor,
        Self::CurrentGain,
        Self::LowCharge,
        Self::HighCharge,
    ];

    /// Name in events, status and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Leak => "leak",
            Self::Contact => "contact",
            Self::WeakCell => "weak_cell",
            Self::HighResistance => "high_resistance",
            Self::ForeignCell => "foreign_cell",
            Self::Module => "module",
            Self::VoltageChannel => "voltage_channel",
            Self::VoltageFrozen => "voltage_frozen",
            Self::DoubledChannels => "doubled_channels",
            Self::SwappedChannels => "swapped_channels",
            Self::CurrentOffset => "current_offset",
            Self::CurrentFrozen => "current_frozen",
            Self::TemperatureSensor => "temperature_sensor",
            Self::CurrentGain => "current_gain",
            Self::LowCharge => "low_charge",
            Self::HighCharge => "high_charge",
        }
    }

    /// Description for logs and reports.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Leak => "loses charge by itself",
            Self::Contact => "high contact resistance",
            Self::WeakCell => "less capacity than the others",
            Self::HighResistance => "more resistance than the others",
            Self::ForeignCell => "more capacity than the others",
            Self::Module => "replaced together",
            Self::VoltageChannel => "voltage channel off",
            Self::VoltageFrozen => "voltage channel frozen",
            Self::DoubledChannels => "two channels of one cell",
            Self::SwappedChannels => "two channels exchanged",
            Self::CurrentOffset => "current sensor off",
            Self::CurrentFrozen => "current frozen",
            Self::TemperatureSensor => "temperature sensor does not follow the load",
            Self::CurrentGain => "current sensor shows too much",
            Self::LowCharge => "less charge than the others",
            Self::HighCharge => "more charge than the others",
        }
    }

    /// What the user should do.
    pub const fn advice(self) -> &'static str {
        match self {
            Self::Leak => {
                "a soft internal short, moisture or a balancing resistor that stays on: measure the cell's rest voltage \
                           over a week, and replace it when the leak grows"
            }
            Self::Contact => "tighten and clean the connections; a loose one heats under load",
            Self::WeakCell => "this cell limits the pack: plan its replacement",
            Self::HighResistance => "the cell has aged more than the others: watch its temperature under load",
            Self::ForeignCell => "the cell has been replaced: balance the pack",
            Self::Module => "modules have been replaced: balance the pack; their history starts again",
            Self::VoltageChannel => "compare the channel with a voltmeter, and check its sense wire",
            Self::VoltageFrozen => "the channel does not show a cell voltage: check monitor chip and sense wire",
            Self::DoubledChannels => "check the wiring of the two channels and the layout of their frames",
            Self::SwappedChannels => "the sense wires or the signals of the two channels are exchanged",
            Self::CurrentOffset => "compare the sensor at rest with an ammeter, and zero it",
            Self::CurrentFrozen => "the reading does not follow the current: check sensor and sender",
            Self::CurrentGain => {
                "compare the sensor under load with an ammeter: all capacities and resistances have changed by its gain"
            }
            Self::TemperatureSensor => "the sensor has fallen off or shows one value: check how it is mounted",
            Self::LowCharge => {
                "balance the pack, because a cell with less charge ends a discharge early; if the difference stays, compare the \
                 channel with a voltmeter"
            }
            Self::HighCharge => {
                "balance the pack, because a cell with more charge ends a charge early; if the difference stays, compare the \
                 channel with a voltmeter"
            }
        }
    }

    /// Whether the two cells of a finding are a pair. Otherwise, they are the ends of a range.
    pub const fn is_of_pair(self) -> bool {
        matches!(self, Self::DoubledChannels | Self::SwappedChannels)
    }

    /// If the probability is below this value, the finding is withdrawn. The value is lower for a leak, because a known
    /// leak is hidden while the BMS balances the pack, that is, discharges the other cells.
    pub(super) const fn withdrawn_below(self) -> f64 {
        match self {
            Self::Leak => 0.01,
            _ => WITHDRAWN,
        }
    }

    /// Whether the fault is in the cell's own voltage channel. If so, nothing else is known about the cell.
    pub const fn is_of_channel(self) -> bool {
        matches!(self, Self::VoltageChannel | Self::VoltageFrozen | Self::DoubledChannels)
    }

    /// Whether the voltage shown for a cell is wrong or belongs to another cell.
    pub const fn is_channel_fault(self) -> bool {
        self.is_of_channel() || matches!(self, Self::SwappedChannels)
    }

    /// Size (absolute value) above which a finding of this kind applies. Kinds with the limit 0.5 are decided by other
    /// conditions.
    pub(super) const fn limit(self) -> f64 {
        match self {
            Self::Leak => LEAK_PER_DAY,
            Self::Contact => CONTACT,
            Self::WeakCell | Self::ForeignCell | Self::Module => CAPACITY,
            Self::HighResistance => RESISTANCE,
            Self::VoltageChannel => CHANNEL_V,
            Self::CurrentGain => GAIN,
            Self::LowCharge | Self::HighCharge => CHARGE,
            _ => 0.5,
        }
    }
}

/// A finding about one cell, several cells or the whole pack.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellFault {
    /// Kind of the fault.
    pub kind: CellFaultKind,
    /// First and last cell of a range, or the lower and the upper channel of a pair. `None` = the whole pack.
    pub cells: Option<(CellIndex, CellIndex)>,
    /// Time since which the fault has been more likely than not.
    pub since: Timestamp,
    /// Time of the first report.
    pub reported: Timestamp,
    /// Probability that the size exceeds the limit of the kind.
    pub probability: f64,
    /// Size, in the unit that [`CellFaultKind`] states for the kind.
    pub size: ScalarGaussian,
}

impl CellFault {
    /// Whether the finding affects the cell.
    pub fn is_of(&self, cell: CellIndex) -> bool {
        let Some((first, last)) = self.cells else { return false };
        if self.kind.is_of_pair() { first == cell || last == cell } else { (first..=last).contains(&cell) }
    }
}

/// Writes the finding; cells are counted from 1. Example:
/// `cell 7: loses charge by itself, 18.24 ± 0.43 % of its capacity a day`.
/// The number after ± is the standard deviation.
impl fmt::Display for CellFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let number = |cell: CellIndex| cell.0 + 1;
        match self.cells.map(|(first, last)| (number(first), number(last))) {
            Some((first, last)) if first == last => write!(f, "cell {first}")?,
            Some((first, last)) if self.kind.is_of_pair() => write!(f, "cells {first} and {last}")?,
            Some((first, last)) => write!(f, "cells {first} to {last}")?,
            None => f.write_str("pack")?,
        }
        write!(f, ": {}", self.kind.words())?;
        let (scale, digits, unit) = match self.kind {
            CellFaultKind::Leak => (100.0, 2, "% of its capacity a day"),
            CellFaultKind::Contact => (100.0, 0, "% of its series resistance"),
            CellFaultKind::VoltageChannel => (1e3, 0, "mV"),
            CellFaultKind::CurrentOffset => (100.0, 2, "% of the rated capacity per hour"),
            _ if self.size.variance > 0.0 => (100.0, 1, "%"),
            _ => return Ok(()),
        };
        write!(f, ", {:.digits$} ± {:.digits$} {unit}", scale * self.size.mean, scale * self.size.std())
    }
}

/// Limit of the leak, fraction of the capacity per day. In a healthy pack, the losses of the cells differ by less than
/// 0.5 % per month.
pub const LEAK_PER_DAY: f64 = 5e-4;
/// Limit of the difference in contact resistance, fraction of the mean cell's series resistance.
pub const CONTACT: f64 = 0.1;
/// Limit of the difference in capacity, fraction.
pub const CAPACITY: f64 = 0.05;
/// Limit of the difference in resistance, fraction.
pub const RESISTANCE: f64 = 0.1;
/// Limit of the difference in charge, fraction of the capacity.
pub const CHARGE: f64 = 0.01;
/// Limit of the voltage channel's offset (V).
pub const CHANNEL_V: f64 = 0.015;

/// Limit of the current sensor's offset, fraction of the rated capacity per hour. At this limit, an SOC from coulomb
/// counting drifts by 24 % per day.
pub const OFFSET_PER_H: f64 = 0.01;

/// Limit of the rise of the current sensor's gain, fraction.
pub const GAIN: f64 = 0.02;

/// A finding is reported if its probability is at least `REPORTED`, and withdrawn if its probability falls below
/// `WITHDRAWN`. For a leak, [`CellFaultKind::withdrawn_below`] is lower.
pub(super) const REPORTED: f64 = 0.999;
pub(super) const WITHDRAWN: f64 = 0.5;

/// Minimum distance of a faulty cell from the median of the pack, in robust standard deviations of the pack's cells.
/// This distance allows for the normal spread of healthy cells.
pub(super) const OUTLIER: f64 = 3.5;
