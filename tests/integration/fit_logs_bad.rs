//! Tests `fit --log` with bad logs. The fitted model must not be worse than the model that packwatch makes from the
//! cell's label (chemistry and rated capacity). The output must name what the log lacks.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::cell::circuit::{self, BranchAt};
use packwatch::cell::{CellModel, Chemistry, Discretisation, Label};
use serde_json::Value;

/// Capacity of the simulated cell (Ah). `RESISTANCE` is its resistance relative to a typical cell of its chemistry.
const TRUE_AH: f64 = 50.0;
const RESISTANCE: f64 = 1.3;

#[derive(Clone, Copy)]
struct Drive {
    chemistry: Chemistry,
    capacity_ah: f64,
    /// SOC at the beginning and at the end.
    soc: (f64, f64),
    has_rests: bool,
    has_temperature: bool,
    /// Interval between rows (s).
    every_s: u32,
    /// Voltage resolution (V).
    step_v: f64,
    /// Error of the current sensor (A).
    offset_a: f64,
    /// Interval without rows (s): from, to.
    gap: (u32, u32),
}

const DRIVE: Drive = Drive {
    chemistry: Chemistry::NcaGraphite,
    capacity_ah: TRUE_AH,
    soc: (0.95, 0.15),
    has_rests: true,
    has_temperature: true,
    every_s: 1,
    step_v: 0.001,
    offset_a: 0.0,
    gap: (0, 0),
};

impl Drive {
    /// The true cell. At 50 % SOC, its open-circuit voltage is 15 mV above that of a typical cell of its chemistry.
    fn model(&self) -> CellModel {
        let mut model = Label::usual(self.chemistry, self.capacity_ah).model().unwrap();
        let soc = model.soc.clone();
        for row in &mut model.ocv_v.values {
            row.iter_mut().zip(&soc).for_each(|(v, soc)| *v += 0.06 * soc * (1.0 - soc));
        }
        model
    }

    /// Current at the given second (A). Repeats 20 s at 1C, 20 s at C/3 and 20 s of rest, with longer rests of 10 min.
    /// If `has_rests` is false, C/5 replaces the short rests, and the longer rests are left out. A charge has half of
    /// these currents.
    fn current_a(&self, second: u32) -> f64 {
        let discharge_a = match second % 60 {
            _ if self.has_rests && second % 3000 > 2400 => 0.0,
            0..20 => self.capacity_ah,
            20..40 => self.capacity_ah / 3.0,
            _ if self.has_rests => 0.0,
            _ => 0.2 * self.capacity_ah,
        };
        if self.soc.1 > self.soc.0 { -0.5 * discharge_a } else { discharge_a }
    }

    /// Appends the rows, starting at second `from`. Returns the second after the last row.
    fn write(&self, text: &mut String, from: u32) -> u32 {
        let model = self.model();
        let (mut soc, mut branch_v, mut second) = (self.soc.0, [0.0; 3], from);
        let falls = self.soc.1 < self.soc.0;
        while (soc > self.soc.1) == falls {
            let current_a = self.current_a(second - from);
            let position = model.grid_position(soc, 25.0);
            for (i, v) in branch_v.iter_mut().enumerate() {
                let branch = BranchAt::new(&model, i, &position, RESISTANCE);
                *v = branch.voltage_after(Discretisation::Exact, *v, current_a, 1.0);
            }
            soc = circuit::soc_after(soc, current_a, self.capacity_ah);
            let position = model.grid_position(soc, 25.0);
            let voltage_v = circuit::terminal_v(&model, &position, RESISTANCE, branch_v.iter().sum(), current_a);
            let voltage_v = (voltage_v / self.step_v).round() * self.step_v;
            if second.is_multiple_of(self.every_s) && !(self.gap.0..self.gap.1).contains(&(second - from)) {
                let temperature = if self.has_temperature { "25" } else { "" };
                let taken_ah = TRUE_AH * (1.0 - soc);
                writeln!(text, "{second},{:.3},{voltage_v:.4},{temperature},{taken_ah:.6}", current_a + self.offset_a)
                    .unwrap();
            }
            second += 1;
        }
        second
    }
}

