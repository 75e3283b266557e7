//! Tests a pack with two kinds of cells (`[[pack.module]]`).

use packwatch::cell::CellModel;
use packwatch::monitor::Downtime;
use packwatch::quantity::CellIndex;

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK, Rig};

const MODULE: &str = "[[pack.module]]\ncells = \"2\"\nchemistry = \"lfp-graphite\"\nrated_capacity_ah = 2.6\n";

/// A cell that follows the model at 25 degrees C.
struct Truth<'a> {
    model: &'a CellModel,
    branches_v: Vec<f64>,
}

impl Truth<'_> {
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

/// Discharges from 95 to 15 % SOC at C/2, after a rest.
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
fn each_cell_kind_uses_its_own_model() {
    let config = config_texts::load(&format!("{PACK}{MODULE}"), DBC).monitor;
    let models = [config.model.clone(), config.modules[0].model.clone()];
    let models = [&models[0], &models[1]];
    let mut mixed = Rig::with(config.clone());
    discharge(&mut mixed, models);
    let [own, module] = socs(&mixed);
    assert!((own.0 - 0.15).abs() < 0.02, "{own:?}");
    assert!((module.0 - 0.15).abs() < 1.96 * module.1, "{module:?}");
    // Without the `[[pack.module]]` table, the second cell is treated like the first.
    let mut alone = Rig::with(config_texts::load(PACK, DBC).monitor);
    discharge(&mut alone, models);
    let [own_alone, taken] = socs(&alone);
    assert!((own_alone.0 - own.0).abs() < 0.005, "without the module {own_alone:?}, with it {own:?}");
    assert!((taken.0 - 0.15).abs() > 0.1, "{taken:?}");
    // After a restart, the stored values apply.
    mixed.restart(Downtime::Seconds(1.0));
    mixed.seconds(5);
    let [own_after, module_after] = socs(&mixed);
    assert!(
        (own_after.0 - own.0).abs() < 0.005 && (module_after.0 - module.0).abs() < 0.02,
        "module after the restart {module_after:?}, before {module:?}"
    );
}

#[test]
fn new_module_starts_fresh_others_continue() {
    let plain = config_texts::load(PACK, DBC).monitor;
    let mut before = Rig::with(plain.clone());
    discharge(&mut before, [&plain.model, &plain.model]);
    before.current_a = Some(0.0);
    before.seconds(60);
    let [own, old] = [0, 1].map(|cell| before.monitor.capacity(CellIndex(cell)));
    assert!(own.std() < 0.25 && old.std() < 0.25, "both learned: {own:?} {old:?}");
    let snapshot = before.monitor.snapshot();
    // In this configuration the second cell has other RC branches and another capacity.
    let text = format!("{PACK}{MODULE}initial_capacity_ah = 2.4\ninitial_capacity_std_ah = 0.5\n");
    let mut rig = Rig::with(config_texts::load(&text, DBC).monitor);
    assert_ne!(rig.config.model.branches.len(), rig.config.modules[0].model.branches.len());
    rig.monitor.restore(snapshot, Downtime::Seconds(3600.0)).unwrap();
    rig.deci = before.deci + 36_000;
    rig.seconds(1);
    let [own_after, module] = [0, 1].map(|cell| rig.monitor.capacity(CellIndex(cell)));
    assert_eq!(own_after, own);
    assert_eq!((module.mean, module.std()), (2.4, 0.5));
}

#[test]
fn only_module_with_model_file_learns() {
    let file = "[[pack.module]]\ncells = \"2\"\ncell_model = \"cells/example_nmc_2600.toml\"\n";
    for (module, is_taught) in [(file, true), (MODULE, false)] {
        let config = config_texts::load(&format!("{PACK}{module}"), DBC).monitor;
        let models = [config.model.clone(), config.modules[0].model.clone()];
        let mut rig = Rig::with(config);
        let before = rig.monitor.capacity(CellIndex(1));
        discharge(&mut rig, [&models[0], &models[1]]);
        rig.current_a = Some(0.0);
        rig.seconds(60);
        let [own, of_module] = [0, 1].map(|cell| rig.monitor.capacity(CellIndex(cell)));
        assert!(own.std() < 0.25, "{own:?}");
        assert_eq!(of_module.std() < 0.9 * before.std(), is_taught, "{module}: {before:?} {of_module:?}");
    }
}

#[test]
fn changed_module_cells_need_restart() {
    let config = config_texts::load(&format!("{PACK}{MODULE}"), DBC).monitor;
    let mut rig = Rig::with(config);
    rig.seconds(5);
    let refused = rig.reload(|config| config.modules[0].cells = vec![CellIndex(0)]).unwrap_err();
    assert_eq!(refused.key, "[[pack.module]]");
    let refused = rig.reload(|config| config.modules.clear()).unwrap_err();
    assert_eq!(refused.key, "[[pack.module]]");
    rig.reload(|config| config.modules[0].estimator.initial.capacity_ah = 2.5).unwrap();
}
