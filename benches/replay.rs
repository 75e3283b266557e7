//! Measures the time of the command `replay` for a whole log: read, parse, decode, estimate, encode.
#![expect(clippy::unwrap_used, reason = "a bench panics if its setup fails")]

use std::process::Command;

fn main() {
    divan::main();
}

/// Simulates ten minutes of the scenario `ev-day` with 96 cells. Returns the folder of the log.
fn log() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("day.log");
    let status = packwatch(&["simulate", "ev-day", "--duration", "600", "-o", log.to_str().unwrap()]).status();
    assert!(status.unwrap().success());
    folder
}

fn packwatch(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_packwatch"));
    command.args(arguments).args(["-c", concat!(env!("CARGO_MANIFEST_DIR"), "/config/example.toml")]);
    command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null());
    command
}

#[divan::bench(sample_count = 5, sample_size = 1)]
fn ten_minutes_of_96_cells(bencher: divan::Bencher) {
    let folder = log();
    let log = folder.path().join("day.log");
    let bytes = std::fs::metadata(&log).unwrap().len();
    bencher
        .counter(divan::counter::BytesCount::new(bytes))
        .bench_local(|| assert!(packwatch(&["replay", log.to_str().unwrap()]).status().unwrap().success()));
}
