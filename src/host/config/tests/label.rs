//! Tests cells described by their label: chemistry, capacity and voltages in `[pack]` instead of a model file.

use super::*;
use crate::cell::Chemistry;

const FILE: &str = "cell_model = \"cell.toml\"";

#[test]
fn label_gives_chemistry_model_with_spread() {
    let config = good(&pack_with(FILE, "chemistry = \"nmc811-graphite\"\nrated_capacity_ah = 60"));
    let (monitor, initial) = (&config.monitor, &config.monitor.estimator.initial);
    assert_eq!((monitor.model.rated_capacity_ah, monitor.model.capacity_ah), (60.0, 60.0));
    assert_eq!((monitor.model.voltage_min_v, monitor.model.voltage_max_v), (2.5, 4.2));
    assert_eq!((initial.capacity_ah, initial.capacity_std_ah), (60.0, 6.0));
    let file = good(PACK).monitor.estimator;
    assert!(initial.log_resistance_std > 2.0 * file.initial.log_resistance_std, "{initial:?}");
    assert!(monitor.estimator.sensor.voltage_offset_v > file.sensor.voltage_offset_v);
    assert!(monitor.estimator.voltage.load_error_sqrt_s > file.voltage.load_error_sqrt_s);
}

#[test]
fn estimator_keys_override_label_spread() {
    let text = pack_with(FILE, "chemistry = \"lfp-graphite\"\nrated_capacity_ah = 100\nvoltage_max_v = 3.6");
    let config = good(&format!("{text}[estimator]\ninitial_log_resistance_std = 0.1\nslow_branch_std = 0.05\n"));
    let estimator = &config.monitor.estimator;
    assert_eq!((estimator.initial.log_resistance_std, estimator.sensor.slow_branch), (0.1, 0.05));
    assert_eq!(config.monitor.model.voltage_max_v, 3.6);
}

#[test]
fn every_chemistry_is_accepted() {
    for (chemistry, name) in Chemistry::ALL {
        for name in [name, name.trim_end_matches("-graphite")] {
            let config = good(&pack_with(FILE, &format!("chemistry = \"{name}\"\nrated_capacity_ah = 5")));
            assert!(config.monitor.model.name.starts_with(chemistry.name()), "{}", config.monitor.model.name);
        }
    }
}

#[test]
fn label_faults_are_reported() {
    let of = |keys: &str| faults(&pack_with(FILE, keys));
    assert_eq!(
        of("strings = 1"),
        [
            "pack.toml:1: pack.cell_model is not set, must be a cell model file, unless chemistry and rated_capacity_ah describe the cell"
        ]
    );
    assert_eq!(
        of("chemistry = \"nca-graphite\""),
        [
            "pack.toml:3: pack.chemistry = \"nca-graphite\", requires rated_capacity_ah, the capacity on the label of one cell"
        ]
    );
    assert_eq!(
        of("cell_model = \"cell.toml\"\nchemistry = \"nca-graphite\"\nvoltage_min_v = 3.0"),
        [
            "pack.toml:4: pack.chemistry = \"nca-graphite\", must not be given together with cell_model, which states it",
            "pack.toml:5: pack.voltage_min_v = 3.0, must not be given together with cell_model, which states it",
        ]
    );
    assert_eq!(
        of("chemistry = \"lfp-graphite\"\nrated_capacity_ah = 100\nvoltage_min_v = 3.5\nvoltage_max_v = 4.3"),
        [
            "pack.toml:3: pack.chemistry = \"lfp-graphite\", 3.5 to 4.3 V is not a plausible range for lfp-graphite (typical: 2.5 to 3.65 V)"
        ]
    );
    assert_eq!(
        of("chemistry = \"nmc-grafite\"\nrated_capacity_ah = 100"),
        [
            "pack.toml:3: pack.chemistry = \"nmc-grafite\", must be one of nmc811-graphite, nmc-graphite, nca-graphite, lco-graphite, lmo-graphite, lfp-graphite, did you mean nmc-graphite"
        ]
    );
}
