//! The layout of the database, and the migrations from older layouts.
//!
//! | table | a row is | kept |
//! | --- | --- | --- |
//! | `pack` | a pack that was or is connected | always |
//! | `moment` | a time of writing: wall clock, inputs' clock, boot clock, boot, pack | as long as a row belongs to it |
//! | `half_cycle` | a charge or discharge of one cell | the oldest thinned |
//! | `capacity`, `loss_modes`, `remaining_life`, `model`, `alarm`, `reset` | a learned capacity, what a cell has lost, a forecast, a change of the cell model, a change of an alarm, a reset; numbered across the tables and chained by hash | the oldest thinned |
//! | `thinned` | a run of chained rows that were thinned out, with the hash of the last | always |
//! | `state`, `state_b` | the core's state, two copies written in turn: slot 0 in full, slot 1 the changes since | the latest two |
//! | `meta` | one row: the chain's end, counts, the vehicle, the layout's version | |
//!
//! Cells count from 0, times are nanoseconds. `PRAGMA user_version` is the layout's version; from version 5 on `meta` has it
//! too, so that a damaged bit does not pass for a newer program.

use rusqlite::{Connection, OptionalExtension, TransactionBehavior};

/// "pkwt": marks the file for file(1).
const APPLICATION_ID: i32 = 0x706B_7774;

/// The statements that lead to each version from the one before; the first starts from an empty file.
pub(super) const MIGRATIONS: &[&str] = &[VERSION_1, VERSION_2, VERSION_3, VERSION_4, VERSION_5, VERSION_6, VERSION_7];

/// The first version that names the vehicle.
pub(super) const VERSION_WITH_VEHICLE: i32 = 4;
/// The first version with two copies of the state.
pub(super) const VERSION_WITH_COPIES: i32 = 5;
/// The first version whose chained rows may be thinned out.
pub(super) const VERSION_WITH_THINNED: i32 = 6;
/// The first version that `meta` states.
const VERSION_WITH_LAYOUT: i32 = 5;

const VERSION_1: &str = "
CREATE TABLE meta (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    chained INTEGER NOT NULL,
    head BLOB NOT NULL,
    half_cycles INTEGER NOT NULL,
    thinned INTEGER NOT NULL,
    thinned_to INTEGER NOT NULL
) STRICT;
INSERT INTO meta VALUES (1, 0, zeroblob(32), 0, 0, 0);
CREATE TABLE pack (
    id INTEGER PRIMARY KEY,
    opened_ns INTEGER NOT NULL,
    closed_ns INTEGER,
    reason TEXT,
    identity TEXT
) STRICT;
CREATE TABLE moment (
    id INTEGER PRIMARY KEY,
    wall_ns INTEGER NOT NULL,
    time_ns INTEGER NOT NULL,
    boottime_ns INTEGER NOT NULL,
    boot BLOB NOT NULL,
    pack INTEGER NOT NULL
) STRICT;
CREATE TABLE half_cycle (
    moment INTEGER NOT NULL,
    cell INTEGER NOT NULL,
    mode TEXT NOT NULL,
    charge_ah REAL NOT NULL,
    swing REAL,
    swing_std REAL,
    duration_s REAL NOT NULL,
    mean_current_a REAL NOT NULL,
    mean_temperature_c REAL,
    PRIMARY KEY (moment, cell)
) STRICT, WITHOUT ROWID;
CREATE TABLE capacity (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER NOT NULL,
    measured_ah REAL,
    measured_std_ah REAL,
    capacity_ah REAL,
    capacity_std_ah REAL,
    usable_capacity_ah REAL,
    usable_capacity_std_ah REAL,
    resistance_ratio REAL,
    resistance_ratio_std REAL,
    hash BLOB NOT NULL
) STRICT;
CREATE TABLE alarm (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER,
    rule TEXT NOT NULL,
    severity TEXT NOT NULL,
    change TEXT NOT NULL,
    state TEXT NOT NULL,
    active INTEGER NOT NULL,
    value REAL,
    probability REAL,
    threshold REAL,
    occurrences INTEGER NOT NULL,
    acknowledged INTEGER NOT NULL,
    hash BLOB NOT NULL
) STRICT;
CREATE TABLE reset (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER,
    reason TEXT NOT NULL,
    capacity_ah REAL,
    capacity_std_ah REAL,
    detail TEXT,
    hash BLOB NOT NULL
) STRICT;
CREATE TABLE state (
    slot INTEGER PRIMARY KEY,
    serial INTEGER NOT NULL,
    length INTEGER NOT NULL,
    bytes BLOB NOT NULL
) STRICT;
";

