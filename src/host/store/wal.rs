//! Reads SQLite's write-ahead log: finds pages that SQLite will not read, and gives a salvage those that it would.
//!
//! SQLite reads a log up to the first page with a wrong checksum and drops the rest silently: after a power cut the rest is
//! a transaction that was never completed, but after damage it is the results learned last. In: the log next to the
//! database, before the database is opened. Out: the fault. A log that is missing, empty or unreadable has none; neither
//! has a log whose end alone is missing.
//!
//! The format is that of <https://www.sqlite.org/fileformat2.html#walformat>.

use std::collections::HashMap;
use std::path::Path;

/// First four bytes without the last bit, which is the byte order of the checksums.
const MAGIC: u32 = 0x377F_0682;
/// Bytes of the log's header, of a frame's, and of the part of a frame's that its checksum covers.
const HEADER: usize = 32;
const FRAME_HEADER: usize = 24;
const FRAME_COVERED: usize = 8;

/// Earlier rounds of the log whose pages may still follow those of the current round.
const MAX_ROUNDS: u32 = 1 << 24;

/// A fault of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Fault {
    /// Completed transactions are lost: which, and where.
    Damaged(String),
    /// The last transaction, from this page on, is incomplete: the power was cut while it was written, or it is damaged.
    LastStep(usize),
}

/// The fault of a log; `None` = no visible fault.
pub(super) fn fault(path: &Path) -> Option<Fault> {
    let log = std::fs::read(path).ok()?;
    check(&log)
}

/// The pages of a log's complete transactions by their numbers in the database, each in its last version; empty without a
/// readable log.
pub(super) fn pages(path: &Path) -> HashMap<u32, Vec<u8>> {
    let Ok(log) = std::fs::read(path) else { return HashMap::new() };
    let mut pages = HashMap::new();
    let Some(Header { page_bytes, mut sum, is_big }) = Header::read(&log) else { return pages };
    let mut uncommitted = Vec::new();
    for frame in log[HEADER..].chunks_exact(FRAME_HEADER + page_bytes) {
        sum = frame_sum(sum, frame, is_big);
        if frame[8..16] != log[16..24] || sum != (word(frame, 16), word(frame, 20)) {
            break;
        }
        uncommitted.push((word(frame, 0), frame[FRAME_HEADER..].to_vec()));
        if word(frame, 4) != 0 {
            pages.extend(uncommitted.drain(..));
        }
    }
    pages
}

/// The header of a log.
struct Header {
    page_bytes: usize,
    sum: (u32, u32),
    is_big: bool,
}

impl Header {
    /// `None` = its checksum is wrong, or no log has that page size.
    fn read(log: &[u8]) -> Option<Self> {
        let header = log.get(..HEADER)?;
        let is_big = word(header, 0) == MAGIC | 1;
        let sum = checksum((0, 0), &header[..24], is_big);
        let is_good = word(header, 0) & !1 == MAGIC && sum == (word(header, 24), word(header, 28));
        let page_bytes = usize::try_from(word(header, 8)).ok().filter(|bytes| (512..=65_536).contains(bytes))?;
        is_good.then_some(Self { page_bytes, sum, is_big })
    }
}

fn frame_sum(sum: (u32, u32), frame: &[u8], is_big: bool) -> (u32, u32) {
    checksum(checksum(sum, &frame[..FRAME_COVERED], is_big), &frame[FRAME_HEADER..], is_big)
}

fn check(log: &[u8]) -> Option<Fault> {
    let (header, frames) = log.split_at_checked(HEADER)?;
    if header.iter().all(|&byte| byte == 0) {
        return None; // space that was never written
    }
    let Some(Header { page_bytes, mut sum, is_big }) = Header::read(log) else {
        return Some(Fault::Damaged(
            "the header of the write-ahead log is damaged: what was stored last is lost".to_owned(),
        ));
    };
    let mut first_bad = None;
    let mut later_commits = 0_u32;
    for (number, frame) in frames.chunks_exact(FRAME_HEADER + page_bytes).enumerate() {
        if is_of_earlier_round(frame, header) {
            continue;
        }
        if first_bad.is_some() {
            later_commits += u32::from(word(frame, 4) != 0);
            continue;
        }
        let next = frame_sum(sum, frame, is_big);
        if frame[8..16] == header[16..24] && next == (word(frame, 16), word(frame, 20)) {
            sum = next;
        } else {
            later_commits = u32::from(word(frame, 4) != 0);
            first_bad = Some(number + 1);
        }
    }
    // One: the pages of an interrupted transaction may have reached the disk in any order.
    first_bad.map(|page| match later_commits {
        0 | 1 => Fault::LastStep(page),
        lost => Fault::Damaged(format!(
            "page {page} of the write-ahead log is damaged: what was stored in up to {lost} later steps is lost"
        )),
    })
}

