//! Subjects of alarms: one specification per rule, and the severities.
//!
//! The table in [`Rule::spec`] is the one place that specifies what a rule compares; configuration, reference page, frames
//! and engine all take it from there.

use serde::{Deserialize, Serialize};

/// Subject of an alarm. The number is the one on the wire (`config/packwatch.dbc`), never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Rule {
    /// Capacity (full to empty open-circuit) below the threshold, Ah.
    CapacityLow = 1,
    /// Usable capacity (configured load and cut-off) below the threshold, Ah.
    UsableCapacityLow = 2,
    /// Recharge period below the threshold, s.
    RechargePeriodLow = 3,
    /// A configured input has not come for too long; the value is its age, s.
    InputMissing = 4,
    /// A configured input keeps being implausible; the value is the share of bad readings, fraction.
    InputImplausible = 5,
    /// The estimator's innovations contradict its own covariance, or the model is another cell's; the value is the mean
    /// normalised innovation squared, or the mismatch ([`ModelCheck`](crate::cell::ModelCheck)) in the same scale.
    EstimateUntrusted = 6,
    /// Resistance relative to new above the threshold, as the last half-cycle left it.
    ResistanceHigh = 7,
    /// SOC of the cell that limits discharge below the threshold, fraction.
    SocLow = 8,
    /// The hottest sensor above the threshold, degrees C.
    TemperatureHigh = 9,
    /// SOC of the fullest cell minus that of the emptiest above the threshold, fraction.
    CellImbalance = 10,
    /// Remaining useful life below the threshold, equivalent full cycles.
    RemainingLifeLow = 11,
    /// SOC or SOH as the pack itself reports it differs from ours, fraction (the larger of the two differences).
    BmsDisagrees = 12,
    /// A file that keeps what was learned or recorded cannot be written; the value is for how long, s.
    StoreFailed = 13,
    /// An interface is down, missing, bus-off or takes no frames; the value is for how long, s.
    BusFault = 14,
    /// Self-discharge against the other cells of the pack above the threshold, fraction of the capacity in a day.
    CellLeak = 15,
    /// Contact resistance beyond that of the other cells above the threshold, fraction of a cell's series resistance in the middle
    /// of the charge at 25 degrees C.
    ConnectionResistance = 16,
    /// The voltage channel shows no cell of its own; the value is 1 then, else 0. The cell's other rules are unknown meanwhile.
    ChannelFaulty = 17,
}

/// Scope of a rule: the pack as a whole, its cells, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// One value for the pack.
    Pack,
    /// One value per cell.
    Cell,
    /// One value per cell, and one for the inputs of no cell (such as the pack's current).
    Both,
}

/// Which side of a threshold is bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// Raised below the threshold.
    Below,
    /// Raised above it.
    Above,
}

/// Unit of a rule's values and thresholds inside the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Ah; a threshold may be a part of the rated capacity.
    AmpereHours,
    /// s.
    Seconds,
    /// 0 to 1.
    Fraction,
    /// 0 to 1, in a day.
    FractionPerDay,
    /// Times something (as new, as expected).
    Ratio,
    /// Degrees C.
    Celsius,
    /// Equivalent full cycles.
    Cycles,
}

impl Unit {
    /// As written after a number; empty for plain numbers.
    pub const fn symbol(self) -> &'static str {
        match self {
            Self::AmpereHours => "Ah",
            Self::Seconds => "s",
            Self::Fraction | Self::Ratio => "",
            Self::Celsius => "degrees C",
            Self::Cycles => "cycles",
            Self::FractionPerDay => "per day",
        }
    }
}

/// Specification of one rule: the compared quantity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RuleSpec {
    /// Pack, cells or both.
    pub scope: Scope,
    /// Which side of its threshold is bad.
    pub direction: Direction,
    /// Unit of value and threshold.
    pub unit: Unit,
    /// Whether the value comes with a standard deviation, so that its probability can be judged.
    pub has_deviation: bool,
    /// Whether a value stays true until the next one, so that the time debounce may run out between them.
    ///
    /// A value learned at a transition does: a capacity is not less low because no cycle has ended since.
    /// A value measured all the time does not: without a new consistency figure the old one proves nothing.
    pub is_learned: bool,
    /// The compared quantity, for readers.
    pub about: &'static str,
}

impl Rule {
    /// Every rule, in wire order.
    pub const ALL: [Self; 17] = [
        Self::CapacityLow,
        Self::UsableCapacityLow,
        Self::RechargePeriodLow,
        Self::InputMissing,
        Self::InputImplausible,
        Self::EstimateUntrusted,
        Self::ResistanceHigh,
        Self::SocLow,
        Self::TemperatureHigh,
        Self::CellImbalance,
        Self::RemainingLifeLow,
        Self::BmsDisagrees,
        Self::StoreFailed,
        Self::BusFault,
        Self::CellLeak,
        Self::ConnectionResistance,
        Self::ChannelFaulty,
    ];

