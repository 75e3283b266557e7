//! A measured cell's whole life (NASA PCoE B0005) through `packwatch replay`, against its published capacities.
//!
//! The published capacity is what 2 A delivers down to 2.7 V, so it is held against the usable capacity. Discharge
//! numbers count from 1; published values first fall below 1.4 Ah at discharge 125 and never below 1.2 Ah.
#![expect(clippy::unwrap_used, reason = "helpers of tests: a missing piece is a failed test")]

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// The measured data, or `None` where it is not.
#[expect(clippy::print_stdout, reason = "a skipped test says so")]
fn data() -> Option<PathBuf> {
    let root = std::env::var_os("PACKWATCH_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = root.join("nasa_pcoe_aging");
    if folder.join("B0005.csv.gz").is_file() {
        return Some(folder);
    }
    println!("SKIPPED: no measured data in {}", root.display());
    None
}

/// One discharge of the table: when it started (s) and its published capacity (Ah).
struct Discharge {
    start_s: f64,
    capacity_ah: f64,
}

fn discharges(folder: &Path) -> Vec<Discharge> {
    let mut table = csv::Reader::from_path(folder.join("B0005_cycles.csv")).unwrap();
    let rows = table.records().map(Result::unwrap).filter(|row| &row[1] == "discharge");
    rows.map(|row| Discharge { start_s: seconds(&row[2]), capacity_ah: row[4].parse().unwrap() }).collect()
}

/// `2008-04-02T15:25:41.593` as UTC; all of the record is in April and May 2008.
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

/// The shipped configuration with `changes` made to its text, beside absolute paths, as a file in `folder`.
fn configuration(folder: &Path, changes: &[(&str, &str)], more: &str) -> PathBuf {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let mut text = std::fs::read_to_string(shipped.join("measured.toml")).unwrap();
    for file in ["cells/nasa_b0005.toml", "measured.dbc"] {
        text = text.replace(&format!("\"{file}\""), &format!("{:?}", shipped.join(file)));
    }
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = folder.join("config.toml");
    std::fs::write(&path, text + more).unwrap();
    path
}

fn replay(config: &Path, data: &Path, more: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_packwatch"))
        .args(["replay", "-c"])
        .arg(config)
        .arg(data.join("B0005.csv.gz"))
        .arg("--start-times")
        .arg(data.join("B0005_cycles.csv"))
        .args(more)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn events(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Number of the latest discharge begun by the event's time.
fn discharge_of(event: &Value, discharges: &[Discharge]) -> usize {
    let time_s = event["time"].as_f64().unwrap() * 1e-9;
    discharges.iter().filter(|discharge| discharge.start_s <= time_s).count()
}

/// After each discharge from number 11 on: error of the usable capacity and its standard deviation, Ah.
fn usable_errors(events: &[Value], discharges: &[Discharge]) -> Vec<(f64, f64)> {
    let mut errors = Vec::new();
    let mut mode = "";
    for event in events {
        match event["event"].as_str().unwrap() {
            "half_cycle" => mode = event["mode"].as_str().unwrap(),
            "capacity" if mode == "discharge" => {
                let number = discharge_of(event, discharges);
                let usable = event["usable_capacity_ah"].as_f64().unwrap();
                let std = event["usable_capacity_std_ah"].as_f64().unwrap();
                if number > 10 {
                    errors.push((usable - discharges[number - 1].capacity_ah, std));
                }
            }
            _ => {}
        }
    }
    errors
}

#[test]
fn the_alarm_comes_at_the_end_of_life_and_not_before() {
    let Some(data) = data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let lower = "\n[[alarm]]\nrule = \"usable_capacity_low\"\nthreshold = 1.2\nseverity = \"warning\"\n";
    let config = configuration(folder.path(), &[], lower);
    let path = folder.path().join("events.jsonl");
    replay(&config, &data, &["--events", path.to_str().unwrap()]);
    let (events, discharges) = (events(&path), discharges(&data));
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
    assert!((120..=130).contains(&at), "published below 1.4 Ah at discharge 125, alarm at {at}");
    assert_eq!(raised(1.2), None, "published never below 1.2 Ah");
}

#[test]
fn usable_capacity_follows_the_published_one_from_a_start_twenty_percent_wrong() {
    let Some(data) = data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let discharges = discharges(&data);
    for start_ah in ["1.54", "2.31"] {
        let start = format!("[pack]\ninitial_capacity_ah = {start_ah}\n");
        let config = configuration(folder.path(), &[("[pack]\n", &start)], "");
        let path = folder.path().join("events.jsonl");
        replay(&config, &data, &["--events", path.to_str().unwrap()]);
        let errors = usable_errors(&events(&path), &discharges);
        assert!(errors.len() > 150, "{} discharges seen", errors.len());
        let count = errors.len() as f64;
        let mean_absolute = errors.iter().map(|(error, _)| error.abs()).sum::<f64>() / count;
        let covered = errors.iter().filter(|(error, std)| error.abs() < 1.96 * std).count() as f64 / count;
        println!(
            "started at {start_ah} Ah: mean absolute error {mean_absolute:.4} Ah, 95 % interval covers {covered:.3}"
        );
        assert!(mean_absolute < 0.025, "{mean_absolute} Ah");
        assert!(covered > 0.85, "{covered}");
    }
}

#[test]
fn one_log_twice_is_the_same_bytes() {
    let Some(data) = data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let config = configuration(folder.path(), &[], "");
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
        assert!(first == second, "{kind} differ");
    }
}
