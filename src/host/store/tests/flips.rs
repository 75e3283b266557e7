//! Every single-bit flip of a small store: it is written again, and the learned capacity is alive.
//!
//! The tests take a sample. `PACKWATCH_FLIPS=all` takes every bit, `PACKWATCH_FLIPS=N` every N-th; `PACKWATCH_STORE=FILE` takes
//! another database. The counts are printed.

use super::folder::Folder;
use super::retention::RowLimits;
use super::rows::tests::capacity;
use super::*;
use crate::monitor::LearnedCell;

/// Bits between two flips of the sample: a prime, so that every bit of a byte and every place of a page is met.
const SAMPLE_STEP: usize = 397;
/// Least part of the flips after which the learned capacity is alive.
const MIN_ALIVE: f64 = 0.999;
/// Least part of the rows that a replaced database has: a page whose head is damaged is lost, and in a small store a page is much.
const MIN_ROWS: f64 = 0.9;

/// What the flips led to.
#[derive(Debug, Default)]
struct FlipCounts {
    flips: usize,
    /// The database was replaced.
    rebuilt: usize,
    /// Neither of the two stored states was found.
    stateless: usize,
    /// Neither a state nor the learned capacity was found.
    forgotten: usize,
    /// Rows of the history that replaced databases were to have, and those they have.
    rows: (i64, i64),
    /// Nothing could be written, or it was not there at the next start.
    never_written: Vec<(usize, String)>,
}

/// The undamaged store.
struct Reference {
    bytes: Vec<u8>,
    /// The stored state, and those that are read when a record is damaged.
    states: Vec<Vec<u8>>,
    learned: Vec<LearnedCell>,
    /// Rows of its history.
    rows: i64,
    now: Stamp,
    /// The state that is written after each flip.
    next: StateDocument,
}

/// Memory where the system has a folder for it: a flip costs several syncs.
fn place() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

fn json(state: &StateDocument) -> Vec<u8> {
    serde_json::to_vec(&state.snapshot).unwrap()
}

impl Reference {
    fn of(bytes: Vec<u8>) -> Self {
        let place = place();
        std::fs::write(place.path().join(DATABASE), &bytes).unwrap();
        let now = document(2, 200, 1_900_000_100).stamp;
        let opening = Folder::new(place.path().to_owned(), RowLimits::SMALL).open(&now).unwrap();
        assert!(opening.is_sound);
        let mut states = vec![json(&opening.state.unwrap())];
        let learned = opening.database.learned().unwrap();
        let found = opening.database.counts();
        drop(opening.database);
        // Without a copy the other is read, and without the deltas the full records.
        let delta_lost = "UPDATE state SET serial = -1 WHERE slot = 1";
        let both_lost = format!("DELETE FROM state_b; {delta_lost}");
        let other_lost = format!("DELETE FROM state; {}", delta_lost.replace("state", "state_b"));
        for change in ["DELETE FROM state", "DELETE FROM state_b", &both_lost, &other_lost] {
            std::fs::write(place.path().join(DATABASE), &bytes).unwrap();
            let opening = Folder::new(place.path().to_owned(), RowLimits::SMALL).open(&now).unwrap();
            opening.database.connection().execute_batch(change).unwrap();
            let other = opening.database.state().unwrap().unwrap();
            states.extend(other.map(|other| json(&StateDocument::parse(&other.json).unwrap())));
        }
        let rows = found.chained + found.half_cycles;
        Self { bytes, states, learned, rows, now, next: document(2, 100, 1_900_000_000) }
    }

    fn flip(&self, bit: usize, place: &Path, counts: &mut FlipCounts) {
        let mut bytes = self.bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        std::fs::write(place.join(DATABASE), &bytes).unwrap();
        counts.flips += 1;
        if let Err(why) = self.start(place, counts) {
            counts.never_written.push((bit, why));
        }
        counts.rebuilt += usize::from(place.join("packwatch.db.damaged-1").exists());
        for file in std::fs::read_dir(place).unwrap() {
            std::fs::remove_file(file.unwrap().path()).unwrap();
        }
    }

