//! Replays simulated lives. `cantools` decodes every sent frame with the DBC of `packwatch dbc`. The values must match
//! the replay's estimates and events within one step of the signal.

use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::Command;

use packwatch::can::e2e::Protection;

struct Life {
    config: String,
    simulate: &'static [&'static str],
    rated_capacity_ah: &'static str,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The value of `PACKWATCH_PYTHON`. If the variable is not set, prints a note and returns `None`.
fn python() -> Option<OsString> {
    let python = std::env::var_os("PACKWATCH_PYTHON");
    if python.is_none() {
        eprintln!("SKIPPED: PACKWATCH_PYTHON is not set to a Python with cantools");
    }
    python
}

fn packwatch(arguments: &[&str], folder: &Path) {
    let mut command = assert_cmd::Command::cargo_bin("packwatch").unwrap();
    command.current_dir(folder).args(arguments).assert().success();
}

/// A shipped configuration with some text replaced and with absolute file paths.
fn config(name: &str, replaced: &[(&str, &str)]) -> String {
    let mut text = fs::read_to_string(root().join("config").join(name)).unwrap();
    let folder = root().join("config").display().to_string();
    let files =
        ["measured.dbc", "pack96.dbc", "cells/"].map(|file| (format!("\"{file}"), format!("\"{folder}/{file}")));
    for (from, to) in replaced.iter().map(|(from, to)| ((*from).to_owned(), (*to).to_owned())).chain(files) {
        text = text.replace(&from, &to);
    }
    for (from, to) in replaced {
        assert!(text.contains(to), "{from}");
    }
    text
}

/// Writes the life's frames, estimates and events to `folder`. Returns the output of `tests/tools/life_decodes.py`.
/// Panics if a value disagrees.
fn decode(python: &OsString, life: &Life, folder: &Path) -> serde_json::Value {
    fs::write(folder.join("pack.toml"), &life.config).unwrap();
    let mut simulate = vec!["simulate", "paper", "-c", "pack.toml", "-o", "in.log"];
    simulate.extend(life.simulate);
    packwatch(&simulate, folder);
    let results = ["--frames", "out.log", "--events", "events.jsonl", "--estimates", "estimates.csv"];
    packwatch(&[&["replay", "-c", "pack.toml", "in.log"], &results[..]].concat(), folder);
    packwatch(&["dbc", "-c", "pack.toml", "-o", "out.dbc"], folder);
    let mut command = Command::new(python);
    command.current_dir(folder).arg(root().join("tests/tools/life_decodes.py"));
    command.args(["out.dbc", "out.log", "estimates.csv", "events.jsonl", life.rated_capacity_ah]);
    let output = command.output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let found: serde_json::Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    eprintln!(
        "{} cells: {} values in {}, {} changed without a report",
        found["cells"], found["values"], found["frames"], found["restated"]
    );
    let sent = fs::read_to_string(folder.join("out.log")).unwrap().lines().count();
    let frames = ["Status", "Health", "Alarm", "Digest"].map(|name| found["frames"][name].as_u64().unwrap());
    assert_eq!(frames.iter().sum::<u64>(), u64::try_from(sent).unwrap());
    assert!(
        found["restated"].as_u64().unwrap() < frames[1] / 100,
        "too many resistances changed without a report: {}",
        found["restated"]
    );
    found
}

fn count(found: &serde_json::Value, of: &str) -> u64 {
    found["per_signal"][of].as_u64().unwrap_or(0)
}

#[test]
fn life_frames_decode_to_replay_values() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let life = Life {
        config: config("paper.toml", &[("period_ms = 1000", "period_ms = 5000")]),
        simulate: &[],
        rated_capacity_ah: "2.6",
    };
    let found = decode(&python, &life, folder.path());
    assert!(found["frames"]["Status"].as_u64().unwrap() > 40_000, "a life of 2.2e5 s, every 5 s");
    assert_eq!(found["frames"]["Alarm at once"], 2, "capacity and recharge period");
    assert!(count(&found, "Alarm.Value_CapacityLow") > 10_000 && count(&found, "Health.RechargePeriod") > 40_000);
    assert!(found["unreported"].as_u64().unwrap() < 100, "only the unfinished charge at the log's end may be missing");
}

