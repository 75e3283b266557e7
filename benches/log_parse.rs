//! Measures the time to convert candump logs to frames and readings, as `replay` does. For comparison, also measures a
//! plain newline scan, which any reader needs.
#![expect(clippy::unwrap_used, reason = "a bench panics if its setup fails")]

use divan::Bencher;
use divan::counter::ItemsCount;
use packwatch_host::can::dbc::Database;
use packwatch_host::can::decode::{Binding, InputMap};
use packwatch_host::io::csv_log::CsvOptions;
use packwatch_host::io::log::{Batch, LogOptions, LogSource};
use packwatch_host::monitor::{Record, RecordKind};
use packwatch_host::quantity::{BusIndex, CellIndex, Channel, Reading, SensorIndex};

fn main() {
    divan::main();
}

/// Lines of one log, about 10 MB.
const LINES: u64 = 200_000;

/// Creates classic frames of 8 bytes with three signals each, at a realistic bus rate.
fn log() -> Vec<u8> {
    let line = |n: u64| {
        let data = n.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let (second, micros) = (n * 225 / 1_000_000, n * 225 % 1_000_000);
        format!("({}.{micros:06}) can0 100#{data:016X}\n", 1_700_000_000 + second)
    };
    (0..LINES).flat_map(|n| line(n).into_bytes()).collect()
}

fn three_signals() -> InputMap {
    let db = Database::parse(include_str!("../config/measured.dbc")).unwrap();
    let bind = |name: &str, channel| {
        let (message, signal) = db.signal(name).unwrap();
        Binding::new(BusIndex(0), message, signal, channel).unwrap()
    };
    InputMap::new(vec![
        bind("MeasuredCell.Voltage", Channel::CellVoltage(CellIndex(0))),
        bind("MeasuredCell.Current", Channel::Current),
        bind("MeasuredCell.Temperature", Channel::Temperature(SensorIndex(0))),
    ])
}

fn value(reading: Reading) -> f64 {
    reading.value.unwrap_or(0.0)
}

fn lines(bencher: Bencher, mut each: impl FnMut(&[u8])) {
    let text = log();
    bencher.counter(ItemsCount::new(LINES)).bench_local(|| {
        let mut start = 0;
        for end in memchr::memchr_iter(b'\n', &text) {
            each(&text[start..end]);
            start = end + 1;
        }
    });
}

#[divan::bench]
fn newline_scan(bencher: Bencher) {
    lines(bencher, |line| {
        divan::black_box(line);
    });
}

/// Reads a file as `replay` does and passes every batch to `each`.
fn batches(bencher: Bencher, mut each: impl FnMut(&[Record])) {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), log()).unwrap();
    bencher.counter(ItemsCount::new(LINES)).bench_local(|| {
        let options = LogOptions {
            interfaces: vec!["can0".to_owned()],
            channels: Vec::new(),
            strict: true,
            csv: CsvOptions::default(),
            encode_row: Box::new(|_, _| 0),
        };
        let mut source = LogSource::new([file.path().to_owned()], options);
        let mut batch = Batch::new(Batch::MAX);
        while source.next_batch(&mut batch).unwrap() {
            each(batch.records());
        }
        assert_eq!(source.counts().frames, LINES);
    });
}

#[divan::bench]
fn parse(bencher: Bencher) {
    batches(bencher, |records| {
        divan::black_box(records);
    });
}

#[divan::bench]
fn parse_and_decode(bencher: Bencher) {
    let map = three_signals();
    batches(bencher, |records| {
        for record in records {
            if let RecordKind::Frame { bus, frame } = &record.kind {
                let mut sum = 0.0;
                map.decode(*bus, frame, |reading| sum += value(reading));
                divan::black_box(sum);
            }
        }
    });
}
