//! Computes the energy of a discharge at the configured load.
//!
//! A table lists the charge q(v) that the cell delivers until its voltage under load falls to v ([`usable_ah`]). The
//! energy is the sum of v dq over this table. If more charge was delivered than the table covers, the rest counts at
//! the cut-off voltage.

use crate::cell::CellModel;
use crate::health::UsableConfig;
use crate::health::usable::usable_ah;

/// Number of voltages in the table, about 8 mV apart for a lithium-ion cell.
const VOLTAGES: u32 = 200;

#[derive(Debug)]
pub(super) struct Discharge {
    /// Falling voltages (V), each with the charge (Ah) that the cell delivers until its voltage falls to this value.
    points: Vec<(f64, f64)>,
    cutoff_v: f64,
}

impl Discharge {
    pub(super) fn new(model: &CellModel, load: &UsableConfig, capacity_ah: f64, resistance_ratio: f64) -> Self {
        let top_v = model.voltage_max_v.max(load.cutoff_v);
        let voltage_v = |step: u32| top_v - (top_v - load.cutoff_v) * f64::from(step) / f64::from(VOLTAGES);
        let point = |step: u32| {
            let cutoff_v = voltage_v(step);
            let load = UsableConfig { cutoff_v, ..*load };
            // The slowest RC branch may have aged more than the other resistances. This difference is ignored, because
            // it changes the mean voltage only by millivolts.
            (cutoff_v, usable_ah(model, &load, 1.0, capacity_ah, (resistance_ratio, 1.0)))
        };
        Self { points: (0..=VOLTAGES).map(point).collect(), cutoff_v: load.cutoff_v }
    }

    pub(super) fn energy_wh(&self, charge_ah: f64) -> f64 {
        let mut energy_wh = 0.0;
        let mut delivered_ah = 0.0;
        for pair in self.points.windows(2) {
            let ((before_v, from_ah), (after_v, to_ah)) = (pair[0], pair[1]);
            let end_ah = to_ah.min(charge_ah);
            energy_wh += 0.5 * (before_v + after_v) * (end_ah - from_ah).max(0.0);
            delivered_ah = end_ah.max(delivered_ah);
        }
        energy_wh + self.cutoff_v * (charge_ah - delivered_ah).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::AgedOcv;
    use crate::cell::model::{Branch, Table};

    /// Creates a cell with the open-circuit voltage 3 V + 1.2 V x SOC, almost without resistance.
    fn model() -> CellModel {
        let row = |value: f64| Table { values: vec![vec![value; 2]] };
        CellModel {
            name: "line".to_owned(),
            rated_capacity_ah: 2.0,
            capacity_ah: 2.0,
            voltage_min_v: 3.0,
            voltage_max_v: 4.2,
            soc: vec![0.0, 1.0],
            temperature_c: vec![25.0],
            ocv_v: Table { values: vec![vec![3.0, 4.2]] },
            aged_ocv: AgedOcv::default(),
            r0_ohm: row(1e-9),
            branches: vec![Branch { r_ohm: row(1e-9), c_farad: row(1e9) }],
            voltage_error_v: None,
            thermal: None,
            spread: None,
        }
    }

    #[test]
    fn energy_is_the_area_below_the_voltage() {
        let load = UsableConfig { current_a: 0.2, temperature_c: 25.0, cutoff_v: 3.0, taper_current_a: 0.05 };
        let discharge = Discharge::new(&model(), &load, 2.0, 1.0);
        // The cell delivers 2 Ah at 3.6 V on average, and the first half at 3.9 V on average.
        assert!((discharge.energy_wh(2.0) - 7.2).abs() < 0.01, "{}", discharge.energy_wh(2.0));
        assert!((discharge.energy_wh(1.0) - 3.9).abs() < 0.01, "{}", discharge.energy_wh(1.0));
        assert!(
            (discharge.energy_wh(2.1) - 7.5).abs() < 0.01,
            "at the cut-off voltage beyond the table: {}",
            discharge.energy_wh(2.1)
        );
    }

    #[test]
    fn resistance_reduces_the_energy() {
        let load = UsableConfig { current_a: 2.0, temperature_c: 25.0, cutoff_v: 3.0, taper_current_a: 0.05 };
        let mut model = model();
        model.r0_ohm = Table { values: vec![vec![0.05; 2]] };
        // At 2 A, the voltage is 0.1 V lower, and the last 0.1 V of the curve is unusable.
        let charge_ah = 2.0 * (1.0 - 0.1 / 1.2);
        let energy_wh = Discharge::new(&model, &load, 2.0, 1.0).energy_wh(charge_ah);
        assert!((energy_wh - charge_ah * (3.0 + 4.1) / 2.0).abs() < 0.01, "{energy_wh}");
    }
}
