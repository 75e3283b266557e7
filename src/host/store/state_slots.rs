//! The slots of the latest state: two copies, of which each commit overwrites the older, and a state that was set aside.
//!
//! A copy is a table of its own, so that one damaged page cannot hold both. It takes two slots: the full record, and the
//! delta that later commits overwrite. Every record has a number, which counts the commits; its hash covers that number and,
//! in a delta, the number of the full record it belongs to. So the newest state is the valid record of the highest number.

use rusqlite::{Connection, OptionalExtension, Transaction, params};

use super::delta_encoder::{DeltaEncoder, EncodedState};
use super::document::StateDocument;
use super::packed;
use super::parts::JsonParts;
use super::schema::VERSION_WITH_COPIES;

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
    /// What is wrong with another record, and which of both is newer; `None` = every record is good.
    pub fault: Option<String>,
}

/// The tables of the copies.
pub(super) const COPIES: [&str; 2] = ["state", "state_b"];
/// First slot of the state in each.
const STATE: i64 = 0;
/// First slot of a state that was set aside.
const ASIDE: i64 = 10;
/// Number in a delta's slot that holds no delta.
const NO_NUMBER: i64 = -1;

/// One copy of the state.
#[derive(Debug, Default)]
struct StateCopy {
    encoder: DeltaEncoder,
    /// Number of its newest valid record; 0 = none.
    number: i64,
}

/// Both copies, as the next commits continue them.
#[derive(Debug, Default)]
pub(super) struct StateCopies {
    copies: [StateCopy; 2],
    /// Number of the latest record.
    latest: i64,
}

/// A state written in a transaction that has not ended.
#[derive(Debug)]
pub(super) struct WrittenState {
    copy: usize,
    encoded: EncodedState,
}

impl StateCopies {
    /// Reads what the next commits build on, in a database of layout `version`. A damaged copy is overwritten first.
    pub(super) fn read(connection: &Connection, version: i32) -> rusqlite::Result<Self> {
        let mut copies = Self::default();
        let tables = COPIES.into_iter().take(if version < VERSION_WITH_COPIES { 1 } else { COPIES.len() });
        for (copy, table) in copies.copies.iter_mut().zip(tables) {
            let CopyContents { encoder, newest, .. } = read_copy(connection, table, STATE)?;
            *copy = StateCopy { encoder, number: newest.map_or(0, |(number, _)| number) };
        }
        copies.latest = copies.copies.iter().map(|copy| copy.number).max().unwrap_or(0);
        Ok(copies)
    }

    /// Writes a state over the older copy.
    pub(super) fn write(
        &self,
        transaction: &Transaction<'_>,
        parts: JsonParts,
        exact: bool,
    ) -> rusqlite::Result<WrittenState> {
        let copy = usize::from(self.copies[1].number < self.copies[0].number);
        let encoded = self.copies[copy].encoder.encode(parts, self.latest + 1, exact);
        write_record(transaction, COPIES[copy], &encoded)?;
        Ok(WrittenState { copy, encoded })
    }

    /// Notes that a written state is on the disk.
    pub(super) fn note_stored(&mut self, written: WrittenState) {
        let copy = &mut self.copies[written.copy];
        (copy.number, self.latest) = (written.encoded.number, written.encoded.number);
        copy.encoder.note_stored(written.encoded);
    }

    /// Moves the newest state to where no commit overwrites it, in place of one that was set aside before; forgets the other
    /// copy.
    pub(super) fn set_aside(&mut self, transaction: &Transaction<'_>) -> rusqlite::Result<()> {
        let (newest, other) = if self.copies[1].number > self.copies[0].number { (1, 0) } else { (0, 1) };
        let [newest, other] = [COPIES[newest], COPIES[other]];
        transaction.execute(&format!("DELETE FROM {other} WHERE slot < ?1"), [ASIDE])?;
        let has_state = slot(transaction, newest, STATE)?.is_some();
        if has_state {
            forget_aside(transaction)?;
        }
        transaction.execute(&format!("UPDATE {newest} SET slot = slot + ?1 WHERE slot < ?1"), [ASIDE])?;
        self.copies = Default::default();
        Ok(())
    }
}

/// Reads the newest valid state; `None` = none was stored. Damage of all records is an error in words: the history may still be
/// good.
pub(super) fn read_state(connection: &Connection) -> rusqlite::Result<Result<Option<StoredState>, String>> {
    let (mut newest, mut faults): (Option<(i64, JsonParts)>, Vec<(i64, String)>) = (None, Vec::new());
    for table in COPIES.into_iter().filter(|table| has_table(connection, table)) {
        let contents = read_copy(connection, table, STATE)?;
        faults.extend(contents.faults);
        let is_newer = |(number, _): &(i64, JsonParts)| newest.as_ref().is_none_or(|(before, _)| number > before);
        if let Some(state) = contents.newest.filter(is_newer) {
            newest = Some(state);
        }
    }
    let Some((number, parts)) = newest else {
        return Ok(faults.pop().map_or(Ok(None), |(_, fault)| Err(fault)));
    };
    let fault = faults.into_iter().max_by_key(|(number, _)| *number).map(|(of, fault)| {
        let outcome = if of < number { "a newer state is good and used" } else { "an earlier state is used" };
        format!("{fault}; {outcome}")
    });
    Ok(Ok(Some(StoredState { json: parts.join(), fault })))
}

