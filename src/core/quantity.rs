//! Time, cell numbers, readings with their faults, and the conventions that every module keeps.
//!
//! Conventions inside the program (only `can` and `config` use wire units and wire signs):
//! * current in A, **positive = discharge** (the paper's sign, dSOC/dt = -I / (3600 C));
//! * voltage in V, temperature in degrees C, charge in Ah, resistance in ohm, time in s or [`Timestamp`];
//! * SOC and SOH are fractions 0..1.
//!
//! [`bounds`] gives the physical limits of each quantity, [`catalogue`] lists the published quantities and their names.

pub mod bounds;
pub mod catalogue;

use std::fmt;

use serde::{Deserialize, Serialize};

/// Length of a day (s).
pub const DAY_S: f64 = 86_400.0;

/// A point in time on the clock of the driver (the program that feeds the core), in integer nanoseconds.
///
/// The driver chooses the origin. The daemon counts from 1970: it reads the wall clock at its start, and then a clock
/// that never steps. A replay uses the time stamps of its log. Apart from the freshness of authenticated messages, the
/// core uses only differences.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Timestamp(i64);

impl Timestamp {
    /// A point earlier than any event.
    pub const LONG_AGO: Self = Self::from_nanos(i64::MIN);

    /// The clock's origin.
    pub const ZERO: Self = Self(0);

    /// Creates a time stamp from nanoseconds since the clock's origin.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// Creates a time stamp from seconds since the clock's origin, rounded to the nearest nanosecond. Saturates at the
    /// ends of the range (292 years). NaN gives the origin.
    pub fn from_secs(seconds: f64) -> Self {
        // Convert whole seconds separately: a float's 53 bits cannot hold nanoseconds since 1970.
        let whole = seconds.floor();
        Self((whole as i64).saturating_mul(1_000_000_000).saturating_add(((seconds - whole) * 1e9).round() as i64))
    }

    /// Nanoseconds since the clock's origin.
    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the clock's origin (a float: about 0.2 us resolution at today's Unix time).
    pub fn secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Seconds from `earlier` to `self`; negative when `earlier` is later.
    #[inline]
    pub fn since(self, earlier: Self) -> f64 {
        // A branch that is never taken costs less than a saturating subtraction in every call.
        let nanos = self.0.checked_sub(earlier.0).unwrap_or_else(|| self.0.saturating_sub(earlier.0));
        nanos as f64 * 1e-9
    }

    /// Returns this point moved by `seconds`, which may be negative.
    pub fn plus_secs(self, seconds: f64) -> Self {
        self.plus_nanos((seconds * 1e9).round() as i64)
    }

    /// Returns this point moved by `nanos`, which may be negative.
    pub const fn plus_nanos(self, nanos: i64) -> Self {
        Self(self.0.saturating_add(nanos))
    }
}

/// An impossible number in a stored state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InvalidState {
    /// Name of the number.
    pub what: &'static str,
    pub found: f64,
    /// Allowed range, with unit.
    pub allowed: &'static str,
}

impl fmt::Display for InvalidState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, found, allowed } = self;
        write!(f, "{what} is {found}, must be {allowed}")
    }
}

impl InvalidState {
    /// Rejects the number unless `is_sound` is true.
    pub fn unless(is_sound: bool, what: &'static str, found: f64, allowed: &'static str) -> Result<(), Self> {
        if is_sound { Ok(()) } else { Err(Self { what, found, allowed }) }
    }

    /// Rejects numbers that are not finite or whose size exceeds 1e20. Squares and cubes of smaller numbers do not
    /// overflow.
    pub fn unless_number(what: &'static str, found: f64) -> Result<(), Self> {
        bounds::NUMBER.check(what, found)
    }

    /// Rejects negative numbers and the numbers that [`Self::unless_number`] rejects.
    pub fn unless_natural(what: &'static str, found: f64) -> Result<(), Self> {
        Self::unless((0.0..=1e20).contains(&found), what, found, "0 to 1e20")
    }

    /// Applies [`Self::unless_number`] to every number and returns the first error.
    pub fn unless_numbers(what: &'static str, all: impl IntoIterator<Item = f64>) -> Result<(), Self> {
        all.into_iter().try_for_each(|found| Self::unless_number(what, found))
    }

    /// Applies [`Self::unless_natural`] to every number and returns the first error.
    pub fn unless_naturals(what: &'static str, all: impl IntoIterator<Item = f64>) -> Result<(), Self> {
        all.into_iter().try_for_each(|found| Self::unless_natural(what, found))
    }

