//! Our side of parse and decode beside `parse.c` and `parse.py`: blocks of the file, lines, frames, signals of a DBC.
//!
//! `cargo run --release --example parse -- LOG DBC [FRAMES]` prints: frames, sum of all values, seconds. It goes the way
//! `packwatch replay` goes up to the sample stage: the same readers, and an [`InputMap`] with every signal of the DBC.
#![expect(clippy::print_stdout, reason = "a program whose output is read by tests/peers/run")]
#![expect(clippy::unwrap_used, reason = "a bench that cannot set itself up has nothing to measure")]

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use packwatch::can::dbc::Database;
use packwatch::can::decode::{Binding, InputMap};
use packwatch::io::candump::{Line, parse_line};
use packwatch::io::lines::{self, Lines, RawLine};
use packwatch::quantity::{BusIndex, CellIndex, Channel};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (log, dbc) = (&arguments[0], &arguments[1]);
    let most = arguments.get(2).map_or(u64::MAX, |frames| frames.parse().unwrap());
    let map = every_signal(&std::fs::read_to_string(dbc).unwrap());
    let start = Instant::now();
    let (frames, sum) = parse_and_decode(Path::new(log), &map, most);
    println!("{frames} {sum:.6} {:.6}", start.elapsed().as_secs_f64());
}

/// Each signal feeds a channel of its own: which one does not matter here.
fn every_signal(dbc: &str) -> InputMap {
    let database = Database::parse(dbc).unwrap();
    let signals =
        database.messages.iter().flat_map(|message| message.signals.iter().map(move |signal| (message, signal)));
    let bind = |(n, (message, signal))| Binding::new(BusIndex(0), message, signal, Channel::CellVoltage(CellIndex(n)));
    InputMap::new((0..).zip(signals).map(|pair| bind(pair).unwrap()).collect())
}

fn parse_and_decode(log: &Path, map: &InputMap, most: u64) -> (u64, f64) {
    let mut lines = Lines::new(lines::open(log, &Arc::default()).unwrap());
    let (mut frames, mut sum) = (0, 0.0);
    while frames < most {
        let Some(RawLine::Whole(line) | RawLine::Last(line)) = lines.next_line().unwrap() else { break };
        let Ok(Line::Frame { frame, .. }) = parse_line(line) else { continue };
        map.decode(BusIndex(0), &frame, |reading| sum += reading.value.unwrap_or(0.0));
        frames += 1;
    }
    (frames, sum)
}
