//! Replays a measured drive with the model of another cell. Within half an hour, packwatch must notice that the model
//! does not fit: the estimate must become untrusted.
//!
//! Panasonic 18650PF and LG HG2 are both 18650 cells of nearly 3 Ah. Each drive runs with both models.

use std::path::Path;
use std::process::Command;

use crate::support::measured;
use serde_json::Value;

fn run(arguments: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_packwatch")).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Fits a model of the cell in `folder` to its slow discharge and some of its drives at 25 degrees C.
fn fit(folder: &Path, capacity_ah: &str, slow: &str, drives: &[&str], model: &Path) {
    let path = |name: &str| folder.join("25C").join(format!("{name}.csv.gz")).display().to_string();
    let (model, slow) = (model.display().to_string(), path(slow));
    let drives: Vec<String> = drives.iter().map(|name| path(name)).collect();
    let mut arguments = vec!["fit", "-o", &model, "--name", "cell", "--capacity", capacity_ah, "--ocv", &slow];
    arguments.extend(drives.iter().map(String::as_str));
    run(&arguments);
}

/// Time (s) from the first row until the estimate first becomes untrusted. `None` if it never does.
fn first_untrusted_s(folder: &Path, model: &Path, drive: &Path) -> Option<f64> {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let text = std::fs::read_to_string(shipped.join("score.toml")).unwrap();
    let text = text
        .replace("\"cells/example_nmc_2600.toml\"", &format!("{model:?}"))
        .replace("\"measured.dbc\"", &format!("{:?}", shipped.join("measured.dbc")));
    let (config, events) = (folder.join("replay.toml"), folder.join("events.jsonl"));
    std::fs::write(&config, text).unwrap();
    let path = |path: &Path| path.display().to_string();
    run(&["replay", "-c", &path(&config), &path(drive), "--sleep-gap", "90", "--events", &path(&events)]);
    let text = std::fs::read_to_string(&events).unwrap();
    let events = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let mut untrusted = events.filter(|event| event["event"] == "trust" && event["trusted"] == false);
    untrusted.next().map(|event| event["time"].as_f64().unwrap() / 1e9)
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn wrong_cell_model_is_untrusted_within_half_hour() {
    let root = measured::root();
    let folder = tempfile::tempdir().unwrap();
    let (panasonic, lg) = (root.join("panasonic_18650pf"), root.join("lg_18650hg2"));
    let models = ["panasonic.toml", "lg.toml"].map(|name| folder.path().join(name));
    fit(&panasonic, "2.995", "ocv_c20", &["Cycle_1", "NN"], &models[0]);
    fit(&lg, "2.781", "549_C20DisCh", &["551_Mixed1", "552_Mixed4"], &models[1]);
    for (drive, own, other) in [(panasonic.join("25C/HWFTa.csv.gz"), 0, 1), (lg.join("25C/551_Mixed2.csv.gz"), 1, 0)] {
        assert_eq!(first_untrusted_s(folder.path(), &models[own], &drive), None, "{drive:?}");
        let found_s = first_untrusted_s(folder.path(), &models[other], &drive);
        assert!(found_s.is_some_and(|found_s| found_s < 1800.0), "{drive:?}: {found_s:?}");
    }
}
