//! Packwatch's part of the parsing comparison with `parse.c` and `parse.py`. Uses the readers of `packwatch replay` up
//! to the sample stage, and an [`InputMap`] with every signal of the DBC.
//!
//! `cargo run --release --example parse -- LOG DBC [FRAMES]` prints frames, sum of all values, and seconds.
#![expect(clippy::print_stdout, reason = "a program whose output is read by tests/peers/run")]
#![expect(clippy::unwrap_used, reason = "a bench panics if its setup fails")]

use std::path::Path;
use std::time::Instant;

use packwatch_core::can::dbc::Database;
use packwatch_core::can::decode::{Binding, InputMap};
use packwatch_core::monitor::RecordKind;
use packwatch_core::quantity::{BusIndex, CellIndex, Channel};
use packwatch_host::io::csv_log::CsvOptions;
use packwatch_host::io::log::{Batch, LogOptions, LogSource};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (log, dbc) = (&arguments[0], &arguments[1]);
    let most = arguments.get(2).map_or(u64::MAX, |frames| frames.parse().unwrap());
    let map = every_signal(&std::fs::read_to_string(dbc).unwrap());
    let start = Instant::now();
    let (frames, sum) = parse_and_decode(Path::new(log), &map, most);
    println!("{frames} {sum:.6} {:.6}", start.elapsed().as_secs_f64());
}

/// Assigns every signal to a separate channel. The kind of channel does not matter here.
fn every_signal(dbc: &str) -> InputMap {
    let database = Database::parse(dbc).unwrap();
    let signals =
        database.messages.iter().flat_map(|message| message.signals.iter().map(move |signal| (message, signal)));
    let bind = |(n, (message, signal))| Binding::new(BusIndex(0), message, signal, Channel::CellVoltage(CellIndex(n)));
    InputMap::new((0..).zip(signals).map(|pair| bind(pair).unwrap()).collect())
}

fn parse_and_decode(log: &Path, map: &InputMap, most: u64) -> (u64, f64) {
    let options = LogOptions {
        interfaces: vec!["can0".to_owned()],
        channels: Vec::new(),
        strict: false,
        csv: CsvOptions::default(),
        encode_row: Box::new(|_, _| 0),
    };
    let mut source = LogSource::new([log.to_owned()], options);
    let mut batch = Batch::new(Batch::MAX);
    let (mut frames, mut sum) = (0, 0.0);
    while frames < most && source.next_batch(&mut batch).unwrap() {
        for record in batch.records() {
            let RecordKind::Frame { bus, frame } = &record.kind else { continue };
            if frames < most {
                map.decode(*bus, frame, |reading| sum += reading.value.unwrap_or(0.0));
                frames += 1;
            }
        }
    }
    (frames, sum)
}
