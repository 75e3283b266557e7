//! Identifies the electrodes of a new cell from its open-circuit curve: the materials, and their lithium contents in
//! the empty and in the full cell.
//!
//! Input: OCV (V) over SOC (fraction). Output: the pair of materials that fits best, with the residual (V). For each
//! pair, damped Gauss-Newton steps fit the four lithium contents. A curve without steps does not determine the size of
//! an electrode, so a weak prior keeps the contents near those of commercial cells. On identifiability: Lee et al., J.
//! Electrochem. Soc. 167 (2020) 090509.

use nalgebra::{Matrix4, Vector4};

use crate::cell::{Electrodes, NegativeMaterial, PositiveMaterial};
use crate::filter::levenberg_marquardt::{Damping, minimise};

const POINTS: u32 = 51;
/// Standard deviation of a real cell's voltage from the voltage of the materials in packwatch's library (V). Materials
/// with the same name differ.
const MATERIAL_V: f64 = 0.01;
/// The same standard deviation below [`LOW_SOC`], where curves fall steeply (V).
const LOW_SOC_V: f64 = 0.03;
/// Upper end of the steep part of the curves, SOC.
const LOW_SOC: f64 = 0.05;
/// Prior mean and standard deviation of the lithium contents [negative empty, negative full, positive empty, positive
/// full].
const PRIOR: [(f64, f64); 4] = [(0.02, 0.03), (0.88, 0.12), (0.92, 0.10), (0.32, 0.12)];
/// Bounds of the lithium contents, in the order of [`PRIOR`].
const BOUNDS: [(f64, f64); 4] = [(0.0005, 0.25), (0.4, 0.999), (0.55, 0.9995), (0.005, 0.6)];
/// Maximum number of steps. The fit converges within 20.
const STEPS: usize = 60;
const DAMPING: Damping =
    Damping { first: 1e-2, fall: 0.3, fall_after_growth: 0.3, growth: 10.0, least: 1e-9, most: f64::INFINITY };
/// Largest accepted residual (V). If the residual is larger, the library lacks the cell's materials. Published cells
/// fit within 5 mV with their own materials. With most other materials, the residual exceeds 10 mV. The limit is a
/// compromise, because wrong materials can also fit. If no materials fit, the curve of an aged cell is predicted by a
/// shift along the SOC. A prediction with wrong materials can be better or worse than this shift.
pub const MAX_RESIDUAL_V: f64 = 0.008;

/// The fitted electrodes and their residual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedElectrodes {
    /// Materials and contents.
    pub electrodes: Electrodes,
    /// Root mean square of the residual above [`LOW_SOC`], V.
    pub residual_v: f64,
}

/// Returns the pair of materials that fits the curve best; `None` = its residual exceeds [`MAX_RESIDUAL_V`].
pub fn identify(ocv_v: impl Fn(f64) -> f64) -> Option<FittedElectrodes> {
    let curve: Vec<(f64, f64)> =
        (0..POINTS).map(|k| f64::from(k) / f64::from(POINTS - 1)).map(|soc| (soc, ocv_v(soc))).collect();
    let pairs = PositiveMaterial::ALL.iter().flat_map(|p| NegativeMaterial::ALL.iter().map(move |n| (p.0, n.0)));
    let fits = pairs.map(|pair| fit_pair(&curve, pair));
    let (electrodes, _) = fits.min_by(|a, b| a.1.total_cmp(&b.1))?;
    let inner: Vec<f64> = curve
        .iter()
        .filter(|(soc, _)| *soc >= LOW_SOC)
        .map(|&(soc, v)| (v - electrodes.voltage_v(soc)).powi(2))
        .collect();
    let residual_v = (inner.iter().sum::<f64>() / inner.len() as f64).sqrt();
    (residual_v <= MAX_RESIDUAL_V).then_some(FittedElectrodes { electrodes, residual_v })
}

fn electrodes((positive, negative): (PositiveMaterial, NegativeMaterial), contents: &Vector4<f64>) -> Electrodes {
    Electrodes {
        positive,
        negative,
        positive_content: [contents[2], contents[3]],
        negative_content: [contents[0], contents[1]],
    }
}

fn fit_pair(curve: &[(f64, f64)], pair: (PositiveMaterial, NegativeMaterial)) -> (Electrodes, f64) {
    let residuals = |x: &Vector4<f64>| {
        let cell = electrodes(pair, x);
        let volts = curve
            .iter()
            .map(move |&(soc, v)| (v - cell.voltage_v(soc)) / if soc < LOW_SOC { LOW_SOC_V } else { MATERIAL_V });
        let prior = PRIOR.iter().zip(x.iter()).map(|((mean, std), x)| (mean - x) / std).collect::<Vec<f64>>();
        volts.chain(prior).collect::<Vec<f64>>()
    };
    let cost = |r: &[f64]| r.iter().map(|r| r * r).sum::<f64>();
    let start = Vector4::from(PRIOR.map(|(mean, _)| mean));
    let step = |(x, r): &(Vector4<f64>, Vec<f64>), damping: f64| {
        let columns: [Vec<f64>; 4] = std::array::from_fn(|k| {
            let step = 1e-5;
            let mut moved = *x;
            moved[k] += step;
            residuals(&moved).iter().zip(r).map(|(a, b)| (a - b) / step).collect()
        });
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let normal = Matrix4::from_fn(|i, j| dot(&columns[i], &columns[j]) * if i == j { 1.0 + damping } else { 1.0 });
        let gradient = Vector4::from_fn(|i, _| dot(&columns[i], r));
        let mut next = x - normal.try_inverse()? * gradient;
        let least = [0.0, 0.0, 0.0, pair.0.least_content()];
        let bounds = next.iter_mut().zip(BOUNDS).zip(least);
        bounds.for_each(|((x, (low, high)), least)| *x = x.clamp(low.max(least), high));
        let trial = residuals(&next);
        (cost(&trial) < cost(r)).then_some((next, trial))
    };
    let (x, r) = minimise(&DAMPING, STEPS, (start, residuals(&start)), step, |_, _, _| false).best;
    (electrodes(pair, &x), cost(&r))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_materials_and_contents_are_identified() {
        for (positive, _) in PositiveMaterial::ALL.into_iter().filter(|(p, _)| *p != PositiveMaterial::Lfp) {
            let cell = Electrodes {
                positive,
                negative: NegativeMaterial::GraphiteSiox,
                positive_content: [0.9, 0.45],
                negative_content: [0.03, 0.85],
            };
            let found = identify(|soc| cell.voltage_v(soc)).expect("a fit");
            let FittedElectrodes { electrodes, residual_v } = found;
            assert_eq!((electrodes.positive, electrodes.negative), (positive, cell.negative), "{found:?}");
            assert!(residual_v < 1e-3, "{found:?}");
            assert!((electrodes.negative_content[1] - 0.85).abs() < 0.02, "{found:?}");
            assert!((electrodes.positive_content[1] - 0.45).abs() < 0.02, "{found:?}");
        }
    }

    #[test]
    fn curve_of_unknown_materials_gives_no_electrodes() {
        assert_eq!(identify(|soc| 2.0 + 2.2 * soc), None);
    }
}
