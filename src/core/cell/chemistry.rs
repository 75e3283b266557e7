//! Creates the model of a cell that was never measured, from its label and from the differences between cells of its
//! chemistry.
//!
//! In: chemistry, rated capacity (Ah), cut-off voltages (V). Out: a [`CellModel`]. Two of its parts state how much a
//! cell may differ from the model: its [`ModelSpread`], and the modes of its curve (typical shapes of the differences
//! between the curves of cells). No measured cell was used for the curve, so measured cells can be used to test it.
//!
//! * Open-circuit voltage: mean and covariance of cells built from published half-cell potentials ([`curve`]).
//! * Resistances: proportional to 1 / capacity, for every chemistry. Geometric means and deviations come from five
//!   fitted cells of 2.9 to 280 Ah. [`arrhenius`](super::arrhenius) gives other temperatures.

pub mod curve;

use std::fmt;

use serde::{Deserialize, Serialize};

use super::aged_ocv::{AgedOcv, MIXES};
use super::electrodes::{Electrodes, NegativeMaterial as Negative, PositiveMaterial as Positive};
use super::model::{Branch, CellModel, ModelSpread, Table, arrhenius};
use super::own_model::OwnModel;
use crate::filter::{ScalarGaussian, interpolate, median};
use curve::{CellType, CurvePrior, PositiveElectrode};

/// Materials of the two electrodes, as stated on a label or data sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Chemistry {
    /// Nickel-rich NMC (811) with graphite.
    Nmc811Graphite,
    /// NMC of unknown nickel content with graphite.
    NmcGraphite,
    /// NCA with graphite.
    NcaGraphite,
    /// LCO with graphite (consumer cells).
    LcoGraphite,
    /// LMO blended with a layered oxide, and graphite (cells of early electric cars).
    LmoGraphite,
    /// LFP with graphite.
    LfpGraphite,
}

impl Chemistry {
    /// Every chemistry, with its name in a configuration.
    pub const ALL: [(Self, &'static str); 6] = [
        (Self::Nmc811Graphite, "nmc811-graphite"),
        (Self::NmcGraphite, "nmc-graphite"),
        (Self::NcaGraphite, "nca-graphite"),
        (Self::LcoGraphite, "lco-graphite"),
        (Self::LmoGraphite, "lmo-graphite"),
        (Self::LfpGraphite, "lfp-graphite"),
    ];

    /// Name in a configuration.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(chemistry, _)| *chemistry == self).map_or("", |found| found.1)
    }

    /// Usual lowest and highest cut-off voltage (V).
    pub fn usual_voltages_v(self) -> (f64, f64) {
        match self {
            Self::LfpGraphite => (2.5, 3.65),
            Self::LcoGraphite | Self::LmoGraphite => (3.0, 4.2),
            Self::Nmc811Graphite | Self::NmcGraphite | Self::NcaGraphite => (2.5, 4.2),
        }
    }

    /// Possible materials of the positive electrode. NMC without a number can have any nickel content, and LMO is
    /// blended with other materials.
    fn positives(self) -> Vec<PositiveElectrode> {
        let blend = |share: f64| PositiveElectrode::blend(Positive::Lmo, share, Positive::Nco);
        match self {
            Self::Nmc811Graphite => vec![Positive::Nmc811.into()],
            Self::NmcGraphite => vec![Positive::Nmc811.into(), Positive::Nmc532.into(), Positive::Nco.into()],
            Self::NcaGraphite => vec![Positive::Nca.into()],
            Self::LcoGraphite => vec![Positive::Lco.into(), Positive::LcoRamadass.into()],
            Self::LmoGraphite => vec![blend(0.3), blend(0.5), blend(0.7)],
            Self::LfpGraphite => vec![Positive::Lfp.into()],
        }
    }

    /// How far a full cell's open-circuit voltage is below the highest voltage (V): minimum and maximum. A charge ends
    /// while some current still flows, so the voltage falls when the cell relaxes. It falls most if the curve is steep
    /// at its upper end.
    fn full_below_v(self) -> [f64; 2] {
        if self == Self::LfpGraphite { [0.05, 0.22] } else { [0.005, 0.035] }
    }

    /// Half of the hysteresis of the open-circuit voltage between charge and discharge (V). LFP: Dreyer et al., Nature
    /// Mater. 9 (2010) 448. Other chemistries: silicon in graphite.
    fn hysteresis_v(self) -> f64 {
        if self == Self::LfpGraphite { 0.010 } else { 0.004 }
    }
}

