//! Flips single bits of a small store. After each flip, it must still be possible to write the store, and the learned
//! capacity must survive.
//!
//! By default, the test flips a sample of the bits. `PACKWATCH_FLIPS=all` tests every bit, `PACKWATCH_FLIPS=N` every
//! N-th bit.

use super::*;

/// Bits between two flips of the sample. The step is a prime, so that the flips reach every bit of a byte and every
/// place of a page.
const SAMPLE_STEP: usize = 397;

#[derive(Debug, Default)]
struct FlipCounts {
    flips: usize,
    /// Number of flips after which the database was set aside.
    set_aside: usize,
    /// Number of flips after which the newest state was not found.
    older: usize,
    /// Flips with a failure: an altered row was shown, no undamaged state was found, nothing could be written, or the
    /// written state or the history's rows were missing at the next start.
    failed: Vec<(&'static str, usize, String)>,
}

/// The undamaged store after the replay of a log of one cell.
struct Reference {
    files: Vec<(&'static str, Vec<u8>)>,
    /// The states in the files, newest first.
    states: [Vec<u8>; 2],
    now: Stamp,
    /// The state that is written after each flip.
    next: StateDocument,
    entries: Vec<HistoryEntry>,
}

/// A folder in memory if the system has one, because a flip needs several syncs.
fn place() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

fn json(snapshot: &Snapshot) -> Vec<u8> {
    serde_json::to_vec(snapshot).unwrap()
}

fn opened(place: &Path, now: &Stamp) -> (OpenedFolder, Folder) {
    let mut folder = Folder::new(place.to_owned());
    (OpenedFolder::open(&mut folder, None, now), folder)
}

impl Reference {
    fn new() -> Self {
        let place = place();
        let state = place.path().join("state");
        snapshot(None, Some(Recorder::create(&state, &config().store, &VehicleIdentity::default()).unwrap()));
        let [database, a, b] = [DATABASE, state_files::FILES[0], state_files::FILES[1]];
        let files = [database, a, b].map(|name| (name, std::fs::read(state.join(name)).unwrap())).to_vec();
        let newest = stored(&state);
        let newest_file = state_files::FILES.into_iter().find(|name| {
            let kept = std::fs::read(state.join(name)).unwrap();
            std::fs::write(state.join(name), "").unwrap();
            let is_newest = stored(&state).number < newest.number;
            std::fs::write(state.join(name), kept).unwrap();
            is_newest
        });
        std::fs::remove_file(state.join(newest_file.unwrap())).unwrap();
        let states = [json(&newest.snapshot), json(&stored(&state).snapshot)];
        // Writes the next state and reads it back. The test later compares it with states that were read from files,
        // and a file contains rounded numbers.
        StateFiles::open(&state).0.write(document(2, 100, 1_900_000_000)).unwrap();
        let next = stored(&state);
        let entries = HistoryReader::open(&state).unwrap().entries(&HistoryQuery::default()).unwrap();
        assert!(entries.len() > 3, "{entries:?}");
        Self { files, entries, states, now: document(2, 200, 1_900_000_100).stamp, next }
    }

    fn flip(&self, name: &'static str, bit: usize, place: &Path, counts: &mut FlipCounts) {
        for (file, bytes) in &self.files {
            let mut bytes = bytes.clone();
            if *file == name {
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            std::fs::write(place.join(file), &bytes).unwrap();
        }
        counts.flips += 1;
        if let Some(row) = self.altered_row(place) {
            counts.failed.push((name, bit, format!("shown as good: {row:?}")));
        }
        if let Err(why) = self.start(name, place, counts) {
            counts.failed.push((name, bit, why));
        }
        counts.set_aside += usize::from(place.join("packwatch.db.damaged-1").exists());
        for file in std::fs::read_dir(place).unwrap() {
            std::fs::remove_file(file.unwrap().path()).unwrap();
        }
    }

    /// A row that the history shows, but that was not written.
    fn altered_row(&self, place: &Path) -> Option<HistoryEntry> {
        let shown = HistoryReader::open(place).ok()?.entries(&HistoryQuery::default()).ok()?;
        shown.into_iter().find(|entry| !self.entries.contains(entry))
    }

    /// Starts with the damaged store, writes a state, and starts again.
    fn start(&self, flipped: &str, place: &Path, counts: &mut FlipCounts) -> Result<(), String> {
        let (OpenedFolder { database, state_files, found, .. }, folder) = opened(place, &self.now);
        let state = found.states.first().map(|state| json(&state.snapshot)).ok_or("no state")?;
        let is_newest = state == self.states[0];
        counts.older += usize::from(!is_newest);
        if !is_newest && (flipped == DATABASE || state != self.states[1]) {
            return Err("another state".to_owned());
        }
        let mut writer = Writer { database, state_files, folder, ..writer(place) };
        let rows = vec![HistoryRow::Event(rows::tests::capacity(0, Some(2.0), 1.9))];
        let mut batches = vec![RowBatch { stamp: self.now, rows }];
        // The second attempt sets a damaged database aside.
        writer.commit(&mut batches, &self.next).or_else(|_| writer.commit(&mut batches, &self.next))?;
        drop(writer);
        let (OpenedFolder { database, found, .. }, _folder) = opened(place, &self.now);
        let is_stored = found.states.first().is_some_and(|state| json(&state.snapshot) == json(&self.next.snapshot));
        (is_stored && database.is_some_and(|database| database.rows() > 0))
            .then_some(())
            .ok_or("it is not there".to_owned())
    }
}

#[test]
fn learned_capacity_survives_any_flipped_bit() {
    let step = match std::env::var("PACKWATCH_FLIPS") {
        Ok(all) if all == "all" => 1,
        Ok(step) => step.parse().unwrap(),
        Err(_) => SAMPLE_STEP,
    };
    let (reference, place, mut counts) = (Reference::new(), place(), FlipCounts::default());
    for (name, bytes) in &reference.files {
        for bit in (0..8 * bytes.len()).step_by(step) {
            reference.flip(name, bit, place.path(), &mut counts);
        }
        eprintln!("{name}, {} bytes", bytes.len());
    }
    let FlipCounts { flips, set_aside, older, failed } = &counts;
    eprintln!("{flips} flips: {} failed, {older} with the older state, {set_aside} databases set aside", failed.len());
    assert!(failed.is_empty(), "{:?}", &failed[..failed.len().min(9)]);
    assert!(*older > 0 && *set_aside > 0, "{counts:?}");
}
