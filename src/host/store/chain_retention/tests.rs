//! A long history of a pack and its successor, thinned.

use super::super::database::Database;
use super::super::folder::DATABASE;
use super::super::reader::{HistoryQuery, HistoryReader};
use super::super::retention::RowLimits;
use super::super::rows::tests::{alarm, capacity, half_cycle, loss_modes, model, remaining_life};
use super::super::rows::{HistoryRow, RowBatch};
use super::super::salvage::salvage;
use super::super::stamp::Stamp;
use super::super::verify::{self, BrokenRow, ChainReport, NotedHead, contradiction};
use super::*;
use crate::alarm::Change;
use crate::monitor::EventKind;
use crate::quantity::{CellIndex, Timestamp};

const MAX_ROWS: i64 = 1000;
const CELLS: u16 = 8;
/// Hours after which the second pack was connected, and of the whole history.
const EXCHANGED: u32 = 300;
const HOURS: u32 = 1200;

/// Memory where the system has a folder for it: a commit costs several syncs.
fn place() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

fn open(path: &std::path::Path) -> Database {
    let limits = RowLimits { chained_rows: MAX_ROWS, half_cycles: 100_000 };
    Database::open(path, &Stamp::replayed(Timestamp::ZERO), limits).unwrap()
}

/// Writes an hour's rows, and as many checkpoints.
fn commit(database: &mut Database, hour: u32, kinds: &[EventKind], checkpoints: u32) {
    let stamp = Stamp::replayed(Timestamp::from_secs(3600.0 * f64::from(hour)));
    let rows = kinds.iter().copied().map(HistoryRow::Event).collect();
    database.commit(&[RowBatch { stamp, rows }], None).unwrap();
    (0..checkpoints).for_each(|_| database.commit(&[], None).unwrap());
}

/// Every hour a capacity and the losses of each cell and a remaining life, now and then an alarm, another cell model and the reset of a
/// filter. Returns the chain's end after each hour.
fn filled(path: &std::path::Path) -> (Database, Vec<(i64, String)>) {
    let mut database = open(path);
    let mut heads = Vec::new();
    for hour in 0..HOURS {
        // Fewer checkpoints than an hour has.
        commit(&mut database, hour, &hour_of(hour), 12);
        heads.push(database.head());
    }
    (database, heads)
}

fn hour_of(hour: u32) -> Vec<EventKind> {
    let mut kinds = vec![remaining_life(500.0 - 0.1 * f64::from(hour))];
    kinds.extend((0..CELLS).flat_map(|cell| {
        let ah = 2.5 - 1e-4 * f64::from(hour);
        [capacity(cell, Some(ah), ah), loss_modes(cell, 1e-4 * f64::from(hour))]
    }));
    if hour.is_multiple_of(4) {
        kinds.push(raised(1 + hour / 4));
        kinds.push(model(Some(2.5 - 1e-4 * f64::from(hour))));
        kinds.push(EventKind::FilterReset { cell: CellIndex(3) });
    }
    if hour == EXCHANGED {
        kinds.push(EventKind::PackReplaced { capacity_ah: Some(2.4), capacity_std_ah: Some(0.1) });
    }
    if hour == 7 {
        kinds.push(half_cycle(0));
    }
    kinds
}

fn raised(times: u32) -> EventKind {
    let mut kind = alarm(Change::Raised);
    if let EventKind::Alarm { ref mut occurrences, .. } = kind {
        *occurrences = times;
    }
    kind
}

fn number(database: &Database, sql: &str) -> i64 {
    database.connection().query_row(sql, [], |row| row.get(0)).unwrap()
}

fn verify(database: &Database) -> ChainReport {
    verify::verify_with(database.connection(), MAX_ROWS / 2).unwrap()
}

fn broken(database: &Database) -> Option<BrokenRow> {
    verify(database).broken
}

