//! Computes the mean and the spread of open-circuit curves from half-cell potentials, for the cells of one chemistry.
//!
//! In: positive and negative materials, and cut-off voltages (V). Out: mean (V) and covariance (V^2) at SOC
//! breakpoints.
//!
//! A cell has a pair of materials and two free lithium contents: the content of the negative electrode in the full
//! cell, and the content of the positive electrode in the empty cell. The cut-off voltages determine the other two
//! contents. All pairs and all contents of a grid are equally likely. Two further errors cover cells that no pair
//! describes: a smooth deviation of 10 mV (30 mV below 5 % SOC), and half of the hysteresis.

use nalgebra::{DMatrix, SymmetricEigen};

use crate::cell::aged_ocv::MIXES;
use crate::cell::electrodes::{Electrodes, NegativeMaterial, PositiveMaterial};
use crate::filter::{bell, crossing};

const BLEND_POINTS: u32 = 400;
/// Range of the potentials in the table of a blend (V).
const BLEND_V: (f64, f64) = (2.5, 4.8);

/// A positive electrode made of one material or of two.
#[derive(Debug, Clone)]
pub enum PositiveElectrode {
    /// One material.
    One(PositiveMaterial),
    /// A blend: lithium contents at equally spaced, rising potentials.
    Blend(Vec<f64>),
}

impl From<PositiveMaterial> for PositiveElectrode {
    fn from(material: PositiveMaterial) -> Self {
        Self::One(material)
    }
}

impl PositiveElectrode {
    /// Two materials in one electrode. Both have the same potential, so their contents are added. Material `a` holds
    /// the fraction `share` of the electrode's capacity.
    pub fn blend(a: PositiveMaterial, share: f64, b: PositiveMaterial) -> Self {
        let content = |material: PositiveMaterial, potential_v: f64| {
            let ends = (material.least_content(), 1.0);
            crossing(ends, |y| material.potential_v(y) > potential_v)
        };
        let (low_v, high_v) = BLEND_V;
        let at = |k: u32| low_v + (high_v - low_v) * f64::from(k) / f64::from(BLEND_POINTS);
        Self::Blend((0..=BLEND_POINTS).map(at).map(|v| share * content(a, v) + (1.0 - share) * content(b, v)).collect())
    }

    fn potential_v(&self, y: f64) -> f64 {
        match self {
            Self::One(material) => material.potential_v(y),
            Self::Blend(contents) => {
                let above = contents.partition_point(|&content| content > y).clamp(1, contents.len() - 1);
                let (lower, upper) = (contents[above - 1], contents[above]);
                let along = if lower > upper { ((lower - y) / (lower - upper)).clamp(0.0, 1.0) } else { 0.0 };
                let step_v = (BLEND_V.1 - BLEND_V.0) / f64::from(BLEND_POINTS);
                BLEND_V.0 + step_v * ((above - 1) as f64 + along)
            }
        }
    }

    fn least_content(&self) -> f64 {
        match self {
            Self::One(material) => material.least_content(),
            Self::Blend(contents) => contents.last().copied().unwrap_or(0.0),
        }
    }
}

/// Common properties of the cells of one chemistry and label.
#[derive(Debug, Clone, Copy)]
pub struct CellType<'a> {
    /// Positive electrodes.
    pub positives: &'a [PositiveElectrode],
    /// Negative electrodes.
    pub negatives: &'a [NegativeMaterial],
    /// Open-circuit voltage of the empty cell (V).
    pub empty_v: f64,
    /// Open-circuit voltages that the full cell may have (V).
    pub full_v: &'a [f64],
    /// Half of the difference between the curves of charge and discharge (V).
    pub hysteresis_v: f64,
}

/// Open-circuit curves of cells of one chemistry.
#[derive(Debug, Clone)]
pub struct CurvePrior {
    /// SOC breakpoints.
    pub soc: Vec<f64>,
    /// Mean (V), strictly rising.
    pub mean_v: Vec<f64>,
    /// Covariance between breakpoints (V^2).
    pub covariance: DMatrix<f64>,
    /// The electrodes of the cell nearest to the mean; `None` for blends.
    pub electrodes: Option<Electrodes>,
}

/// One cell. The contents are [negative empty, negative full, positive empty, positive full]; the curve is in V.
struct PossibleCell {
    contents: [f64; 4],
    curve_v: Vec<f64>,
}

