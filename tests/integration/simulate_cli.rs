//! Runs `packwatch simulate` and `packwatch demo` as a user does.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Output;

use packwatch::io::candump::{Line, parse_line};

fn config(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name).display().to_string()
}

fn packwatch(args: &[&str]) -> Output {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_packwatch"));
    command.args(args).output().expect("the binary starts")
}

/// Simulates half a minute of the scenario with 96 cells. Returns the paths of log and truth.
fn simulate_day(folder: &Path, name: &str, seed: &str) -> (PathBuf, PathBuf) {
    let (log, truth) = (folder.join(format!("{name}.log")), folder.join(format!("{name}.csv")));
    let (log_text, truth_text) = (log.display().to_string(), truth.display().to_string());
    let example = config("example.toml");
    let output = packwatch(&[
        "simulate",
        "ev-day",
        "-c",
        &example,
        "-o",
        &log_text,
        "--truth",
        &truth_text,
        "--seed",
        seed,
        "--duration",
        "30",
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    (log, truth)
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).expect("the file exists")
}

#[test]
fn seed_determines_output_bytes() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let first = simulate_day(folder.path(), "first", "3");
    let again = simulate_day(folder.path(), "again", "3");
    let other = simulate_day(folder.path(), "other", "4");
    assert!(bytes(&first.0) == bytes(&again.0) && bytes(&first.1) == bytes(&again.1));
    assert!(bytes(&first.0) != bytes(&other.0));
}

#[test]
fn two_cycles_of_day_take_two_days() {
    let truth = |cycles: &str| {
        let example = config("example.toml");
        let cells = ["--cells", "1", "--period", "1000", "--cell-period", "1000"];
        let output =
            packwatch(&[&["simulate", "ev-day", "-c", &example, "-o", "-", "--cycles", cycles], &cells[..]].concat());
        let words = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{words}");
        assert!(words.contains(&format!("{cycles} cycles completed")), "{words}");
        output.stdout.len()
    };
    let (one, two) = (truth("1"), truth("2"));
    assert!(two as f64 > 1.8 * one as f64, "truth of one cycle {one} bytes, of two {two}");
}

#[test]
fn log_is_ordered_candump_with_10_ms_current() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (log, _) = simulate_day(folder.path(), "day", "1");
    let log = bytes(&log);
    let (mut last_ns, mut currents) = (0, 0);
    for line in log.split(|&b| b == b'\n').filter(|line| !line.is_empty()) {
        match parse_line(line) {
            Ok(Line::Frame { time, frame, .. }) => {
                assert!(time.nanos() > last_ns, "{}", String::from_utf8_lossy(line));
                last_ns = time.nanos();
                currents += u32::from(frame.id().raw() == 256);
            }
            _ => panic!("not a frame: {}", String::from_utf8_lossy(line)),
        }
    }
    assert_eq!(currents, 3000);
    assert_eq!(last_ns / 1_000_000_000, 1_700_000_029);
}

#[test]
fn truth_rows_are_complete_and_charge_balances() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (log, truth) = (folder.path().join("p.log.gz"), folder.path().join("p.csv.gz"));
    let (log_text, truth_text) = (log.display().to_string(), truth.display().to_string());
    let example = config("example.toml");
    let output = packwatch(&[
        "simulate",
        "paper",
        "-c",
        &example,
        "-o",
        &log_text,
        "--truth",
        &truth_text,
        "--cells",
        "2",
        "--duration",
        "600",
        "--truth-period",
        "10",
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut text = String::new();
    flate2::read::GzDecoder::new(bytes(&truth).as_slice()).read_to_string(&mut text).expect("compressed text");
    let mut rows = csv::Reader::from_reader(text.as_bytes());
    let head = "time_s,cell,soc,u1_v,capacity_ah,resistance_ratio,current_a,voltage_v,temperature_c";
    assert_eq!(rows.headers().expect("a head").iter().collect::<Vec<_>>().join(","), head);
    let rows: Vec<Vec<f64>> = rows.deserialize().collect::<Result<_, _>>().expect("numbers");
    assert_eq!(rows.len(), 2 * 60);
    let (first, last) = (&rows[0], &rows[rows.len() - 2]);
    let charge_ah = first[6] * (last[0] - first[0]) / 3600.0;
    assert!((first[2] - last[2] - charge_ah / first[4]).abs() < 1e-8);
    let mut log_text = String::new();
    flate2::read::GzDecoder::new(bytes(&log).as_slice()).read_to_string(&mut log_text).expect("compressed text");
    assert!(log_text.starts_with("(1700000000.000000000) can0 100#"), "{:?}", log_text.lines().next());
}

#[test]
fn out_of_range_settings_name_allowed_range() {
    let example = config("example.toml");
    for (args, code, says) in [
        (vec!["--initial-soc", "2"], 2, "must be 0 to 1"),
        (vec!["--noise-voltage", "nan"], 2, "must be 0 or more"),
        (vec!["--duration", "0"], 2, "must be above 0"),
        (vec!["--cells", "97"], 1, "must be at most 96"),
        (vec!["--cell-period", "15"], 1, "must be a multiple"),
    ] {
        let mut all = vec!["simulate", "ev-day", "-c", &example, "-o", "/dev/null"];
        all.extend(args);
        let output = packwatch(&all);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{all:?}: {message}");
        assert!(message.contains(says), "{all:?}: {message}");
    }
}

#[test]
fn missing_configuration_and_unwritable_log_are_reported() {
    let missing = packwatch(&["simulate", "paper", "-c", "/nowhere/pack.toml", "-o", "/dev/null"]);
    assert_eq!(missing.status.code(), Some(78));
    let example = config("example.toml");
    let unwritable = packwatch(&["simulate", "paper", "-c", &example, "-o", "/nowhere/x.log", "--duration", "1"]);
    assert_eq!(unwritable.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&unwritable.stderr).contains("/nowhere/x.log: cannot be written"));
}

#[test]
fn demo_ends_with_both_decoded_alarms() {
    for seed in ["1", "2", "3"] {
        let output = packwatch(&["demo", "--seed", seed]);
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        let last = text.lines().last().unwrap_or_default();
        assert!(
            last.starts_with("capacity alarm raised in cycle ") && last.contains("recharge-period alarm in cycle ")
        );
        let frames =
            text.lines().filter(|line| line.starts_with('(')).filter_map(|line| parse_line(line.as_bytes()).ok());
        assert_eq!(frames.count(), 2, "{text}");
    }
}
