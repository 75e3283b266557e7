//! Tests state and history with `replay --state`, `history` and `reset`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::Command;
use serde_json::Value;

fn packwatch(args: &[&str]) -> Output {
    let mut command = Command::cargo_bin("packwatch").expect("Cargo builds the binary");
    // Do not contact a daemon that runs on this machine.
    command.env("RUNTIME_DIRECTORY", "/nonexistent").args(args).output().expect("the binary starts")
}

fn good(args: &[&str]) -> String {
    let output = packwatch(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

fn bad(args: &[&str]) -> String {
    let output = packwatch(args);
    assert_eq!(output.status.code(), Some(1), "{args:?}: {}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8(output.stderr).expect("text")
}

fn log(folder: &Path) -> String {
    let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
    let mut soc: f64 = 0.9;
    for second in 0..7_200_u32 {
        let current_a = if second / 900 % 2 == 0 { 2.0 } else { -2.0 };
        soc -= current_a / 3600.0 / 2.6;
        let voltage_v = 3.3 + 0.8 * soc - 0.05 * current_a;
        text.push_str(&format!("{},{current_a},{voltage_v:.4},24.5\n", 1_700_000_000 + second));
    }
    let path = folder.join("cell.csv");
    fs::write(&path, text).expect("written");
    path.display().to_string()
}

struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn filled() -> Self {
        let place = Self { folder: tempfile::tempdir().expect("a folder") };
        let log = log(place.folder.path());
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml");
        let snapshot = place.path("end.json");
        let config = config.display().to_string();
        good(&["replay", "-c", &config, &log, "--state", &place.state(), "--snapshot", &snapshot]);
        place
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    fn state(&self) -> String {
        self.path("state")
    }

    fn database(&self) -> PathBuf {
        self.folder.path().join("state/packwatch.db")
    }

    fn rows(&self, args: &[&str]) -> Vec<Value> {
        let state = self.state();
        let text = good(&[&["history", "--state", &state, "--json", "--limit", "0"], args].concat());
        let document: Value = serde_json::from_str(&text).expect("JSON");
        document["rows"].as_array().expect("rows").clone()
    }
}

#[test]
fn replay_stores_learned_values_in_history() {
    let place = Place::filled();
    let state = place.state();
    let capacities = place.rows(&["--kind", "capacity"]);
    assert!(capacities.len() >= 5, "{capacities:?}");
    assert!(capacities.iter().all(|row| row["kind"] == "capacity" && row["cell"] == 0 && row["pack"] == 1));
    assert_eq!(place.rows(&["--kind", "half-cycle"]).len(), place.rows(&["--kind", "half-cycle", "--cell", "1"]).len());
    assert!(place.rows(&["--cell", "2"]).is_empty());
    let late = place.rows(&["--since", "1700003000"]);
    assert!(!late.is_empty() && late.len() < place.rows(&[]).len());
    let table = good(&["history", "--state", &state, "--limit", "3"]);
    assert_eq!(table.lines().count(), 4, "{table}");
    let csv = good(&["history", "--state", &state, "export", "--kind", "capacity"]);
    assert_eq!(csv.lines().count(), capacities.len() + 1);
    assert!(csv.starts_with("kind,seq,wall_ns,utc,time_ns,boot,pack,cell,measured_ah,"), "{csv}");
    assert!(good(&["history", "--state", &state, "verify"]).contains("none changed"));
}

#[test]
fn vehicle_appears_in_all_outputs() {
    let place = Place { folder: tempfile::tempdir().expect("a folder") };
    let log = log(place.folder.path());
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let names =
        ["measured.toml", "measured.dbc", "cells/nasa_b0005.toml", "cells/example_nmc_2600.toml", "packwatch.dbc"];
    fs::create_dir_all(place.folder.path().join("cells")).expect("created");
    for name in names {
        fs::copy(shipped.join(name), place.folder.path().join(name)).expect("copied");
    }
    let config = place.path("measured.toml");
    fs::create_dir(format!("{config}.d")).expect("created");
    let vehicle = "[vehicle]\nname = \"Bus 12\"\nid = \"WDB1\"\npack = \"front\"\n";
    fs::write(format!("{config}.d/vehicle.toml"), vehicle).expect("written");
    let (events, state) = (place.path("events.jsonl"), place.state());
    good(&["replay", "-c", &config, &log, "--state", &state, "--events", &events]);
    let head = r#"{"vehicle":{"id":"WDB1","name":"Bus 12","pack":"front"}}"#;
    assert_eq!(fs::read_to_string(&events).expect("events").lines().next(), Some(head));
    let table = good(&["history", "--state", &state]);
    assert_eq!(table.lines().next(), Some("Bus 12 (WDB1), pack front"));
    let document: Value = serde_json::from_str(&good(&["history", "--state", &state, "--json"])).expect("JSON");
    assert_eq!(document["vehicle"]["pack"], "front");
    assert!(good(&["check", &config]).contains("\nvehicle\n  Bus 12 (WDB1), pack front\n"));
    in_report_and_export(&place, &config, &log);
}

#[cfg(feature = "lab")]
fn in_report_and_export(place: &Place, config: &str, log: &str) {
    let (page, out) = (place.path("page.html"), place.path("tables"));
    good(&["report", "--state", &place.state(), "-o", &page]);
    let title = "<title>Bus 12 (WDB1), pack front</title>";
    assert!(fs::read_to_string(&page).expect("a page").contains(title), "no {title}");
    good(&["export", "-c", config, log, "-o", &out]);
    let about = fs::read_to_string(format!("{out}/cell/about.json")).expect("about.json");
    let about: Value = serde_json::from_str(&about).expect("JSON");
    assert_eq!(about["metadata"]["packwatch.vehicle_id"], "WDB1");
}

#[cfg(not(feature = "lab"))]
fn in_report_and_export(_: &Place, _: &str, _: &str) {}

#[test]
fn verify_names_first_changed_rows() {
    let place = Place::filled();
    let before = fs::read(place.database()).expect("read");
    let rows = place.rows(&["--kind", "capacity"]);
    let wanted = rows[2]["capacity_ah"].as_f64().expect("a number").to_be_bytes();
    let at = before.windows(8).position(|window| window == wanted).expect("the capacity is in the file");
    let mut after = before.clone();
    after[at + 7] ^= 1;
    fs::write(place.database(), after).expect("written");
    let printed = bad(&["history", "--state", &place.state(), "verify"]);
    assert!(printed.contains("rows 1 to ") && printed.contains(" (segment 1) were changed: expected "), "{printed}");
}

#[test]
fn replay_rejects_existing_history() {
    let place = Place::filled();
    let log = place.path("cell.csv");
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml").display().to_string();
    let before = fs::read(place.database()).expect("read");
    let printed = bad(&["replay", "-c", &config, &log, "--state", &place.state()]);
    assert!(printed.contains("already contains a state; a replay needs a new state folder"), "{printed}");
    assert_eq!(fs::read(place.database()).expect("read"), before);
    let printed = bad(&["replay", "-c", &config, &log, "--state", &log]);
    assert!(printed.contains("is a file, must be a folder for state and history"), "{printed}");
}

#[test]
fn pack_change_without_daemon_starts_history() {
    let place = Place::filled();
    let (state, socket) = (place.state(), place.path("none.sock"));
    let reset = ["reset", "--pack-replaced", "--state", &state, "--control", &socket];
    assert!(bad(&reset).contains("--yes"));
    let printed = good(&[&reset[..], &["--yes"]].concat());
    assert!(printed.contains("closed the history of pack 1, started the history of pack 2"), "{printed}");
    let mut resets = place.rows(&["--kind", "reset"]);
    resets.retain(|row| row["reason"] != "filter_reset");
    assert_eq!(resets.len(), 1);
    assert_eq!((resets[0]["reason"].as_str(), resets[0]["pack"].as_i64()), (Some("pack_replaced"), Some(1)));
    assert!(resets[0]["capacity_ah"].as_f64().is_some_and(|ah| (1.0..4.0).contains(&ah)), "{resets:?}");
    assert!(good(&["history", "--state", &state, "verify"]).contains("none changed"));
    let nowhere = place.path("nowhere");
    let printed = bad(&["reset", "--pack-replaced", "--yes", "--state", &nowhere, "--control", &socket]);
    assert!(printed.contains("no daemon is running and no history found"), "{printed}");
}

#[test]
fn missing_or_foreign_history_is_reported() {
    let place = Place::filled();
    let printed = bad(&["history", "--state", &place.path("nowhere")]);
    assert!(printed.contains("no history found"), "{printed}");
    let mut bytes = fs::read(place.database()).expect("read");
    bytes[60..64].copy_from_slice(&99_u32.to_be_bytes());
    fs::write(place.database(), bytes).expect("written");
    let printed = bad(&["history", "--state", &place.state()]);
    assert!(printed.contains("format 99, must be 3"), "{printed}");
}
