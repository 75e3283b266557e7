//! Compares two cell models: open-circuit curves (V), resistances (fraction), and resulting SOC errors (fraction).
//!
//! In: two [`CellModel`]s. Out: values of the second model minus values of the first. To compare cells of different
//! size, resistances are multiplied by the rated capacity, and the load of each cell is C/2 (half of its rated capacity
//! per hour).

use super::chemistry::USUAL_LOAD_PER_H;
use super::model::CellModel;
use super::model_bands::CURVE_C;

const CURVE_STEPS: u32 = 100;
/// Number of SOC steps in the table that gives the SOC of a voltage; a multiple of `CURVE_STEPS`.
const READ_STEPS: u32 = 400;
/// SOC range in which SOC errors count. Outside this range, curves are so steep that the SOC errors of any model are
/// small.
const MIDDLE: (f64, f64) = (0.05, 0.95);

/// A difference at one SOC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtSoc {
    /// SOC (fraction).
    pub soc: f64,
    /// Value of the second model minus value of the first.
    pub value: f64,
}

/// Summary of differences.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Root mean square.
    pub rms: f64,
    /// Largest difference, with its sign, and its SOC.
    pub worst: AtSoc,
}

/// Differences at one temperature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtTemperature {
    /// Temperature (degrees C).
    pub temperature_c: f64,
    /// Relative difference (fraction) of series resistance times rated capacity.
    pub series: Difference,
    /// Relative difference (fraction) of settled resistance (all branches settled) times rated capacity.
    pub settled: Difference,
    /// Difference of the SOC (fraction) that the models read from the same voltage under C/2.
    pub load_soc: Difference,
}

/// The second model compared with the first.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelComparison {
    /// Open-circuit voltage at 25 degrees C over SOC (V).
    pub curve_v: Vec<AtSoc>,
    /// Summary of `curve_v`.
    pub curve: Difference,
    /// Difference of the SOC (fraction) that the models read from the same voltage at rest.
    pub rest_soc: Difference,
    /// Relative difference of the capacity (fraction).
    pub capacity: f64,
    /// Resistances and SOC under load, by temperature; empty if the models share no temperature.
    pub temperatures: Vec<AtTemperature>,
}

impl Difference {
    fn of(values: &[AtSoc]) -> Self {
        let squares: f64 = values.iter().map(|at| at.value * at.value).sum();
        let largest = values.iter().copied().max_by(|a, b| a.value.abs().total_cmp(&b.value.abs()));
        Self {
            rms: (squares / values.len().max(1) as f64).sqrt(),
            worst: largest.unwrap_or(AtSoc { soc: 0.0, value: 0.0 }),
        }
    }
}

impl ModelComparison {
    /// Compares `second` with `first`.
    pub fn new(first: &CellModel, second: &CellModel) -> Self {
        let curve_v: Vec<AtSoc> = (0..=CURVE_STEPS)
            .map(|k| f64::from(k) / f64::from(CURVE_STEPS))
            .map(|soc| AtSoc { soc, value: ocv_v(second, soc) - ocv_v(first, soc) })
            .collect();
        let shared = [-20.0, -10.0, 0.0, 10.0, 25.0, 40.0, 50.0].into_iter();
        let shared = shared.filter(|&t| [first, second].iter().all(|model| has(model, t)));
        Self {
            curve: Difference::of(&curve_v),
            rest_soc: soc_difference(first, second, CURVE_C, 0.0),
            capacity: second.capacity_ah / first.capacity_ah - 1.0,
            temperatures: shared.map(|t| at_temperature(first, second, t)).collect(),
            curve_v,
        }
    }
}

fn ocv_v(model: &CellModel, soc: f64) -> f64 {
    model.ocv_v(&model.grid_position(soc, CURVE_C))
}

/// Whether a temperature is within the tables of a model. If the tables have only one temperature, returns true only
/// for [`CURVE_C`].
fn has(model: &CellModel, temperature_c: f64) -> bool {
    match model.temperature_c[..] {
        [_] => temperature_c == CURVE_C,
        [low, .., high] => (low..=high).contains(&temperature_c),
        [] => false,
    }
}

fn at_temperature(first: &CellModel, second: &CellModel, temperature_c: f64) -> AtTemperature {
    let ratio = |ohm: fn(&CellModel, f64, f64) -> f64| {
        let at = |k: u32| {
            let soc = f64::from(k) / 10.0;
            let [first, second] = [first, second].map(|model| model.rated_capacity_ah * ohm(model, soc, temperature_c));
            AtSoc { soc, value: second / first - 1.0 }
        };
        Difference::of(&(1..=9).map(at).collect::<Vec<_>>())
    };
    AtTemperature {
        temperature_c,
        series: ratio(|model, soc, t| model.r0_ohm(&model.grid_position(soc, t))),
        settled: ratio(|model, soc, t| model.settled_ohm(&model.grid_position(soc, t))),
        load_soc: soc_difference(first, second, temperature_c, USUAL_LOAD_PER_H),
    }
}