/// Reads the document of the newest valid state; `None` = there is none.
pub(super) fn read_document(connection: &Connection) -> Option<StateDocument> {
    StateDocument::parse(&read_state(connection).ok()?.ok()??.json).ok()
}

/// Reads the document of the state that was set aside; `None` = there is no valid one.
pub(super) fn read_aside(connection: &Connection) -> Option<StateDocument> {
    let of = |table| read_copy(connection, table, ASIDE).ok()?.newest;
    let (_, parts) = COPIES.into_iter().find_map(of)?;
    StateDocument::parse(&parts.join()).ok()
}

/// Forgets the state that was set aside.
pub(super) fn forget_aside(connection: &Connection) -> rusqlite::Result<()> {
    COPIES
        .into_iter()
        .filter(|table| has_table(connection, table))
        .try_for_each(|table| connection.execute(&format!("DELETE FROM {table} WHERE slot >= ?1"), [ASIDE]).map(drop))
}

/// Forgets all states.
pub(super) fn forget_all(connection: &Connection) -> rusqlite::Result<()> {
    COPIES.into_iter().try_for_each(|table| connection.execute(&format!("DELETE FROM {table}"), []).map(drop))
}

/// Older layouts have one copy.
fn has_table(connection: &Connection, table: &str) -> bool {
    connection.table_exists(None, table).unwrap_or(true)
}

/// What a copy contains.
#[derive(Default)]
struct CopyContents {
    encoder: DeltaEncoder,
    /// Number and contents of its newest valid record.
    newest: Option<(i64, JsonParts)>,
    /// Damaged records, with their numbers as far as they are known.
    faults: Vec<(i64, String)>,
}

fn read_copy(connection: &Connection, table: &str, first: i64) -> rusqlite::Result<CopyContents> {
    let (full, delta) = (slot(connection, table, first)?, slot(connection, table, first + 1)?);
    let room = delta.as_ref().map_or(0, |delta| delta.room);
    let delta = delta.filter(|delta| delta.number != NO_NUMBER);
    let mut contents = CopyContents::default();
    let Some(full) = full else {
        contents
            .faults
            .extend(delta.map(|delta| (delta.number, "the full record of a stored state is missing".to_owned())));
        return Ok(contents);
    };
    match DeltaEncoder::with_base(full.number, &full.record, room) {
        Ok(encoder) => contents.encoder = encoder,
        Err(damaged) => {
            let number = delta.map_or(full.number, |delta| delta.number.max(full.number));
            contents.faults.push((number, damaged.to_string()));
            return Ok(contents);
        }
    }
    let Some((serial, base)) = contents.encoder.base() else { return Ok(contents) };
    contents.newest = match delta {
        None => Some((serial, base.clone())),
        Some(delta) => match packed::read_delta(&delta.record, base, serial, delta.number) {
            Ok(parts) => Some((delta.number, parts)),
            Err(damaged) => {
                contents.faults.push((delta.number, damaged.to_string()));
                Some((serial, base.clone()))
            }
        },
    };
    Ok(contents)
}

/// Writes a record to its slot.
fn write_record(transaction: &Transaction<'_>, table: &str, packed: &EncodedState) -> rusqlite::Result<()> {
    let slot = STATE + i64::from(!packed.is_full);
    let length = i64::try_from(packed.length).unwrap_or(i64::MAX);
    let values = params![slot, packed.number, length, packed.bytes];
    // An update of equal length overwrites in place, page by changed page.
    let updated = transaction
        .prepare_cached(&format!("UPDATE {table} SET serial = ?2, length = ?3, bytes = ?4 WHERE slot = ?1"))?
        .execute(values)?;
    if updated == 0 {
        transaction.execute(&format!("INSERT INTO {table} VALUES (?1, ?2, ?3, ?4)"), values)?;
    }
    if packed.is_full {
        // The old delta belongs to the full record before. Its room is kept.
        transaction.execute(&format!("UPDATE {table} SET serial = ?2 WHERE slot = ?1"), [STATE + 1, NO_NUMBER])?;
    }
    Ok(())
}

/// A slot of a copy.
struct Slot {
    number: i64,
    record: Vec<u8>,
    room: usize,
}

fn slot(connection: &Connection, table: &str, slot: i64) -> rusqlite::Result<Option<Slot>> {
    connection
        .query_row(&format!("SELECT serial, length, bytes FROM {table} WHERE slot = ?1"), [slot], |row| {
            let mut record: Vec<u8> = row.get(2)?;
            let room = record.len();
            record.truncate(usize::try_from(row.get::<_, i64>(1)?).unwrap_or(usize::MAX));
            Ok(Slot { number: row.get(0)?, record, room })
        })
        .optional()
}
