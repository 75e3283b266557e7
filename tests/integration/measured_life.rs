//! Replays whole lives of measured cells (NASA PCoE B0005, B0006) and compares the estimated capacities with the
//! published capacities.
//!
//! The published capacity is the charge delivered at 2 A down to 2.7 V, so the test compares it with the usable
//! capacity. The limit of 2.7 V applies to both cells, even where the cycler discharged further. Discharges are
//! numbered from 1. The published capacity first falls below 1.4 Ah at discharge 125 (B0005) and 109 (B0006). The
//! published capacity of B0005 never falls below 1.2 Ah. Each model was fitted only to its cell's first five cycles.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::measured;
use crate::support::window::{WindowUnit, windowed};
use serde_json::Value;

/// One discharge of the table: start time (s) and published capacity (Ah).
struct Discharge {
    start_s: f64,
    capacity_ah: f64,
}

fn discharges(folder: &Path, cell: &str) -> Vec<Discharge> {
    let mut table = csv::Reader::from_path(folder.join(format!("{cell}_cycles.csv"))).unwrap();
    let rows = table.records().map(Result::unwrap).filter(|row| &row[1] == "discharge");
    rows.map(|row| Discharge { start_s: seconds(&row[2]), capacity_ah: row[4].parse().unwrap() }).collect()
}

/// Parses `2008-04-02T15:25:41.593` as UTC. The whole record lies in April and May 2008.
fn seconds(stamp: &str) -> f64 {
    let number = |from: usize, to: usize| stamp[from..to].parse::<f64>().unwrap();
    let days = number(8, 10) - 1.0 + if number(5, 7) == 5.0 { 30.0 } else { 0.0 };
    let midnight_1_april = 1_207_008_000.0;
    midnight_1_april
        + days * 86_400.0
        + number(11, 13) * 3600.0
        + number(14, 16) * 60.0
        + stamp[17..].parse::<f64>().unwrap()
}

/// Writes the shipped configuration for `cell` to `folder`, with absolute paths and without outputs, which take half of
/// the time. `changes` are text replacements; `more` is appended.
fn configuration(folder: &Path, cell: &str, changes: &[(&str, &str)], more: &str) -> PathBuf {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let mut text = std::fs::read_to_string(shipped.join("measured.toml")).unwrap();
    let model = format!("cells/nasa_{}.toml", cell.to_lowercase());
    for (written, file) in [("cells/nasa_b0005.toml", model.as_str()), ("measured.dbc", "measured.dbc")] {
        text = text.replace(&format!("\"{written}\""), &format!("{:?}", shipped.join(file)));
    }
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let (inputs, _) = text.split_once("[output]").unwrap();
    let path = folder.join("config.toml");
    std::fs::write(&path, format!("{inputs}{more}")).unwrap();
    path
}

fn replay(config: &Path, data: &Path, more: &[&str]) {
    replay_rows(config, &data.join("B0005.csv.gz"), &data.join("B0005_cycles.csv"), more);
}

