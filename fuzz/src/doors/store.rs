//! Fuzz entry point for a store whose database or state file has changed bytes or is cut off. Reading and opening the
//! store must succeed or report a reason. If the store opens, a daemon must be able to run on it.

use std::path::Path;
use std::sync::OnceLock;

use packwatch::config::VehicleIdentity;
use packwatch::io::place::PlaceSetting;
use packwatch::monitor::{Monitor, Outputs};
use packwatch::quantity::Timestamp;
use packwatch::store::{HistoryQuery, HistoryReader, Store};

use super::core::records;
use super::files::folder;
use super::source::Source;
use super::world;

/// Fuzz input for a drive with a half-cycle (a complete charge or discharge).
const DRIVE: &[u8] = &[7, 0xE8, 3, 6, 31, 6, 31, 7, 0x18, 0xFC, 6, 31, 6, 31, 7, 0xE8, 3, 6, 31];

const FILES: [&str; 3] = ["packwatch.db", "state-a.json.zst", "state-b.json.zst"];

fn stored() -> &'static [Vec<u8>; 3] {
    static STORED: OnceLock<[Vec<u8>; 3]> = OnceLock::new();
    STORED.get_or_init(|| {
        let folder = folder();
        // Writing twice fills both state files.
        (0..2).for_each(|_| write(folder.path()));
        FILES.map(|name| std::fs::read(folder.path().join(name)).expect("a file"))
    })
}

/// Opens the store, drives and stops, as a daemon does.
fn write(path: &Path) {
    let config = world::config();
    let setting = PlaceSetting::At(path.to_owned());
    let Ok((store, found)) = Store::open(&setting, &config.store, &VehicleIdentity::default()) else { return };
    let mut monitor = Monitor::new(config.monitor.clone());
    for state in found.states {
        let _ = monitor.restore(state.snapshot, state.downtime);
    }
    let Some(mut store) = store else { return };
    let (mut out, mut now) = (Outputs::default(), Timestamp::ZERO);
    for record in records(&mut Source::new(DRIVE)) {
        out.clear();
        monitor.handle(&record, &mut out);
        now = record.time;
        store.learned(&out.events, &monitor, now);
    }
    store.finish(&monitor, now);
}

/// Damages a file of a store (see the module documentation).
pub fn store(data: &[u8]) {
    let mut source = Source::new(data);
    let mut files = stored().clone();
    let bytes = &mut files[usize::from(source.byte()) % FILES.len()];
    for _ in 0..=source.byte() % 8 {
        let (at, length) =
            (usize::from(source.u16()) | usize::from(source.byte()) << 16, 1 + usize::from(source.byte() % 8));
        let at = at % bytes.len();
        let end = (at + length).min(bytes.len());
        bytes[at..end].iter_mut().for_each(|byte| *byte ^= source.byte());
    }
    if source.byte().is_multiple_of(8) {
        bytes.truncate(usize::from(source.u16()));
    }
    let folder = folder();
    for (name, bytes) in FILES.iter().zip(&files) {
        std::fs::write(folder.path().join(name), bytes).expect("written");
    }
    if let Ok(reader) = HistoryReader::open(folder.path()) {
        let _ = (reader.verify(), reader.snapshot(), reader.entries(&HistoryQuery::default()));
    }
    write(folder.path());
}