    /// Starts with the damaged store, writes, and starts again.
    fn start(&self, place: &Path, counts: &mut FlipCounts) -> Result<(), String> {
        let mut folder = Folder::new(place.to_owned(), RowLimits::SMALL);
        let opening = folder.open(&self.now).map_err(|error| error.to_string())?;
        if place.join("packwatch.db.damaged-1").exists() {
            let found = opening.database.counts();
            counts.rows.0 += self.rows;
            // One says that it was damaged.
            counts.rows.1 += found.chained + found.half_cycles - 1;
        }
        let is_alive = |learned: &[LearnedCell]| learned == self.learned && !learned.is_empty();
        match &opening.state {
            Some(state) if self.states.contains(&json(state)) => {}
            Some(_) => return Err("a state that was never stored".to_owned()),
            None => {
                counts.stateless += 1;
                counts.forgotten += usize::from(!is_alive(&opening.learned));
            }
        }
        let record = || StateRecord::new(&self.next, true, false).unwrap();
        let rows = vec![HistoryRow::Event(capacity(0, Some(2.0), 1.9))];
        let batch = RowBatch { stamp: self.now, rows };
        let mut database = opening.database;
        if let Err(error) = database.commit(std::slice::from_ref(&batch), Some(record())) {
            // As the writer: the next attempt replaces it.
            drop(database);
            folder.mark_damaged(&error.to_string());
            database = folder.open(&self.now).map_err(|again| format!("{error}, then {again}"))?.database;
            database.commit(&[batch], Some(record())).map_err(|again| format!("{error}, then {again}"))?;
        }
        drop((database, folder));
        let again = Folder::new(place.to_owned(), RowLimits::SMALL).open(&self.now);
        let opening = again.map_err(|error| format!("again: {error}"))?;
        match opening.state {
            Some(found) if json(&found) == json(&self.next) => Ok(()),
            _ => Err("what was written is not there".to_owned()),
        }
    }
}

/// A small store as a daemon leaves it: a replayed day of one cell.
fn small_store() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    snapshot(None, Some(Recorder::create(&state, &config().store, &VehicleIdentity::default()).unwrap()));
    std::fs::read(state.join(DATABASE)).unwrap()
}

/// Stores that earlier programs never wrote again, took for a newer program's or rebuilt with nothing.
#[test]
fn damaged_stores_of_earlier_programs_are_written_again_with_what_was_learned() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let data = std::env::var_os("PACKWATCH_DATA").map_or(shared, PathBuf::from);
    let folder = data.join("../more-data/hardening");
    let Ok(base) = std::fs::read(folder.join("store-base.db")) else {
        return eprintln!("not run: no {}", folder.display());
    };
    let reference = Reference::of(base);
    for entry in std::fs::read_dir(&folder).unwrap() {
        let file = entry.unwrap().path();
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        if name.starts_with("store-") {
            let (place, mut counts) = (place(), FlipCounts::default());
            std::fs::copy(&file, place.path().join(DATABASE)).unwrap();
            std::fs::set_permissions(place.path().join(DATABASE), std::os::unix::fs::PermissionsExt::from_mode(0o600))
                .unwrap();
            reference.start(place.path(), &mut counts).unwrap_or_else(|why| panic!("{name}: {why}"));
            assert_eq!(counts.forgotten, 0, "{name}");
            eprintln!("{name}: {}", if counts.stateless > 0 { "capacities of the history" } else { "state" });
        }
    }
}

#[test]
fn after_any_flipped_bit_the_store_is_written_and_the_learned_capacity_is_alive() {
    let step = match std::env::var("PACKWATCH_FLIPS") {
        Ok(all) if all == "all" => 1,
        Ok(step) => step.parse().unwrap(),
        Err(_) => SAMPLE_STEP,
    };
    let bytes = std::env::var("PACKWATCH_STORE").map_or_else(|_| small_store(), |file| std::fs::read(file).unwrap());
    let reference = Reference::of(bytes);
    let (place, mut counts) = (place(), FlipCounts::default());
    for bit in (0..8 * reference.bytes.len()).step_by(step) {
        reference.flip(bit, place.path(), &mut counts);
    }
    let FlipCounts { flips, rebuilt, stateless, forgotten, rows: (wanted, saved), never_written } = &counts;
    let bytes = reference.bytes.len();
    let never = never_written.len();
    eprintln!(
        "{bytes} bytes, {flips} flips: {never} never written, {forgotten} forgotten, {stateless} without a state, {rebuilt} rebuilt \
         with {saved} of {wanted} rows"
    );
    assert!(never_written.is_empty(), "{never_written:?}");
    assert!(*saved as f64 >= MIN_ROWS * *wanted as f64 && *wanted > 0, "{counts:?}");
    assert!(*forgotten as f64 <= (1.0 - MIN_ALIVE) * *flips as f64, "{counts:?}");
}
