//! Declares the tables `[limits.*]`. They give the [`Limits`] of plausible readings.

use super::choices::TEMPERATURE_C;
use crate::cell::CellModel;
use crate::config::schema::key::Presence::{Default, Optional};
use crate::config::schema::key::ValueRange::{Above, Between};
use crate::config::schema::section::section;
use crate::quantity::bounds;
use crate::sample::Limits;

section! {
    /// Plausible pack currents. A reading outside the limits is counted and changes no estimate.
    CurrentLimits at "limits.current" gives Limits, |keys, found: (f64, f64)| {
        /// Largest plausible discharge current of the pack.
        max_discharge_a: Option<f64>, "A", Above(0.0, 1e6), Optional("the DBC's limit") => max: keys.max_discharge_a.unwrap_or(found.1.min(bounds::CURRENT_A.high));
        /// Largest plausible charge current of the pack, as a positive number.
        max_charge_a: Option<f64>, "A", Above(0.0, 1e6), Optional("the DBC's limit")
            => min: keys.max_charge_a.map_or(found.0.max(bounds::CURRENT_A.low), |limit| -limit);
        /// Fastest plausible change.
        max_rate_a_per_s: Option<f64>, "A/s", Above(0.0, 1e9), Optional("not checked") => max_rate_per_s: keys.max_rate_a_per_s;
        /// A reading that has not changed at all for this long is stuck. Allow for parked packs, whose current may be constant.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional("not checked");
        /// A reading older than this is stale: estimates continue without it, are marked, and become less certain.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("1.0");
    }
}

section! {
    /// Plausible cell voltages. A total voltage is divided by `pack.cells` first.
    VoltageLimits at "limits.voltage" gives Limits, |keys, model: &CellModel, found: (f64, f64)| {
        /// Lowest plausible cell voltage.
        min_v: Option<f64>, "V", Between(0.0, 1e3), Optional("the DBC's limit, but at least half of the cell model's `voltage_min_v`")
            => min: keys.min_v.unwrap_or(found.0.max(0.5 * model.voltage_min_v));
        /// Highest plausible cell voltage.
        max_v: Option<f64>, "V", Above(0.0, 1e3), Optional("the DBC's limit, but at most the cell model's `voltage_max_v` plus 0.5 V")
            => max: keys.max_v.unwrap_or(found.1.min(model.voltage_max_v + 0.5));
        /// Fastest plausible change.
        max_rate_v_per_s: Option<f64>, "V/s", Above(0.0, 1e6), Optional("not checked") => max_rate_per_s: keys.max_rate_v_per_s;
        /// A reading that has not changed at all for this long although the current has changed is stuck.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional("not checked");
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("2.0");
    }
}

section! {
    /// Plausible temperatures.
    TemperatureLimits at "limits.temperature" gives Limits, |keys, found: (f64, f64)| {
        /// Lowest plausible temperature.
        min_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional("the DBC's limit, but at least -60") => min: keys.min_c.unwrap_or(found.0.max(-60.0));
        /// Highest plausible temperature.
        max_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional("the DBC's limit, but at most 150") => max: keys.max_c.unwrap_or(found.1.min(150.0));
        /// Fastest plausible change.
        max_rate_c_per_s: Option<f64>, "degrees C/s", Above(0.0, 1e6), Optional("not checked")
            => max_rate_per_s: keys.max_rate_c_per_s;
        /// A reading that has not changed at all for this long although the current has changed is stuck.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional("not checked");
        /// A reading older than this is stale; if the cell has a thermal model, the model replaces it.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0");
    }
}