    /// Rejects numbers below 1e-150 or above 1e20, so that the caller can divide by the number's square.
    pub fn unless_positive(what: &'static str, found: f64) -> Result<(), Self> {
        bounds::VARIANCE.check(what, found)
    }

    /// Rejects a capacity that no cell can have (Ah).
    pub fn unless_capacity(what: &'static str, found: f64) -> Result<(), Self> {
        bounds::CAPACITY_AH.check(what, found)
    }
}

/// Largest number of cells (series elements) of a pack. With 1,024 cells, the 11-bit field of the alarm frame can hold
/// a cell number or "the whole pack".
pub const MAX_CELLS: usize = 1024;

/// Index of a cell in the pack, from 0. Displays and DBC patterns may count from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct CellIndex(pub u16);

impl CellIndex {
    /// Returns the index into per-cell arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Index of a CAN interface, in the order of the configuration's `interfaces`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct BusIndex(pub u8);

impl BusIndex {
    /// Returns the index into per-interface arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Index of a temperature sensor, in the order of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SensorIndex(pub u16);

impl SensorIndex {
    /// Returns the index into per-sensor arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// The input that a configured signal provides.
///
/// Readings of one frame are processed in the order of the variants. A voltage triggers the estimator, so current and
/// temperature of the same frame come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// State of the pack's contactors. When they are open, no current flows.
    Contactor,
    /// Direction of a current that is sent as a magnitude: 1 = discharge, -1 = charge.
    CurrentDirection,
    /// Pack current (A); positive = discharge, after the configured sign was applied.
    Current,
    /// A temperature sensor (degrees C).
    Temperature(SensorIndex),
    /// Total pack voltage (V).
    PackVoltage,
    /// One cell's voltage (V).
    CellVoltage(CellIndex),
    /// SOC reported by the pack, fraction. The value is only compared with the estimate; the estimate never uses it.
    ReportedSoc,
    /// SOH (capacity over rated capacity) reported by the pack, fraction. The value is only compared with the estimate;
    /// the estimate never uses it.
    ReportedSoh,
    /// Voltage of the vehicle's 12 V (or 24 V) supply (V). If this voltage is too low, no diagnostic requests are sent.
    /// Never used by an estimate.
    SupplyVoltage,
    /// Whether the BMS bleeds a cell; 0 = the BMS does not bleed the cell. Only the cell-fault detector uses this
    /// value.
    Balancing(CellIndex),
    /// Serial number of the pack, or another number that identifies the pack.
    PackIdentity,
}

/// Reason why a reading cannot be used. A bad reading is data, not an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// The frame carries fewer bytes than the signal needs.
    ShortFrame,
    /// The frame failed the end-to-end check: damaged, repeated, out of sequence, or the first frame of a sequence.
    EndToEnd,
    /// The sender marks the signal as not available.
    NotAvailable,
    /// The value is NaN or infinite on the wire (IEEE float signals).
    NotFinite,
    /// The value is outside the range that the DBC or the configuration gives.
    OutOfRange,
    /// The value changed faster than the configured rate allows.
    RateTooHigh,
    /// The value did not change for a long time although it should have changed.
    Stuck,
    /// There was no value for longer than the configured age.
    Stale,
}

/// One value decoded from a frame, in the program's units and sign, or the fault that prevents it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// The input that the reading belongs to.
    pub channel: Channel,
    /// The value, or the fault that makes it unusable.
    pub value: Result<f64, Fault>,
}

/// Operating mode: sign of the current after dead band, hysteresis and minimum duration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// No reading of the current has arrived yet, or the latest reading is stale.
    #[default]
    Unknown,
    /// The current is negative, beyond the dead band.
    Charge,
    /// The current is inside the dead band.
    Rest,
    /// The current is positive, beyond the dead band.
    Discharge,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_round_trip_at_unix_scale() {
        let t = Timestamp::from_secs(1_700_000_000.25);
        assert_eq!(t.nanos(), 1_700_000_000_250_000_000);
        assert_eq!(t.plus_secs(-0.25).since(t), -0.25);
    }

    #[test]
    fn differences_saturate_instead_of_wrapping() {
        let far = Timestamp::from_nanos(i64::MAX);
        assert!(far.since(Timestamp::from_nanos(i64::MIN)) > 9.0e9);
        assert_eq!(far.plus_secs(1.0), far);
    }
}