    /// The rule of a wire number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|rule| *rule as u8 == number)
    }

    /// As written in configurations, events and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::CapacityLow => "capacity_low",
            Self::UsableCapacityLow => "usable_capacity_low",
            Self::RechargePeriodLow => "recharge_period_low",
            Self::InputMissing => "input_missing",
            Self::InputImplausible => "input_implausible",
            Self::EstimateUntrusted => "estimate_untrusted",
            Self::ResistanceHigh => "resistance_high",
            Self::SocLow => "soc_low",
            Self::TemperatureHigh => "temperature_high",
            Self::CellImbalance => "cell_imbalance",
            Self::RemainingLifeLow => "remaining_life_low",
            Self::BmsDisagrees => "bms_disagrees",
            Self::StoreFailed => "store_failed",
            Self::BusFault => "bus_fault",
            Self::CellLeak => "cell_leak",
            Self::ConnectionResistance => "connection_resistance",
            Self::ChannelFaulty => "channel_faulty",
        }
    }

    /// Whether the rule compares what the cell's voltages show: a faulty channel shows nothing of it.
    pub const fn is_of_cell_voltage(self) -> bool {
        matches!(
            self,
            Self::CapacityLow
                | Self::UsableCapacityLow
                | Self::EstimateUntrusted
                | Self::ResistanceHigh
                | Self::CellLeak
                | Self::ConnectionResistance
        )
    }

    /// Its specification.
    pub const fn spec(self) -> RuleSpec {
        use Direction::{Above, Below};
        use Scope::{Both, Cell, Pack};
        use Unit::{AmpereHours, Celsius, Cycles, Fraction, FractionPerDay, Ratio, Seconds};
        let (scope, direction, unit, has_deviation, is_learned, about) = match self {
            Self::CapacityLow => (Cell, Below, AmpereHours, true, true, "a cell's capacity"),
            Self::UsableCapacityLow => (Cell, Below, AmpereHours, true, true, "a cell's usable capacity"),
            Self::RechargePeriodLow => (Pack, Below, Seconds, true, true, "the recharge period"),
            Self::InputMissing => (Both, Above, Seconds, false, false, "the age of an input"),
            Self::InputImplausible => (Both, Above, Fraction, false, false, "the share of bad readings of an input"),
            Self::EstimateUntrusted => {
                (Cell, Above, Ratio, false, false, "a cell's mean normalised innovation squared")
            }
            Self::ResistanceHigh => (Cell, Above, Ratio, true, true, "a cell's resistance relative to new"),
            Self::SocLow => (Pack, Below, Fraction, true, false, "the SOC of the emptiest cell"),
            Self::TemperatureHigh => (Pack, Above, Celsius, false, false, "the highest temperature"),
            Self::CellImbalance => {
                (Pack, Above, Fraction, true, false, "the SOC between the fullest and the emptiest cell")
            }
            Self::RemainingLifeLow => (Pack, Below, Cycles, true, true, "the remaining useful life"),
            Self::BmsDisagrees => {
                (Pack, Above, Fraction, true, false, "the difference from the SOC or SOH the pack reports")
            }
            Self::StoreFailed => (Pack, Above, Seconds, false, false, "the time a file could not be written"),
            Self::BusFault => (Pack, Above, Seconds, false, false, "the time an interface was out of order"),
            Self::CellLeak => (Cell, Above, FractionPerDay, true, true, "a cell's self-discharge"),
            Self::ConnectionResistance => {
                (Cell, Above, Fraction, true, true, "a cell's contact resistance beyond the others'")
            }
            Self::ChannelFaulty => (Cell, Above, Fraction, false, false, "whether a voltage channel is faulty"),
        };
        RuleSpec { scope, direction, unit, has_deviation, is_learned, about }
    }
}

/// Severity, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Severity {
    /// Worth knowing.
    Info = 1,
    /// Plan a visit.
    Warning = 2,
    /// Act now.
    Severe = 3,
}

impl Severity {
    /// All of them, mildest first.
    pub const ALL: [Self; 3] = [Self::Info, Self::Warning, Self::Severe];

    /// As written in configurations, events and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Severe => "severe",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_dense_and_found_again() {
        for (number, rule) in (1..).zip(Rule::ALL) {
            assert_eq!(rule as u8, number);
            assert_eq!(Rule::from_number(number), Some(rule));
            assert_eq!(serde_json::to_value(rule).expect("a word"), rule.name());
        }
        assert_eq!((Rule::from_number(0), Rule::from_number(18)), (None, None));
    }
}
