//! Alarm rules and severities.
//!
//! The table in [`Rule::spec`] specifies what each rule compares. The configuration, the reference page, the reports
//! and the engine use this table.

use serde::{Deserialize, Serialize};

/// An alarm rule. The value of a variant is the wire code (`config/packwatch.dbc`) and is never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Rule {
    /// The capacity (Ah) between the full and the empty open-circuit voltage is below the threshold.
    CapacityLow = 1,
    /// The usable capacity (Ah), with the configured load and cut-off, is below the threshold.
    UsableCapacityLow = 2,
    /// The recharge period (s) is below the threshold.
    RechargePeriodLow = 3,
    /// A configured input is missing for too long. The value is the input's age (s).
    InputMissing = 4,
    /// A configured input is implausible too often. The value is the fraction of bad readings.
    InputImplausible = 5,
    /// The estimator's innovations contradict its own covariance, or the model belongs to another cell. The value is
    /// the mean normalised innovation squared, or the mismatch ([`ModelCheck`](crate::cell::ModelCheck)) on the same
    /// scale.
    EstimateUntrusted = 6,
    /// The resistance relative to new is above the threshold. The value is the resistance that was learned in the last
    /// half-cycle.
    ResistanceHigh = 7,
    /// The SOC (fraction) of the cell that limits discharge is below the threshold.
    SocLow = 8,
    /// The highest temperature (degrees C) is above the threshold.
    TemperatureHigh = 9,
    /// The SOC difference (fraction) between the fullest and the emptiest cell is above the threshold.
    CellImbalance = 10,
    /// The remaining useful life (equivalent full cycles) is below the threshold.
    RemainingLifeLow = 11,
    /// SOC or SOH reported by the pack differs from the estimate. The value is the larger of the two differences
    /// (fraction).
    BmsDisagrees = 12,
    /// A file of the stored state or of the records cannot be written. The value is the duration of this fault (s).
    StoreFailed = 13,
    /// An interface is down, missing, bus-off or accepts no frames. The value is the duration of this fault (s).
    BusFault = 14,
    /// A cell's self-discharge in excess of the other cells is above the threshold. The unit is a fraction of the
    /// capacity per day.
    CellLeak = 15,
    /// A cell's contact resistance in excess of the other cells is above the threshold. The unit is a fraction of the
    /// cell's series resistance at medium SOC and 25 degrees C.
    ConnectionResistance = 16,
    /// A voltage channel does not show its own cell. The value is 1 in this case, else 0. While the value is 1, the
    /// rules that depend on the cell's voltage are unknown.
    ChannelFaulty = 17,
    /// Signs of a thermal event in a cell. The value is 1 if the cell's voltage collapses, 2 if a temperature of the
    /// cell rises faster than the current explains, 3 for both, else 0.
    ThermalEvent = 18,
}

/// Scope of a rule: the pack as a whole, its cells, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// One value for the pack.
    Pack,
    /// One value per cell.
    Cell,
    /// One value per cell, and one for inputs that belong to the whole pack (such as the pack's current).
    Both,
}

/// Which side of a threshold is bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// The alarm is raised below the threshold.
    Below,
    /// The alarm is raised above the threshold.
    Above,
}

/// Unit of a rule's values and thresholds inside the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Ah; the configuration may give a threshold as a fraction of the rated capacity.
    AmpereHours,
    Seconds,
    /// Fraction, 0 to 1.
    Fraction,
    /// Fraction per day, 0 to 1.
    FractionPerDay,
    /// A multiple of a reference, such as the value when new or the expected value.
    Ratio,
    Celsius,
    Cycles,
}

impl Unit {
    /// The unit as written after a number; empty for plain numbers.
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

/// Specification of one rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RuleSpec {
    /// Pack, cells or both.
    pub scope: Scope,
    /// The bad side of the threshold.
    pub direction: Direction,
    /// Unit of value and threshold.
    pub unit: Unit,
    /// Whether the value has a standard deviation, so that a probability can be compared.
    pub has_deviation: bool,
    /// Whether a value stays valid until the next value arrives, so that the time debounce continues between values.
    ///
    /// A learned value, such as a capacity, stays valid until it is learned again. A measured value does not, because
    /// an old value proves nothing without new data.
    pub is_learned: bool,
    /// Name of the compared quantity, for messages.
    pub about: &'static str,
}

