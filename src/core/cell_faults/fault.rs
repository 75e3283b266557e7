//! What is found, and from when on it is reported.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, Timestamp};

/// What is wrong. The number is the one on the wire, never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum CellFaultKind {
    /// The cell loses charge against the others; fraction of its capacity in a day.
    Leak = 1,
    /// The contact resistance of its connection is higher than that of the others; fraction of the cell's series resistance.
    Contact = 2,
    /// Its capacity is below that of the others; fraction.
    WeakCell = 3,
    /// Its resistance is above that of the others, as of an aged cell; fraction.
    HighResistance = 4,
    /// Its capacity is above that of the others: a cell of another age; fraction.
    ForeignCell = 5,
    /// Several cells side by side have changed at once: a replaced module; mean change of their capacity, fraction.
    Module = 6,
    /// Its voltage channel is off by a constant; V.
    VoltageChannel = 7,
    /// Its voltage channel stays at one value; the value is 1.
    VoltageFrozen = 8,
    /// Two voltage channels show the values of one cell; the value is 1.
    DoubledChannels = 9,
    /// Two voltage channels have been exchanged; the value is 1.
    SwappedChannels = 10,
    /// The sensor of the current is off by a constant; part of the rated capacity per hour.
    CurrentOffset = 11,
    /// The reading of the current stays at one value; the value is 1.
    CurrentFrozen = 12,
    /// The temperature sensor of these cells does not follow the load; the value is 1.
    TemperatureSensor = 13,
    /// The gain of the current's sensor has risen; fraction.
    CurrentGain = 14,
}

impl CellFaultKind {
    /// Every kind, in the order of the wire.
    pub const ALL: [Self; 14] = [
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
    ];

    /// As written in events, status and reports.
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
        }
    }

    /// In words.
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
        }
    }

    /// What to do about it.
    pub const fn advice(self) -> &'static str {
        match self {
            Self::Leak => {
                "a soft internal short, moisture or a balancing resistor that stays on: measure the cell's rest voltage \
                           over a week, and replace it when the leak grows"
            }
            Self::Contact => "tighten and clean the connections of the cell; a loose one heats under load",
            Self::WeakCell => "the pack ends with this cell: plan its replacement",
            Self::HighResistance => "the cell has aged more than the others: watch its temperature under load",
            Self::ForeignCell => "the cell has been replaced: balance the pack",
            Self::Module => "modules have been replaced: balance the pack; their history begins again",
            Self::VoltageChannel => "compare the channel with a voltmeter, and check its sense wire",
            Self::VoltageFrozen => "the channel shows no cell: check monitor chip and sense wire",
            Self::DoubledChannels => "check the wiring of the two channels and the layout of their frames",
            Self::SwappedChannels => "the sense wires or the signals of the two channels are exchanged",
            Self::CurrentOffset => "compare the sensor at rest with an ammeter, and zero it",
            Self::CurrentFrozen => "the reading is no current: check sensor and sender",
            Self::CurrentGain => {
                "compare the sensor under load with an ammeter: all capacities and resistances have changed by its gain"
            }
            Self::TemperatureSensor => "the sensor has fallen off or shows one value: check where it sits",
        }
    }

    /// Whether its two cells are a pair, not the ends of a range.
    pub const fn is_of_pair(self) -> bool {
        matches!(self, Self::DoubledChannels | Self::SwappedChannels)
    }

    /// Probability below which it is withdrawn. A BMS that bleeds the other cells hides a leak that was seen before.
    pub(super) const fn withdrawn_below(self) -> f64 {
        match self {
            Self::Leak => 0.01,
            _ => WITHDRAWN,
        }
    }

    /// Whether it is the measurement that fails, so that nothing is known of the cell.
    pub const fn is_of_channel(self) -> bool {
        matches!(self, Self::VoltageChannel | Self::VoltageFrozen | Self::DoubledChannels)
    }

    /// Whether the voltages that are read as a cell's are not those of that cell.
    pub const fn is_channel_fault(self) -> bool {
        self.is_of_channel() || matches!(self, Self::SwappedChannels)
    }

    /// Size beyond which it is one, in the unit of the kind; of those that are so or not, one half.
    pub(super) const fn limit(self) -> f64 {
        match self {
            Self::Leak => LEAK_PER_DAY,
            Self::Contact => CONTACT,
            Self::WeakCell | Self::ForeignCell | Self::Module => CAPACITY,
            Self::HighResistance => RESISTANCE,
            Self::VoltageChannel => CHANNEL_V,
            Self::CurrentGain => GAIN,
            _ => 0.5,
        }
    }
}

/// A finding.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellFault {
    /// What.
    pub kind: CellFaultKind,
    /// First and last cell of it; of two channels the lower and the upper one; `None` = the pack as a whole.
    pub cells: Option<(CellIndex, CellIndex)>,
    /// When it was first likelier than not.
    pub since: Timestamp,
    /// When it was first reported.
    pub reported: Timestamp,
    /// Probability that it is beyond the limit of its kind.
    pub probability: f64,
    /// How large; the unit is that of the kind.
    pub size: ScalarGaussian,
}

impl CellFault {
    /// Whether it is about the cell.
    pub fn is_of(&self, cell: CellIndex) -> bool {
        let Some((first, last)) = self.cells else { return false };
        if self.kind.is_of_pair() { first == cell || last == cell } else { (first..=last).contains(&cell) }
    }
}

/// In words, cells counted from 1: `cell 7: loses charge by itself, 18.24 ± 0.43 % of its capacity a day`. The deviation is one standard
/// deviation.
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

/// Leak beyond which it is one, fraction of the capacity in a day: healthy cells of one pack differ by less than 0.5 % a month.
pub const LEAK_PER_DAY: f64 = 5e-4;
/// The same of contact, capacity and resistance, fractions, and of the channel, V.
pub const CONTACT: f64 = 0.1;
/// See [`CONTACT`].
pub const CAPACITY: f64 = 0.05;
/// See [`CONTACT`].
pub const RESISTANCE: f64 = 0.1;
/// See [`CONTACT`].
pub const CHANNEL_V: f64 = 0.015;

/// Offset of the current beyond which its sensor is faulty, part of the rated capacity per hour: SOC runs away by a quarter in a day.
pub const OFFSET_PER_H: f64 = 0.01;

/// Rise of the current's gain beyond which its sensor is faulty, fraction.
pub const GAIN: f64 = 0.02;

/// Probability from which on a finding is reported, and below which it is withdrawn.
pub(super) const REPORTED: f64 = 0.999;
pub(super) const WITHDRAWN: f64 = 0.5;

/// Least distance from the middle of the pack in robust standard deviations of its cells: cells of one kind differ.
pub(super) const OUTLIER: f64 = 3.5;