/// Whether a frame is from an earlier round of the log: each round increments the first salt and draws the second.
fn is_of_earlier_round(frame: &[u8], header: &[u8]) -> bool {
    let rounds = word(header, 16).wrapping_sub(word(frame, 8));
    (1..MAX_ROUNDS).contains(&rounds) && word(frame, 12) != word(header, 20)
}

/// The big-endian word at a place.
fn word(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..at + 4).and_then(|bytes| bytes.try_into().ok()).map_or(0, u32::from_be_bytes)
}

fn checksum(mut sum: (u32, u32), bytes: &[u8], is_big: bool) -> (u32, u32) {
    let (words, _) = bytes.as_chunks::<4>();
    let value = |bytes: [u8; 4]| if is_big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) };
    for pair in words.chunks_exact(2) {
        sum.0 = sum.0.wrapping_add(value(pair[0])).wrapping_add(sum.1);
        sum.1 = sum.1.wrapping_add(value(pair[1])).wrapping_add(sum.0);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A log of several commits, as SQLite leaves it when the process is killed.
    fn log() -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.db");
        let connection = rusqlite::Connection::open(&path).unwrap();
        connection.execute_batch("PRAGMA journal_mode = WAL; CREATE TABLE t (x)").unwrap();
        for number in 0..20 {
            connection.execute("INSERT INTO t VALUES (?1)", [number]).unwrap();
        }
        std::fs::read(folder.path().join("x.db-wal")).unwrap()
    }

    #[test]
    fn a_flipped_bit_is_found_wherever_it_is() {
        let good = log();
        assert_eq!(check(&good), None);
        let frame = FRAME_HEADER + usize::try_from(word(&good, 8)).unwrap();
        let last = good.len() - frame;
        let places = (0..good.len())
            .step_by(997)
            .chain((HEADER..good.len()).step_by(frame).flat_map(|at| at..at + FRAME_HEADER));
        for at in places {
            for bit in 0..8 {
                let mut bad = good.clone();
                bad[at] ^= 1 << bit;
                match check(&bad) {
                    Some(Fault::Damaged(_)) => assert!(at < last, "byte {at}"),
                    // A transaction may reach the disk in any order; without its mark, its pages count to the next one.
                    Some(Fault::LastStep(_)) => assert!(at + frame >= last, "byte {at}"),
                    None => panic!("byte {at}, bit {bit}"),
                }
            }
        }
    }

    #[test]
    fn a_torn_end_is_no_damage() {
        let good = log();
        for length in [0, 10, HEADER, HEADER + 100, good.len() / 2, good.len() - 1] {
            assert_eq!(check(&good[..length]), None, "{length} bytes");
        }
        for zeroed in [10, FRAME_HEADER + 4096] {
            let mut torn = good.clone();
            let kept = torn.len() - zeroed;
            torn[kept..].fill(0);
            assert!(matches!(check(&torn), Some(Fault::LastStep(_))), "{zeroed} bytes");
        }
    }

    #[test]
    fn frames_of_an_earlier_round_are_no_fault() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.db");
        let connection = rusqlite::Connection::open(&path).unwrap();
        connection.execute_batch("PRAGMA journal_mode = WAL; CREATE TABLE t (x)").unwrap();
        for round in 0..4 {
            for number in 0..20 - 5 * round {
                connection.execute("INSERT INTO t VALUES (?1)", [number]).unwrap();
            }
            let log = std::fs::read(folder.path().join("x.db-wal")).unwrap();
            assert_eq!(check(&log), None, "round {round}");
            connection.execute_batch("PRAGMA wal_checkpoint(RESTART)").unwrap();
        }
    }
}
