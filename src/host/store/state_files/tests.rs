//! Tests writing, reading, damaging and setting aside state files on a real file system.

use super::super::tests::document;
use super::*;

/// Creates a folder in memory if the system has one, because each write syncs several times, which is slow on a disk.
fn place() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

/// Writes a state for each of these packs, in order.
fn written(folder: &Path, packs: impl IntoIterator<Item = i64>) -> StateFiles {
    let mut files = StateFiles::open(folder).0;
    for pack in packs {
        files.write(StateDocument { pack, ..document(1, 100, 1_800_000_000) }).unwrap();
    }
    files
}

fn found(folder: &Path) -> (Option<i64>, Option<i64>, usize) {
    let FoundStates { newest, aside, faults } = StateFiles::open(folder).1;
    (newest.map(|state| state.pack), aside.map(|state| state.pack), faults.len())
}

#[test]
fn states_are_written_alternately_newest_is_read() {
    let place = place();
    assert_eq!(found(place.path()), (None, None, 0));
    for pack in 1..=5 {
        // Between two states, the files are closed and opened again, as after a restart of the daemon.
        drop(written(place.path(), [pack]));
        assert_eq!(found(place.path()), (Some(pack), None, 0));
    }
    drop(written(place.path(), [6, 7, 8]));
    assert_eq!(found(place.path()), (Some(8), None, 0));
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 2);
}

#[test]
fn flipped_bit_is_detected_other_state_remains() {
    let place = place();
    drop(written(place.path(), [1, 2]));
    for (name, left) in [(FILES[1], 1), (FILES[0], 2)] {
        let (path, good) = (place.path().join(name), fs::read(place.path().join(name)).unwrap());
        for bit in 0..8 * good.len() {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(matches!(StateDocument::decode(&bad), Err(StateFault::Damaged(_))), "{name}, bit {bit}");
        }
        for bad in [&good[..good.len() - 1], &[], b"this is no state"] {
            fs::write(&path, bad).unwrap();
            assert_eq!(found(place.path()), (Some(left), None, 1), "{name}");
        }
        fs::write(&path, good).unwrap();
    }
}

#[test]
fn damaged_file_is_replaced_next() {
    let place = place();
    drop(written(place.path(), [1, 2]));
    fs::remove_file(place.path().join(FILES[1])).unwrap();
    fs::create_dir_all(place.path().join(FILES[1]).join("within")).unwrap();
    drop(written(place.path(), [3]));
    assert_eq!(found(place.path()), (Some(3), None, 0));
}

#[test]
fn zstd_decompressor_shows_json() {
    let place = place();
    drop(written(place.path(), [4711]));
    let file = File::open(place.path().join(FILES[0])).unwrap();
    let json: serde_json::Value = serde_json::from_slice(&zstd::decode_all(file).unwrap()).unwrap();
    assert_eq!((&json["format"], &json["pack"], &json["number"]), (&1.into(), &4711.into(), &1.into()));
    assert!(json["snapshot"].is_object());
}

#[test]
fn state_set_aside_survives_later_writes() {
    let place = place();
    let mut files = written(place.path(), [1, 2]);
    files.set_aside();
    files.write(StateDocument { pack: 3, ..document(1, 100, 1_800_000_000) }).unwrap();
    assert_eq!(found(place.path()), (Some(3), Some(2), 0));
    drop(written(place.path(), [4, 5]));
    assert_eq!(found(place.path()), (Some(5), Some(2), 0));
    forget(place.path()).unwrap();
    assert_eq!(found(place.path()), (None, None, 0));
    assert!(forget(place.path()).is_ok(), "there is nothing to forget");
}

#[test]
fn state_with_other_format_is_set_aside() {
    let place = place();
    drop(written(place.path(), [1]));
    let other = StateDocument { format: 1, ..document(1, 100, 1_800_000_000) }.encode().unwrap();
    let json = String::from_utf8(zstd::decode_all(&other[..]).unwrap()).unwrap();
    let mut file = zstd::bulk::compress(json.replacen("\"format\":1", "\"format\":2", 1).as_bytes(), LEVEL).unwrap();
    let hash = Sha256::digest(&file);
    file.extend([&HASH_HEAD[..], &hash].concat());
    assert_eq!(StateDocument::decode(&file).unwrap_err(), StateFault::Unfit("format 2, must be 1".to_owned()));
    fs::write(place.path().join(FILES[1]), &file).unwrap();
    assert_eq!(found(place.path()), (Some(1), None, 1));
    drop(written(place.path(), [2]));
    assert_eq!(fs::read(place.path().join(ASIDE)).unwrap(), file);
    assert_eq!(found(place.path()), (Some(2), None, 0));
}

#[test]
fn rounding_keeps_nine_digits_and_whole_numbers() {
    for (value, stored) in [
        (0.123_456_789_012, 0.123_456_789),
        (-1.234_567_890_12e-30, -1.234_567_89e-30),
        (123_456.123_456_789, 123_456.123_457),
        (4_294_967_295.0, 4_294_967_295.0),
        (1_700_000_000.123_456_8, 1_700_000_000.123_456_8),
        (f64::MAX, f64::MAX),
        (0.1, 0.1),
    ] {
        assert_eq!(rounded(value), stored);
    }
}
