//! Tests cell model files, and compares the full text of every fault.

use super::*;

#[test]
fn cell_model_faults_are_reported() {
    let table: &[(&str, &str, &str)] = &[
        ("format = 1", "format = 2", "cell.toml:1: format = 2, must be 1"),
        (
            "name = \"test\"\n",
            "",
            "cell.toml:1: name is missing, must be a string that is not empty: Name of the cell, for people",
        ),
        ("capacity_ah = 1.9", "capacity_ah = -1.9", "cell.toml:4: capacity_ah = -1.9, must be 0.001 to 100000"),
        (
            "voltage_max_v = 4.2",
            "voltage_max_v = 2.5",
            "cell.toml:6: voltage_max_v = 2.5, must be above voltage_min_v = 2.5",
        ),
        (
            "[3.0, 3.6, 4.1]",
            "[3.0, 3.6, 3.6]",
            "cell.toml:12: tables.ocv_v: 3.6 follows 3.6 at 10 degrees C, must rise strictly with soc",
        ),
        ("[3.0, 3.6, 4.1]", "[3.0, 3.6]", "cell.toml:12: tables.ocv_v: row 1 has 2 values, must be 3, one per soc"),
        ("[[3.0, 3.6, 4.1], ", "[", "cell.toml:12: tables.ocv_v: 1 rows, must be 2, one per temperature_c"),
        ("[3.0, 3.6, 4.1]", "[3.0, nan, 4.1]", "cell.toml:12: tables.ocv_v = nan, must be above 0 and at most 100"),
        ("[[0.1, 0.1, 0.1]", "[[0.1, -0.1, 0.1]", "cell.toml:13: tables.r0_ohm = -0.1, must be 0.000000001 to 1000"),
        (
            "[[100, 100, 100]",
            "[[100, 0, 100]",
            "cell.toml:16: tables.branches[1].c_farad = 0, must be 0.000001 to 1000000000000",
        ),
        (
            "c_farad = [[100, 100, 100], ",
            "c_farad = [",
            "cell.toml:16: tables.branches[1].c_farad: 1 rows, must be 2, one per temperature_c",
        ),
        (
            "temperature_c = [10, 30]",
            "temperature_c = [30, 10]",
            "cell.toml:11: tables.temperature_c: 10 follows 30, must rise strictly",
        ),
        (
            "[provenance]",
            "[thermal]\nheat_capacity_j_per_k = 1\nresistance_k_per_w = 0\n[provenance]",
            "cell.toml:9: thermal.resistance_k_per_w = 0, must be above 0 and at most 1000000000",
        ),
        (
            "[tables]",
            "[tables]\nx = 1",
            "cell.toml:10: tables.x is not a known key, must be one of soc, temperature_c, ocv_v, r0_ohm, voltage_error_v, branches",
        ),
        (
            "[provenance]",
            "[electrodes]\npositive = \"nmc\"\nnegative = \"graphite\"\npositive_content = [0.9, 0.3]\n\
             negative_content = [0.0, 0.9]\n[provenance]",
            "cell.toml:8: electrodes.positive = \"nmc\", must be one of nmc811, nmc532, nca, nco, lco, \
             lco_ramadass, lmo, lfp, did you mean nmc532",
        ),
        (
            "[provenance]",
            "[electrodes]\npositive = \"nmc811\"\nnegative = \"graphite\"\npositive_content = [0.3, 0.9]\n\
             negative_content = [0.0, 0.9]\n[provenance]",
            "cell.toml:10: electrodes.positive_content = [0.3, 0.9], must be two numbers, the higher first: \
             for the empty, then the full cell",
        ),
    ];
    for (from, to, fault) in table {
        assert!(CELL.contains(from), "{from}");
        assert_eq!(read_texts(PACK, &CELL.replacen(from, to, 1), DBC).unwrap_err(), [*fault], "{from} -> {to}");
    }
    let branch = "[[tables.branches]]\nr_ohm = [[1, 1, 1], [1, 1, 1]]\nc_farad = [[1, 1, 1], [1, 1, 1]]\n";
    let four = read_texts(PACK, &format!("{CELL}{}", branch.repeat(3)), DBC).unwrap_err();
    assert_eq!(four, ["cell.toml:14: tables.branches: 4 tables [[tables.branches]], must be 1 to 3"]);
    let none = read_texts(PACK, CELL.split("[[tables.branches]]").next().unwrap(), DBC).unwrap_err();
    assert_eq!(none, ["cell.toml:9: tables.branches: 0 tables [[tables.branches]], must be 1 to 3"]);
}

#[test]
fn unusable_cell_model_file_is_reported_at_its_key() {
    for name in ["no.toml", "no\\ntoml"] {
        let expected = [
            format!("{name}: cannot be read: entity not found"),
            format!(
                "pack.toml:3: pack.cell_model = \"{name}\", must be a cell model file, relative to the folder of the configuration"
            ),
        ];
        assert_eq!(faults(&pack_with("\"cell.toml\"", &format!("\"{name}\""))), expected);
    }
    let module = "[[pack.module]]\ncells = \"3\"\ncell_model = \"pack.toml\"\n";
    let expected = [
        "pack.toml: is a configuration, must be a cell model file (format, name, [tables], ...)",
        "pack.toml:17: pack.module[1].cell_model = \"pack.toml\", must be a cell model file, relative to the folder of the configuration",
    ];
    assert_eq!(faults(&format!("{PACK}{module}")), expected);
}

