//! Declares the types of keys with a fixed choice of words, and ranges that several tables share.

use crate::alarm::Rule;
use crate::can::e2e::Profile;
use crate::can::secoc;
use crate::cell::{CapacityState, Chemistry, Discretisation};
use crate::config::schema::key::{ValueRange, within};
use crate::config::schema::setting::choice;
use crate::health::RechargeAlarm;
use crate::quantity::bounds;

/// Lowest and highest temperature that may be configured (degrees C).
pub(crate) const TEMPERATURE_C: ValueRange = within(bounds::TEMPERATURE_C);
/// Range of standard deviations and of noise densities.
pub(crate) const DEVIATION: ValueRange = within(bounds::DEVIATION);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PositiveCurrent {
    /// Into the pack.
    Charge,
    /// Out of the pack.
    Discharge,
}

/// Which J1939 source addresses may send a message of a DBC file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SourceAddress {
    /// Any address if the DBC file marks the message as a J1939 parameter group, else the address in the DBC file.
    Auto,
    /// Any address, for every extended identifier.
    Any,
    /// The address in the DBC file.
    Exact,
}

/// Byte order of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WireOrder {
    /// The most significant byte first.
    Big,
    /// The least significant byte first.
    Little,
}

/// How the capacity is computed from the charge of a half-cycle (one charge or one discharge).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MethodKey {
    /// Charge divided by the change of the SOC (the swing), which is computed from the voltages.
    Swing,
    /// Charge divided by a configured swing.
    Nominal,
}

/// AUTOSAR end-to-end protection profile of a frame; `None` = unprotected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct E2eKey(pub Option<Profile>);

choice!(PositiveCurrent { "charge" => Self::Charge, "discharge" => Self::Discharge });
choice!(SourceAddress { "auto" => Self::Auto, "any" => Self::Any, "exact" => Self::Exact });
choice!(WireOrder { "big" => Self::Big, "little" => Self::Little });
choice!(MethodKey { "swing" => Self::Swing, "nominal" => Self::Nominal });
choice!(E2eKey {
    "off" => Self(None),
    "1A" => Self(Some(Profile::P01A)),
    "1C" => Self(Some(Profile::P01C)),
    "5" => Self(Some(Profile::P05)),
});
choice!(secoc::Profile { "1" => Self::P1, "3" => Self::P3, "fd" => Self::Fd });
choice!(Discretisation { "exact" => Self::Exact, "euler" => Self::Euler });
choice!(Chemistry {
    "nmc811-graphite" | "nmc811" => Self::Nmc811Graphite,
    "nmc-graphite" | "nmc" => Self::NmcGraphite,
    "nca-graphite" | "nca" => Self::NcaGraphite,
    "lco-graphite" | "lco" => Self::LcoGraphite,
    "lmo-graphite" | "lmo" => Self::LmoGraphite,
    "lfp-graphite" | "lfp" => Self::LfpGraphite,
});
choice!(CapacityState { "joint" => Self::Joint, "held" => Self::Held });
choice!(RechargeAlarm { "raw" => Self::Raw, "normalised" => Self::Normalised });
choice!(Profile { "1A" => Self::P01A, "1C" => Self::P01C, "5" => Self::P05 });
choice!(Rule {
    "capacity_low" => Self::CapacityLow,
    "usable_capacity_low" => Self::UsableCapacityLow,
    "recharge_period_low" => Self::RechargePeriodLow,
    "input_missing" => Self::InputMissing,
    "input_implausible" => Self::InputImplausible,
    "estimate_untrusted" => Self::EstimateUntrusted,
    "resistance_high" => Self::ResistanceHigh,
    "soc_low" => Self::SocLow,
    "temperature_high" => Self::TemperatureHigh,
    "cell_imbalance" => Self::CellImbalance,
    "remaining_life_low" => Self::RemainingLifeLow,
    "bms_disagrees" => Self::BmsDisagrees,
    "store_failed" => Self::StoreFailed,
    "bus_fault" => Self::BusFault,
    "cell_leak" => Self::CellLeak,
    "connection_resistance" => Self::ConnectionResistance,
    "channel_faulty" => Self::ChannelFaulty,
    "thermal_event" => Self::ThermalEvent,
});
