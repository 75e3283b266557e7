//! Tests the check that compares the current with the voltages, in a pack whose cell voltages arrive in many frames,
//! spread over time. The check must wait for complete rounds (one voltage of every cell), even if the first cells
//! belong to a module with other cells.

use std::fmt::Write as _;

use packwatch::can::decode::Channel;
use packwatch::can::encode::InputEncoder;
use packwatch::monitor::{Command, Monitor, MonitorConfig, Outputs, Record, RecordKind};
use packwatch::quantity::{CellIndex, SensorIndex, Timestamp};

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK};

const CELLS: u16 = 40;
const MODULE: &str = "[[pack.module]]\ncells = \"1-20\"\nchemistry = \"nmc-graphite\"\nrated_capacity_ah = 2.6\n";

/// The pack of the test rig, enlarged to [`CELLS`] cells: ten messages with four voltages each.
fn config(modules: &str) -> MonitorConfig {
    let pack = PACK
        .replace("cells = 2\n", "cells = 40\n")
        .replace("cells = \"2\"", "cells = \"2-40\"")
        .replace("Cells.Voltage{n}", "Cells{m}.Voltage{n}");
    let mut dbc = DBC[..DBC.find("BO_ 272").unwrap()].to_owned();
    for cell in 0..CELLS {
        if cell % 4 == 0 {
            writeln!(dbc, "BO_ {} Cells{}: 8 A", 512 + cell / 4, cell / 4).unwrap();
        }
        writeln!(dbc, " SG_ Voltage{} : {}|16@1+ (0.0001,0) [0|5] \"V\" A", cell + 1, 16 * (cell % 4)).unwrap();
    }
    config_texts::load(&format!("{pack}{modules}"), &dbc).monitor
}

/// Current (A). It changes every 10 s.
fn load_a(second: u32) -> f64 {
    f64::from((second / 10).wrapping_mul(2_654_435_761) >> 24) / 64.0 - 2.0
}

/// Simulates a drive of 10 minutes. Returns the number of seconds at whose end the estimate of at least one cell was
/// not trusted.
fn untrusted_seconds(modules: &str, sign: f64) -> u32 {
    let config = config(modules);
    let ohm = config.model.r0_ohm(&config.model.grid_position(0.5, 25.0));
    let encoder = InputEncoder::new(&config.input);
    let (mut monitor, mut out, mut untrusted) = (Monitor::new(config), Outputs::default(), 0);
    for second in 0..600 {
        let current_a = load_a(second);
        let mut values = vec![(Channel::Current, Some(sign * current_a)), (Channel::ReportedSoc, Some(0.5))];
        values.extend([0, 1].map(|sensor| (Channel::Temperature(SensorIndex(sensor)), Some(25.0))));
        values.extend((0..CELLS).map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(3.65 - ohm * current_a))));
        let mut frames = Vec::new();
        encoder.encode(&values, &mut frames);
        assert_eq!(frames.len(), 11);
        for centi in 0..100_u32 {
            let time = Timestamp::from_secs(f64::from(100 * second + centi) / 100.0);
            if let Some((bus, frame)) = frames.get(centi as usize / 4).filter(|_| centi % 4 == 0) {
                monitor.handle(&Record { time, kind: RecordKind::Frame { bus: *bus, frame: *frame } }, &mut out);
            }
            monitor.handle(&Record { time: time.plus_secs(0.005), kind: RecordKind::Tick }, &mut out);
            out.clear();
        }
        untrusted += u32::from(monitor.cell_views().any(|cell| cell.trusted == Some(false)));
    }
    untrusted
}

#[test]
fn inverted_current_is_found_in_spread_rounds() {
    for modules in ["", MODULE] {
        assert_eq!(untrusted_seconds(modules, 1.0), 0, "{modules}");
        let untrusted = untrusted_seconds(modules, -1.0);
        assert!(untrusted > 450, "{untrusted} s of 600 s: {modules}");
    }
}

fn give(monitor: &mut Monitor, encoder: &InputEncoder, second: u32, current_a: f64, voltage_v: f64) {
    let mut values = vec![(Channel::Current, Some(current_a))];
    values.extend([0, 1].map(|sensor| (Channel::Temperature(SensorIndex(sensor)), Some(25.0))));
    values.extend((0..CELLS).map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(voltage_v))));
    let (mut frames, mut out) = (Vec::new(), Outputs::default());
    encoder.encode(&values, &mut frames);
    for (k, (bus, frame)) in (0..).zip(&frames) {
        let time = Timestamp::from_secs(f64::from(second) + 0.04 * f64::from(k));
        monitor.handle(&Record { time, kind: RecordKind::Frame { bus: *bus, frame: *frame } }, &mut out);
    }
    monitor.handle(&Record { time: Timestamp::from_secs(f64::from(second) + 0.9), kind: RecordKind::Tick }, &mut out);
}

#[test]
fn voltages_before_and_after_interruption_are_not_compared() {
    let time = Timestamp::from_secs(60.0);
    for interruption in [Record { time, kind: RecordKind::UnknownGap }, Record::command(time, Command::PackReplaced)] {
        let config = config("");
        let encoder = InputEncoder::new(&config.input);
        let mut monitor = Monitor::new(config);
        for second in 0..60 {
            give(&mut monitor, &encoder, second, 1.0, 3.60);
        }
        monitor.handle(&interruption, &mut Outputs::default());
        for second in 61..90 {
            give(&mut monitor, &encoder, second, 1.0, 3.75);
            assert!(monitor.cell_views().all(|cell| cell.trusted != Some(false)), "{interruption:?}: {second}");
        }
    }
}
