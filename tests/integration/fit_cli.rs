//! Runs `packwatch fit` as a user does.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use serde_json::Value;

use crate::support::measured;

fn packwatch() -> Command {
    Command::cargo_bin("packwatch").unwrap()
}

/// Pulses of 2 A for 60 s every 120 s, from a full 1 Ah cell of 50 mohm, one row per second.
fn pulses(folder: &Path, rows: u32, first_v: f64) -> PathBuf {
    let mut text = "time_s,current_a,voltage_v\n".to_owned();
    let mut out_ah = 0.0;
    for k in 0..rows {
        let current = if k % 120 < 60 { 0.0 } else { 2.0 };
        out_ah += current / 3600.0;
        let voltage = first_v - 1.0 * out_ah - 0.05 * current;
        writeln!(text, "{k},{current},{voltage:.5}").unwrap();
    }
    let path = folder.join("pulses.csv");
    std::fs::write(&path, text).unwrap();
    path
}

/// Standard error of a fit that must fail with code 1 and write no model.
fn refused(folder: &Path, args: &[&str]) -> String {
    let model = folder.join("model.toml");
    let output = packwatch().arg("fit").args(["--name", "cell", "-o"]).arg(&model).args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{args:?}");
    assert!(output.stdout.is_empty() && !model.exists());
    String::from_utf8(output.stderr).unwrap().replace(&format!("{}/", folder.display()), "")
}

#[test]
fn simple_cell_is_fitted_and_model_loads() {
    let folder = tempfile::tempdir().unwrap();
    let file = pulses(folder.path(), 3500, 4.2);
    let model = folder.path().join("model.toml");
    let run = || {
        let named = ["fit", "--json", "--branches", "1", "--name", "a \"cell\"", "-o"];
        let output = packwatch().args(named).arg(&model).arg(&file).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let json: Value = serde_json::from_slice(&output.stdout).unwrap();
        (json, std::fs::read(&model).unwrap())
    };
    let ((json, first), (_, second)) = (run(), run());
    assert!(json["rmse_v"].as_f64().unwrap() < 0.002, "{json}");
    assert_eq!(json["files"][0]["rows"], 3500);
    assert!(json["seconds"].as_f64().unwrap() > 0.0);
    assert!(first == second, "two runs gave different models");
    let loaded = packwatch::config::cell_model::load(&model).unwrap();
    assert_eq!(loaded.name, "a \"cell\"");
    let place = loaded.grid_position(0.5, 25.0);
    assert!((loaded.settled_ohm(&place) - 0.05).abs() < 0.007, "{}", loaded.settled_ohm(&place));
    assert!((loaded.capacity_ah - 0.9444).abs() < 0.03, "{}", loaded.capacity_ah);
}

#[test]
fn unusable_data_is_rejected_with_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    pulses(folder.path(), 3500, 3.6);
    let found = refused(folder.path(), &["--voltage-max", "4.2", &path("pulses.csv")]);
    assert_eq!(found, "pulses.csv: begins at 3.6 V, expected a full cell (at least 4.10 V): its SOC is unknown\n");
    pulses(folder.path(), 300, 4.2);
    let found = refused(folder.path(), &["--capacity", "1", &path("pulses.csv")]);
    assert_eq!(found, "the data cover SOC 0.93 to 1.00, at least 0.5 of the range is needed\n");
    std::fs::write(path("rest.csv"), "time_s,current_a,voltage_v\n0,0,4.2\n1,0,4.2\n").unwrap();
    assert_eq!(refused(folder.path(), &["--voltage-min", "3", &path("rest.csv")]), "no discharge in the data\n");
    let missing = refused(folder.path(), &[&path("nowhere.csv")]);
    assert!(missing.starts_with("nowhere.csv: "), "{missing}");
    let no_cycles = refused(folder.path(), &["--first-cycles", "3", &path("pulses.csv")]);
    assert_eq!(no_cycles, "pulses.csv: --first-cycles needs the columns cycle and type\n");
    let disagree = refused(folder.path(), &["--branches", "2", "--tau", "10", &path("pulses.csv")]);
    assert_eq!(disagree, "--tau has 1 values, --branches is 2: must agree\n");
    let falling = refused(folder.path(), &["--temperatures", "25,0", &path("pulses.csv")]);
    assert_eq!(falling, "--temperatures: 0 follows 25, must rise\n");
    let many = refused(folder.path(), &["--branches", "4", &path("pulses.csv")]);
    assert_eq!(many, "--branches = 4, must be 1 to 3\n");
    let open = refused(folder.path(), &["--soc-nodes", "0,0.5", &path("pulses.csv")]);
    assert_eq!(open, "--soc-nodes = 0.5, must be a list that ends with 1\n");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn paper_pulse_test_fits_within_10_mv() {
    let file = measured::path("nasa_randomized/RW9_pulsed_discharge_1hz.csv.gz");
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("rw9.toml");
    let output = packwatch().args(["fit", "--json", "--name", "RW9", "-o"]).arg(&model).arg(file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(json["rmse_v"].as_f64().unwrap() < 0.005, "{json}");
    assert!(json["seconds"].as_f64().unwrap() < 10.0, "{json}");
    packwatch::config::cell_model::load(&model).unwrap();
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn first_cycles_give_discharge_and_charge_model() {
    let file = measured::path("nasa_pcoe_aging/B0005.csv.gz");
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("b0005.toml");
    let limits = ["--voltage-min", "2.7", "--voltage-max", "4.2", "--first-cycles", "10"];
    let output =
        packwatch().args(["fit", "--name", "B0005", "-o"]).arg(&model).args(limits).arg(file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::fs::read_to_string(&model).unwrap();
    let residual = |key: &str| {
        let line = text.lines().find(|line| line.starts_with(key)).unwrap();
        line.split(" = ").nth(1).unwrap().parse::<f64>().unwrap()
    };
    assert!(residual("residual_discharge_rmse_mv") < 7.5);
    assert!(residual("residual_charge_rmse_mv") < 12.5);
    let loaded = packwatch::config::cell_model::load(&model).unwrap();
    assert!((loaded.capacity_ah - 1.92).abs() < 0.01, "{}", loaded.capacity_ah);
    let thermal = loaded.thermal.unwrap();
    assert!((60.0..100.0).contains(&thermal.heat_capacity_j_per_k), "{thermal:?}");
}