/// The example's pack, reduced to eight cells. Each kind of frame is protected by a different profile.
fn protected_pack() -> String {
    let whole = config("example.toml", &[]);
    let (before, sensors) = whole.split_once("[[input.temperature]]").unwrap();
    let after = sensors.rsplit_once("[[input.temperature]]").unwrap().1.split_once("\n\n").unwrap().1;
    let sensor = "[[input.temperature]]\nsignal = \"Temperatures.Temperature1\"\n\n";
    let mut text = format!("{before}{sensor}{after}");
    for (from, to) in [
        ("cells = 96 ", "cells = 8 "),
        ("fd = false", "fd = true"),
        ("max_age_s = 0.5", "max_age_s = 5.0"),
        ("period_ms = 1000", "period_ms = 5000"),
        (
            "[output.status]\nperiod_ms = 100",
            "[output.status]\nid = 0x18FF5001\nextended = true\nfd = true\ne2e = \"5\"\ndata_id = 0x101\nperiod_ms = 2500",
        ),
        ("[output.health]", "[output.health]\nfd = true\nbrs = true\ne2e = \"1C\"\ndata_id = 0x102"),
        (
            "[output.alarm]",
            "[output.digest]\ne2e = \"1C\"\ndata_id = 0x104\n[output.alarm]\ne2e = \"1A\"\ndata_id = 0x103",
        ),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    text
}

#[test]
fn protected_pack_frames_decode_to_replay_values() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let simulate = &[
        "--cycles",
        "16",
        "--loss-per-cycle",
        "0.1",
        "--resistance-per-cycle",
        "0.05",
        "--spread-capacity",
        "0.03",
        "--spread-soc",
        "0.02",
    ];
    let life = Life { config: protected_pack(), simulate, rated_capacity_ah: "2.6" };
    let found = decode(&python, &life, folder.path());
    assert_eq!(found["cells"], 8);
    assert!(
        found["frames"]["Alarm at once"].as_u64().unwrap() >= 8,
        "each cell has its own alarm: {}",
        found["frames"]
    );
    assert!(count(&found, "Health.UsableCapacity") > 10_000);
    let checked = check_headers(&folder.path().join("out.log"), &folder.path().join("pack.toml"));
    assert_eq!(checked, fs::read_to_string(folder.path().join("out.log")).unwrap().lines().count());
}

/// Verifies checksum and counter of every frame of a log. Returns the number of frames.
fn check_headers(log: &Path, config: &Path) -> usize {
    let plan = packwatch::config::load(config).unwrap().monitor.output.unwrap().plan;
    let messages: Vec<_> = plan.messages().map(|sent| (sent.id, sent.protection)).collect();
    let mut next = vec![None; messages.len()];
    let text = fs::read_to_string(log).unwrap();
    for line in text.lines() {
        let frame = line.split(' ').next_back().unwrap();
        let (id, data) = frame.split_once('#').unwrap();
        let data = data.strip_prefix('#').map_or(data, |fd| &fd[1..]);
        let byte = |place: usize| u8::from_str_radix(&data[place..place + 2], 16).unwrap();
        let payload: Vec<u8> = (0..data.len()).step_by(2).map(byte).collect();
        let which = messages.iter().position(|(known, _)| known.to_string() == id).unwrap();
        let protection: Protection = messages[which].1.unwrap();
        let counter = protection.verified_counter(&payload).unwrap_or_else(|| panic!("{line}"));
        assert!(next[which].is_none_or(|next| next == counter), "{line}");
        next[which] = Some(protection.profile.next_counter(counter));
    }
    text.lines().count()
}
