//! Tests cell models that are built from a label, that is, from chemistry and rated capacity (`score --chemistry`), and
//! models that are fitted to ordinary drives (`fit --log`), on simulated and measured cells.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::cell::circuit::{self, BranchAt};
use packwatch::cell::{CellModel, Chemistry, Discretisation, Label};
use serde_json::Value;

use crate::support::measured;

/// True capacity of the simulated cell (Ah); its label says 3.
const TRUE_AH: f64 = 2.7;
/// Resistances of the simulated cell, relative to the typical resistances of its chemistry.
const RESISTANCE: f64 = 1.4;

fn run(args: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::cargo_bin("packwatch").unwrap().args(args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

fn json(args: &[&str]) -> Value {
    let (code, out, error) = run(args);
    assert_eq!(code, Some(0), "{args:?}: {error}");
    serde_json::from_str(&out).unwrap()
}

/// The true cell. At medium SOC, its open-circuit curve is 15 mV above the typical curve of its chemistry. Its capacity
/// differs from the label.
fn true_model() -> CellModel {
    let mut model = Label::usual(Chemistry::NcaGraphite, TRUE_AH).model().unwrap();
    let soc = model.soc.clone();
    for row in &mut model.ocv_v.values {
        row.iter_mut().zip(&soc).for_each(|(v, soc)| *v += 0.06 * soc * (1.0 - soc));
    }
    model
}

/// Writes a drive from `soc` to 15 %: 20 s at 2C, 20 s at C/2 and 20 s of rest, repeated for 40 min. A rest of 10 min
/// follows, and then the drive continues.
fn drive(folder: &Path, name: &str, mut soc: f64, seed: u32) -> PathBuf {
    let model = true_model();
    let mut text = "time_s,current_a,voltage_v,temperature_c,discharged_ah\n".to_owned();
    let mut branch_v = [0.0; 3];
    let (mut second, first) = (0_u32, soc);
    while soc > 0.15 {
        let phase = second.wrapping_add(7 * seed) % 60;
        let is_rest = second % 3000 > 2400;
        let current_a = if is_rest || phase >= 40 {
            0.0
        } else if phase < 20 {
            2.0 * TRUE_AH
        } else {
            0.5 * TRUE_AH
        };
        let position = model.grid_position(soc, 25.0);
        for (i, v) in branch_v.iter_mut().enumerate() {
            let branch = BranchAt::new(&model, i, &position, RESISTANCE);
            *v = branch.voltage_after(Discretisation::Exact, *v, current_a, 1.0);
        }
        soc = circuit::soc_after(soc, current_a, TRUE_AH);
        let position = model.grid_position(soc, 25.0);
        let voltage_v = circuit::terminal_v(&model, &position, RESISTANCE, branch_v.iter().sum(), current_a);
        writeln!(text, "{second},{current_a},{voltage_v:.5},25,{:.6}", TRUE_AH * (1.0 - soc)).unwrap();
        second += 1;
    }
    assert!(first > soc);
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

/// Root mean square SOC error in points, and fraction of samples inside the interval, from the first score.
fn soc_score(args: &[&str]) -> (f64, f64) {
    let found = json(args);
    let soc = &found["scores"][0]["soc"];
    (soc["rmse_points"].as_f64().unwrap(), soc["coverage"].as_f64().unwrap())
}

const LABEL: [&str; 4] = ["--chemistry", "nca-graphite", "--rated", "3"];

#[test]
fn partial_drives_give_capacity_and_curve() {
    let folder = tempfile::tempdir().unwrap();
    let paths = [
        drive(folder.path(), "a.csv", 0.97, 1),
        drive(folder.path(), "b.csv", 0.8, 2),
        drive(folder.path(), "c.csv", 0.9, 3),
    ];
    let [a, b, c] = paths.each_ref().map(|path| path.to_str().unwrap());
    let model = folder.path().join("model.toml");
    let model = model.to_str().unwrap();
    let fit = [&["fit", "--json", "--log", a, b, "-o", model][..], &LABEL].concat();
    let found = json(&fit);
    let capacity_ah = found["capacity_ah"].as_f64().unwrap();
    assert!((capacity_ah / TRUE_AH - 1.0).abs() < 0.03, "{capacity_ah}");
    let bytes = std::fs::read(model).unwrap();
    json(&fit);
    assert_eq!(std::fs::read(model).unwrap(), bytes, "the same logs give the same model");

    let (label_rmse, label_inside) =
        soc_score(&[&["score", "--json", "--truth-capacity", "2.7", c][..], &LABEL].concat());
    let (rmse, inside) = soc_score(&["score", "--json", "--truth-capacity", "2.7", "--cell", model, c]);
    assert!(
        label_inside > 0.95 && inside > 0.95,
        "inside the interval: {label_inside} by the label, {inside} by the fit"
    );
    assert!(rmse < 1.5 && rmse < 0.6 * label_rmse, "RMSE {rmse} by the fit, {label_rmse} by the label");
}

#[test]
fn log_fit_names_missing_data() {
    let folder = tempfile::tempdir().unwrap();
    let short = folder.path().join("short.csv");
    std::fs::write(&short, "time_s,current_a,voltage_v\n0,1,3.7\n1,1,3.7\n").unwrap();
    let (short, out) = (short.to_str().unwrap(), folder.path().join("m.toml"));
    let out = out.to_str().unwrap();
    let (code, _, error) = run(&["fit", "--log", short, "-o", out]);
    assert_eq!(code, Some(2), "{error}");
    assert!(error.contains("--config") && error.contains("--chemistry"), "{error}");
    let (code, _, error) = run(&[&["fit", "--log", short, "-o", out][..], &LABEL].concat());
    assert_eq!(code, Some(1), "{error}");
    assert!(error.contains("no stretch of 20 readings with current and voltage in the logs"), "{error}");
    let unlike = ["--chemistry", "lfp-graphite", "--rated", "3", "--voltage-min", "3.9", "--voltage-max", "4.4"];
    let (code, _, error) = run(&[&["score", short][..], &unlike].concat());
    assert_eq!(code, Some(78), "{error}");
    assert!(
        error.contains("3.9 to 4.4 V is not a plausible range for lfp-graphite (typical: 2.5 to 3.65 V)"),
        "{error}"
    );
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn two_drives_identify_measured_cell() {
    let file =
        |name: &str| measured::path(&format!("panasonic_18650pf/25C/{name}.csv.gz")).to_str().unwrap().to_owned();
    let (a, b, c) = (file("Cycle_1"), file("Cycle_2"), file("NN"));
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model.toml");
    let model = model.to_str().unwrap();
    let label = ["--chemistry", "nca-graphite", "--rated", "2.9"];
    let truth = ["score", "--json", "--truth-capacity", "2.99", &c];
    // This cell in tests/label.md: 2.9 points with the label's model, 0.5 points after the fit to two drives.
    let (label_rmse, label_inside) = soc_score(&[&truth[..], &label].concat());
    assert!(label_rmse < 4.0 && label_inside > 0.85, "{label_rmse} {label_inside}");
    json(&[&["fit", "--json", "--log", &a, &b, "-o", model][..], &label].concat());
    let (rmse, inside) = soc_score(&[&truth[..], &["--cell", model]].concat());
    assert!(rmse < 1.0 && inside > 0.85, "{rmse} {inside}");
}
