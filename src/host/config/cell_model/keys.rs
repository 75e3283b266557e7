//! Declares every key of a cell model file: name, unit, range, default and meaning.

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
        /// Version of the file format.
        format: u16, "", Between(1.0, 1.0), Required;
        /// Name of the cell, for people.
        name: String, "", NotEmpty, Required;
        /// Chemistry, for people.
        chemistry: Option<String>, "", NotEmpty, Optional("none");
        /// Rated capacity, as on the label. SOH is relative to it.
        rated_capacity_ah: f64, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Required;
        /// Charge that a new cell delivers from full to empty, both defined by the open-circuit voltage.
        capacity_ah: f64, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Required;
        /// How the open-circuit curve changes as the cell loses capacity, if there is no table `[electrodes]`. 0: the curve shrinks evenly over SOC. 1: the top keeps its ampere-hours and the empty end is reached sooner.
        ocv_ageing_shift: Option<f64>, "", Between(0.0, 1.0), Optional("0");
        /// Lowest voltage under load.
        voltage_min_v: f64, "V", Above(0.0, 100.0), Required;
        /// Highest voltage under charge.
        voltage_max_v: f64, "V", Above(0.0, 100.0), Required;
    }
}

section! {
    /// The equivalent circuit over SOC and temperature. Two-dimensional tables have one row per temperature and one column per SOC.
    Tables at "tables" {
        /// SOC breakpoints, strictly increasing from 0 to 1.
        soc: Vec<f64>, "fraction", Between(0.0, 1.0), Required;
        /// Temperature breakpoints, strictly increasing.
        temperature_c: Vec<f64>, "degrees C", within(bounds::TEMPERATURE_C), Required;
        /// Open-circuit voltage, strictly increasing along each row.
        ocv_v: Vec<Vec<f64>>, "V", Above(0.0, 100.0), Required;
        /// Series resistance of a new cell.
        r0_ohm: Vec<Vec<f64>>, "ohm", within(bounds::RESISTANCE_OHM), Required;
        /// Standard deviation of the model's voltage error, averaged over 100 s, as determined by `packwatch fit`.
        voltage_error_v: Option<Vec<Vec<f64>>>, "V", Above(0.0, 10.0), Optional("`estimator.model_error_v_sqrt_s`");
    }
}

section! {
    /// The conditions under which the cell was measured, written by `packwatch fit` for people. Beyond these temperatures a fitted model continues with a larger `voltage_error_v`, so that estimates are less certain there.
    Measured at "measured" {
        /// Lowest and highest temperature.
        temperature_c: Option<Vec<f64>>, "degrees C", within(bounds::TEMPERATURE_C), Optional("unknown");
        /// Lowest and highest current; positive = discharge.
        current_a: Option<Vec<f64>>, "A", within(bounds::CURRENT_A), Optional("unknown");
        /// Lowest and highest state of charge.
        soc: Option<Vec<f64>>, "fraction", Between(-1.0, 2.0), Optional("unknown");
    }
}

section! {
    /// A branch: a resistor and a capacitor in parallel. A model has 1 to 3 branches.
    BranchTables at "tables.branches" gives Branch, |keys| {
        /// Resistance of a new cell.
        r_ohm: Vec<Vec<f64>>, "ohm", within(bounds::RESISTANCE_OHM), Required => r_ohm: Table { values: keys.r_ohm.clone() };
        /// Capacitance.
        c_farad: Vec<Vec<f64>>, "F", within(bounds::CAPACITANCE_F), Required => c_farad: Table { values: keys.c_farad.clone() };
    }
}

section! {
    /// The electrodes of the new cell, as `packwatch fit` identifies them from a slow test. They determine how the open-circuit curve changes as lithium and active material are lost. Lithium contents are fractions of the electrode's maximum.
    ElectrodesKeys at "electrodes" gives Electrodes, |keys| {
        /// Material of the positive electrode.
        positive: PositiveMaterial, "", Any, Required;
        /// Material of the negative electrode.
        negative: NegativeMaterial, "", Any, Required;
        /// Lithium content of the positive electrode in the empty and in the full cell.
        positive_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => positive_content: ends(&keys.positive_content);
        /// Lithium content of the negative electrode in the empty and in the full cell.
        negative_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => negative_content: ends(&keys.negative_content);
    }
}

section! {
    /// How far a cell may differ from the model, as standard deviations. Used if the model was not fitted to the cell's own type: a model from a label, or one learned in a vehicle and written by `packwatch model export`. Without this table the usual spread between cells of one type is assumed.
    SpreadKeys at "spread" gives ModelSpread, |keys| {
        /// Constant error of the open-circuit curve, in addition to `curve_modes_v`.
        curve_v: f64, "V", Between(0.0, 1.0), Required;
        /// Resistance: spread of its natural logarithm relative to the model.
        log_resistance: f64, "", Between(0.0, 5.0), Required;
        /// Resistance of the slowest branch relative to the other resistances.
        slow_branch: f64, "fraction", Between(0.0, 5.0), Required;
        /// Capacity relative to the model.
        capacity: f64, "fraction", Between(0.0, 1.0), Required;
        /// Relative error of the voltage drop, averaged over one second.
        drop_sqrt_s: f64, "", Between(0.0, 100.0), Required;
        /// Two shapes (modes) of the error of the open-circuit curve. Each is a list with one voltage per entry of `tables.soc`.
        curve_modes_v: Vec<Vec<f64>>, "V", Between(-1.0, 1.0), Required =>;
    }
}

/// Declares that the names of the materials are the allowed words of a key.
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

/// Returns the first and the last value. The caller checks that there are exactly two values.
pub(crate) fn ends(values: &[f64]) -> [f64; 2] {
    [values.first().copied().unwrap_or(f64::NAN), values.last().copied().unwrap_or(f64::NAN)]
}

section! {
    /// The thermal model of one cell. Without it a stale temperature has no replacement.
    ThermalKeys at "thermal" gives Thermal, |keys| {
        /// Heat capacity.
        heat_capacity_j_per_k: f64, "J/K", Above(0.0, 1e9), Required;
        /// Thermal resistance to the surroundings.
        resistance_k_per_w: f64, "K/W", Above(0.0, 1e9), Required;
    }
}

pub(crate) const SECTIONS: &[SectionInfo] = &[
    SectionInfo::one::<Head>(),
    SectionInfo::notes(
        "provenance",
        "The source of the numbers, for people. Any keys are allowed. `packwatch cells` shows `citation` (or `source`) and `licence`.",
    ),
    SectionInfo::one::<Measured>(),
    SectionInfo::one::<Tables>(),
    SectionInfo::many::<BranchTables>(),
    SectionInfo::one::<ElectrodesKeys>(),
    SectionInfo::optional::<SpreadKeys>(),
    SectionInfo::one::<ThermalKeys>(),
];
