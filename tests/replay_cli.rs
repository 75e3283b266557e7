//! `packwatch replay` as its user runs it, with the shipped configuration of a measured cell.

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml")
}

fn replay(args: &[&str]) -> assert_cmd::assert::Assert {
    let mut command = Command::cargo_bin("packwatch").expect("the binary is built");
    command.arg("replay").arg("-c").arg(config()).args(args).assert()
}

/// Half an hour of discharge pulses at 1 s.
fn log(folder: &Path) -> String {
    let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
    for second in 0..1800 {
        let current_a = if second % 60 < 40 { 2.0 } else { 0.0 };
        let voltage_v = 4.1 - 0.0002 * f64::from(second) - 0.1 * current_a;
        text.push_str(&format!("{second},{current_a},{voltage_v:.4},24.5\n"));
    }
    let path = folder.join("cell.csv");
    fs::write(&path, text).expect("written");
    path.display().to_string()
}

#[test]
fn replaying_twice_gives_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = log(folder.path());
    let results = ["1", "2"].map(|run| {
        let paths =
            ["estimates", "events", "frames", "snapshot"].map(|kind| folder.path().join(format!("{kind}{run}")));
        let [estimates, events, frames, snapshot] = paths.each_ref().map(|path| path.to_str().expect("UTF-8"));
        let files = ["--estimates", estimates, "--events", events, "--frames", frames, "--snapshot", snapshot];
        replay(&[&[log.as_str()], &files[..]].concat()).success();
        paths.map(|path| fs::read(path).expect("result written"))
    });
    assert_eq!(results[0], results[1]);
    let rows = String::from_utf8_lossy(&results[0][0]).lines().count();
    assert!((1700..=1801).contains(&rows), "{rows} estimates");
    assert!(!results[0][2].is_empty(), "frames are sent");
}

#[test]
fn the_summary_is_json_on_request() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = replay(&[&log(folder.path()), "--json"]).success().get_output().stdout.clone();
    let summary: serde_json::Value = serde_json::from_slice(&output).expect("JSON");
    assert_eq!(summary["frames"], 1800);
    assert_eq!(summary["bad_lines"], 0);
    assert!(summary["cells"][0]["soc"].as_f64().is_some_and(|soc| (0.0..=1.0).contains(&soc)), "{summary}");
}

#[test]
fn a_bad_line_is_fatal_only_when_strict() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.log");
    fs::write(&path, "(1.000000) vcan0 123#1\n").expect("written");
    let path = path.display().to_string();
    let shown = replay(&[&path]).success().get_output().stdout.clone();
    assert!(String::from_utf8_lossy(&shown).contains("a.log:1: column 22: found \"1\""));
    let strict = replay(&[&path, "--strict"]).code(1).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&strict).contains("a.log:1: column 22: found \"1\""));
}

#[test]
fn a_full_disk_is_an_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = replay(&[&log(folder.path()), "--estimates", "/dev/full"]).code(1).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&error).contains("/dev/full: cannot be written"));
}

#[test]
fn a_snapshot_beyond_the_log_is_an_error_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let snapshot = folder.path().join("state");
    let snapshot = snapshot.to_str().expect("UTF-8");
    replay(&[&log(folder.path()), "--snapshot", snapshot, "--snapshot-at", "+1e6"]).code(1);
    assert!(!Path::new(snapshot).exists());
}
