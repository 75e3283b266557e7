//! Tests `[[pack.module]]`: modules with a different cell model.

use super::*;

fn with_modules(modules: &str) -> String {
    format!("{PACK}{modules}")
}

const LFP: &str = "[[pack.module]]\ncells = \"2, 4\"\nchemistry = \"lfp-graphite\"\nrated_capacity_ah = 2.5\n";

#[test]
fn module_has_cells_model_and_initial_capacity() {
    let monitor = good(&with_modules(LFP)).monitor;
    let [module] = monitor.modules.as_slice() else { panic!("{:?}", monitor.modules) };
    assert_eq!(module.cells, [CellIndex(1), CellIndex(3)]);
    assert_eq!((module.model.rated_capacity_ah, module.model.voltage_max_v), (2.5, 3.65));
    assert_eq!((module.estimator.initial.capacity_ah, monitor.estimator.initial.capacity_ah), (2.5, 1.9));
    assert_eq!(monitor.own_cells(), 2);
    let aged = "[[pack.module]]\ncells = \"3\"\ncell_model = \"cell.toml\"\ninitial_capacity_ah = 1.2\ninitial_capacity_std_ah = 0.3\n";
    let monitor = good(&with_modules(aged)).monitor;
    let initial = monitor.modules[0].estimator.initial;
    assert_eq!((initial.capacity_ah, initial.capacity_std_ah), (1.2, 0.3));
}

#[test]
fn voltage_limits_cover_all_cells() {
    let low = "[[pack.module]]\ncells = \"1\"\nchemistry = \"nmc-graphite\"\nrated_capacity_ah = 2\n";
    let [alone, beside] = [PACK.to_owned(), with_modules(low)].map(|text| good(&text).monitor.sample.voltage);
    assert!(beside.min <= alone.min && beside.max >= alone.max, "{alone:?} {beside:?}");
    let lfp = "chemistry = \"lfp-graphite\"\nrated_capacity_ah = 2.5";
    let nmc = "[[pack.module]]\ncells = \"1\"\nchemistry = \"nmc811-graphite\"\nrated_capacity_ah = 2.5\n";
    let pack = pack_with("cell_model = \"cell.toml\"", lfp);
    let [alone, beside] = [pack.clone(), format!("{pack}{nmc}")].map(|text| good(&text).monitor.sample.voltage.max);
    assert!(beside > alone + 0.4, "{alone} {beside}");
}

#[test]
fn other_cell_size_widens_uncertainty() {
    let (config, _) = read_texts(&with_modules(&LFP.replace("2.5", "50")), CELL, DBC).unwrap();
    let line = PACK.lines().count() + 2;
    let expected = format!(
        "pack.toml:{line}: pack.module[1].cells = \"2, 4\", have 25 times the 2 Ah of the pack's own cells, which carry the same current"
    );
    assert!(config.warnings.contains(&expected), "{:?}", config.warnings);
    assert!(!good(&with_modules(LFP)).warnings.iter().any(|warning| warning.contains("pack's own")));
}

#[test]
fn check_lists_module_cells() {
    let (_, description) = read_texts(&with_modules(LFP), CELL, DBC).unwrap();
    let words = description.pack.join("\n");
    assert!(words.contains("cells 2, 4: another type of cell, lfp-graphite"), "{words}");
}

#[test]
fn module_faults_are_reported() {
    let of = |module: &str| faults(&with_modules(&format!("[[pack.module]]\n{module}\n")));
    let line = PACK.lines().count() + 1;
    for (module, at, expected) in [
        (
            "cells = \"2\"",
            0,
            "pack.module[1].cell_model is not set, must be a cell model file, unless chemistry and rated_capacity_ah describe the cell",
        ),
        (
            "cells = \"2\"\nchemistry = \"lfp-graphite\"",
            2,
            "pack.module[1].chemistry = \"lfp-graphite\", requires rated_capacity_ah, the capacity on the label of one cell",
        ),
        (
            "cells = \"2\"\ncell_model = \"cell.toml\"\nchemistry = \"lfp-graphite\"",
            3,
            "pack.module[1].chemistry = \"lfp-graphite\", must not be given together with cell_model, which states it",
        ),
        (
            "cells = \"3-5\"\ncell_model = \"cell.toml\"",
            1,
            "pack.module[1].cells = \"3-5\", must be within 1 to 4 (pack.cells)",
        ),
        (
            "cells = \"1-4\"\ncell_model = \"cell.toml\"",
            1,
            "pack.module[1].cells = \"1-4\", must leave at least one cell of the pack's own type",
        ),
        (
            "cells = \"1\"\ncell_model = \"cell.toml\"\ninitial_capacity_ah = 20",
            3,
            "pack.module[1].initial_capacity_ah = 20, must be plausible for a cell of \"test\", 0.095 to 5.7 Ah",
        ),
        (
            "cells = \"1\"\ncell_model = \"cell.toml\"\nrated_capacity_ah = 200",
            3,
            "pack.module[1].rated_capacity_ah = 200, must be the capacity of one cell of \"test\", which has 1.9 Ah",
        ),
    ] {
        assert_eq!(of(module), [format!("pack.toml:{}: {expected}", line + at)]);
    }
    let twice = format!("{LFP}[[pack.module]]\ncells = \"1-2\"\ncell_model = \"cell.toml\"\n");
    let found = faults(&with_modules(&twice));
    assert!(found.len() == 1 && found[0].contains("must not name cells of pack.module"), "{found:?}");
}
