//! Catalogue of every published number of the pack and its cells.
//!
//! [`TABLE`] has a row per quantity, with its JSON keys, its unit and its names in metrics, MQTT and VSS. The status
//! document, metrics, MQTT entities, VSS signals, exports and the manual iterate over the table. To publish another
//! number, add a row to the table and set its value in the [`Monitor`](crate::monitor::Monitor).

mod table;

pub use table::TABLE;

use std::fmt;

use serde::de::{IgnoredAny, MapAccess, Visitor};
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    pub mean: f64,
    /// `None` = the value has no standard deviation.
    pub std: Option<f64>,
}

impl Estimate {
    /// The mean or the standard deviation.
    pub fn part(self, part: Part) -> Option<f64> {
        match part {
            Part::Mean => Some(self.mean),
            Part::Std => self.std,
        }
    }

    /// Drops a standard deviation that is not finite; `None` = the mean is not finite.
    fn known(self) -> Option<Self> {
        let std = self.std.filter(|std| std.is_finite());
        self.mean.is_finite().then_some(Self { std, ..self })
    }
}

impl From<(f64, f64)> for Estimate {
    fn from((mean, std): (f64, f64)) -> Self {
        Self { mean, std: Some(std) }
    }
}

impl From<f64> for Estimate {
    fn from(mean: f64) -> Self {
        Self { mean, std: None }
    }
}

/// One of the two numbers of an [`Estimate`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Mean,
    Std,
}

/// Unit of a quantity inside the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// SOC or SOH, as a fraction.
    Level,
    /// Any other fraction, 0 to 1.
    Fraction,
    /// Relative to new.
    Ratio,
    Volts,
    /// Positive = discharge.
    Amperes,
    Celsius,
    AmpereHours,
    WattHours,
    Watts,
    Seconds,
    Days,
    /// Equivalent full cycles.
    Cycles,
    /// Number of things or events.
    Count,
}

impl Unit {
    /// The unit as written in tables.
    pub const fn symbol(self) -> &'static str {
        match self {
            Self::Level | Self::Fraction => "fraction",
            Self::Ratio => "",
            Self::Volts => "V",
            Self::Amperes => "A",
            Self::Celsius => "degrees C",
            Self::AmpereHours => "Ah",
            Self::WattHours => "Wh",
            Self::Watts => "W",
            Self::Seconds => "s",
            Self::Days => "days",
            Self::Cycles => "cycles",
            Self::Count => "count",
        }
    }
}

/// Path of a VSS signal, from which the path of the standard deviation is derived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VssPath {
    /// Standard VSS, below its battery branch.
    Standard(&'static str),
    /// The overlay, below the configured branch.
    Overlay(&'static str),
}

/// Description and names of a quantity of the pack, or of each cell.
#[derive(Debug, Clone, Copy)]
pub struct Presentation {
    pub about: &'static str,
    /// `None` = not published in MQTT.
    pub mqtt_key: Option<&'static str>,
    /// Name of the entity in Home Assistant; empty for a cell.
    pub mqtt_name: &'static str,
    pub vss: VssPath,
}

/// A row of the catalogue.
#[derive(Debug, Clone, Copy)]
pub struct QuantityRow {
    pub quantity: Quantity,
    /// JSON key and column name of the mean.
    pub key: &'static str,
    /// JSON key and column name of the standard deviation.
    pub std_key: Option<&'static str>,
    pub unit: Unit,
    /// Name in metrics, without prefix and unit.
    pub metric: &'static str,
    /// `None` = only cells have this quantity.
    pub pack: Option<Presentation>,
    /// `None` = only the pack has this quantity.
    pub cell: Option<Presentation>,
}

impl QuantityRow {
    /// The key of the mean and, if it exists, the key of the standard deviation.
    pub fn parts(&self) -> impl Iterator<Item = (Part, &'static str)> + use<> {
        [(Part::Mean, self.key)].into_iter().chain(self.std_key.map(|key| (Part::Std, key)))
    }

    const fn number(quantity: Quantity, key: &'static str, unit: Unit, metric: &'static str) -> Self {
        Self { quantity, key, std_key: None, unit, metric, pack: None, cell: None }
    }

    const fn estimate(
        quantity: Quantity,
        (key, std_key): (&'static str, &'static str),
        unit: Unit,
        metric: &'static str,
    ) -> Self {
        Self { std_key: Some(std_key), ..Self::number(quantity, key, unit, metric) }
    }

    const fn power(quantity: Quantity, keys: (&'static str, &'static str), metric: &'static str) -> Self {
        Self::estimate(quantity, keys, Unit::Watts, metric)
    }

    const fn pack(self, about: &'static str, (key, name): (&'static str, &'static str), vss: VssPath) -> Self {
        Self { pack: Some(Presentation { about, mqtt_key: Some(key), mqtt_name: name, vss }), ..self }
    }

    const fn cell(self, about: &'static str, mqtt_key: Option<&'static str>, vss: VssPath) -> Self {
        Self { cell: Some(Presentation { about, mqtt_key, mqtt_name: "", vss }), ..self }
    }
}

/// A published number. [`TABLE`] describes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(missing_docs, reason = "the row describes it")]
pub enum Quantity {
    Soc,
    SocLow,
    SocHigh,
    ReportedSoc,
    Voltage,
    Current,
    CurrentOffset,
    Temperature,
    TemperatureMax,
    Capacity,
    UsableCapacity,
    Soh,
    ReportedSoh,
    ResistanceRatio,
    LithiumLoss,
    NegativeLoss,
    PositiveLoss,
    RemainingCycles,
    RemainingCyclesLow,
    RemainingCyclesHigh,
    RemainingDays,
    RechargePeriod,
    NormalisedRechargePeriod,
    RemainingEnergy,
    EnergyToFull,
    EnergySoh,
    TimeToEmpty,
    TimeToFull,
    TimeToTarget,
    DischargePower2s,
    DischargePower10s,
    DischargePower30s,
    ChargePower2s,
    ChargePower10s,
    ChargePower30s,
    LimitEvents,
    FastCharges,
    HighSocTime,
}

impl Quantity {
    pub fn row(self) -> &'static QuantityRow {
        &TABLE[self as usize]
    }
}

