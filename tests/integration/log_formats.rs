//! Tests commands on logs in other tools' formats, on files that are not logs, and `look` on a drive.

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::replay;

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK};

const START_US: i64 = 1_700_000_000_000_000;

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/pack").join(name)
}

fn packwatch(args: &[&str]) -> assert_cmd::assert::Assert {
    Command::cargo_bin("packwatch").expect("Cargo builds the binary").args(args).assert()
}

fn stderr(assert: &assert_cmd::assert::Assert) -> String {
    String::from_utf8_lossy(&assert.get_output().stderr).into_owned()
}

fn stdout(assert: &assert_cmd::assert::Assert) -> String {
    String::from_utf8_lossy(&assert.get_output().stdout).into_owned()
}

fn estimates(folder: &Path, log: &str) -> String {
    let (config, out) = (example("pack.toml"), folder.join("estimates.csv"));
    let args = ["replay", "-c", config.to_str().unwrap(), log, "--estimates", out.to_str().unwrap()];
    packwatch(&args).success();
    fs::read_to_string(out).unwrap()
}

/// The frames of the example `drive.log`: time since the start (us), identifier, bytes in hex separated by spaces.
fn frames() -> Vec<(i64, String, String)> {
    let text = fs::read_to_string(example("drive.log")).unwrap();
    let frame = |line: &str| {
        let mut parts = line.split_whitespace();
        let stamp = parts.next().unwrap().trim_matches(['(', ')']).replace('.', "");
        let (id, data) = parts.nth(1).unwrap().split_once('#').unwrap();
        let bytes: Vec<&str> = data.as_bytes().chunks(2).map(|pair| std::str::from_utf8(pair).unwrap()).collect();
        (stamp.parse::<i64>().unwrap() - START_US, id.to_owned(), bytes.join(" "))
    };
    text.lines().map(frame).collect()
}

fn write(folder: &Path, name: &str, header: &str, line: impl Fn(i64, &str, &str) -> String) -> String {
    let lines: String = frames().iter().map(|(us, id, bytes)| line(*us, id, bytes) + "\r\n").collect();
    let path = folder.join(name);
    fs::write(&path, format!("{header}{lines}")).unwrap();
    path.to_str().unwrap().to_owned()
}

fn seconds(us: i64) -> String {
    format!("{}.{:06}", us / 1_000_000, us % 1_000_000)
}

#[test]
fn drive_in_other_formats_gives_same_estimates() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let expected = estimates(folder, example("drive.log").to_str().unwrap());
    assert!(expected.lines().count() > 1000, "{expected}");
    let logs = [
        write(
            folder,
            "a.log",
            "date Tue Nov 14 10:13:20.000 pm 2023\nbase hex  timestamps absolute\n",
            |us, id, bytes| format!("   {} 1  {id}             Rx   d 8 {bytes}", seconds(us)),
        ),
        write(folder, "b.csv", "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n", |us, id, bytes| {
            format!("{},00000{id},false,Rx,0,8,{}", START_US + us, bytes.replace(' ', ","))
        }),
        write(folder, "c.txt", "", |us, id, bytes| {
            format!(" ({})  vcan0  RX - -  {id}   [8]  {bytes}", seconds(START_US + us))
        }),
        write(folder, "d.crtd", "", |us, id, bytes| format!("{} 1R11 {id} {bytes}", seconds(START_US + us))),
    ];
    for log in &logs {
        assert!(estimates(folder, log) == expected, "{log}");
    }
    // A log recorded on another channel gives the same estimates if the channel is mapped to the configured interface.
    let other = write(folder, "e.log", "base hex timestamps absolute\n", |us, id, bytes| {
        format!("{} 3 {id} Rx d 8 {bytes}", seconds(us))
    });
    let config = example("pack.toml");
    let args = ["replay", "-c", config.to_str().unwrap(), &other];
    let error = stderr(&packwatch(&args).code(1));
    assert!(error.contains("channel 3") && error.contains("--channel 3=vcan0"), "{error}");
    packwatch(&[&args[..], &["--channel", "3=vcan0"]].concat()).success();
}