impl CurvePrior {
    /// Computes the curves of all pairs of materials. Returns `None` if no pair gives a cell with these cut-off
    /// voltages.
    pub fn new(cell_type: &CellType<'_>, soc: &[f64]) -> Option<Self> {
        let CellType { positives, negatives, empty_v, full_v, hysteresis_v } = *cell_type;
        let pairs = positives.iter().flat_map(|p| negatives.iter().map(move |&n| (p, n)));
        let with_contents = |(p, n)| {
            // First list: content of the negative electrode in the full cell, from fast-charging to high-energy
            // designs. Second list: content of the positive electrode in the empty cell. It is below 1, because lithium
            // is lost in the first cycles.
            let contents =
                [0.78, 0.84, 0.90, 0.95].iter().flat_map(|&x| [0.84, 0.88, 0.92, 0.97].iter().map(move |&y| (x, y)));
            let ends = contents.flat_map(|contents| full_v.iter().map(move |&full_v| (contents, full_v)));
            ends.filter_map(move |(contents, full_v)| {
                Some(((p, n), possible_cell((p, n), contents, (empty_v, full_v), soc)?))
            })
        };
        let cells: Vec<_> = pairs.flat_map(with_contents).collect();
        let count = cells.len() as f64;
        if cells.is_empty() {
            return None;
        }
        let mean_v: Vec<f64> =
            (0..soc.len()).map(|s| cells.iter().map(|(_, cell)| cell.curve_v[s]).sum::<f64>() / count).collect();
        let off_v = |cell: &PossibleCell, s: usize| cell.curve_v[s] - mean_v[s];
        // Smooth deviation (V) of a cell's materials from the materials in `cell::electrodes`, larger where the curves
        // are steep. The fit of electrodes (`ident::electrodes` in packwatch-lab) allows the same deviations.
        let material_v = |s: usize| if soc[s] < 0.05 { 0.030 } else { 0.010 };
        let covariance = DMatrix::from_fn(soc.len(), soc.len(), |a, b| {
            let between: f64 = cells.iter().map(|(_, cell)| off_v(cell, a) * off_v(cell, b)).sum::<f64>() / count;
            let material = material_v(a) * material_v(b) * bell((soc[a] - soc[b]) / 0.15);
            between + material + hysteresis_v * hysteresis_v
        });
        let distance = |cell: &PossibleCell| (0..soc.len()).map(|s| off_v(cell, s) * off_v(cell, s)).sum::<f64>();
        let nearest = cells.iter().min_by(|a, b| distance(&a.1).total_cmp(&distance(&b.1)));
        let electrodes = nearest.and_then(|((positive, negative), cell)| match positive {
            PositiveElectrode::One(positive) => Some(Electrodes {
                positive: *positive,
                negative: *negative,
                positive_content: [cell.contents[2], cell.contents[3]],
                negative_content: [cell.contents[0], cell.contents[1]],
            }),
            PositiveElectrode::Blend(_) => None,
        });
        Some(Self { soc: soc.to_vec(), mean_v, covariance, electrodes })
    }

    /// Splits the differences between cells into independent shapes (modes). Returns the modes that have the largest
    /// effect on an SOC computed from a voltage. Each mode is the change of the curve for one standard deviation (V).
    /// Also returns the standard deviation of the differences that these modes do not explain (V).
    pub fn modes_v(&self) -> ([Vec<f64>; MIXES], Vec<f64>) {
        let n = self.soc.len();
        let slope_v = |s: usize| {
            let (a, b) = (s.saturating_sub(1), (s + 1).min(n - 1));
            // On a curve flatter than 0.1 V per unit of SOC, a voltage gives hardly any information about the SOC.
            ((self.mean_v[b] - self.mean_v[a]) / (self.soc[b] - self.soc[a])).max(0.1)
        };
        let width = |s: usize| 0.5 * (self.soc[(s + 1).min(n - 1)] - self.soc[s.saturating_sub(1)]);
        let weight: Vec<f64> = (0..n).map(|s| width(s).sqrt() / slope_v(s)).collect();
        let weighted = DMatrix::from_fn(n, n, |a, b| weight[a] * self.covariance[(a, b)] * weight[b]);
        let eigen = SymmetricEigen::new(weighted);
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let mode = |k: usize| {
            let (column, scale) = (eigen.eigenvectors.column(order[k]), eigen.eigenvalues[order[k]].max(0.0).sqrt());
            // Make the largest component positive, because the sign of an eigenvector is arbitrary.
            let largest = column.iter().copied().fold(0.0, |m: f64, v| if v.abs() > m.abs() { v } else { m });
            (0..n).map(|s| largest.signum() * scale * column[s] / weight[s]).collect::<Vec<f64>>()
        };
        let modes_v: [Vec<f64>; MIXES] = std::array::from_fn(mode);
        let rest = |s: usize| {
            let explained: f64 = modes_v.iter().map(|mode_v| mode_v[s] * mode_v[s]).sum();
            // Minimum error of a curve (V).
            (self.covariance[(s, s)] - explained).max(0.0).sqrt().max(0.004)
        };
        let rest_v = (0..n).map(rest).collect();
        (modes_v, rest_v)
    }
}

/// Adds an independent error of 2 mV per breakpoint to a curve's covariance and returns the inverse of the sum; `None`
/// if the sum is not positive definite.
pub fn information(covariance_v2: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let own = DMatrix::from_diagonal_element(covariance_v2.nrows(), covariance_v2.nrows(), 0.002 * 0.002);
    Some((covariance_v2 + own).cholesky()?.inverse())
}

/// The cell with these materials, lithium contents and cut-off voltages; `None` if such a cell does not exist.
fn possible_cell(
    (positive, negative): (&PositiveElectrode, NegativeMaterial),
    (negative_full, positive_empty): (f64, f64),
    (low_v, high_v): (f64, f64),
    soc: &[f64],
) -> Option<PossibleCell> {
    let full_v = |y: f64| positive.potential_v(y) - negative.potential_v(negative_full);
    let empty_v = |x: f64| positive.potential_v(positive_empty) - negative.potential_v(x);
    let positive_full = crossing((positive.least_content(), positive_empty), |y| full_v(y) > high_v);
    let negative_empty = crossing((0.0, 0.15), |x| empty_v(x) < low_v);
    let reaches =
        [full_v(positive_full) - high_v, empty_v(negative_empty) - low_v].iter().all(|off_v| off_v.abs() < 0.002);
    let at = |soc: f64, empty: f64, full: f64| empty + soc * (full - empty);
    let voltage_v = |soc: f64| {
        positive.potential_v(at(soc, positive_empty, positive_full))
            - negative.potential_v(at(soc, negative_empty, negative_full))
    };
    let curve_v: Vec<f64> = soc.iter().map(|&soc| voltage_v(soc)).collect();
    let rises = curve_v.windows(2).all(|pair| pair[0] < pair[1]);
    let contents = [negative_empty, negative_full, positive_empty, positive_full];
    (reaches && rises).then_some(PossibleCell { contents, curve_v })
}
