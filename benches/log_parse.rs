//! How fast candump lines are parsed, beside the newline scan that any reader must do.

use packwatch::io::candump::{Line, parse_line};

fn main() {
    divan::main();
}

/// Lines of one log, about 1 MB.
const LINES: u64 = 25_000;

/// Classic frames of 8 bytes on two interfaces, as a pack at work sends them.
fn log() -> Vec<u8> {
    let line = |n: u64| {
        let data = n.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        format!("(17000{:05}.{:06}) can{} {:03X}#{data:016X}\n", n / 1000, n % 1000 * 1000, n % 2, n % 0x7FF)
    };
    (0..LINES).flat_map(|n| line(n).into_bytes()).collect()
}

#[divan::bench]
fn newline_scan(bencher: divan::Bencher) {
    let text = log();
    bencher.counter(divan::counter::ItemsCount::new(LINES)).bench_local(|| memchr::memchr_iter(b'\n', &text).count());
}

#[divan::bench]
fn scan_and_parse(bencher: divan::Bencher) {
    let text = log();
    bencher.counter(divan::counter::ItemsCount::new(LINES)).bench_local(|| {
        let (mut start, mut frames) = (0, 0u64);
        for end in memchr::memchr_iter(b'\n', &text) {
            if let Ok(Line::Frame { frame, .. }) = parse_line(&text[start..end]) {
                frames += u64::from(divan::black_box(&frame).data().len() == 8);
            }
            start = end + 1;
        }
        assert_eq!(frames, LINES);
    });
}
