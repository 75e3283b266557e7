//! Every key of a cell model file.

use toml::Spanned;
use toml::de::DeValue;

use crate::cell::{Branch, Electrodes, ModelSpread, NegativeMaterial, PositiveMaterial, Table, Thermal};
use crate::config::schema::Presence::{Optional, Required};
use crate::config::schema::ValueRange::{Above, Any, Between, NotEmpty};
use crate::config::schema::{SectionInfo, Setting, ValueFault, ValueRange, in_range, section, typed, within};
use crate::quantity::bounds;

section! {
    /// A cell type.
    Head at "" {
        /// Version of this layout.
        format: u16, "", Between(1.0, 1.0), Required;
        /// Name of the cell, for people.
        name: String, "", NotEmpty, Required;
        /// Chemistry, for people.
        chemistry: Option<String>, "", NotEmpty, Optional;
        /// Capacity on the label, which SOH is relative to.
        rated_capacity_ah: f64, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Required;
        /// Charge of a new cell from full to empty open-circuit voltage.
        capacity_ah: f64, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Required;
        /// How far the open-circuit curve shifts as the cell loses capacity, where `[electrodes]` does not say it: 0 = it shrinks evenly over SOC; 1 = the top keeps its ampere-hours and the empty end comes sooner. Without either: 0.
        ocv_ageing_shift: Option<f64>, "", Between(0.0, 1.0), Optional;
        /// Lowest voltage under load.
        voltage_min_v: f64, "V", Above(0.0, 100.0), Required;
        /// Highest voltage under charge.
        voltage_max_v: f64, "V", Above(0.0, 100.0), Required;
    }
}

section! {
    /// The circuit over SOC and temperature. Two-dimensional tables have one row per temperature and one column per SOC.
    Tables at "tables" {
        /// SOC breakpoints, strictly rising from 0 to 1.
        soc: Vec<f64>, "fraction", Between(0.0, 1.0), Required;
        /// Temperature breakpoints, strictly rising.
        temperature_c: Vec<f64>, "degrees C", within(bounds::TEMPERATURE_C), Required;
        /// Open-circuit voltage, strictly rising along each row.
        ocv_v: Vec<Vec<f64>>, "V", Above(0.0, 100.0), Required;
        /// Series resistance of a new cell.
        r0_ohm: Vec<Vec<f64>>, "ohm", within(bounds::RESISTANCE_OHM), Required;
        /// Standard deviation of the model's voltage error, averaged over 100 s, as `packwatch fit` determines it. Without it: the estimator's `model_error_v_sqrt_s`.
        voltage_error_v: Option<Vec<Vec<f64>>>, "V", Above(0.0, 10.0), Optional;
    }
}

section! {
    /// Where the cell was measured, as `packwatch fit` writes it. For people: beyond these temperatures the tables of a fit continue with larger `voltage_error_v`, so that estimates are less certain there.
    Measured at "measured" {
        /// Lowest and highest temperature. Without it: not known.
        temperature_c: Option<Vec<f64>>, "degrees C", within(bounds::TEMPERATURE_C), Optional;
        /// Lowest and highest current; positive = discharge. Without it: not known.
        current_a: Option<Vec<f64>>, "A", within(bounds::CURRENT_A), Optional;
        /// Lowest and highest state of charge. Without it: not known.
        soc: Option<Vec<f64>>, "fraction", Between(-1.0, 2.0), Optional;
    }
}

section! {
    /// A branch of a resistor and a capacitor in parallel, 1 to 3 of them.
    BranchTables at "tables.branches" gives Branch, |keys| {
        /// Resistance of a new cell.
        r_ohm: Vec<Vec<f64>>, "ohm", within(bounds::RESISTANCE_OHM), Required => r_ohm: Table { values: keys.r_ohm.clone() };
        /// Capacitance.
        c_farad: Vec<Vec<f64>>, "F", within(bounds::CAPACITANCE_F), Required => c_farad: Table { values: keys.c_farad.clone() };
    }
}