/// Chemistry, rated capacity and voltage limits, as printed on a cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Label {
    /// Chemistry.
    pub chemistry: Chemistry,
    /// Rated capacity (Ah).
    pub rated_ah: f64,
    /// Lowest cut-off voltage (V).
    pub voltage_min_v: f64,
    /// Highest cut-off voltage (V).
    pub voltage_max_v: f64,
}

/// Prior: what is known about a cell before it was measured. It comes from the label ([`Label::prior`]), or from the
/// label and from other vehicles ([`FleetPrior::prior`](super::FleetPrior::prior)).
#[derive(Debug, Clone)]
pub struct LabelPrior {
    /// The label.
    pub label: Label,
    /// Model of the mean cell with this label.
    pub model: CellModel,
    /// Open-circuit curve of the mean cell with this label, and the covariance of the differences between cells.
    pub curve: CurvePrior,
    /// Expected model; `None` = the expected model is `model`.
    pub expected: Option<OwnModel>,
    /// Standard deviation of ln(resistance) between cells, divided by the standard deviation that the label alone
    /// gives.
    pub log_resistance_ratio: f64,
    /// Standard deviation of the curve's sag in the cold (V), see [`CurveOfCells::cold_sag_v`].
    pub cold_sag_std_v: f64,
    /// Standard deviation of the capacity (fraction).
    pub capacity_std: f64,
}

pub(super) const SOC: [f64; 21] =
    [0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 0.95, 1.0];

/// Temperature breakpoints (degrees C). Arrhenius' law interpolates between them.
pub(super) const TEMPERATURE_C: [f64; TEMPERATURE_NODES] = [-30.0, 0.0, 25.0, 60.0];
/// Number of temperature breakpoints.
pub const TEMPERATURE_NODES: usize = 4;

/// One resistance of a usual cell at 25 degrees C.
struct UsualResistance {
    /// Resistance times capacity at SOC 0.5 (ohm Ah).
    ohm_ah: f64,
    /// Time constant (s); 0 = series resistance.
    tau_s: f64,
    /// Resistance at each SOC of [`SHAPE_SOC`], relative to the resistance at SOC 0.5.
    shape: [f64; 5],
}

const SHAPE_SOC: [f64; 5] = [0.0, 0.05, 0.1, 0.2, 1.0];

/// Number of resistances: the series resistance and one per branch.
pub const RESISTANCES: usize = 4;

/// Time constants of the branches (s).
pub const TAU_S: [f64; RESISTANCES - 1] = [RESISTANCE[1].tau_s, RESISTANCE[2].tau_s, RESISTANCE[3].tau_s];

/// SOC nodes of [`ResistanceFactors`].
pub const FACTOR_SOC: [f64; 9] = [0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0];

/// Resistances of a cell relative to the model of its label.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResistanceFactors {
    /// ln of each resistance ratio at 25 degrees C, at [`FACTOR_SOC`].
    pub ln: [[f64; FACTOR_SOC.len()]; RESISTANCES],
    /// Relative deviation (fraction) of each activation energy from the usual activation energy.
    pub by_temperature: [f64; RESISTANCES],
}

impl ResistanceFactors {
    fn ratio(&self, j: usize, soc: f64, arrhenius: f64) -> f64 {
        libm::exp(interpolate(&FACTOR_SOC, &self.ln[j], soc) + self.by_temperature[j] * libm::log(arrhenius))
    }
}

/// An open-circuit curve and its uncertainty, at the SOC breakpoints of a label's model.
#[derive(Debug, Clone)]
pub struct CurveOfCells {
    /// Mean (V), rising.
    pub mean_v: Vec<f64>,
    /// Typical shapes of the differences between cells (V per standard deviation).
    pub modes_v: [Vec<f64>; MIXES],
    /// Standard deviation of the differences that the modes do not explain (V).
    pub rest_v: Vec<f64>,
    /// Sag of the curve: how much lower it is under load at 0 degrees C than at 25 degrees C (V). [`cold_share`]
    /// converts it to other temperatures.
    pub cold_sag_v: ScalarGaussian,
    /// Electrodes whose curve is close to the mean curve; `None` for a positive electrode that is a blend.
    pub electrodes: Option<Electrodes>,
}

