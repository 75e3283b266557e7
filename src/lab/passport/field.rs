//! Lists the values of a battery passport that packwatch can determine: name, unit, definition and place in each
//! standard. `docs/src/lab/passport.md` explains the choice of the places.

use serde_json::Value;

/// Group of the temperatures in IDTA. They share one time.
const TEMPERATURES: &str = "TemperatureInformation";

/// Form of a passport.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standard {
    /// IDTA 02035-5, submodel Product Condition 1.0.1, as the JSON of its values.
    ProductCondition,
    /// Catena-X `io.catenax.battery.battery_pass` 6.0.0.
    BatteryPass,
}

impl Standard {
    /// Name of the standard, with the version.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ProductCondition => {
                "urn:samm:io.admin-shell.idta.batterypass.product_condition:1.0.1#ProductCondition"
            }
            Self::BatteryPass => "urn:samm:io.catenax.battery.battery_pass:6.0.0#BatteryPass",
        }
    }
}

/// A value of a passport.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Field {
    /// Equivalent full cycles.
    FullCycles,
    /// Charge moved (Ah).
    CapacityThroughput,
    /// Energy moved (kWh).
    EnergyThroughput,
    /// State of charge (%).
    StateOfCharge,
    /// Highest temperature of the sensors (degrees C).
    Temperature,
    /// Time above the highest temperature (min).
    TimeHot,
    /// Time below the lowest temperature (min).
    TimeCold,
    /// Time of charging above the highest temperature (min).
    TimeHotCharging,
    /// Time of charging below the lowest temperature (min).
    TimeColdCharging,
    /// Capacity (Ah).
    RemainingCapacity,
    /// Capacity lost, % of the rated capacity.
    CapacityFade,
    /// Largest resistance increase of any cell, % of the resistance of a new cell.
    CellResistanceIncrease,
    /// Resistance increase of all cells together, % of the resistance of the new cells.
    PackResistanceIncrease,
    /// Highest ohmic resistance of any cell (ohm).
    CellResistance,
    /// Ohmic resistance of all cells together (ohm).
    PackResistance,
    /// Energy of a full discharge (kWh).
    RemainingEnergy,
    /// Energy of a full discharge, % of the certified energy.
    StateOfCertifiedEnergy,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    /// Path of the object that contains the number and its time.
    pub(super) group: &'static str,
    pub(super) value: &'static str,
    pub(super) time: &'static str,
}

impl Place {
    const fn idta(group: &'static str, value: &'static str) -> Self {
        Self { group, value, time: "LastUpdate" }
    }

    const fn catena_x(group: &'static str) -> Self {
        Self { group, value: "value", time: "time" }
    }
}

impl Field {
    /// All values, in the order of the details file (`--details`).
    pub const ALL: [Self; 17] = [
        Self::FullCycles,
        Self::CapacityThroughput,
        Self::EnergyThroughput,
        Self::StateOfCharge,
        Self::Temperature,
        Self::TimeHot,
        Self::TimeCold,
        Self::TimeHotCharging,
        Self::TimeColdCharging,
        Self::RemainingCapacity,
        Self::CapacityFade,
        Self::CellResistanceIncrease,
        Self::PackResistanceIncrease,
        Self::CellResistance,
        Self::PackResistance,
        Self::RemainingEnergy,
        Self::StateOfCertifiedEnergy,
    ];

