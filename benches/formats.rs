//! Measures the time to read text logs of other tools as frames.
#![expect(clippy::unwrap_used, reason = "a bench panics if its setup fails")]

use std::io::Cursor;

use divan::Bencher;
use divan::counter::ItemsCount;
use packwatch_formats::{Format, Item, Source};

fn main() {
    divan::main();
}

/// Lines of one log, about 12 MB.
const LINES: u64 = 200_000;

/// Creates classic frames of 8 bytes at a realistic bus rate. `line` gets the time (us) and the data bytes.
fn log(header: &str, line: impl Fn(u64, [u8; 8]) -> String) -> Vec<u8> {
    let lines = (0..LINES).map(|n| line(n * 225, n.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes()));
    header.bytes().chain(lines.flat_map(String::into_bytes)).collect()
}

fn hex(data: [u8; 8], separator: &str) -> String {
    data.map(|byte| format!("{byte:02X}")).join(separator)
}

fn read(bencher: Bencher, text: &[u8]) {
    let format = Format::recognise(text).unwrap();
    bencher.counter(ItemsCount::new(LINES)).with_inputs(|| Box::new(Cursor::new(text.to_vec()))).bench_local_values(
        |reader| {
            let mut log = format.open(Source { reader, file: None }).unwrap();
            let mut frames = 0;
            while let Some(item) = log.next_item().unwrap() {
                frames += u64::from(matches!(divan::black_box(item), Item::Frame { .. }));
            }
            assert_eq!(frames, LINES);
        },
    );
}

#[divan::bench]
fn asc(bencher: Bencher) {
    let header = "date Tue Nov 14 10:13:20.000 pm 2023\nbase hex  timestamps absolute\n";
    let line = |us: u64, data| {
        format!("{:4}.{:06} 1  100             Rx   d 8 {}\n", us / 1_000_000, us % 1_000_000, hex(data, " "))
    };
    read(bencher, &log(header, line));
}

#[divan::bench]
fn trc(bencher: Bencher) {
    let line = |us: u64, data| {
        format!("{us:7} {:9}.{:03} DT 1      0100 Rx - 8    {}\n", us / 1000, us % 1000, hex(data, " "))
    };
    read(bencher, &log(";$FILEVERSION=2.1\n;$STARTTIME=45244.925\n", line));
}

#[divan::bench]
fn candump_screen(bencher: Bencher) {
    let line = |us: u64, data| {
        format!(" (17{:08}.{:06})  can0  100   [8]  {}\n", us / 1_000_000, us % 1_000_000, hex(data, " "))
    };
    read(bencher, &log("", line));
}

#[divan::bench]
fn gvret(bencher: Bencher) {
    let header = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n";
    read(bencher, &log(header, |us, data| format!("{us},00000100,false,Rx,0,8,{},\n", hex(data, ","))));
}