/// Geometric means of models fitted to Panasonic 18650PF, LG HG2, LG M50 (simulated), EVE LF280 and a Leaf cell.
const RESISTANCE: [UsualResistance; RESISTANCES] = [
    UsualResistance { ohm_ah: 0.073, tau_s: 0.0, shape: [1.6, 1.4, 1.25, 1.08, 1.0] },
    UsualResistance { ohm_ah: 0.031, tau_s: 10.0, shape: [3.5, 2.5, 1.8, 1.2, 1.1] },
    UsualResistance { ohm_ah: 0.050, tau_s: 100.0, shape: [3.0, 2.2, 1.6, 1.1, 1.0] },
    UsualResistance { ohm_ah: 0.030, tau_s: 1000.0, shape: [3.0, 2.2, 1.6, 1.1, 1.0] },
];

/// Sag of the curve at a temperature, relative to the sag at 0 degrees C.
pub(super) fn cold_share(temperature_c: f64) -> f64 {
    ((25.0 - temperature_c) / 25.0).max(0.0)
}

/// Sag of the curve under load: how much lower it is at 0 degrees C than at 25 degrees C (V).
///
/// The charge-transfer resistance is larger at small currents than at large currents (Butler-Volmer), especially in the
/// cold. The model uses the resistances at large currents. Under load, the cell's voltage is therefore lower than the
/// model's by a nearly constant amount. The value follows from the SOC errors of the label's model at 10, 0 and -10
/// degrees C: LG HG2 0.03 V, Panasonic 0.03 V (0.01 V of this is ageing), Leaf cell -0.01 V (only at 10 degrees C),
/// simulated LG M50 0.
pub(super) fn usual_cold_sag_v() -> ScalarGaussian {
    ScalarGaussian::from_std(0.015, 0.015)
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { chemistry, rated_ah, voltage_min_v, voltage_max_v } = self;
        write!(f, "{} {rated_ah} Ah, {voltage_min_v} to {voltage_max_v} V", chemistry.name())
    }
}

impl Label {
    /// The label with the chemistry's usual cut-off voltages.
    pub fn usual(chemistry: Chemistry, rated_ah: f64) -> Self {
        let (voltage_min_v, voltage_max_v) = chemistry.usual_voltages_v();
        Self { chemistry, rated_ah, voltage_min_v, voltage_max_v }
    }

    /// The label with another chemistry. If the cut-off voltages do not suit the new chemistry, its usual cut-off
    /// voltages replace them.
    pub fn with_chemistry(&self, chemistry: Chemistry) -> Self {
        let (low_v, high_v) = chemistry.usual_voltages_v();
        // The highest voltage must be within 0.2 V of the usual highest voltage.
        let is_usual = (self.voltage_max_v - high_v).abs() <= 0.2;
        let (voltage_min_v, voltage_max_v) =
            if is_usual { (self.voltage_min_v, self.voltage_max_v) } else { (low_v, high_v) };
        Self { chemistry, voltage_min_v, voltage_max_v, ..*self }
    }

    /// Mean and covariance of the open-circuit curves of cells with this label; `None` if no cell of this chemistry has
    /// these cut-off voltages.
    pub fn curve(&self) -> Option<CurvePrior> {
        let full_v = self.chemistry.full_below_v().map(|below_v| self.voltage_max_v - below_v);
        let cell_type = CellType {
            positives: &self.chemistry.positives(),
            // The negative materials that have the plateaus of graphite against lithium.
            negatives: &[Negative::GraphiteSiox, Negative::Graphite, Negative::GraphiteStaged],
            empty_v: self.voltage_min_v,
            full_v: &full_v,
            hysteresis_v: self.chemistry.hysteresis_v(),
        };
        CurvePrior::new(&cell_type, &SOC)
    }

    /// Model of the mean cell with this label. Returns `None` in the same case as [`Self::curve`].
    pub fn model(&self) -> Option<CellModel> {
        self.prior().map(|prior| prior.model)
    }

    /// Prior of a cell with this label. Returns `None` in the same case as [`Self::curve`].
    pub fn prior(&self) -> Option<LabelPrior> {
        let curve = self.curve()?;
        let (modes_v, rest_v) = curve.modes_v();
        let spread = ModelSpread {
            curve_v: median(rest_v.iter().copied()).unwrap_or_default(),
            // From the five fitted cells. Away from 25 degrees C, the temperature law adds uncertainty.
            log_resistance: 0.45,
            slow_branch: 0.5,
            // A cell may differ from its label by the tolerance of manufacture and by its age.
            capacity: 0.1,
            // The voltage drop is assumed to have an error of 40 % that persists for 100 s, because the resistances of
            // different cells depend differently on time, SOC and temperature. The value was chosen with the LG HG2
            // cell at 0 to -10 degrees C.
            drop_sqrt_s: 4.0,
        };
        let CurvePrior { mean_v, electrodes, .. } = curve.clone();
        let of_cells = CurveOfCells { mean_v, modes_v, rest_v, cold_sag_v: usual_cold_sag_v(), electrodes };
        let factors = ResistanceFactors::default();
        let model = self.model_of(self.rated_ah, &of_cells, &factors, &[0.0; TEMPERATURE_NODES], spread);
        let (capacity_std, cold_sag_std_v) = (spread.capacity, usual_cold_sag_v().std());
        Some(LabelPrior {
            label: *self,
            model,
            curve,
            expected: None,
            log_resistance_ratio: 1.0,
            cold_sag_std_v,
            capacity_std,
        })
    }

