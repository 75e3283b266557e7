//! Runs `packwatch diagnose` as a user does and compares it with the simulator's truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use assert_cmd::cargo::cargo_bin;
use serde_json::Value;

/// The leaking cell and the cell with a stuck channel, counted from 1. The pack has 96 cells.
const LEAKING: u64 = 7;
const STUCK: u64 = 20;

fn packwatch(args: &[&str]) -> String {
    let output = Command::new(cargo_bin("packwatch")).args(args).output().expect("it runs");
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// From the last true states: usable charge, charge that balancing would recover, and the cell that ends a discharge.
/// Both charges are fractions of the mean cell's capacity.
fn truth(path: &Path) -> (f64, f64, u64) {
    let mut cells: BTreeMap<u64, (f64, f64)> = BTreeMap::new();
    for row in csv::Reader::from_path(path).expect("the truth").deserialize() {
        let row: BTreeMap<String, f64> = row.expect("numbers");
        cells.insert(row["cell"] as u64 + 1, (row["soc"], row["capacity_ah"]));
    }
    let least = |value: fn(&(f64, f64)) -> f64| {
        let all = cells.iter().map(|(cell, state)| (*cell, value(state)));
        all.min_by(|a, b| a.1.total_cmp(&b.1)).expect("cells")
    };
    let (first_empty, dischargeable_ah) = least(|(soc, ah)| soc * ah);
    let (_, chargeable_ah) = least(|(soc, ah)| (1.0 - soc) * ah);
    let (_, least_ah) = least(|(_, ah)| *ah);
    let mean_ah = cells.values().map(|state| state.1).sum::<f64>() / cells.len() as f64;
    let usable = (dischargeable_ah + chargeable_ah) / mean_ah;
    (usable, least_ah / mean_ah - usable, first_empty)
}

#[test]
fn leak_cost_matches_simulator_and_names_cell() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| -> PathBuf { folder.path().join(name) };
    let text = |path: PathBuf| path.display().to_string();
    let config = text(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example.toml"));
    let (log, state, true_states) = (text(path("pack.log.gz")), text(path("state")), text(path("truth.csv")));
    let (leak, stuck) = (format!("leak:{LEAKING}:20mA"), format!("voltage-stuck:{STUCK}"));
    let simulate = ["simulate", "ev-day", "-c", &config, "-o", &log, "--cycles", "2", "--period", "3000", "--sensors"];
    packwatch(
        &[
            &simulate[..],
            &["usual", "--fault", &leak, "--fault", &stuck, "--truth", &true_states, "--truth-period", "600"],
        ]
        .concat(),
    );
    packwatch(&["replay", "-c", &config, &log, "--state", &state]);

    let page: Value = serde_json::from_str(&packwatch(&["diagnose", "--state", &state, "--json"])).expect("JSON");
    let pack = &page["pack"];
    let (usable, lost_by_imbalance, first_empty) = truth(&path("truth.csv"));
    for (name, expected) in [("usable", usable), ("lost_by_imbalance", lost_by_imbalance)] {
        let found = |number: &str| pack[name]["fraction"][number].as_f64().expect("a number");
        let (mean, std) = (found("mean"), found("std"));
        assert!((mean - expected).abs() < 3.0 * std && std < 0.03, "{name}: {mean} ± {std}, not {expected}");
    }
    assert_eq!((pack["discharge_limit"]["cell"].as_u64(), first_empty), (Some(LEAKING), LEAKING));
    assert_eq!((&pack["discharge_limit"]["reason"], &pack["unknown"]), (&Value::from("leak"), &Value::Null));
    assert_eq!(pack["left_out"], serde_json::json!([{ "cell": STUCK, "reason": "faulty_channel" }]));
    // The stored state does not contain a cell model from a file, so the energy is unknown.
    assert_eq!(pack["usable"]["kwh"], Value::Null);

    let lines = packwatch(&["diagnose", "--state", &state]);
    for part in
        ["\npack\nusable ", "\nlost by imbalance ", "\nends a discharge      cell 7, leak: ", "\nspread of SOC "]
    {
        assert!(lines.contains(part), "no {part:?} in\n{lines}");
    }
}

#[test]
fn uncompared_pack_is_unknown() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = |name: &str| folder.path().join(name).display().to_string();
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example.toml").display().to_string();
    let log = text("short.log");
    packwatch(&["simulate", "ev-day", "-c", &config, "-o", &log, "--duration", "20"]);
    let lines = packwatch(&["diagnose", "-c", &config, &log]);
    assert!(lines.contains("\npack\nusable  unknown: the cells have not been compared yet\n"), "{lines}");
}