/// The values of the pack or of a cell; `None` = unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Values<const IS_PACK: bool>([Option<Estimate>; TABLE.len()]);

pub type PackValues = Values<true>;
pub type CellValues = Values<false>;

impl<const IS_PACK: bool> Default for Values<IS_PACK> {
    fn default() -> Self {
        Self([None; TABLE.len()])
    }
}

impl<const IS_PACK: bool> Values<IS_PACK> {
    /// The rows that apply to the pack or to a cell.
    pub fn rows() -> impl Iterator<Item = (&'static QuantityRow, &'static Presentation)> {
        TABLE.iter().filter_map(|row| Some((row, if IS_PACK { row.pack.as_ref() } else { row.cell.as_ref() }?)))
    }

    pub fn get(&self, quantity: Quantity) -> Option<Estimate> {
        self.0[quantity as usize]
    }

    pub fn mean(&self, quantity: Quantity) -> Option<f64> {
        self.get(quantity).map(|estimate| estimate.mean)
    }

    pub fn std(&self, quantity: Quantity) -> Option<f64> {
        self.get(quantity)?.std
    }

    /// The mean or the standard deviation of a quantity.
    pub fn part(&self, quantity: Quantity, part: Part) -> Option<f64> {
        self.get(quantity)?.part(part)
    }

    /// Sets a value. A mean or a standard deviation that is not finite becomes unknown.
    pub fn set(&mut self, quantity: Quantity, value: Option<impl Into<Estimate>>) {
        self.0[quantity as usize] = value.map(Into::into).and_then(Estimate::known);
    }

    /// The values with a new value for `quantity`.
    #[must_use]
    pub fn with(mut self, quantity: Quantity, value: Option<impl Into<Estimate>>) -> Self {
        self.set(quantity, value);
        self
    }
}

impl<const IS_PACK: bool> Serialize for Values<IS_PACK> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        write(serializer, Self::rows().map(|(row, _)| (row, self.get(row.quantity))))
    }
}

impl<'de, const IS_PACK: bool> Deserialize<'de> for Values<IS_PACK> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(ValuesVisitor)
    }
}

/// Quantities recorded after each half-cycle of a cell: in the event `capacity`, in the history and in exported tables.
pub const RECORDED: [Quantity; 3] = [Quantity::Capacity, Quantity::UsableCapacity, Quantity::ResistanceRatio];

/// Quantities recorded after each half-cycle of the pack: in the event `outlook`, in the history and in exported
/// tables.
pub const RECORDED_OF_PACK: [Quantity; 5] = [
    Quantity::RemainingEnergy,
    Quantity::EnergyToFull,
    Quantity::EnergySoh,
    Quantity::DischargePower10s,
    Quantity::ChargePower10s,
];

/// Values of some quantities; `None` = unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Selection<const IS_PACK: bool, const N: usize>([Option<Estimate>; N]);

/// Values of the [`RECORDED`] quantities of a cell.
pub type RecordedValues = Selection<false, { RECORDED.len() }>;
/// Values of the [`RECORDED_OF_PACK`] quantities.
pub type RecordedPackValues = Selection<true, { RECORDED_OF_PACK.len() }>;

impl<const IS_PACK: bool, const N: usize> Default for Selection<IS_PACK, N> {
    fn default() -> Self {
        Self([None; N])
    }
}