#[test]
fn a_long_history_is_bounded_and_still_verified() {
    let place = place();
    let path = place.path().join(DATABASE);
    let (database, heads) = filled(&path);
    let written = database.counts().chained;
    assert!(written > 20 * MAX_ROWS, "{written}");
    let report = verify(&database);
    assert_eq!(report.broken, None);
    assert_eq!((report.rows, report.good_rows), (written, written - report.thinned_rows));
    let sum: Vec<String> =
        HistoryTable::CHAINED.iter().map(|table| format!("(SELECT count(*) FROM {})", table.name())).collect();
    assert_eq!(number(&database, &format!("SELECT {}", sum.join(" + "))), report.good_rows);
    // A pass over all tables later, and with the rows that are never thinned.
    let bound = MAX_ROWS + MAX_ROWS / 2;
    assert!((MAX_ROWS / 2..=bound).contains(&report.good_rows), "{} of {written}", report.good_rows);
    let latest = format!("SELECT count(*) FROM capacity WHERE seq > {}", written - MAX_ROWS / 2);
    assert!(number(&database, &latest) >= MAX_ROWS / 2 * 8 / 18, "the latest half is whole");
    for (pack, first, last) in [(1, 0, EXCHANGED), (2, EXCHANGED + 1, HOURS - 1)] {
        for cell in 0..CELLS {
            let ends = format!(
                "SELECT count(*) FROM capacity r JOIN moment m ON m.id = r.moment WHERE cell = {cell} AND pack = {pack} AND \
                 time_ns IN ({first} * 3600000000000, {last} * 3600000000000)"
            );
            assert_eq!(number(&database, &ends), 2, "the ends of cell {cell} of pack {pack}");
        }
    }
    let alarms = number(&database, "SELECT count(*) FROM alarm WHERE occurrences <= 100");
    assert_eq!(alarms, 100, "the first hundred occurrences");
    assert!(
        number(&database, "SELECT count(*) FROM alarm") < i64::from(HOURS / 4),
        "an alarm that comes and goes is thinned"
    );
    let models = number(&database, "SELECT count(*) FROM model");
    let early = "SELECT count(*) FROM model r JOIN moment m ON m.id = r.moment WHERE time_ns < 400 * 3600000000000";
    assert_eq!(number(&database, early), 100, "the first hundred models");
    assert!((101..i64::from(HOURS / 4)).contains(&models), "{models} models");
    assert_eq!(number(&database, "SELECT count(*) FROM reset WHERE reason = 'pack_replaced'"), 1);
    assert_eq!(number(&database, "SELECT count(*) FROM half_cycle h JOIN moment m ON m.id = h.moment"), 1);
    let unused = "SELECT count(*) FROM moment WHERE id NOT IN (SELECT moment FROM capacity UNION SELECT moment FROM loss_modes \
                  UNION SELECT moment FROM remaining_life UNION SELECT moment FROM model UNION SELECT moment FROM alarm \
                  UNION SELECT moment FROM reset UNION SELECT moment FROM half_cycle)";
    assert_eq!(number(&database, unused), 0, "moments without a row");

    // Ends that were noted: each fits, or is said to be thinned out.
    let (mut fit, mut gone) = (0, 0);
    for (rows, hash) in &heads {
        match contradiction(database.connection(), &NotedHead { rows: *rows, hash: hash.clone() }).unwrap() {
            None => fit += 1,
            Some(why) if why.contains("thinned out since") => gone += 1,
            Some(why) => panic!("{why}"),
        }
        let other = NotedHead { rows: *rows, hash: "0".repeat(64) };
        assert!(contradiction(database.connection(), &other).unwrap().is_some());
    }
    assert!(fit > 30 && gone > 100, "{fit} fit, {gone} cannot be compared");
    database.close().unwrap();
    assert_eq!(open(&path).counts().chained, written, "it is opened as sound");
    let reader = HistoryReader::open(place.path()).unwrap();
    let shown = reader.entries(&HistoryQuery::default()).unwrap();
    assert_eq!(i64::try_from(shown.len()).unwrap(), report.good_rows + 1);
}

#[test]
fn short_runs_of_the_daemon_together_reach_all_tables() {
    let place = place();
    let path = place.path().join(DATABASE);
    for hour in 0..HOURS {
        let mut database = open(&path);
        commit(&mut database, hour, &hour_of(hour), 2);
        database.close().unwrap();
    }
    let database = open(&path);
    let report = verify(&database);
    assert!(report.broken.is_none() && report.good_rows <= 2 * MAX_ROWS, "{report:?}");
    for (table, rows) in [
        ("capacity", 2000),
        ("loss_modes", 2000),
        ("remaining_life", 500),
        ("model", 280),
        ("alarm", 280),
        ("reset", 250),
    ] {
        let left = number(&database, &format!("SELECT count(*) FROM {table}"));
        assert!(left < rows, "{table}: {left}");
    }
}

