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
    /// How far the open-circuit curve shifts as capacity is lost, see [`CellModel::ocv_soc`]; 0 = the curve only shrinks.
    pub ocv_ageing_shift: f64,
    /// Series resistance, ohm.
    pub r0_ohm: Table,
    /// RC branches, 1 to [`MAX_BRANCHES`].
    pub branches: Vec<Branch>,
    /// Thermal parameters; `None` = no temperature fallback.
    pub thermal: Option<Thermal>,
}

/// The four grid corners round one (SOC, temperature) and their weights: found once, used for every table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    s: usize,
    t: usize,
    /// Weight of the upper SOC column, in [0, 1].
    along_s: f64,
    /// The same without the limit: the OCV goes on beyond 0 and 1.
    beyond_s: f64,
    /// Weight of the upper temperature row, in [0, 1].
    along_t: f64,
}

impl Table {
    fn at(&self, place: &Place, along_s: f64) -> f64 {
        let low = interpolate(&self.values[place.t], place.s, along_s);
        if place.along_t == 0.0 {
            return low;
        }
        let high = interpolate(&self.values[place.t + 1], place.s, along_s);
        low + place.along_t * (high - low)
    }
}

fn interpolate(row: &[f64], s: usize, along: f64) -> f64 {
    row[s] + along * (row[s + 1] - row[s])
}

/// Interval of `x` in rising `breakpoints`, and how far along it `x` is (below 0 or above 1 outside).
fn locate(breakpoints: &[f64], x: f64) -> (usize, f64) {
    let last = breakpoints.len() - 2;
    let i = breakpoints[1..=last].iter().take_while(|&&b| x >= b).count();
    (i, (x - breakpoints[i]) / (breakpoints[i + 1] - breakpoints[i]))
}

impl CellModel {
    /// The place of a SOC and a temperature in the grid.
    pub fn place(&self, soc: f64, temperature_c: f64) -> Place {
        let (s, beyond_s) = locate(&self.soc, soc);
        let (t, along_t) = match self.temperature_c.len() {
            1 => (0, 0.0),
            _ => locate(&self.temperature_c, temperature_c),
        };
        Place { s, t, along_s: beyond_s.clamp(0.0, 1.0), beyond_s, along_t: along_t.clamp(0.0, 1.0) }
    }

    /// Open-circuit voltage, V.
    pub fn ocv_v(&self, place: &Place) -> f64 {
        self.ocv_v.at(place, place.beyond_s)
    }

    /// SOC of a new cell whose open-circuit voltage a cell of `capacity_ah` at `soc` has.
    ///
    /// An ageing cell does not lose its charge evenly over the curve: lithium bound elsewhere lets the anode slip against
    /// the cathode, so the top keeps its ampere-hours and the bottom loses them. s' = s + a s (1 - s) with
    /// a = shift * (1 - C / C_new); a shift of 1 would keep the slope over ampere-hours at SOC 1 exactly, 0 shrinks evenly.
    pub fn ocv_soc(&self, soc: f64, capacity_ah: f64) -> f64 {
        let lost = self.ocv_ageing_shift * (1.0 - capacity_ah / self.capacity_ah);
        // Beyond +-1 the curve would fold; beyond the ends of the curve it keeps its course.
        let inside = soc.clamp(0.0, 1.0);
        soc + lost.clamp(-0.9, 0.9) * inside * (1.0 - inside)
    }

    /// Slope of the open-circuit voltage over SOC, V per unit of SOC.
    pub fn ocv_slope_v(&self, place: &Place) -> f64 {
        let rise = |row: &[f64]| row[place.s + 1] - row[place.s];
        let low = rise(&self.ocv_v.values[place.t]);
        let high = if place.along_t == 0.0 { low } else { rise(&self.ocv_v.values[place.t + 1]) };
        (low + place.along_t * (high - low)) / (self.soc[place.s + 1] - self.soc[place.s])
    }

