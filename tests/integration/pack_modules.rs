//! A pack of two cells of which one is of another kind: `[[pack.module]]`.

use packwatch::cell::CellModel;
use packwatch::monitor::Downtime;
use packwatch::quantity::CellIndex;

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK, Rig};

const MODULE: &str = "[[pack.module]]\ncells = \"2\"\nchemistry = \"lfp-graphite\"\nrated_capacity_ah = 2.6\n";

/// A cell of the model, discharged at 25 degrees C.
struct Truth<'a> {
    model: &'a CellModel,
    branches_v: Vec<f64>,
}

impl Truth<'_> {
    /// Its voltage after `seconds` of this current, V.
    fn after(&mut self, seconds: f64, soc: f64, current_a: f64) -> f64 {
        let position = self.model.grid_position(soc, 25.0);
        for (i, branch_v) in self.branches_v.iter_mut().enumerate() {
            let settled_v = self.model.branch_r_ohm(i, &position) * current_a;
            let left = (-seconds / self.model.branch_tau_s(i, &position)).exp();
            *branch_v = settled_v + (*branch_v - settled_v) * left;
        }
        self.model.ocv_v(&position) - current_a * self.model.r0_ohm(&position) - self.branches_v.iter().sum::<f64>()
    }
}

/// From 95 to 15 % with half the capacity per hour, after a rest.
fn discharge(rig: &mut Rig, models: [&CellModel; 2]) {
    let (capacity_ah, current_a, period_s) = (2.6, 1.3, 5);
    let mut cells = models.map(|model| Truth { model, branches_v: vec![0.0; model.branches.len()] });
    rig.voltages_v = cells.each_mut().map(|cell| Some(cell.after(0.0, 0.95, 0.0)));
    rig.current_a = Some(0.0);
    rig.seconds(600);
    rig.current_a = Some(current_a);
    let mut soc = 0.95;
    while soc > 0.15 {
        soc -= current_a * f64::from(period_s) / 3600.0 / capacity_ah;
        rig.voltages_v = cells.each_mut().map(|cell| Some(cell.after(f64::from(period_s), soc, current_a)));
        rig.seconds(i64::from(period_s));
    }
}

fn socs(rig: &Rig) -> [(f64, f64); 2] {
    let estimates: Vec<_> = rig.monitor.latest().flatten().map(|it| (it.soc, it.soc_std)).collect();
    estimates.try_into().unwrap_or_else(|found| panic!("{found:?}"))
}

#[test]
fn each_kind_of_cell_is_estimated_by_its_own_model() {
    let config = config_texts::load(&format!("{PACK}{MODULE}"), DBC).monitor;
    let models = [config.model.clone(), config.modules[0].model.clone()];
    let models = [&models[0], &models[1]];
    let mut mixed = Rig::with(config.clone());
    discharge(&mut mixed, models);
    let [own, module] = socs(&mixed);
    assert!((own.0 - 0.15).abs() < 0.02, "{own:?}");
    assert!((module.0 - 0.15).abs() < 1.96 * module.1, "{module:?}");
    // Without the module its cell is taken for one of the pack's own.
    let mut alone = Rig::with(config_texts::load(PACK, DBC).monitor);
    discharge(&mut alone, models);
    let [own_alone, taken] = socs(&alone);
    assert!((own_alone.0 - own.0).abs() < 0.005, "{own_alone:?} {own:?}");
    assert!((taken.0 - 0.15).abs() > 0.1, "{taken:?}");
    // What was stored continues.
    mixed.restart(Downtime::Seconds(1.0));
    mixed.seconds(5);
    let [own_after, module_after] = socs(&mixed);
    assert!(
        (own_after.0 - own.0).abs() < 0.005 && (module_after.0 - module.0).abs() < 0.02,
        "{module_after:?} {module:?}"
    );
}

#[test]
fn other_cells_in_a_module_need_a_restart_and_other_capacities_do_not() {
    let config = config_texts::load(&format!("{PACK}{MODULE}"), DBC).monitor;
    let mut rig = Rig::with(config);
    rig.seconds(5);
    let refused = rig.reload(|config| config.modules[0].cells = vec![CellIndex(0)]).unwrap_err();
    assert_eq!(refused.key, "[[pack.module]]");
    let refused = rig.reload(|config| config.modules.clear()).unwrap_err();
    assert_eq!(refused.key, "[[pack.module]]");
    rig.reload(|config| config.modules[0].estimator.initial.capacity_ah = 2.5).unwrap();
}