    pub(super) const fn meaning(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::FullCycles => (
                "full_cycles",
                "1",
                "charge moved in both directions divided by twice the rated capacity; whole ones in the passport",
            ),
            Self::CapacityThroughput => {
                ("capacity_throughput", "Ah", "charge moved in complete charges and discharges, both directions added")
            }
            Self::EnergyThroughput => {
                ("energy_throughput", "kWh", "integral of |voltage x current|, both directions added")
            }
            Self::StateOfCharge => {
                ("state_of_charge", "%", "dischargeable charge over the charge between full and empty")
            }
            Self::Temperature => ("temperature", "degrees C", "highest of the sensors' latest readings"),
            Self::TimeHot => ("time_hot", "min", "time with a sensor above the highest temperature ([outlook])"),
            Self::TimeCold => ("time_cold", "min", "time with a sensor below the lowest temperature ([outlook])"),
            Self::TimeHotCharging => ("time_hot_charging", "min", "part of time_hot in which the pack was charged"),
            Self::TimeColdCharging => ("time_cold_charging", "min", "part of time_cold in which the pack was charged"),
            Self::RemainingCapacity => {
                ("remaining_capacity", "Ah", "capacity of the weakest cell times the parallel strings")
            }
            Self::CapacityFade => ("capacity_fade", "%", "rated less remaining capacity, of the rated"),
            Self::CellResistanceIncrease => {
                ("cell_resistance_increase", "%", "resistance increase of the cell with the largest, of the new cell's")
            }
            Self::PackResistanceIncrease => {
                ("pack_resistance_increase", "%", "mean resistance increase of all cells, of the new cells'")
            }
            Self::CellResistance => (
                "cell_resistance",
                "ohm",
                "series resistance of that cell at half charge and 25 degrees C, by the cell model",
            ),
            Self::PackResistance => {
                ("pack_resistance", "ohm", "the same of all cells in series, over the parallel strings")
            }
            Self::RemainingEnergy => (
                "remaining_energy",
                "kWh",
                "energy of a discharge from full at the configured load, until the weakest cell is empty",
            ),
            Self::StateOfCertifiedEnergy => {
                ("state_of_certified_energy", "%", "remaining energy over the certified energy")
            }
        }
    }

    pub(super) const fn place(self, standard: Standard) -> Option<Place> {
        let (idta, catena_x) = match self {
            Self::FullCycles => {
                (Some(("NumberOfFullCycles", "NumberOfFullCyclesValue")), Some("performance.dynamic.fullCycles"))
            }
            Self::CapacityThroughput => (
                Some(("CapacityThroughput", "CapacityThroughputValue")),
                Some("performance.dynamic.capacity.throughput"),
            ),
            Self::EnergyThroughput => {
                (Some(("EnergyThroughput", "EnergyThroughputValue")), Some("performance.dynamic.energy.throughput"))
            }
            Self::StateOfCharge => {
                (Some(("StateOfCharge", "StateOfChargeValue")), Some("performance.dynamic.stateOfCharge"))
            }
            Self::Temperature => (Some((TEMPERATURES, "MeasuredTemp")), None),
            Self::TimeHot => (Some((TEMPERATURES, "TimeExtremeHighTemp")), None),
            Self::TimeCold => (Some((TEMPERATURES, "TimeExtremeLowTemp")), None),
            Self::TimeHotCharging => (Some((TEMPERATURES, "TimeExtremeHighTempCharging")), None),
            Self::TimeColdCharging => (Some((TEMPERATURES, "TimeExtremeLowTempCharging")), None),
            Self::RemainingCapacity => {
                (Some(("RemainingCapacity", "RemainingCapacityValue")), Some("performance.dynamic.capacity.capacity"))
            }
            Self::CapacityFade => (None, Some("performance.dynamic.capacity.fade")),
            Self::CellResistanceIncrease => (None, Some("performance.dynamic.resistance.increase.cell")),
            Self::PackResistanceIncrease => (None, Some("performance.dynamic.resistance.increase.pack")),
            Self::CellResistance => (None, Some("performance.dynamic.resistance.remaining.cell")),
            Self::PackResistance => (None, Some("performance.dynamic.resistance.remaining.pack")),
            Self::RemainingEnergy => {
                (Some(("RemainingEnergy", "RemainingEnergyValue")), Some("performance.dynamic.energy.remaining"))
            }
            Self::StateOfCertifiedEnergy => (
                Some(("StateOfCertifiedEnergy", "StateOfCertifiedEnergyValue")),
                Some("performance.dynamic.energy.soce"),
            ),
        };
        match (standard, idta, catena_x) {
            (Standard::ProductCondition, Some((group, value)), _) => Some(Place::idta(group, value)),
            (Standard::BatteryPass, _, Some(group)) => Some(Place::catena_x(group)),
            _ => None,
        }
    }

    /// Returns the number for a passport. Both standards count whole cycles.
    pub(super) fn number(self, value: f64) -> Value {
        match self {
            // Integers below 2^53 are exact.
            Self::FullCycles => Value::from(value.floor().max(0.0) as u64),
            _ => Value::from(rounded(value)),
        }
    }
}

/// Rounds to seven significant digits. The error is far below every standard deviation. A zero is positive.
pub(super) fn rounded(value: f64) -> f64 {
    format!("{value:.6e}").parse().unwrap_or(value) + 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_are_whole_and_others_have_seven_digits() {
        assert_eq!(Field::FullCycles.number(12.97), Value::from(12));
        assert_eq!(Field::StateOfCharge.number(12.971_234_56), Value::from(12.971_23));
        assert_eq!(rounded(0.004_460_274_12), 0.004_460_274);
        assert_eq!(rounded(-0.0).to_bits(), 0.0_f64.to_bits());
    }

    #[test]
    fn every_value_has_a_unique_place() {
        for standard in [Standard::ProductCondition, Standard::BatteryPass] {
            let mut all: Vec<_> = Field::ALL.iter().filter_map(|field| field.place(standard)).collect();
            let places = all.len();
            all.sort_unstable_by_key(|place| (place.group, place.value));
            all.dedup_by_key(|place| (place.group, place.value));
            assert_eq!(all.len(), places, "{standard:?}");
        }
        let has_place = |field: &Field| {
            [Standard::ProductCondition, Standard::BatteryPass].iter().any(|standard| field.place(*standard).is_some())
        };
        assert!(Field::ALL.iter().all(has_place));
    }
}