/// SOC that the second model reads from a voltage of the first model, minus the SOC of the first model. All branches
/// are settled. `load_per_h` is the load current divided by the rated capacity (1/h).
fn soc_difference(first: &CellModel, second: &CellModel, temperature_c: f64, load_per_h: f64) -> Difference {
    let drop_v = |model: &CellModel, soc: f64| {
        load_per_h * model.rated_capacity_ah * model.settled_ohm(&model.grid_position(soc, temperature_c))
    };
    let terminal_v =
        |model: &CellModel, soc: f64| model.ocv_v(&model.grid_position(soc, temperature_c)) - drop_v(model, soc);
    let places: Vec<f64> = (0..=READ_STEPS).map(|k| f64::from(k) / f64::from(READ_STEPS)).collect();
    let readings_v: Vec<f64> = places.iter().map(|&soc| terminal_v(second, soc)).collect();
    let at = |k: u32| {
        let soc = f64::from(k) / f64::from(CURVE_STEPS);
        AtSoc { soc, value: nearest(&places, &readings_v, terminal_v(first, soc), soc) - soc }
    };
    let middle = (0..=CURVE_STEPS).map(at).filter(|at| (MIDDLE.0..=MIDDLE.1).contains(&at.soc));
    Difference::of(&middle.collect::<Vec<_>>())
}

/// Returns the SOC nearest to `soc` at which a model has the voltage. If no SOC has this voltage, returns the SOC with
/// the nearest voltage. Under load, several SOCs can have the same voltage, because a resistance that rises with the
/// SOC bends the curve down.
fn nearest(places: &[f64], readings_v: &[f64], voltage_v: f64, soc: f64) -> f64 {
    let crossings = places.windows(2).zip(readings_v.windows(2)).filter_map(|(place, reading)| {
        let (low, high) = (reading[0] - voltage_v, reading[1] - voltage_v);
        match (low == 0.0, high == 0.0) {
            (true, _) => Some(place[0]),
            (_, true) => Some(place[1]),
            _ if low.is_sign_positive() != high.is_sign_positive() => {
                Some(place[0] + (place[1] - place[0]) * low / (low - high))
            }
            _ => None,
        }
    });
    let found = crossings.min_by(|a, b| (a - soc).abs().total_cmp(&(b - soc).abs()));
    let least =
        || places.iter().zip(readings_v).min_by(|a, b| (a.1 - voltage_v).abs().total_cmp(&(b.1 - voltage_v).abs()));
    found.or_else(|| least().map(|(place, _)| *place)).unwrap_or(soc)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;
    use crate::cell::{Chemistry, Label};

    #[test]
    fn model_equals_itself() {
        for model in [small_model(), Label::usual(Chemistry::LfpGraphite, 100.0).model().expect("a model")] {
            let found = ModelComparison::new(&model, &model);
            assert_eq!((found.curve.rms, found.capacity), (0.0, 0.0));
            assert!(found.rest_soc.worst.value.abs() < 1e-12, "{:?}", found.rest_soc);
            assert!(!found.temperatures.is_empty());
            for at in found.temperatures {
                assert_eq!((at.series.rms, at.settled.worst.value), (0.0, 0.0));
                assert!(at.load_soc.worst.value.abs() < 1e-12, "{at:?}");
            }
        }
    }

    #[test]
    fn raised_curve_and_resistances_are_reported() {
        let first = small_model();
        let mut second = first.clone();
        second.ocv_v.values.iter_mut().flatten().for_each(|v| *v += 0.012);
        let found = ModelComparison::new(&first, &second);
        assert!((found.curve.rms - 0.012).abs() < 1e-12 && (found.curve.worst.value - 0.012).abs() < 1e-12);
        // At 25 degrees C, the slopes are 1.325 and 1.075 V per unit of SOC. The second model reads the SOC too low.
        let worst = found.rest_soc.worst.value;
        assert!((worst + 0.012 / 1.075).abs() < 2e-4, "{worst}");
        let mut second = first.clone();
        second.r0_ohm.values.iter_mut().flatten().for_each(|r| *r *= 2.0);
        let found = ModelComparison::new(&first, &second);
        let at = found.temperatures.iter().find(|at| at.temperature_c == 25.0).expect("shared");
        assert!((at.series.rms - 1.0).abs() < 1e-12 && at.settled.rms > 0.5, "{at:?}");
        assert!(found.rest_soc.rms < 1e-9 && at.load_soc.worst.value > 0.01, "{at:?}");
    }

    #[test]
    fn sizes_are_compared_per_capacity() {
        let of = |rated_ah: f64| Label::usual(Chemistry::NcaGraphite, rated_ah).model().expect("a model");
        let found = ModelComparison::new(&of(2.9), &of(60.0));
        assert!(found.capacity > 19.0);
        assert!(found.temperatures.iter().all(|at| at.settled.rms < 1e-9 && at.load_soc.rms < 1e-6), "{found:?}");
    }
}
