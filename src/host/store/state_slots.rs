//! The slots of the table `state`: the latest state, and one that was set aside.
//!
//! A state takes two slots: the full record, and the delta that later checkpoints overwrite. The delta carries the serial
//! number of the full record it belongs to.

use rusqlite::{Connection, OptionalExtension, Transaction, params};

use super::delta_encoder::{DeltaEncoder, EncodedState};
use super::document::StateDocument;
use super::packed;
use super::parts::JsonParts;

/// A state to be stored.
#[derive(Debug)]
pub(super) struct StateRecord {
    /// The state's document.
    pub parts: JsonParts,
    /// Not rounded (on stop).
    pub exact: bool,
    /// Keeps the state stored so far next to it, because no daemon has restored that.
    pub sets_aside: bool,
}

impl StateRecord {
    /// A record of a document.
    ///
    /// # Errors
    /// When the document could not be read back: a number that is not finite is written as `null`.
    pub(super) fn new(document: &StateDocument, exact: bool, sets_aside: bool) -> Result<Self, String> {
        let json = serde_json::to_vec(document).map_err(|error| error.to_string())?;
        StateDocument::parse(&json)?;
        let parts = JsonParts::of(&json).ok_or("a number of the state cannot be read")?;
        Ok(Self { parts, exact, sets_aside })
    }
}

/// A state read from the database.
#[derive(Debug)]
pub(super) struct StoredState {
    /// The state's document, JSON.
    pub json: Vec<u8>,
    /// What is wrong with a later state, if one was lost.
    pub lost_later: Option<String>,
}

/// First slot of the state.
pub(super) const STATE: i64 = 0;
/// Serial number of a delta without a base.
const NO_SERIAL: i64 = -1;
/// First slot of a state that was set aside.
pub(super) const ASIDE: i64 = 10;

/// Reads the stored full record as the base of deltas; the default when there is none or it is damaged.
pub(super) fn read_base(connection: &Connection, first: i64) -> rusqlite::Result<DeltaEncoder> {
    let Some(full) = slot(connection, first)? else { return Ok(DeltaEncoder::default()) };
    let room = slot(connection, first + 1)?.map_or(0, |delta| delta.room);
    Ok(DeltaEncoder::with_base(full.serial, &full.record, room).unwrap_or_default())
}

/// Reads the state from the slot `first` on; `None` = none was stored. A damaged state is an error in words: the history
/// may still be good.
pub(super) fn read_state(
    connection: &Connection,
    delta_encoder: &DeltaEncoder,
    first: i64,
) -> rusqlite::Result<Result<Option<StoredState>, String>> {
    if slot(connection, first)?.is_none() {
        return Ok(Ok(None));
    }
    let Some((serial, base)) = delta_encoder.base() else { return Ok(Err("the stored state is damaged".to_owned())) };
    let delta = slot(connection, first + 1)?.filter(|delta| delta.serial == serial);
    let (parts, lost_later) = match delta.map(|slot| packed::read_delta(&slot.record, base, serial)) {
        None => (base.clone(), None),
        Some(Ok(parts)) => (parts, None),
        Some(Err(damaged)) => (base.clone(), Some(damaged.to_string())),
    };
    Ok(Ok(Some(StoredState { json: parts.join(), lost_later })))
}

/// Reads the document of the state from the slot `first` on; `None` = there is no good one.
pub(super) fn read_document(connection: &Connection, first: i64) -> Option<StateDocument> {
    let delta_encoder = read_base(connection, first).ok()?;
    let stored = read_state(connection, &delta_encoder, first).ok()?.ok()??;
    StateDocument::parse(&stored.json).ok()
}

/// Moves the stored state to where no checkpoint overwrites it, in place of one that was set aside before.
pub(super) fn set_aside(transaction: &Transaction<'_>) -> rusqlite::Result<()> {
    transaction.execute(
        "DELETE FROM state WHERE slot >= ?1 AND EXISTS (SELECT 1 FROM state WHERE slot = ?2)",
        [ASIDE, STATE],
    )?;
    transaction.execute("UPDATE state SET slot = slot + ?1 WHERE slot < ?1", [ASIDE]).map(drop)
}

/// Forgets the state that was set aside.
pub(super) fn forget_aside(connection: &Connection) -> rusqlite::Result<()> {
    connection.execute("DELETE FROM state WHERE slot >= ?1", [ASIDE]).map(drop)
}

/// Writes a record to its slot.
pub(super) fn write_state(transaction: &Transaction<'_>, packed: &EncodedState) -> rusqlite::Result<()> {
    let slot = STATE + i64::from(!packed.is_full);
    let length = i64::try_from(packed.length).unwrap_or(i64::MAX);
    let values = params![slot, packed.serial, length, packed.bytes];
    // An update of equal length overwrites in place, page by changed page.
    let updated = transaction
        .prepare_cached("UPDATE state SET serial = ?2, length = ?3, bytes = ?4 WHERE slot = ?1")?
        .execute(values)?;
    if updated == 0 {
        transaction.execute("INSERT INTO state VALUES (?1, ?2, ?3, ?4)", values)?;
    }
    if packed.is_full {
        // Serial numbers restart when a full record was lost: an old delta must never fit a new one. Its room is kept.
        transaction.execute("UPDATE state SET serial = ?2 WHERE slot = ?1", [STATE + 1, NO_SERIAL])?;
    }
    Ok(())
}

/// A slot of `state`.
struct Slot {
    serial: i64,
    record: Vec<u8>,
    room: usize,
}

fn slot(connection: &Connection, slot: i64) -> rusqlite::Result<Option<Slot>> {
    connection
        .query_row("SELECT serial, length, bytes FROM state WHERE slot = ?1", [slot], |row| {
            let mut record: Vec<u8> = row.get(2)?;
            let room = record.len();
            record.truncate(usize::try_from(row.get::<_, i64>(1)?).unwrap_or(usize::MAX));
            Ok(Slot { serial: row.get(0)?, record, room })
        })
        .optional()
}
