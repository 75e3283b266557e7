//! Time, cell numbers, readings with their faults, and the conventions that every module keeps.
//!
//! Conventions inside the program (only `can` and the configuration use wire units and wire signs):
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

/// A point in time: integer nanoseconds on the clock of the driver, the program that feeds the core.
///
/// The daemon counts from 1970: it reads the wall clock once at its start, and then a clock that never steps. A replay
/// uses the time stamps of its log. The core uses only differences, except for the freshness of authenticated messages.
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

    /// Creates a time stamp from seconds since the clock's origin. Saturates (292 years); NaN gives the origin.
    pub fn from_secs(seconds: f64) -> Self {
        // Convert whole seconds separately: a float's 53 bits cannot hold nanoseconds since 1970.
        let whole = seconds.floor();
        Self((whole as i64).saturating_mul(1_000_000_000).saturating_add(((seconds - whole) * 1e9).round() as i64))
    }

    /// Nanoseconds since the clock's origin.
    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the clock's origin, with a resolution of about 0.2 us in today's Unix time.
    pub fn secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Seconds from `earlier` to `self`; negative when `earlier` is later.
    #[inline]
    pub fn since(self, earlier: Self) -> f64 {
        // A branch that is never taken is cheaper than a saturating subtraction.
        let nanos = self.0.checked_sub(earlier.0).unwrap_or_else(|| self.0.saturating_sub(earlier.0));
        nanos as f64 * 1e-9
    }

    /// This point moved by `seconds`, which may be negative.
    pub fn plus_secs(self, seconds: f64) -> Self {
        self.plus_nanos((seconds * 1e9).round() as i64)
    }

    /// This point moved by `nanos`, which may be negative.
    pub const fn plus_nanos(self, nanos: i64) -> Self {
        Self(self.0.saturating_add(nanos))
    }
}

/// An impossible number in a stored state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InvalidState {
    pub what: &'static str,
    pub found: f64,
    /// Range with unit.
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

    /// Rejects numbers that are not finite or exceed 1e20 in size, so that squares and cubes do not overflow.
    pub fn unless_number(what: &'static str, found: f64) -> Result<(), Self> {
        bounds::NUMBER.check(what, found)
    }

    /// Rejects negative numbers and the numbers that [`Self::unless_number`] rejects.
    pub fn unless_natural(what: &'static str, found: f64) -> Result<(), Self> {
        Self::unless((0.0..=1e20).contains(&found), what, found, "0 to 1e20")
    }

    /// Applies [`Self::unless_number`] to every number.
    pub fn unless_numbers(what: &'static str, all: impl IntoIterator<Item = f64>) -> Result<(), Self> {
        all.into_iter().try_for_each(|found| Self::unless_number(what, found))
    }

    /// Applies [`Self::unless_natural`] to every number.
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

/// Largest number of cells (series elements) of a pack. The 11-bit field of the alarm frame holds a cell or "the whole
/// pack".
pub const MAX_CELLS: usize = 1024;

/// Index of a cell in the pack, from 0. Displays and DBC patterns may count from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct CellIndex(pub u16);

impl CellIndex {
    /// Index into per-cell arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Index of a CAN interface, in the order of the configuration's `interfaces`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct BusIndex(pub u8);

impl BusIndex {
    /// Index into per-interface arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Index of a temperature sensor, in the order of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SensorIndex(pub u16);

impl SensorIndex {
    /// Index into per-sensor arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// The input that a signal provides.
///
/// Readings of one frame are processed in the order of the variants. A voltage triggers the estimator, so current and
/// temperature come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// State of the contactors. No current flows while they are open.
    Contactor,
    /// Direction of a current that is sent as a magnitude: 1 = discharge, -1 = charge.
    CurrentDirection,
    /// Pack current (A), positive = discharge.
    Current,
    /// A temperature sensor (degrees C).
    Temperature(SensorIndex),
    /// Total pack voltage (V).
    PackVoltage,
    /// One cell's voltage (V).
    CellVoltage(CellIndex),
    /// SOC reported by the pack, fraction. It is only compared with the estimate.
    ReportedSoc,
    /// SOH reported by the pack (capacity over rated capacity), fraction. It is only compared with the estimate.
    ReportedSoh,
    /// The vehicle's 12 V or 24 V supply (V). If it is too low, no diagnostic requests are sent.
    SupplyVoltage,
    /// Whether the BMS bleeds a cell (discharges it for balancing); 0 = no. For the cell-fault detector only.
    Balancing(CellIndex),
    /// Serial number or another number that identifies the pack.
    PackIdentity,
}

/// Why a reading cannot be used. A bad reading is data, not an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// The frame is shorter than the signal needs.
    ShortFrame,
    /// The end-to-end check failed: damaged, repeated, out of sequence, or the first frame of a sequence.
    EndToEnd,
    /// The sender marks the signal as not available.
    NotAvailable,
    /// NaN or infinite (IEEE float signals).
    NotFinite,
    /// Outside the range of the DBC or the configuration.
    OutOfRange,
    /// Faster change than the configured rate allows.
    RateTooHigh,
    /// No change for a long time although the value should have changed.
    Stuck,
    /// No value for longer than the configured age.
    Stale,
}

/// One value decoded from a frame, in the program's units and sign, or the fault that makes the value unusable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    pub channel: Channel,
    pub value: Result<f64, Fault>,
}

/// Sign of the current after dead band, hysteresis and minimum duration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// No current reading yet, or the latest reading is stale.
    #[default]
    Unknown,
    /// Negative, beyond the dead band.
    Charge,
    /// Inside the dead band.
    Rest,
    /// Positive, beyond the dead band.
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
