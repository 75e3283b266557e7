//! Measures the time to decode one frame with [`InputMap::decode`], and the time to encode the frames of one set of
//! values with [`InputEncoder`].

use divan::{Bencher, black_box};
use packwatch_host::can::dbc::Database;
use packwatch_host::can::decode::{Binding, InputMap};
use packwatch_host::can::encode::InputEncoder;
use packwatch_host::can::{CanId, Frame};
use packwatch_host::quantity::{BusIndex, CellIndex, Channel, SensorIndex};

/// Number of cells of the example pack. Each of the 32 multiplexer pages has the voltages of three cells.
const CELLS: u16 = 96;

fn main() {
    divan::main();
}

fn bind(db: &Database, name: &str, channel: Channel) -> Binding {
    let (message, signal) = db.signal(name).expect("the shipped DBC has the signal");
    Binding::new(BusIndex(0), message, signal, channel).expect("its layout is valid")
}

fn three_signals() -> InputMap {
    let db = Database::parse(include_str!("../config/measured.dbc")).expect("the shipped DBC parses");
    InputMap::new(vec![
        bind(&db, "MeasuredCell.Voltage", Channel::CellVoltage(CellIndex(0))),
        bind(&db, "MeasuredCell.Current", Channel::Current),
        bind(&db, "MeasuredCell.Temperature", Channel::Temperature(SensorIndex(0))),
    ])
}

fn cells() -> InputMap {
    let db = Database::parse(include_str!("../config/pack96.dbc")).expect("the shipped DBC parses");
    let cell = |n: u16| bind(&db, &format!("CellVoltages.CellVoltage{}", n + 1), Channel::CellVoltage(CellIndex(n)));
    InputMap::new((0..CELLS).map(cell).collect())
}

fn values() -> Vec<(Channel, Option<f64>)> {
    (0..CELLS).map(|n| (Channel::CellVoltage(CellIndex(n)), Some(3.5 + f64::from(n) / 1000.0))).collect()
}

fn decode(bencher: Bencher, map: &InputMap, frame: &Frame) {
    bencher.bench_local(|| {
        let mut sum = 0.0;
        map.decode(BusIndex(0), black_box(frame), |reading| sum += reading.value.unwrap_or(0.0));
        sum
    });
}

#[divan::bench]
fn decode_three_signals_of_a_classic_frame(bencher: Bencher) {
    let frame = Frame::classic(CanId::Standard(256), &[0x80, 0x1A, 0x06, 0x10, 0x27, 0, 0xC4, 9]).expect("8 bytes");
    decode(bencher, &three_signals(), &frame);
}

#[divan::bench]
fn decode_a_page_of_96_multiplexed_cells(bencher: Bencher) {
    let map = cells();
    let mut frames = Vec::new();
    InputEncoder::new(&map).encode(&values(), &mut frames);
    let (_, last) = frames.last().expect("one frame per page");
    decode(bencher, &map, last);
}

#[divan::bench]
fn decode_an_unmapped_frame(bencher: Bencher) {
    decode(bencher, &cells(), &Frame::classic(CanId::Standard(0x595), &[0; 8]).expect("8 bytes"));
}

#[divan::bench]
fn encode_96_cells_into_32_frames(bencher: Bencher) {
    let (encoder, values) = (InputEncoder::new(&cells()), values());
    let mut frames = Vec::new();
    bencher.bench_local(|| {
        frames.clear();
        encoder.encode(black_box(&values), &mut frames)
    });
}