    /// The model of a cell with this present capacity (Ah), curve and resistances. `drop_std` is the standard deviation
    /// of ln(voltage drop) at each temperature of the tables. `drop_std` times the voltage drop at the load
    /// [`USUAL_LOAD_PER_H`] counts as a voltage error of the model.
    pub fn model_of(
        &self,
        capacity_ah: f64,
        curve: &CurveOfCells,
        factors: &ResistanceFactors,
        drop_std: &[f64; TEMPERATURE_NODES],
        spread: ModelSpread,
    ) -> CellModel {
        let row = |&t: &f64| curve.mean_v.iter().map(|v| v - cold_share(t) * curve.cold_sag_v.mean).collect();
        let rows: Vec<Vec<f64>> = TEMPERATURE_C.iter().map(row).collect();
        let mut aged_ocv = curve
            .electrodes
            .and_then(|electrodes| AgedOcv::of_electrodes(&electrodes, &SOC, capacity_ah, &rows))
            // Used for blends, and for electrodes that give no curve for an aged cell.
            .unwrap_or_else(|| AgedOcv::of_shift(0.5, &SOC, capacity_ah, &rows));
        aged_ocv.add_spread(&curve.modes_v);
        let table = |j: usize| {
            let UsualResistance { ohm_ah, shape, .. } = &RESISTANCE[j];
            let row = |&t: &f64| {
                let by_temperature = arrhenius(t);
                let at = |&soc: &f64| {
                    let ohm = ohm_ah / self.rated_ah * interpolate(&SHAPE_SOC, shape, soc);
                    ohm * by_temperature * factors.ratio(j, soc, by_temperature)
                };
                SOC.iter().map(at).collect()
            };
            Table { values: TEMPERATURE_C.iter().map(row).collect() }
        };
        let branch = |(i, tau_s): (usize, &f64)| {
            let r_ohm = table(i + 1);
            let farad = |row: &Vec<f64>| row.iter().map(|r| tau_s / r).collect();
            Branch { c_farad: Table { values: r_ohm.values.iter().map(farad).collect() }, r_ohm }
        };
        let r0_ohm = table(0);
        let branches: Vec<Branch> = TAU_S.iter().enumerate().map(branch).collect();
        let drop_v = |t: usize, s: usize| {
            let settled_ohm: f64 = branches.iter().fold(r0_ohm.values[t][s], |sum, it| sum + it.r_ohm.values[t][s]);
            USUAL_LOAD_PER_H * self.rated_ah * settled_ohm
        };
        let error_v = |t: usize| {
            let sag_v = cold_share(TEMPERATURE_C[t]) * curve.cold_sag_v.std();
            let at = |s: usize| curve.rest_v[s].hypot(drop_std[t] * drop_v(t, s)).hypot(sag_v);
            (0..SOC.len()).map(at).collect::<Vec<f64>>()
        };
        CellModel {
            name: format!("{} {} Ah (chemistry prior)", self.chemistry.name(), self.rated_ah),
            rated_capacity_ah: self.rated_ah,
            capacity_ah,
            voltage_min_v: self.voltage_min_v,
            voltage_max_v: self.voltage_max_v,
            soc: SOC.to_vec(),
            temperature_c: TEMPERATURE_C.to_vec(),
            ocv_v: Table { values: rows },
            aged_ocv,
            voltage_error_v: Some(Table { values: (0..TEMPERATURE_C.len()).map(error_v).collect() }),
            r0_ohm,
            branches,
            thermal: None,
            spread: Some(spread),
        }
    }
}

/// Load at which errors of resistances are converted to voltage errors of the model: current divided by rated capacity
/// (1/h).
pub const USUAL_LOAD_PER_H: f64 = 0.5;

#[cfg(test)]
mod tests;
