//! Fuzz entry point for a stored state with some numbers replaced, or for arbitrary bytes. If the state is not
//! rejected, the monitor must start from it, run, and accept the state that it then writes.

use std::sync::OnceLock;

use packwatch::monitor::{Downtime, Monitor, Outputs, Snapshot};

use super::core::{check, records};
use super::source::Source;
use super::world;

/// Fuzz input for a drive that fills every part of the state: load, rest, an alarm, a test alarm, a diagnostic answer.
const DRIVE: &[u8] = &[
    7, 0xE8, 3, 6, 31, 6, 31, 15, 0, 7, 0x18, 0xFC, 6, 31, 6, 31, 8, 120, 0, 31, 23, 5, 14, 1, 0, 0, 0, 0, 0, 3, 0, 31,
];

fn stored() -> &'static str {
    static STORED: OnceLock<String> = OnceLock::new();
    STORED.get_or_init(|| {
        let mut monitor = Monitor::new(world::config().monitor.clone());
        let mut out = Outputs::default();
        records(&mut Source::new(DRIVE)).iter().for_each(|record| monitor.handle(record, &mut out));
        serde_json::to_string(&monitor.snapshot()).expect("a snapshot serialises to JSON")
    })
}

fn numbers(text: &str) -> Vec<(usize, usize)> {
    let (mut found, mut begin, mut is_text) = (Vec::new(), None, false);
    for (at, byte) in text.bytes().enumerate() {
        is_text ^= byte == b'"';
        match (begin, byte.is_ascii_digit() || matches!(byte, b'-' | b'+' | b'.' | b'e' | b'E')) {
            (None, true) if !is_text && (byte.is_ascii_digit() || byte == b'-') => begin = Some(at),
            (Some(from), false) => {
                found.push((from, at));
                begin = None;
            }
            _ => {}
        }
    }
    found
}

fn changed(source: &mut Source<'_>) -> Vec<u8> {
    if source.byte().is_multiple_of(16) {
        return source.rest().to_vec();
    }
    let mut text = stored().to_owned();
    for _ in 0..=source.byte() % 4 {
        let places = numbers(&text);
        let (from, to) = places[usize::from(source.u16()) % places.len()];
        let number = source.number();
        let digits = if number.is_finite() { format!("{number:e}") } else { "null".to_owned() };
        let digits = if source.byte().is_multiple_of(2) { digits } else { source.i16().to_string() };
        text.replace_range(from..to, &digits);
    }
    text.into_bytes()
}

/// Tests a stored state (see the module documentation).
pub fn snapshot(data: &[u8]) {
    let mut source = Source::new(data);
    let downtimes = [Downtime::AsStamped, Downtime::Unknown, Downtime::Seconds(0.0), Downtime::Seconds(1e9)];
    let downtime = source.one_of(&downtimes);
    let Ok(snapshot) = serde_json::from_slice::<Snapshot>(&changed(&mut source)) else { return };
    let mut monitor = Monitor::new(world::config().monitor.clone());
    if monitor.restore(snapshot, downtime).is_err() {
        return;
    }
    let mut out = Outputs { want_estimates: true, ..Outputs::default() };
    for record in records(&mut Source::new(&DRIVE[..16])).iter().take(400) {
        out.clear();
        monitor.handle(record, &mut out);
        check(record, &out);
    }
    let text = serde_json::to_string(&monitor.snapshot()).expect("a snapshot serialises to JSON");
    let snapshot: Snapshot = serde_json::from_str(&text).expect("its own snapshot reads back");
    let mut again = Monitor::new(world::config().monitor.clone());
    let accepted = again.restore(snapshot, Downtime::AsStamped);
    assert!(accepted.is_ok(), "the monitor rejects its own state: {accepted:?}");
}