    /// Series resistance of a new cell, ohm.
    pub fn r0_ohm(&self, place: &Place) -> f64 {
        self.r0_ohm.at(place, place.along_s)
    }

    /// Resistance of branch `i` of a new cell, ohm.
    pub fn branch_r_ohm(&self, i: usize, place: &Place) -> f64 {
        self.branches[i].r_ohm.at(place, place.along_s)
    }

    /// Time constant of branch `i`, s. Ageing scales its resistance and leaves this alone.
    pub fn branch_tau_s(&self, i: usize, place: &Place) -> f64 {
        self.branch_r_ohm(i, place) * self.branches[i].c_farad.at(place, place.along_s)
    }

    /// Resistance of a new cell once every branch has settled, ohm.
    pub fn settled_ohm(&self, place: &Place) -> f64 {
        (0..self.branches.len()).fold(self.r0_ohm(place), |sum, i| sum + self.branch_r_ohm(i, place))
    }

    /// SOC whose open-circuit voltage is `voltage_v`, by bisection over [-0.5, 1.5]; outside, the nearest end.
    pub fn soc_of_ocv(&self, voltage_v: f64, temperature_c: f64) -> f64 {
        falling_crossing(-0.5, 1.5, |soc| voltage_v - self.ocv_v(&self.place(soc, temperature_c)))
    }
}

/// Where the falling function `f` crosses zero in [`low`, `high`], to 2^-40 of the width; the nearest end when it does not.
pub(crate) fn falling_crossing(mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if f(middle) > 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A small two-temperature, one-branch cell for tests.
    pub(crate) fn small_model() -> CellModel {
        let table = |rows: [[f64; 3]; 2]| Table { values: rows.iter().map(|r| r.to_vec()).collect() };
        CellModel {
            name: "test".into(),
            rated_capacity_ah: 2.0,
            capacity_ah: 2.0,
            voltage_min_v: 2.7,
            voltage_max_v: 4.2,
            soc: vec![0.0, 0.5, 1.0],
            temperature_c: vec![0.0, 40.0],
            ocv_ageing_shift: 0.0,
            ocv_v: table([[3.0, 3.6, 4.2], [3.0, 3.7, 4.2]]),
            r0_ohm: table([[0.08, 0.06, 0.06], [0.04, 0.03, 0.03]]),
            branches: vec![Branch {
                r_ohm: table([[0.04, 0.02, 0.02], [0.02, 0.01, 0.01]]),
                c_farad: table([[1000.0; 3]; 2]),
            }],
            thermal: Some(Thermal { heat_capacity_j_per_k: 45.0, resistance_k_per_w: 8.0 }),
        }
    }

    #[test]
    fn tables_are_bilinear_inside_and_exact_at_the_nodes() {
        let model = small_model();
        assert_eq!(model.ocv_v(&model.place(0.5, 40.0)), 3.7);
        assert!((model.ocv_v(&model.place(0.25, 20.0)) - 3.325).abs() < 1e-12);
        assert!((model.r0_ohm(&model.place(0.25, 10.0)) - 0.06125).abs() < 1e-12);
    }

    #[test]
    fn outside_the_grid_ocv_goes_on_in_soc_and_all_else_holds_its_edge() {
        let model = small_model();
        assert!((model.ocv_v(&model.place(1.1, 0.0)) - 4.32).abs() < 1e-12);
        assert!((model.ocv_v(&model.place(-0.1, 0.0)) - 2.88).abs() < 1e-12);
        assert_eq!(model.r0_ohm(&model.place(-0.1, -30.0)), 0.08);
        assert_eq!(model.r0_ohm(&model.place(1.1, 60.0)), 0.03);
    }

    #[test]
    fn soc_of_ocv_inverts_the_curve() {
        let model = small_model();
        for soc in [-0.1, 0.0, 0.3, 0.5, 0.77, 1.0, 1.05] {
            let voltage = model.ocv_v(&model.place(soc, 17.0));
            assert!((model.soc_of_ocv(voltage, 17.0) - soc).abs() < 1e-9);
        }
    }
}
