//! Computes how errors of the cell model at the start and end of a half-cycle (one charge or discharge) change the
//! learned capacity. All half-cycles between the same two SOC values have the same errors, so these errors do not
//! average out.
//!
//! In: SOC at the start and end of a half-cycle. Out: change of the half-cycle's capacity (Ah) per standard deviation
//! of each error.
//!
//! A half-cycle's capacity C is charge / swing, where the swing is the higher SOC minus the lower SOC. An error e (V)
//! of the open-circuit curve at one end changes the SOC at this end by e / slope, and the capacity by (C / swing) (e /
//! slope). The errors are defined at SOC nodes. They are independent of each other and are interpolated linearly
//! between the nodes. Their size is the setting `end_error_v`. Without this setting, it follows from the voltage error
//! that the cell model states. If the model states no error, the errors are 0 here. The constant voltage offset of the
//! cell's estimator must then also cover the errors of the curve.

use super::CapacityConfig;
use super::half_cycle::HalfCycle;
use crate::cell::model_bands::CURVE_C;
use crate::cell::{CellModel, ModelBands, reach_of_error};
use crate::quantity::Mode;

/// Number of errors, one per SOC node. The nodes are evenly spaced from SOC 0 to 1. In real cells, the error of the
/// curve differs between SOC values that are a quarter of the SOC range apart.
pub(super) const END_ERRORS: usize = 5;

/// Change of a half-cycle's capacity (Ah) per standard deviation of each error; zero if the SOC at the half-cycle's
/// ends is unknown. `is_label`: whether the model comes from a label. If so, the whole uncertainty of the curve counts
/// as an error that is the same in all half-cycles.
pub(super) fn effects_ah(
    model: &CellModel,
    config: &CapacityConfig,
    half_cycle: &HalfCycle,
    capacity_ah: f64,
    is_label: bool,
) -> [f64; END_ERRORS] {
    let mut effects = [0.0; END_ERRORS];
    let Some(ends) = &half_cycle.ends else { return effects };
    let bands = ModelBands::new(model);
    let temperature = model.temperature_position(half_cycle.mean_temperature_c.unwrap_or(CURVE_C));
    // A swing below 2 % gives no useful measurement. It counts as 2 %, so that the effect stays finite.
    let swing = (half_cycle.charge_ah / capacity_ah).max(0.02);
    // A discharge starts at its higher SOC, a charge at its lower SOC.
    let sign = if half_cycle.mode == Mode::Charge { -1.0 } else { 1.0 };
    for (soc, fuller) in ends.iter().zip([sign, -sign]) {
        let position = model.grid_position_at(&temperature, *soc);
        // Half of the error that a fitted model states is an error of the curve, which is the same in all half-cycles.
        // The other half depends on the history of the current, so it differs between half-cycles.
        let of_fit_v = || model.voltage_error_v(&position).map_or(0.0, |error_v| 0.5 * error_v);
        let of_label_v = || bands.curve_std_v(*soc).unwrap_or(0.0);
        let own_v = || if is_label { of_label_v() } else { of_fit_v() };
        let error_v = config.end_error_v.unwrap_or_else(own_v);
        let soc_error = if is_label {
            reach_of_error(model, &temperature, capacity_ah, (*soc, error_v))
        } else {
            error_v / model.ocv_slope_v(&position, capacity_ah)
        };
        let effect_ah = -fuller * capacity_ah / swing * soc_error;
        let along = soc.clamp(0.0, 1.0) * (END_ERRORS - 1) as f64;
        let node = (0..END_ERRORS - 2).take_while(|&k| along >= (k + 1) as f64).count();
        let share = along - node as f64;
        effects[node] += effect_ah * (1.0 - share);
        effects[node + 1] += effect_ah * share;
    }
    effects
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::model::tests::small_model;
    use crate::health::CapacityMethod;

    const CONFIG: CapacityConfig = CapacityConfig {
        method: CapacityMethod::Swing,
        noise_ah_per_cycle: 0.0,
        noise_ah_per_rest_day: 0.0,
        end_error_v: Some(0.004),
        current_gain_std: 0.0,
        current_offset_std_a: 0.0,
        fade_std_ah_per_cycle: 0.0,
        fade_noise_ah_per_cycle: 0.0,
    };

    fn discharge(charge_ah: f64, from: f64, to: f64) -> HalfCycle {
        HalfCycle {
            mode: Mode::Discharge,
            charge_ah,
            swing: None,
            end_soc: Some(to),
            ends: Some([from, to]),
            duration_s: 3600.0,
            mean_current_a: charge_ah,
            mean_temperature_c: Some(25.0),
        }
    }

    #[test]
    fn curve_error_moves_capacity_by_slope_and_swing() {
        let model = small_model();
        let found = effects_ah(&model, &CONFIG, &discharge(0.9, 1.0, 0.375), 1.8, false);
        // At 25 C (interpolated at 5/8 of the way from 0 to 40 C), the slope of the curve is 1.075 V per unit of SOC
        // above SOC 0.5, and 1.325 V below. The swing is 0.5.
        let per_volt = 1.8 / 0.5 * 0.004;
        let lower = 0.5 * per_volt / 1.325;
        let expected = [0.0, lower, lower, 0.0, -per_volt / 1.075];
        for (found, expected) in found.into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }

    #[test]
    fn charge_and_discharge_of_equal_swing_have_equal_errors() {
        let model = small_model();
        let down = discharge(0.9, 0.8, 0.3);
        let up = HalfCycle { mode: Mode::Charge, ends: down.ends.map(|[a, b]| [b, a]), ..down };
        assert_eq!(effects_ah(&model, &CONFIG, &up, 1.8, false), effects_ah(&model, &CONFIG, &down, 1.8, false));
    }

    #[test]
    fn tiny_swing_is_limited_and_unknown_ends_have_no_effect() {
        let model = small_model();
        let tiny = effects_ah(&model, &CONFIG, &discharge(0.001, 0.8, 0.8), 1.8, false);
        let least = effects_ah(&model, &CONFIG, &discharge(0.036, 0.8, 0.8), 1.8, false);
        assert_eq!(tiny, least);
        let unknown = HalfCycle { ends: None, ..discharge(0.9, 0.8, 0.3) };
        assert_eq!(effects_ah(&model, &CONFIG, &unknown, 1.8, false), [0.0; END_ERRORS]);
    }
}