const VERSION_2: &str = "
CREATE TABLE remaining_life (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER,
    cycles REAL,
    cycles_low REAL,
    cycles_high REAL,
    days REAL,
    days_low REAL,
    days_high REAL,
    hash BLOB NOT NULL
) STRICT;
";

const VERSION_3: &str = "
CREATE TABLE loss_modes (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER,
    lli REAL,
    lli_std REAL,
    lam_ne REAL,
    lam_ne_std REAL,
    lam_pe REAL,
    lam_pe_std REAL,
    hash BLOB NOT NULL
) STRICT;
";

/// The vehicle, as JSON.
const VERSION_4: &str = "
ALTER TABLE meta ADD COLUMN vehicle TEXT;
";

/// The second copy of the state, and the second place of the layout's version.
const VERSION_5: &str = "
CREATE TABLE state_b (
    slot INTEGER PRIMARY KEY,
    serial INTEGER NOT NULL,
    length INTEGER NOT NULL,
    bytes BLOB NOT NULL
) STRICT;
ALTER TABLE meta ADD COLUMN layout INTEGER;
";

/// Chained rows that were thinned out.
const VERSION_6: &str = "
CREATE TABLE thinned (
    last INTEGER PRIMARY KEY,
    first INTEGER NOT NULL,
    hash BLOB NOT NULL
) STRICT;
";

/// Changes of the cell model that is learned on board. It is the model of all cells: `cell` is NULL.
const VERSION_7: &str = "
CREATE TABLE model (
    seq INTEGER PRIMARY KEY,
    moment INTEGER NOT NULL,
    cell INTEGER,
    state TEXT NOT NULL,
    capacity_ah REAL,
    capacity_std_ah REAL,
    residual_v REAL,
    chemistry TEXT,
    taken_back INTEGER NOT NULL,
    hash BLOB NOT NULL
) STRICT;
";

/// The version of an open database; 0 = an empty file.
pub(super) fn version(connection: &Connection) -> rusqlite::Result<i32> {
    connection.query_row("PRAGMA user_version", [], |row| row.get(0))
}

/// The version this program writes.
pub(super) fn known(migrations: &[&str]) -> i32 {
    i32::try_from(migrations.len()).unwrap_or(i32::MAX)
}

/// The version in `meta`; `None` = an older layout, or damage.
pub(super) fn noted_version(connection: &Connection) -> Option<i32> {
    connection.query_row("SELECT layout FROM meta WHERE id = 1", [], |row| row.get(0)).optional().ok()??
}

/// Whether `version` is not damaged, as far as that is known.
pub(super) fn is_confirmed(connection: &Connection, version: i32) -> bool {
    (0..VERSION_WITH_LAYOUT).contains(&version) || noted_version(connection) == Some(version)
}

/// Brings the layout from `version` to the latest, all or nothing.
pub(super) fn migrate(connection: &mut Connection, version: i32, migrations: &[&str]) -> rusqlite::Result<()> {
    let done = usize::try_from(version).unwrap_or(0);
    if done >= migrations.len() {
        return Ok(());
    }
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    for migration in &migrations[done..] {
        transaction.execute_batch(migration)?;
    }
    transaction.pragma_update(None, "application_id", APPLICATION_ID)?;
    let version = known(migrations);
    transaction.pragma_update(None, "user_version", version)?;
    if version >= VERSION_WITH_LAYOUT {
        transaction.execute("UPDATE meta SET layout = ?1", [version])?;
    }
    transaction.commit()
}
