//! The voltages of a large pack arrive in many frames, with ticks between them. The check of the current must still see
//! whole rounds, also if the first cells belong to a module of another kind.

use std::fmt::Write as _;

use packwatch::can::decode::Channel;
use packwatch::can::encode::InputEncoder;
use packwatch::monitor::{Monitor, Outputs, Record, RecordKind};
use packwatch::quantity::{CellIndex, SensorIndex, Timestamp};

use crate::support::config_texts;

const CELLS: u16 = 40;
const MODULE: &str = "[[pack.module]]\ncells = \"1-20\"\nchemistry = \"nmc-graphite\"\nrated_capacity_ah = 2.6\n";
const PACK: &str = r#"
[pack]
cells = 40
cell_model = "cells/example_nmc_2600.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells{m}.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature"
"#;

/// A message with current and temperature, and ten messages with four voltages each.
fn dbc() -> String {
    let mut text =
        "VERSION \"\"\nBU_: A\nBO_ 256 Status: 8 A\n SG_ Current : 0|16@1- (0.01,0) [-300|300] \"A\" A\n SG_ \
                    Temperature : 16|8@1+ (1,-40) [-40|200] \"degC\" A\n"
            .to_owned();
    for cell in 0..CELLS {
        if cell % 4 == 0 {
            writeln!(text, "BO_ {} Cells{}: 8 A", 512 + cell / 4, cell / 4).unwrap();
        }
        writeln!(text, " SG_ Voltage{} : {}|16@1+ (0.0001,0) [0|5] \"V\" A", cell + 1, 16 * (cell % 4)).unwrap();
    }
    text
}

/// Current (A): a new level every 10 s.
fn load_a(second: u32) -> f64 {
    f64::from((second / 10).wrapping_mul(2_654_435_761) >> 24) / 64.0 - 2.0
}

/// Drives for 10 minutes and returns in how many seconds the cells were untrusted. The sensor has `sign`.
fn untrusted_seconds(modules: &str, sign: f64) -> u32 {
    let config = config_texts::load(&format!("{PACK}{modules}"), &dbc()).monitor;
    let ohm = config.model.r0_ohm(&config.model.grid_position(0.5, 25.0));
    let encoder = InputEncoder::new(&config.input);
    let (mut monitor, mut out, mut untrusted) = (Monitor::new(config), Outputs::default(), 0);
    for second in 0..600 {
        let current_a = load_a(second);
        let mut values =
            vec![(Channel::Current, Some(sign * current_a)), (Channel::Temperature(SensorIndex(0)), Some(25.0))];
        values.extend((0..CELLS).map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(3.65 - ohm * current_a))));
        let mut frames = Vec::new();
        encoder.encode(&values, &mut frames);
        assert_eq!(frames.len(), 11);
        for centi in 0..100_u32 {
            let time = Timestamp::from_secs(f64::from(100 * second + centi) / 100.0);
            // A message every 40 ms, with ticks in between.
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
