//! The equivalent-circuit model of one cell type: OCV, R0 and 1 to 3 RC branches over SOC x temperature.
//!
//! Outside the grid the nearest edge value holds (no extrapolation) in temperature; in SOC the OCV goes on
//! with the slope of its last interval, so that a wrong SOC beyond 0 or 1 is still pulled back, while
//! resistances hold their edge value.

/// Most RC branches a model may have.
pub const MAX_BRANCHES: usize = 3;

/// One table over SOC (columns) x temperature (rows).
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// `values[t][s]`, row per temperature breakpoint, column per SOC breakpoint.
    pub values: Vec<Vec<f64>>,
}

/// One RC branch.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// Resistance, ohm.
    pub r_ohm: Table,
    /// Capacitance, farad.
    pub c_farad: Table,
}

/// Thermal model of one cell: C dT/dt = losses - (T - ambient) / R.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thermal {
    /// Heat capacity, J/K.
    pub heat_capacity_j_per_k: f64,
    /// Thermal resistance to the surroundings, K/W.
    pub resistance_k_per_w: f64,
}

/// A checked cell model: breakpoints strictly rising, OCV strictly rising over SOC, all resistances and
/// capacitances positive and finite, tables without holes. Made by `config::cell_model`.
#[derive(Debug, Clone, PartialEq)]
pub struct CellModel {
    /// For people.
    pub name: String,
    /// Label capacity, Ah: what SOH is relative to.
    pub rated_capacity_ah: f64,
    /// Capacity of a new cell between its full and empty open-circuit voltages at the reference temperature, Ah.
    pub capacity_ah: f64,
    /// Lowest voltage under load, V.
    pub voltage_min_v: f64,
    /// Highest voltage under charge, V.
    pub voltage_max_v: f64,
    /// SOC breakpoints, fraction, first 0, last 1.
    pub soc: Vec<f64>,
    /// Temperature breakpoints, degrees C.
    pub temperature_c: Vec<f64>,
    /// Open-circuit voltage, V.
    pub ocv_v: Table,
    /// Series resistance, ohm.
    pub r0_ohm: Table,
    /// RC branches, 1 to [`MAX_BRANCHES`].
    pub branches: Vec<Branch>,
    /// Thermal parameters; `None` = no temperature fallback.
    pub thermal: Option<Thermal>,
}