#[test]
fn electrode_data_determine_curve_ageing() {
    let with = |contents: &str| {
        let keys =
            format!("[electrodes]\npositive = \"nmc811\"\nnegative = \"graphite_siox\"\n{contents}\n[provenance]");
        read_texts(PACK, &CELL.replacen("[provenance]", &keys, 1), DBC)
    };
    let good = "positive_content = [0.8531, 0.2679]\nnegative_content = [0.0335, 0.9107]";
    let model = with(good).expect("a configuration").0.monitor.model;
    // Change of the open-circuit voltage at SOC 0.5 after a loss of 20 % of the capacity (V).
    let offset_v = |model: &crate::cell::CellModel| {
        let (aged, new) = (0.8 * model.capacity_ah, model.grid_position(0.5, 25.0));
        model.aged_ocv_v(&new, aged) - model.ocv_v(&new)
    };
    assert!(offset_v(&model).abs() > 0.002, "{}", offset_v(&model));
    assert_eq!(offset_v(&good_model()), 0.0, "without electrode data the curve only shrinks");
    let faults = [
        (
            "positive_content = [0.85, 0.27]\nnegative_content = [0.9, 0.03]",
            "cell.toml:11: electrodes.negative_content = [0.9, 0.03], must be two numbers, the lower first: \
             for the empty, then the full cell",
        ),
        (
            "positive_content = [0.85, 0.27]\nnegative_content = [0.03, 0.5, 0.9]",
            "cell.toml:11: electrodes.negative_content = [0.03, 0.5, 0.9], must be two numbers, the lower first: \
             for the empty, then the full cell",
        ),
        (
            "positive_content = [0.4, 0.39]\nnegative_content = [0.0, 0.01]",
            "cell.toml:10: electrodes.positive_content: the ageing of the open-circuit curve cannot be computed from these contents",
        ),
    ];
    for (contents, fault) in faults {
        assert_eq!(with(contents).expect_err("a fault"), [fault]);
    }
    let both = CELL.replacen("[provenance]", "ocv_ageing_shift = 0.5\n[provenance]", 1);
    let keys = format!("[electrodes]\npositive = \"nmc811\"\nnegative = \"graphite_siox\"\n{good}\n[provenance]");
    let faults = read_texts(PACK, &both.replacen("[provenance]", &keys, 1), DBC).expect_err("a fault");
    assert_eq!(faults, ["cell.toml:7: ocv_ageing_shift = 0.5, must not be given together with [electrodes]"]);
}

fn good_model() -> crate::cell::CellModel {
    good(PACK).monitor.model
}

#[test]
fn written_model_reads_back_unchanged() {
    use crate::cell::{AgeingLaw, Chemistry, Label};
    use crate::config::cell_model::{self, SourcedModel};
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("cell.toml");
    let same = |sourced: &SourcedModel| {
        std::fs::write(&path, cell_model::text(sourced, "a test")).expect("written");
        let found = cell_model::load_sourced(&path).expect("a model");
        assert_eq!(found.model, sourced.model);
        assert_eq!(
            (&found.source.chemistry, &found.source.provenance),
            (&sourced.source.chemistry, &sourced.source.provenance)
        );
        assert_eq!(found.source.measured, sourced.source.measured);
    };
    for (chemistry, _) in Chemistry::ALL {
        same(&crate::config::of_label(&Label::usual(chemistry, 2.9)).expect("a model"));
    }
    let shipped = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/cells");
    let entries = cell_model::library::list(&shipped).expect("a folder");
    assert!(entries.len() >= 6, "{entries:?}");
    let models: Vec<SourcedModel> = entries.into_iter().map(|entry| entry.model.expect("a model")).collect();
    assert!(models.iter().any(|it| matches!(it.model.aged_ocv.law(), AgeingLaw::Electrodes(_))));
    models.iter().for_each(same);
}

#[test]
fn model_spread_widens_estimator_like_label_spread() {
    let spread = |modes: &str| {
        let keys = format!(
            "[spread]\ncurve_v = 0.01\nlog_resistance = 0.45\nslow_branch = 0.5\ncapacity = 0.07\ndrop_sqrt_s = 4.0\n\
             curve_modes_v = {modes}\n[provenance]"
        );
        read_texts(PACK, &CELL.replacen("[provenance]", &keys, 1), DBC)
    };
    let config = spread("[[0.03, 0.02, 0.01], [0.0, -0.01, 0.0]]").expect("a configuration").0;
    let (estimator, model) = (&config.monitor.estimator, &config.monitor.model);
    assert_eq!((estimator.initial.log_resistance_std, estimator.sensor.slow_branch), (0.45, 0.5));
    assert_eq!(estimator.initial.capacity_std_ah, 0.07 * model.capacity_ah);
    assert_eq!(model.aged_ocv_changes_v(&model.grid_position(0.0, 10.0), model.capacity_ah).1, [0.03, 0.0]);
    let fault = |modes: &str| spread(modes).expect_err("a fault");
    assert_eq!(
        fault("[[0.03, 0.02, 0.01]]"),
        ["cell.toml:13: spread.curve_modes_v: rows of 3 values, must be two rows of 3, one value per soc"]
    );
    assert_eq!(
        fault("[[0.03, 0.02, 0.01], [0.0]]"),
        ["cell.toml:13: spread.curve_modes_v: rows of 3 and 1 values, must be two rows of 3, one value per soc"]
    );
}
