//! Tests cell voltages that are read by diagnostic requests, on a simulated pack and on the log of a real car.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::measured;
use assert_cmd::Command;
use packwatch::can::encode::InputEncoder;
use packwatch::can::isotp::segment;
use packwatch::can::{CanId, Frame};
use packwatch::monitor::{Monitor, Outputs, Record};
use packwatch::quantity::{BusIndex, CellIndex, Channel, Timestamp};

/// A Nissan Leaf: 96 cell voltages of 16 bits in group 2 of service 0x21; current and pack values in group 1.
const LEAF: &str = r#"[pack]
cells = 96
cell_model = "CELL"
[[interface]]
name = "can0"
[input.current]
signal = "Leaf.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Leaf.Cell{n}"
[input.reported_soc]
signal = "Leaf.Soc"
[limits.current]
max_age_s = 15
[limits.voltage]
max_age_s = 15
[[input.diagnostic]]
name = "Leaf"
request = 0x79B
response = 0x7BB
service = 0x21
identifier = 0x01
signals = [
  { name = "Current", bit = 0, length = 32, signed = true, factor = 0.0009765625, unit = "A", minimum = -600, maximum = 600 },
  { name = "PackVoltage", bit = 144, length = 16, factor = 0.01, unit = "V", minimum = 200, maximum = 450 },
  { name = "Soc", bit = 248, length = 24, factor = 0.0001, unit = "%", minimum = 0, maximum = 100 },
]
[[input.diagnostic]]
name = "Leaf"
request = 0x79B
response = 0x7BB
service = 0x21
identifier = 0x02
signals = [{ name = "Cell{n}", numbers = "1-96", bit = 0, length = 16, factor = 0.001, unit = "V", minimum = 1, maximum = 5 }]
"#;

fn written(folder: &Path, text: &str) -> PathBuf {
    let cell = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/cells/example_nmc_2600.toml");
    let path = folder.join("pack.toml");
    fs::write(&path, text.replace("CELL", cell.to_str().unwrap())).unwrap();
    path
}

fn packwatch(args: &[&str]) -> Vec<u8> {
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.args(args).assert().success().get_output().stdout.clone()
}