impl Rule {
    /// Every rule, in the order of the wire codes.
    pub const ALL: [Self; 18] = [
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
        Self::ThermalEvent,
    ];

    /// The rule with a wire code; `None` = no such rule.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|rule| *rule as u8 == number)
    }

    /// Formats a value of the rule with its unit. Fractions are shown as percentages, the evidence of a thermal event in
    /// words.
    pub fn with_unit(self, value: f64) -> String {
        let unit = self.spec().unit;
        let evidence = (0_u8..).zip(EVIDENCE).find(|(code, _)| self == Self::ThermalEvent && f64::from(*code) == value);
        if let Some((_, words)) = evidence {
            return words.to_owned();
        }
        match unit {
            Unit::Fraction => format!("{:.1} %", 100.0 * value),
            Unit::FractionPerDay => format!("{:.3} %/d", 100.0 * value),
            Unit::Ratio => format!("{value:.2}"),
            Unit::AmpereHours => format!("{value:.3} {}", unit.symbol()),
            Unit::Seconds | Unit::Celsius | Unit::Cycles => format!("{value:.1} {}", unit.symbol()),
        }
    }

    /// The name in configurations, events and on the command line.
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
            Self::ThermalEvent => "thermal_event",
        }
    }

    /// Whether the rule depends on the cell's voltages, so that a faulty channel makes its value unknown.
    pub const fn depends_on_cell_voltage(self) -> bool {
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

    /// The specification of the rule.
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
                (Pack, Above, Fraction, true, false, "the SOC difference between the fullest and the emptiest cell")
            }
            Self::RemainingLifeLow => (Pack, Below, Cycles, true, true, "the remaining useful life"),
            Self::BmsDisagrees => {
                (Pack, Above, Fraction, true, false, "the difference from the SOC or SOH the pack reports")
            }
            Self::StoreFailed => (Pack, Above, Seconds, false, false, "the time a file could not be written"),
            Self::BusFault => (Pack, Above, Seconds, false, false, "the duration of an interface fault"),
            Self::CellLeak => (Cell, Above, FractionPerDay, true, true, "a cell's self-discharge"),
            Self::ConnectionResistance => {
                (Cell, Above, Fraction, true, true, "a cell's contact resistance in excess of the other cells")
            }
            Self::ChannelFaulty => (Cell, Above, Fraction, false, false, "whether a voltage channel is faulty"),
            Self::ThermalEvent => (Cell, Above, Ratio, false, false, "the evidence of a thermal event"),
        };
        RuleSpec { scope, direction, unit, has_deviation, is_learned, about }
    }
}

/// Values of [`Rule::ThermalEvent`] in words.
const EVIDENCE: [&str; 4] = [
    "no evidence now",
    "voltage collapses",
    "temperature rises faster than the current explains",
    "voltage collapses and temperature rises",
];

/// Severity; the values are the wire codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Severity {
    /// No action is needed.
    Info = 1,
    /// A workshop visit should be planned.
    Warning = 2,
    /// Action is needed at once.
    Severe = 3,
}

impl Severity {
    /// All severities, least severe first.
    pub const ALL: [Self; 3] = [Self::Info, Self::Warning, Self::Severe];

    /// The name in configurations, events and on the command line.
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
    fn wire_numbers_are_dense_and_reversible() {
        for (number, rule) in (1..).zip(Rule::ALL) {
            assert_eq!(rule as u8, number);
            assert_eq!(Rule::from_number(number), Some(rule));
            assert_eq!(serde_json::to_value(rule).expect("a word"), rule.name());
        }
        assert_eq!((Rule::from_number(0), Rule::from_number(19)), (None, None));
    }
}