section! {
    /// The electrodes of the new cell, as `packwatch fit` finds them in a slow test: how the open-circuit curve changes as lithium and active material are lost. The lithium content of an electrode is a fraction of its maximum.
    ElectrodesKeys at "electrodes" gives Electrodes, |keys| {
        /// Material of the positive electrode.
        positive: PositiveMaterial, "", Any, Required;
        /// Material of the negative electrode.
        negative: NegativeMaterial, "", Any, Required;
        /// Lithium content of the positive electrode of the empty and of the full cell.
        positive_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => positive_content: ends(&keys.positive_content);
        /// Lithium content of the negative electrode of the empty and of the full cell.
        negative_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => negative_content: ends(&keys.negative_content);
    }
}

section! {
    /// How far a cell may be from the model, in standard deviations, where it is not of a fit's own type: of a model from a label or of one that the vehicle has learned, as `packwatch model export` writes it. Without it: as cells of one type are.
    SpreadKeys at "spread" gives ModelSpread, |keys| {
        /// Constant error of the open-circuit curve, beside its modes.
        curve_v: f64, "V", Between(0.0, 1.0), Required;
        /// ln(resistance relative to the model).
        log_resistance: f64, "", Between(0.0, 5.0), Required;
        /// Resistance of the slowest branch beside the others.
        slow_branch: f64, "fraction", Between(0.0, 5.0), Required;
        /// Capacity.
        capacity: f64, "fraction", Between(0.0, 1.0), Required;
        /// Voltage drop: fraction of it over one second.
        drop_sqrt_s: f64, "", Between(0.0, 100.0), Required;
        /// Two modes of the open-circuit curve's error, one value per `tables.soc`.
        curve_modes_v: Vec<Vec<f64>>, "V", Between(-1.0, 1.0), Required =>;
    }
}

/// Names of the materials in a cell model.
macro_rules! material {
    ($material:ty) => {
        impl Setting for $material {
            const KIND: &'static str = "one of";
            const CHOICES: &'static [&'static str] = &names(&<$material>::ALL);

            fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
                let name = typed(value, value.get_ref().as_str())?;
                in_range(value, Self::ALL.iter().find(|(_, known)| *known == name).map(|(material, _)| *material))
            }
        }
    };
}
material!(PositiveMaterial);
material!(NegativeMaterial);

const fn names<T, const N: usize>(all: &[(T, &'static str); N]) -> [&'static str; N] {
    let mut names = [""; N];
    let mut k = 0;
    while k < N {
        names[k] = all[k].1;
        k += 1;
    }
    names
}

/// The first and the last value; the number of values is checked before.
pub(crate) fn ends(values: &[f64]) -> [f64; 2] {
    [values.first().copied().unwrap_or(f64::NAN), values.last().copied().unwrap_or(f64::NAN)]
}

section! {
    /// The thermal model of one cell; without it there is no fallback for a stale temperature.
    ThermalKeys at "thermal" gives Thermal, |keys| {
        /// Heat capacity.
        heat_capacity_j_per_k: f64, "J/K", Above(0.0, 1e9), Required;
        /// Thermal resistance to the surroundings.
        resistance_k_per_w: f64, "K/W", Above(0.0, 1e9), Required;
    }
}

/// Every table of a cell model file, in the order of the reference page.
pub(crate) const SECTIONS: &[SectionInfo] = &[
    SectionInfo::one::<Head>(),
    SectionInfo::notes(
        "provenance",
        "Where the numbers come from. For people; any keys. `packwatch cells` shows `citation` (or `source`) and `licence`.",
    ),
    SectionInfo::one::<Measured>(),
    SectionInfo::one::<Tables>(),
    SectionInfo::many::<BranchTables>(),
    SectionInfo::one::<ElectrodesKeys>(),
    SectionInfo::optional::<SpreadKeys>(),
    SectionInfo::one::<ThermalKeys>(),
];