#[test]
fn candump_log_with_comment_is_no_table() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("shell.log");
    let drive = fs::read_to_string(example("drive.log")).unwrap();
    fs::write(&log, format!("# candump -L vcan0,100:7FF\n{drive}")).unwrap();
    let expected = estimates(folder.path(), example("drive.log").to_str().unwrap());
    assert!(estimates(folder.path(), log.to_str().unwrap()) == expected);
}

#[test]
fn doctor_and_discover_read_other_formats() {
    let folder = tempfile::tempdir().unwrap();
    let log = write(folder.path(), "a.asc", "base hex timestamps absolute\n", |us, id, bytes| {
        format!("{} 1 {id} Rx d 8 {bytes}", seconds(us))
    });
    let (config, dbc) = (example("pack.toml"), example("pack.dbc"));
    let report = stdout(&packwatch(&["doctor", "-c", config.to_str().unwrap(), &log]).success());
    assert!(report.contains("No faults found"), "{report}");
    let page = stdout(&packwatch(&["discover", &log, "--dbc", dbc.to_str().unwrap()]).success());
    assert!(page.contains("PackStatus.Current") && page.contains("can0"), "{page}");
}

#[test]
fn logs_without_battery_fail_with_reason() {
    let folder = tempfile::tempdir().unwrap();
    let config = example("pack.toml");
    let case = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, content).unwrap();
        stderr(&packwatch(&["replay", "-c", config.to_str().unwrap(), path.to_str().unwrap()]).code(1))
    };
    let error = case("empty.log", b"");
    assert!(error.contains("the log is empty"), "{error}");
    let error = case("notes.txt", b"driving home\nparked\n");
    assert!(error.contains("notes.txt:1: \"driving home\" has no known format"), "{error}");
    let error = case("other.log", b"(1700000000.000000) vcan0 7FF#00\n(1700000001.000000) vcan0 7FF#00\n");
    assert!(error.contains("none of 2 frames carries a configured signal"), "{error}");
    let error = case("elsewhere.log", b"(1700000000.000000) can7 100#FDFF410000000000\n");
    assert!(error.contains("interface can7") && error.contains("--channel can7=vcan0"), "{error}");
    let error = case("book.xlsx", b"PK\x03\x04\x14\x00\x06\x00xl/workbook.xml");
    assert!(error.contains("book.xlsx") && error.contains("Excel"), "{error}");
    let drive = fs::read_to_string(example("drive.log")).unwrap();
    let cut = |line: &str| {
        if line.contains("101#") { line[..line.find('#').unwrap()].to_owned() + "#00" } else { line.to_owned() }
    };
    let short: String = drive.lines().map(|line| cut(line) + "\n").collect();
    let error = case("short.log", short.as_bytes());
    assert!(error.contains("no voltage was usable") && error.contains("in short frames"), "{error}");
    let slow: String = drive
        .lines()
        .enumerate()
        .map(|(n, line)| format!("({}.000000{}\n", 1_700_000_000 + n / 2 * 60, &line[line.find(')').unwrap()..]))
        .collect();
    let error = case("slow.log", slow.as_bytes());
    assert!(error.contains("mostly asleep") && error.contains("--sleep-gap"), "{error}");
}