impl<const IS_PACK: bool, const N: usize> Selection<IS_PACK, N> {
    const fn quantities() -> &'static [Quantity] {
        if IS_PACK { &RECORDED_OF_PACK } else { &RECORDED }
    }

    /// Selects from all values of the pack or of a cell.
    pub fn of(values: &Values<IS_PACK>) -> Self {
        let mut selected = Self::default();
        selected.0.iter_mut().zip(Self::quantities()).for_each(|(place, quantity)| *place = values.get(*quantity));
        selected
    }

    /// The value of a quantity; `None` = unknown or not selected.
    pub fn get(&self, quantity: Quantity) -> Option<Estimate> {
        Self::quantities().iter().zip(self.0).find(|(selected, _)| **selected == quantity)?.1
    }

    pub fn mean(&self, quantity: Quantity) -> Option<f64> {
        self.get(quantity).map(|estimate| estimate.mean)
    }

    pub fn pair(&self, quantity: Quantity) -> Option<(f64, f64)> {
        self.get(quantity).and_then(|estimate| Some((estimate.mean, estimate.std?)))
    }

    /// The values with a new value for `quantity`. Ignores quantities that are not selected.
    #[must_use]
    pub fn with(mut self, quantity: Quantity, value: Option<impl Into<Estimate>>) -> Self {
        let value = value.map(Into::into).and_then(Estimate::known);
        for (place, _) in self.0.iter_mut().zip(Self::quantities()).filter(|(_, selected)| **selected == quantity) {
            *place = value;
        }
        self
    }

    /// The keys in order, each mean before its standard deviation.
    pub fn keys() -> impl Iterator<Item = &'static str> {
        Self::quantities().iter().flat_map(|quantity| quantity.row().parts().map(|(_, key)| key))
    }
}

impl<const IS_PACK: bool, const N: usize> Serialize for Selection<IS_PACK, N> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        write(serializer, Self::quantities().iter().zip(self.0).map(|(quantity, value)| (quantity.row(), value)))
    }
}

impl<'de, const IS_PACK: bool, const N: usize> Deserialize<'de> for Selection<IS_PACK, N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Values::deserialize(deserializer).map(|values| Self::of(&values))
    }
}

/// Writes a map by key.
fn write<S: Serializer>(
    serializer: S,
    values: impl Iterator<Item = (&'static QuantityRow, Option<Estimate>)>,
) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(None)?;
    for (row, value) in values {
        for (part, key) in row.parts() {
            map.serialize_entry(key, &value.and_then(|value| value.part(part)))?;
        }
    }
    map.end()
}

/// Ignores keys that are not in the catalogue.
struct ValuesVisitor<const IS_PACK: bool>;

impl<'de, const IS_PACK: bool> Visitor<'de> for ValuesVisitor<IS_PACK> {
    type Value = Values<IS_PACK>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("values by their keys")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
        let (mut means, mut stds) = ([None; TABLE.len()], [None; TABLE.len()]);
        while let Some(key) = map.next_key::<String>()? {
            let place = TABLE.iter().zip(means.iter_mut().zip(&mut stds)).find_map(|(row, (mean, std))| {
                if row.key == key { Some(mean) } else { (row.std_key? == key).then_some(std) }
            });
            match place {
                Some(place) => *place = map.next_value::<Option<f64>>()?,
                None => drop(map.next_value::<IgnoredAny>()?),
            }
        }
        let mut values = Values::default();
        for (row, (mean, std)) in TABLE.iter().zip(means.into_iter().zip(stds)) {
            values.set(row.quantity, mean.map(|mean| Estimate { mean, std }));
        }
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn quantity_rows_are_in_order_with_unique_keys() {
        assert!(TABLE.iter().enumerate().all(|(index, row)| row.quantity as usize == index));
        let keys: Vec<_> = TABLE.iter().flat_map(|row| [Some(row.key), row.std_key]).flatten().collect();
        assert_eq!(keys.iter().collect::<BTreeSet<_>>().len(), keys.len());
        let endings = [
            ("_v", Unit::Volts),
            ("_a", Unit::Amperes),
            ("_c", Unit::Celsius),
            ("_ah", Unit::AmpereHours),
            ("_s", Unit::Seconds),
        ];
        for row in &TABLE {
            assert!(row.pack.is_some() || row.cell.is_some(), "{}", row.key);
            for (ending, unit) in endings {
                assert_eq!(row.key.ends_with(ending), row.unit == unit, "{}", row.key);
            }
        }
    }

    #[test]
    fn json_round_trip_keeps_values_and_unknowns() {
        let values = CellValues::default()
            .with(Quantity::Soc, Some(Estimate { mean: 0.5, std: Some(0.01) }))
            .with(Quantity::Voltage, Some(3.6))
            .with(Quantity::Temperature, Some(f64::NAN));
        let json = serde_json::to_value(values).unwrap();
        assert_eq!((json["soc"].as_f64(), json["soc_std"].as_f64()), (Some(0.5), Some(0.01)));
        assert!(json["temperature_c"].is_null() && json.get("soh").is_none(), "{json}");
        assert_eq!(serde_json::from_value::<CellValues>(json).unwrap(), values);
        let earlier: CellValues = serde_json::from_str(r#"{"voltage_v":3.6,"trusted":true}"#).unwrap();
        assert_eq!(earlier, CellValues::default().with(Quantity::Voltage, Some(3.6)));
    }
}