#[test]
fn every_cell_keeps_as_much() {
    let place = place();
    let (database, _) = filled(&place.path().join(DATABASE));
    let kept: Vec<i64> = (0..CELLS)
        .map(|cell| number(&database, &format!("SELECT count(*) FROM capacity WHERE cell = {cell}")))
        .collect();
    let (least, most) = (kept.iter().min().unwrap(), kept.iter().max().unwrap());
    assert!(*least >= 30 && most - least <= 20, "{kept:?}");
}

#[test]
fn a_changed_removed_or_hidden_row_is_named() {
    let place = place();
    let (database, _) = filled(&place.path().join(DATABASE));
    let after_gap =
        number(&database, "SELECT min(r.seq) FROM capacity r JOIN thinned t ON t.last = r.seq - 1 WHERE r.seq > 1000");
    let row_of = |damage: &str| {
        database.connection().execute_batch(&format!("BEGIN; {damage}")).unwrap();
        let found = broken(&database).map(|row| row.row);
        database.connection().execute_batch("ROLLBACK").unwrap();
        found
    };
    let changed = row_of(&format!("UPDATE capacity SET capacity_ah = 9 WHERE seq = {after_gap}"));
    assert_eq!(changed, Some(after_gap));
    assert_eq!(row_of(&format!("DELETE FROM capacity WHERE seq = {after_gap}")), Some(after_gap));
    let run = format!("UPDATE thinned SET hash = zeroblob(32) WHERE last = {after_gap} - 1");
    assert_eq!(row_of(&run), Some(after_gap), "the hash that the next row carries on");
    let whole = number(&database, "SELECT max(seq) - 10 FROM capacity");
    let latest = number(&database, "SELECT max(seq) - 20 FROM alarm");
    let hidden = format!(
        "INSERT INTO thinned SELECT seq, seq, hash FROM alarm WHERE seq = (SELECT max(seq) FROM alarm WHERE seq <= {latest} + 20);
         DELETE FROM alarm WHERE seq = (SELECT max(last) FROM thinned)"
    );
    assert!(row_of(&hidden).is_some(), "one of the latest rows cannot be thinned out");
    let others = [
        // Rows that are there cannot be thinned out.
        &format!("INSERT INTO thinned VALUES ({whole}, {whole} - 2, zeroblob(32))"),
        "DELETE FROM thinned WHERE last = (SELECT min(last) FROM thinned)",
        "UPDATE thinned SET last = 9223372036854775807 WHERE last = (SELECT max(last) FROM thinned)",
    ];
    for damage in others {
        assert!(row_of(damage).is_some(), "{damage}");
    }
    assert_eq!(row_of("SELECT 1"), None);
}

#[test]
fn a_thinned_history_is_salvaged_whole() {
    let place = place();
    let (path, new) = (place.path().join(DATABASE), place.path().join("new.db"));
    let (database, _) = filled(&path);
    let report = verify(&database);
    let losses = number(&database, "SELECT count(*) FROM loss_modes");
    let lives = number(&database, "SELECT count(*) FROM remaining_life");
    let models = number(&database, "SELECT count(*) FROM model");
    database.close().unwrap();
    let mut database = open(&new);
    let saved = salvage(&path, &place.path().join("pages.db"), &mut database).unwrap();
    assert_eq!((database.counts().chained, saved.refused), (report.good_rows, 0));
    assert_eq!((saved.losses as i64, saved.lives as i64), (losses, lives), "their hashes show the table");
    assert_eq!(saved.models as i64, models);
    assert_eq!((database.counts().packs, broken(&database)), (2, None));
}

#[test]
fn the_latest_half_is_kept_whole_and_what_is_kept_of_the_rest_fits_a_quarter() {
    assert_eq!([0, 499, 500, 999, 1000, 1999, 2000].map(|age| zero_bits_kept(age, 1000)), [0, 0, 2, 2, 4, 4, 6]);
    let kept: f64 = (0..10_000_000).map(|age| 0.5_f64.powi(zero_bits_kept(age, 1000) as i32)).sum();
    assert!((700.0..=750.0).contains(&kept), "{kept}");
}

#[test]
fn zero_bits_are_counted_from_the_end() {
    let hash = |end: [u8; 3]| -> Hash { std::array::from_fn(|at| if at < 29 { 0xFF } else { end[at - 29] }) };
    assert_eq!([[1, 1, 1], [1, 1, 8], [1, 1, 0], [1, 4, 0]].map(|end| zero_bits(&hash(end))), [0, 3, 8, 10]);
    assert_eq!(zero_bits(&[0; 32]), 256);
}