#[test]
fn look_writes_report_or_asks() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (log, dbc) = (example("drive.log"), example("pack.dbc"));
    let (log, dbc) = (log.to_str().unwrap(), dbc.to_str().unwrap());
    let (out, pack) = (path("look.html"), path("pack.toml"));
    let args = ["look", log, "--dbc", dbc, "--out", &out, "--write", &pack];
    let question = stderr(&packwatch(&args).code(1));
    assert!(question.contains("--label") && !Path::new(&out).exists() && !Path::new(&pack).exists(), "{question}");
    let args = [&args[..], &["--label", "nmc:2.6Ah"]].concat();
    let text = stdout(&packwatch(&args).success());
    for part in ["CellVoltages.CellVoltage{n} on vcan0: 4 of", "pack.toml written", "wiring", "battery", "look.html"] {
        assert!(text.contains(part), "{part} is not in: {text}");
    }
    assert!(fs::read_to_string(&out).unwrap().contains("</html>"));
    let text = stderr(&packwatch(&["look", "-", "--label", "nmc:2.6Ah"]).code(1));
    assert!(text.contains("-: must be a file"), "{text}");
    // Without a DBC, `look` writes the fields to a DBC file. `look` must not replace an existing file.
    let (car, own) = (path("car.toml"), path("car.dbc"));
    fs::write(&own, "MINE").unwrap();
    let text = stderr(&packwatch(&["look", log, "--label", "nmc:2.6Ah:4s", "--out", &out, "--write", &car]).code(1));
    assert!(text.contains("car.dbc: exists and would be replaced"), "{text}");
    assert_eq!(fs::read_to_string(&own).unwrap(), "MINE");
    // A table needs only the label.
    let table = path("drive.csv");
    let row = |n: i32| format!("{n},{},{:.3}\n", n / 20 % 3, 3.9 - f64::from(n) * 1e-4 - 0.04 * f64::from(n / 20 % 3));
    fs::write(&table, format!("time,current,voltage\n{}", (0..900).map(row).collect::<String>())).unwrap();
    let text = stdout(&packwatch(&["look", &table, "--label", "nmc:2.6Ah", "--out", &out]).success());
    for part in ["column 2 \"current\" in A (assumed), discharge positive", "which temperature?", "wiring", "battery"] {
        assert!(text.contains(part), "{part} is not in: {text}");
    }
    let text = stderr(&packwatch(&["look", &table, "--out", &out]).code(1));
    assert!(text.contains("which battery is it?"), "{text}");
    // If the configuration exists, no label is needed.
    let own = path("table.toml");
    let [first, again] = [&["--label", "nmc:2.6Ah"][..], &[]].map(|label| {
        let output = packwatch(&[&["look", &table, "--out", &out, "--write", &own], label].concat()).success();
        assert_eq!(stderr(&output).matches("drive.csv").count(), 1, "the table is named once");
        stdout(&output)
    });
    assert!(!first.contains("cannot be read") && again.contains("exists, so it is used as it is"), "{first}{again}");
    let text = stderr(&packwatch(&["look", &table, "--out", &out, "--write", &table]).code(1));
    assert!(text.contains("drive.csv: is an input"), "{text}");
    let rows: String = (0..900).map(row).collect();
    fs::write(&table, format!("time,current,voltage\n{rows}900,{},3.7\n901,1,3.7\n", " ".repeat(3_000_000))).unwrap();
    let text = stdout(&packwatch(&["look", &table, "--label", "nmc:2.6Ah", "--out", &out]).success());
    assert!(text.contains("the rest of the file is not read"), "{text}");
    fs::write(&table, "").unwrap();
    let text = stderr(&packwatch(&["look", &table, "--label", "nmc:2.6Ah:4s", "--out", &out]).code(1));
    assert_eq!(text.matches("drive.csv: is empty").count(), 1, "{text}");
    let edited = fs::read_to_string(&pack).unwrap().replace("rated_capacity_ah = 2.6", "rated_capacity_ah = 2.5");
    fs::write(&pack, &edited).unwrap();
    let text = stdout(&packwatch(&args).success());
    assert!(text.contains("exists, so it is used as it is"), "{text}");
    assert_eq!(fs::read_to_string(&pack).unwrap(), edited);
}

#[test]
fn default_sleep_gap_follows_maximum_age() {
    let gap_s = |limits: &str| replay::sleep_gap_s(&config_texts::load(&format!("{PACK}{limits}"), DBC).monitor);
    assert_eq!(gap_s(""), 30.0);
    assert_eq!(gap_s("[limits.current]\nmax_age_s = 90.0\n"), 90.0);
    assert_eq!(gap_s("[limits.voltage]\nmax_age_s = 70.0\n"), 70.0);
}
