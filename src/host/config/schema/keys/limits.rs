//! The tables of plausible readings: `[limits.*]`, to the [`Limits`] of the sample stage.

use super::choices::TEMPERATURE_C;
use crate::cell::CellModel;
use crate::config::schema::key::Presence::{Default, Optional};
use crate::config::schema::key::ValueRange::{Above, Between};
use crate::config::schema::section::section;
use crate::quantity::bounds;
use crate::sample::Limits;

section! {
    /// Plausible pack currents. A reading outside changes no estimate and is counted.
    CurrentLimits at "limits.current" gives Limits, |keys, found: (f64, f64)| {
        /// Largest plausible discharge current of the pack. Without it: the limit of the DBC.
        max_discharge_a: Option<f64>, "A", Above(0.0, 1e6), Optional => max: keys.max_discharge_a.unwrap_or(found.1.min(bounds::CURRENT_A.high));
        /// Largest plausible charge current of the pack, written positive. Without it: the limit of the DBC.
        max_charge_a: Option<f64>, "A", Above(0.0, 1e6), Optional
            => min: keys.max_charge_a.map_or(found.0.max(bounds::CURRENT_A.low), |limit| -limit);
        /// Fastest plausible change. Without it: not checked.
        max_rate_a_per_s: Option<f64>, "A/s", Above(0.0, 1e9), Optional => max_rate_per_s: keys.max_rate_a_per_s;
        /// A reading that has not changed at all for this long is stuck. Without it: not checked (the current of a parked pack may be constant).
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale: estimates continue without it, their deviation grows, and they are marked.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("1.0");
    }
}

section! {
    /// Plausible cell voltages; a total voltage is divided by `pack.cells` first.
    VoltageLimits at "limits.voltage" gives Limits, |keys, model: &CellModel, found: (f64, f64)| {
        /// Smallest plausible voltage of a cell. Without it: the limit of the DBC, but at least half the cell model's `voltage_min_v`.
        min_v: Option<f64>, "V", Between(0.0, 1e3), Optional
            => min: keys.min_v.unwrap_or(found.0.max(0.5 * model.voltage_min_v));
        /// Largest plausible voltage of a cell. Without it: the limit of the DBC, but at most the cell model's `voltage_max_v` plus 0.5 V.
        max_v: Option<f64>, "V", Above(0.0, 1e3), Optional
            => max: keys.max_v.unwrap_or(found.1.min(model.voltage_max_v + 0.5));
        /// Fastest plausible change. Without it: not checked.
        max_rate_v_per_s: Option<f64>, "V/s", Above(0.0, 1e6), Optional => max_rate_per_s: keys.max_rate_v_per_s;
        /// A reading that has not changed at all for this long, while the current has, is stuck. Without it: not checked.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("2.0");
    }
}

section! {
    /// Plausible temperatures.
    TemperatureLimits at "limits.temperature" gives Limits, |keys, found: (f64, f64)| {
        /// Lowest plausible temperature. Without it: the limit of the DBC, but at least -60.
        min_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional => min: keys.min_c.unwrap_or(found.0.max(-60.0));
        /// Highest plausible temperature. Without it: the limit of the DBC, but at most 150.
        max_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional => max: keys.max_c.unwrap_or(found.1.min(150.0));
        /// Fastest plausible change. Without it: not checked.
        max_rate_c_per_s: Option<f64>, "degrees C/s", Above(0.0, 1e6), Optional
            => max_rate_per_s: keys.max_rate_c_per_s;
        /// A reading that has not changed at all for this long, while the current has, is stuck. Without it: not checked.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale; the thermal model replaces it, if the cell has one.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0");
    }
}
