//! Tests the examples: the log with its DBC and configuration, both listening ECUs, and the core as a library.

use std::fs;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use assert_cmd::Command;

#[expect(dead_code, reason = "`main` is not called: the test passes its own input")]
#[path = "../../examples/core_as_library.rs"]
mod core_as_library;
#[expect(dead_code, reason = "`main` is not called: the test passes its own input")]
#[path = "../../examples/listen.rs"]
mod listen;

const HEARD: &str = "1700000000.1 status valid, SOC 27.8 %\n\
                     1700000175.1 alarm SocLow warning pack active: 20, threshold 20\n";
/// Maximum total size of the example's files, so that a clone stays small.
const MOST_BYTES: u64 = 50_000;

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn pack(name: &str) -> PathBuf {
    repository().join("examples/pack").join(name)
}

/// A folder with `frames.log` and `events.jsonl` of a replay of the example.
fn replayed() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.current_dir(folder.path()).arg("replay").arg("-c").arg(pack("pack.toml")).arg(pack("drive.log"));
    command.args(["--frames", "frames.log", "--events", "events.jsonl"]).assert().success();
    folder
}

#[test]
fn example_pack_is_small_and_passes_check() {
    let files = fs::read_dir(repository().join("examples/pack")).unwrap();
    let bytes: u64 = files.map(|file| file.unwrap().metadata().unwrap().len()).sum();
    assert!(bytes < MOST_BYTES, "{bytes} bytes");
    Command::cargo_bin("packwatch").unwrap().arg("check").arg(pack("pack.toml")).assert().success();
}

#[test]
fn example_listener_reports_state_and_alarm() {
    let folder = replayed();
    let dbc = fs::read_to_string(repository().join("config/packwatch.dbc")).unwrap();
    let frames = BufReader::new(fs::File::open(folder.path().join("frames.log")).unwrap());
    let mut out = Vec::new();
    listen::listen(&dbc, frames, &mut out).unwrap();
    assert_eq!(String::from_utf8(out).unwrap(), HEARD);
}

#[test]
fn example_listener_in_python_agrees() {
    let Some(python) = std::env::var_os("PACKWATCH_PYTHON") else {
        println!("skipped: PACKWATCH_PYTHON names no Python with python-can and cantools");
        return;
    };
    let folder = replayed();
    let script = repository().join("examples/listen.py");
    let output = Command::new(python).arg(script).arg(folder.path().join("frames.log")).assert().success();
    assert_eq!(String::from_utf8_lossy(&output.get_output().stdout), HEARD);
}

#[test]
fn example_core_gives_events_of_replay() {
    let folder = replayed();
    let mut out = Vec::new();
    core_as_library::monitor_log(&pack("pack.toml"), &pack("drive.log"), &mut out).unwrap();
    let events = fs::read_to_string(folder.path().join("events.jsonl")).unwrap();
    let frames = fs::read_to_string(folder.path().join("frames.log")).unwrap().lines().count();
    let out = String::from_utf8(out).unwrap();
    let rest = out.strip_prefix(&events).unwrap_or_else(|| panic!("{out}\nmust begin with\n{events}"));
    assert!(rest.starts_with("SOC 18.7 %") && rest.ends_with(&format!("{frames} frames to send\n")), "{rest}");
}