fn log(folder: &Path, name: &str, drives: &[Drive]) -> PathBuf {
    let mut text = "time_s,current_a,voltage_v,temperature_c,discharged_ah\n".to_owned();
    let mut second = 0;
    for drive in drives {
        second = drive.write(&mut text, second);
    }
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

fn json(args: &[&str]) -> Value {
    let output = Command::cargo_bin("packwatch").unwrap().args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Root mean square SOC error in points, and fraction of samples within the interval.
fn score(args: &[&str]) -> (f64, f64) {
    let found = json(&[&["score", "--json", "--truth-capacity", "50"][..], args].concat());
    let soc = &found["scores"][0]["soc"];
    (soc["rmse_points"].as_f64().unwrap(), soc["coverage"].as_f64().unwrap())
}

/// Returns the notes of a fit to `logs`. Checks on another drive that the SOC error with the fitted model is less than
/// 0.3 points larger than the error with the model from the label.
fn notes_of_fit(folder: &Path, logs: &[PathBuf], label: &[&str]) -> Vec<String> {
    let model = folder.join("model.toml");
    let (model, judge) = (model.to_str().unwrap(), log(folder, "judge.csv", &[DRIVE]));
    let logs: Vec<&str> = logs.iter().map(|path| path.to_str().unwrap()).collect();
    let found = json(&[&["fit", "--json", "-o", model][..], label, &["--log"], &logs].concat());
    let judge = judge.to_str().unwrap();
    let (by_label, _) = score(&[label, &[judge]].concat());
    let (fitted, inside) = score(&["--cell", model, judge]);
    assert!(fitted < by_label + 0.3 && inside > 0.85, "{fitted} after {by_label}, {inside} inside: {found}");
    let notes = found["notes"].as_array().unwrap();
    notes.iter().map(|note| note.as_str().unwrap().to_owned()).collect()
}

const LABEL: [&str; 4] = ["--chemistry", "nca-graphite", "--rated", "50"];

#[test]
fn bad_log_model_is_no_worse_than_label() {
    let other_pack = Drive { capacity_ah: 0.8 * TRUE_AH, soc: (0.9, 0.4), ..DRIVE };
    let cases: [(&str, &[Drive], &str); 9] = [
        ("begins in the middle", &[Drive { soc: (0.6, 0.15), ..DRIVE }], ""),
        ("no rest", &[Drive { has_rests: false, ..DRIVE }], "no rest in the logs"),
        ("no temperature", &[Drive { has_temperature: false, ..DRIVE }], "no temperature in the logs"),
        ("charge only", &[Drive { soc: (0.2, 0.9), ..DRIVE }], "no discharge in the logs"),
        ("gaps", &[Drive { gap: (1000, 3000), ..DRIVE }], ""),
        (
            "another pack half-way",
            &[Drive { soc: (0.9, 0.5), ..DRIVE }, other_pack],
            "the voltages do not match any single cell",
        ),
        ("steps of 20 mV", &[Drive { step_v: 0.02, ..DRIVE }], "voltages in steps of 20 mV"),
        ("every 5 s", &[Drive { every_s: 5, ..DRIVE }], "readings every 5 s"),
        ("short", &[Drive { soc: (0.7, 0.62), ..DRIVE }], "the logs do not show the capacity"),
    ];
    for (name, drives, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        let logs = [log(folder.path(), "a.csv", drives)];
        let notes = notes_of_fit(folder.path(), &logs, &LABEL);
        assert!(notes.iter().any(|note| note.contains(expected)), "{name}: {notes:?}");
    }
}

#[test]
fn wrong_label_capacity_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let logs = [log(folder.path(), "a.csv", &[Drive { soc: (0.99, 0.1), ..DRIVE }])];
    let notes = notes_of_fit(folder.path(), &logs, &["--chemistry", "nca-graphite", "--rated", "60"]);
    let capacity: f64 = notes[0].split(' ').nth(1).unwrap().parse().unwrap();
    assert!((capacity / TRUE_AH - 1.0).abs() < 0.05, "{notes:?}");
}

#[test]
fn wrong_label_chemistry_is_named() {
    let cases = [
        (Chemistry::Nmc811Graphite, "lfp-graphite", true),
        (Chemistry::LfpGraphite, "nmc811-graphite", true),
        (Chemistry::NcaGraphite, "lco-graphite", true),
        (Chemistry::NcaGraphite, "nca-graphite", false),
        (Chemistry::LfpGraphite, "lfp-graphite", false),
    ];
    for (chemistry, on_label, is_wrong) in cases {
        let folder = tempfile::tempdir().unwrap();
        let path = log(folder.path(), "a.csv", &[Drive { chemistry, soc: (0.98, 0.1), ..DRIVE }]);
        let model = folder.path().join("model.toml");
        let found = json(&[
            "fit",
            "--json",
            "--log",
            path.to_str().unwrap(),
            "--chemistry",
            on_label,
            "--rated",
            "50",
            "-o",
            model.to_str().unwrap(),
        ]);
        let notes = found["notes"].as_array().unwrap();
        let names = |note: &Value| note.as_str().unwrap().contains(&format!("better than {on_label}, the chemistry"));
        assert_eq!(notes.iter().any(names), is_wrong, "{chemistry:?} on a label of {on_label}: {notes:?}");
    }
}

#[test]
fn current_offset_over_days_keeps_chemistry() {
    let folder = tempfile::tempdir().unwrap();
    // The sensor is off by C/50 for more than two days, so the counted charge is wrong by more than the capacity.
    let drive = Drive { offset_a: TRUE_AH / 50.0, every_s: 10, ..DRIVE };
    let (out, back) = (Drive { soc: (0.9, 0.2), ..drive }, Drive { soc: (0.2, 0.9), ..drive });
    let logs = [log(folder.path(), "a.csv", &[out, back].repeat(10))];
    let notes = notes_of_fit(folder.path(), &logs, &LABEL);
    let capacity: f64 = notes[0].split(' ').nth(1).unwrap().parse().unwrap();
    assert!((capacity / TRUE_AH - 1.0).abs() < 0.05, "{notes:?}");
    assert!(notes.iter().all(|note| !note.contains("the chemistry on the label")), "{notes:?}");
}