#[test]
fn leaf_cells_are_estimated_from_answers() {
    assert!(LEAF.lines().count() <= 60);
    let folder = tempfile::tempdir().unwrap();
    let config = written(folder.path(), LEAF);
    let (config, log) = (config.to_str().unwrap(), folder.path().join("drive.log"));
    let log = log.to_str().unwrap();
    packwatch(&["simulate", "ev-day", "-c", config, "--duration", "900", "-o", log]);
    let text = fs::read_to_string(log).unwrap();
    assert!(text.contains("79B#022102") && text.contains("7BB#10C2"), "requests and answers of 194 bytes");
    let summary: serde_json::Value =
        serde_json::from_slice(&packwatch(&["replay", "-c", config, "--json", log])).unwrap();
    let cells = summary["cells"].as_array().unwrap();
    assert_eq!((cells.len(), summary["controllers"][0]["unasked"].as_u64()), (96, Some(0)), "{summary}");
    assert!(cells.iter().all(|cell| cell["soc_std"].as_f64().is_some_and(|std| std < 0.1)), "{summary}");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn leaf_log_gives_values_of_its_answers() {
    let log = measured::path("can_ev/leaf2019_uds_poll.log.gz");
    let folder = tempfile::tempdir().unwrap();
    // The logger requested groups 1 and 4 only, so this log contains no cells.
    let pack = LEAF.replace(
        "[input.cell_voltage]\nsignal = \"Leaf.Cell{n}\"",
        "[input.pack_voltage]\nsignal = \"Leaf.PackVoltage\"",
    );
    let config = written(folder.path(), &pack);
    let args = ["replay", "-c", config.to_str().unwrap(), "--json", log.to_str().unwrap()];
    let summary: serde_json::Value = serde_json::from_slice(&packwatch(&args)).unwrap();
    let controller = &summary["controllers"][0];
    assert_eq!((controller["read"].as_u64(), controller["other"].as_u64()), (Some(13), Some(13)), "{controller}");
    assert_eq!((controller["unasked"].as_u64(), controller["refused"].as_u64()), (Some(0), Some(0)));
    assert!(controller["lost"].as_array().unwrap().iter().all(|lost| lost == 0), "{controller}");
}

/// The current rises while the frames of the answer with the cell voltages arrive. The cell voltages must be combined
/// with the current at the answer's first frame.
#[test]
fn answer_values_are_dated_to_first_frame() {
    let folder = tempfile::tempdir().unwrap();
    let pack = LEAF.replace("cells = 96", "cells = 8").replacen("0x79B", "0x797", 1).replacen("0x7BB", "0x79A", 1);
    let config = packwatch::config::load(&written(folder.path(), &pack)).unwrap().monitor;
    let encoder = InputEncoder::new(&config.input).with_answers(&config.answers);
    let frames = |values: &[(Channel, Option<f64>)]| {
        let mut made = Vec::new();
        encoder.encode(values, &mut made);
        made
    };
    let cells = frames(&[0, 1, 2, 3, 4, 5, 6, 7].map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(3.7))));
    let current = |current_a| frames(&[(Channel::Current, Some(current_a)), (Channel::ReportedSoc, Some(0.5))]);
    let (mut monitor, mut out) = (Monitor::new(config), Outputs { want_estimates: true, ..Outputs::default() });
    let mut give = |ms: i64, frame: &Frame, out: &mut Outputs| {
        let time = Timestamp::from_nanos(ms * 1_000_000);
        monitor.handle(&Record::frame(time, BusIndex(0), frame), out);
    };
    current(10.0).iter().for_each(|(_, frame)| give(0, frame, &mut out));
    let is_answer = |frame: &Frame| frame.id() == CanId::Standard(0x7BB);
    let (first, rest) = cells.split_at(1 + cells.iter().position(|(_, frame)| is_answer(frame)).unwrap());
    first.iter().for_each(|(_, frame)| give(100, frame, &mut out));
    current(200.0).iter().for_each(|(_, frame)| give(150, frame, &mut out));
    assert!(out.estimates.is_empty());
    rest.iter().for_each(|(_, frame)| give(300, frame, &mut out));
    monitor.settle(&mut out);
    let measured: Vec<_> = out.estimates.iter().map(|estimate| (estimate.time, estimate.measured.current_a)).collect();
    assert_eq!(measured, [(Timestamp::from_nanos(100_000_000), 10.0); 8]);
}

/// Reproduces two faults of a public car definition. The pack voltage lacks a division by ten, and it is limited to the
/// range that the author expected.
#[test]
fn doctor_finds_pack_voltage_off_by_ten() {
    let folder = tempfile::tempdir().unwrap();
    let pack = LEAF.replace(
        r#"{ name = "PackVoltage", bit = 144, length = 16, factor = 0.01, unit = "V", minimum = 200, maximum = 450 }"#,
        r#"{ name = "PackVoltage", bit = 144, length = 16, factor = 0.1, unit = "V", minimum = 200, maximum = 450 }"#,
    );
    let config = written(folder.path(), &pack);
    let mut group_1 = [&[0x61, 1][..], &[0; 51]].concat();
    group_1[20..22].copy_from_slice(&35_520_u16.to_be_bytes()); // 355.20 V from 96 cells of 3.7 V
    let group_2 = [&[0x61, 2][..], &3700_u16.to_be_bytes().repeat(96)].concat();
    let mut log = String::new();
    let mut ms = 0;
    let mut line = |id: &str, payload: &[u8]| {
        ms += 10;
        let data: String = payload.iter().map(|byte| format!("{byte:02X}")).collect();
        log.push_str(&format!("({}.{:03}000) can0 {id}#{data}\n", ms / 1000, ms % 1000));
    };
    for _ in 0..60 {
        for (group, message) in [(1, &group_1), (2, &group_2)] {
            line("79B", &[2, 0x21, group, 0, 0, 0, 0, 0]);
            segment(None, message, 0).iter().for_each(|payload| line("7BB", payload));
        }
    }
    let path = folder.path().join("car.log");
    fs::write(&path, log).unwrap();
    let mut doctor = Command::cargo_bin("packwatch").unwrap();
    let output = doctor.args(["doctor", "-c", config.to_str().unwrap(), path.to_str().unwrap()]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("WARNING   Leaf.PackVoltage is off by a factor of 10"), "{text}");
    assert!(text.contains("96 of 96 cell voltages"), "{text}");
}