fn replay_rows(config: &Path, rows: &Path, start_times: &Path, more: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_packwatch"))
        .args(["replay", "-c"])
        .arg(config)
        .arg(rows)
        .arg("--start-times")
        .arg(start_times)
        .args(more)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn events(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Number of the last discharge that started before the event.
fn discharge_of(event: &Value, discharges: &[Discharge]) -> usize {
    let time_s = event["time"].as_f64().unwrap() * 1e-9;
    discharges.iter().filter(|discharge| discharge.start_s <= time_s).count()
}

struct UsableCapacityReport {
    discharge: usize,
    usable_ah: f64,
    std_ah: f64,
    error_ah: f64,
}

/// Usable capacities reported after each discharge, with their errors. The first ten discharges are left out.
fn usable_errors(events: &[Value], discharges: &[Discharge]) -> Vec<UsableCapacityReport> {
    let mut stated = Vec::new();
    let mut mode = "";
    for event in events {
        match event["event"].as_str().unwrap() {
            "half_cycle" => mode = event["mode"].as_str().unwrap(),
            "capacity" if mode == "discharge" => {
                let discharge = discharge_of(event, discharges);
                let usable_ah = event["usable_capacity_ah"].as_f64().unwrap();
                let std_ah = event["usable_capacity_std_ah"].as_f64().unwrap();
                if discharge > 10 {
                    let error_ah = usable_ah - discharges[discharge - 1].capacity_ah;
                    stated.push(UsableCapacityReport { discharge, usable_ah, std_ah, error_ah });
                }
            }
            _ => {}
        }
    }
    stated
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn alarm_comes_at_end_of_life() {
    let data = measured::path("nasa_pcoe_aging");
    let folder = tempfile::tempdir().unwrap();
    let lower = "\n[[alarm]]\nrule = \"usable_capacity_low\"\ninfo = 1.2\n";
    let config = configuration(folder.path(), "B0005", &[], lower);
    let path = folder.path().join("events.jsonl");
    replay(&config, &data, &["--events", path.to_str().unwrap()]);
    let (events, discharges) = (events(&path), discharges(&data, "B0005"));
    let raised = |threshold: f64| {
        let about = |event: &&Value| event["event"] == "alarm" && event["rule"] == "usable_capacity_low";
        events
            .iter()
            .filter(about)
            .find(|event| event["active"] == true && event["threshold"] == threshold)
            .map(|event| discharge_of(event, &discharges))
    };
    let at = raised(1.4).expect("the cell falls below 1.4 Ah");
    println!("alarm at 1.4 Ah after discharge {at}");
    assert!((120..=130).contains(&at), "the published capacity is below 1.4 Ah from discharge 125, alarm at {at}");
    assert_eq!(raised(1.2), None, "the published capacity never falls below 1.2 Ah");
}

struct Score {
    mean_absolute_ah: f64,
    covered: f64,
    /// Number of the first discharge after which the estimated usable capacity was below 1.4 Ah.
    first_below: Option<usize>,
}

fn score(events: &[Value], discharges: &[Discharge]) -> Score {
    let errors = usable_errors(events, discharges);
    assert!(errors.len() > 145, "{} discharges seen", errors.len());
    let count = errors.len() as f64;
    Score {
        mean_absolute_ah: errors.iter().map(|e| e.error_ah.abs()).sum::<f64>() / count,
        covered: errors.iter().filter(|e| e.error_ah.abs() < 1.96 * e.std_ah).count() as f64 / count,
        first_below: errors.iter().find(|e| e.usable_ah < 1.4).map(|e| e.discharge),
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn usable_capacity_converges_from_wrong_start() {
    let data = measured::path("nasa_pcoe_aging");
    let folder = tempfile::tempdir().unwrap();
    for (cell, new_ah, end_of_life) in [("B0005", 1.9216, 125), ("B0006", 2.1059, 109)] {
        let discharges = discharges(&data, cell);
        for part in [0.8, 1.2] {
            let start = format!("[pack]\ninitial_capacity_ah = {}\n", new_ah * part);
            let config = configuration(folder.path(), cell, &[("[pack]\n", &start)], "");
            let path = folder.path().join("events.jsonl");
            let rows = data.join(format!("{cell}.csv.gz"));
            let times = data.join(format!("{cell}_cycles.csv"));
            replay_rows(&config, &rows, &times, &["--events", path.to_str().unwrap()]);
            let life = score(&events(&path), &discharges);
            println!(
                "{cell} started at {part} of its capacity: mean absolute error {:.4} Ah, covered {:.3}, below 1.4 Ah at {:?}",
                life.mean_absolute_ah, life.covered, life.first_below
            );
            assert!(life.mean_absolute_ah < 0.015, "{cell} {part}: {} Ah", life.mean_absolute_ah);
            assert!(life.covered > 0.9, "{cell} {part}: {}", life.covered);
            let at = life.first_below.expect("falls below 1.4 Ah");
            assert!(
                at.abs_diff(end_of_life) <= 3,
                "{cell} {part}: estimate below 1.4 Ah at discharge {at}, published {end_of_life}"
            );
        }
    }
}

/// For each run, seed and unit of the windows. A window is a random part of a charge or discharge. The monitor receives
/// only the rows in the windows.
const RUNS: [(u64, WindowUnit); 4] =
    [(1, WindowUnit::Duration), (2, WindowUnit::Duration), (3, WindowUnit::Charge), (4, WindowUnit::Charge)];

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn usable_capacity_is_learned_from_windows() {
    let data = measured::path("nasa_pcoe_aging");
    let folder = tempfile::tempdir().unwrap();
    let rows = folder.path().join("windows.csv");
    for cell in ["B0005", "B0006"] {
        let discharges = discharges(&data, cell);
        let (mut sum_ah, mut sum_covered) = (0.0, 0.0);
        for (seed, by) in RUNS {
            windowed(&data.join(format!("{cell}.csv.gz")), &rows, seed, by);
            let config = configuration(folder.path(), cell, &[], "");
            let path = folder.path().join("events.jsonl");
            let times = data.join(format!("{cell}_cycles.csv"));
            replay_rows(&config, &rows, &times, &["--events", path.to_str().unwrap()]);
            let life = score(&events(&path), &discharges);
            let by = format!("{by:?}").to_lowercase();
            println!(
                "{cell} in windows of its {by} (seed {seed}): mean absolute error {:.4} Ah, covered {:.3}",
                life.mean_absolute_ah, life.covered
            );
            assert!(life.mean_absolute_ah < 0.085, "{cell} {by} {seed}: {} Ah", life.mean_absolute_ah);
            (sum_ah, sum_covered) = (sum_ah + life.mean_absolute_ah, sum_covered + life.covered);
        }
        // The error of the voltage curve depends only on the SOC, so all windows of a run can be at unfavourable SOC
        // values. The mean of all runs must therefore be better than a single run.
        let (mean_ah, covered) = (sum_ah / RUNS.len() as f64, sum_covered / RUNS.len() as f64);
        assert!(mean_ah < 0.065, "{cell}: {mean_ah} Ah");
        // A 95 % interval should cover 95 % of the true values. This interval covers fewer, because it ignores that the
        // curve's errors differ between the two ends of a window.
        assert!(covered > 0.4, "{cell}: {covered}");
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn repeated_replay_is_byte_identical() {
    let data = measured::path("nasa_pcoe_aging");
    let folder = tempfile::tempdir().unwrap();
    let output = "[output]\n[output.status]\n[output.health]\n[output.alarm]\n";
    let config = configuration(folder.path(), "B0005", &[], output);
    let kinds = ["estimates", "events", "frames"];
    let mut runs = Vec::new();
    for run in ["first", "second"] {
        let paths = kinds.map(|kind| folder.path().join(format!("{run}.{kind}")));
        let mut arguments = vec!["--until".to_owned(), "+400000".to_owned()];
        for (kind, path) in kinds.iter().zip(&paths) {
            arguments.extend([format!("--{kind}"), path.to_str().unwrap().to_owned()]);
        }
        replay(&config, &data, &arguments.iter().map(String::as_str).collect::<Vec<_>>());
        runs.push(paths.map(|path| std::fs::read(path).unwrap()));
    }
    for (kind, (first, second)) in kinds.iter().zip(runs[0].iter().zip(&runs[1])) {
        assert!(first.len() > 10_000, "{kind}: {} bytes", first.len());
        assert!(first == second, "{kind} of the two runs differ");
    }
}
