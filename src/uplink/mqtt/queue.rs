//! Queue on disk for messages that the broker has not acknowledged, oldest first.
//!
//! Input: messages of the recorder (samples and events). Output: the oldest messages of a class, in order, until they
//! are removed. An added message survives a power cut and a restart (SQLite with a write-ahead log, flushed at each
//! commit).
//!
//! The number and the size of the messages are limited. A full queue drops its oldest samples. It drops its oldest
//! events only if it has no samples. Drops are counted, and the counts survive restarts. A damaged file is set aside
//! and replaced by a new one. If the disk fails, or if a newer version wrote the file, the file is left unchanged.

use std::cell::{Cell, RefCell};
use std::fs::File;
use std::path::{Path, PathBuf};

use packwatch_host::io::clock::Reading;
use rusqlite::{Connection, ErrorCode, OptionalExtension as _, Transaction, params};
use tokio::sync::Notify;

use super::settings::HistorySettings;

const FILE: &str = "queue.db";
const LOCK: &str = "queue.lock";
const VERSION: i64 = 1;
/// Class of the missed events in the table `dropped`.
const MISSED: i64 = 2;
/// Number of pages (4 KiB each) in the write-ahead log that cause a checkpoint: 1 MiB.
const CHECKPOINT_PAGES: i64 = 256;

/// Class of a message. The class decides which messages are dropped first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// A periodic sample.
    Sample = 0,
    /// An event, including alarms; dropped only if no samples are left.
    Event = 1,
}

/// A queued message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueuedMessage {
    /// Sequence number. It increases by one with each message, also across restarts.
    pub sequence: i64,
    /// Text of the message.
    pub body: String,
}

/// Fill of the queue, and drops since it was created.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Fill {
    /// Number of messages.
    pub messages: u64,
    /// Size of the messages, bytes.
    pub bytes: u64,
    /// Samples dropped.
    pub dropped_samples: u64,
    /// Events dropped.
    pub dropped_events: u64,
    /// Events that were never queued, because the daemon no longer listed them.
    pub missed_events: u64,
}

/// The queue.
#[derive(Debug)]
pub struct Queue {
    database: RefCell<Connection>,
    max_messages: u64,
    max_bytes: u64,
    fill: Cell<Fill>,
    added: Notify,
    _lock: File,
}

impl Queue {
    /// Opens the queue in its folder; creates what is missing.
    ///
    /// # Errors
    /// Fails if the folder or the file cannot be read or written, if another uplink uses the folder, or if a newer
    /// version wrote the file.
    pub fn open(settings: &HistorySettings) -> Result<Self, String> {
        let folder = &settings.folder;
        let at = |error: &dyn std::fmt::Display| format!("{}: {error}", folder.display());
        std::fs::create_dir_all(folder).map_err(|error| at(&error))?;
        let lock = File::create(folder.join(LOCK)).map_err(|error| at(&error))?;
        lock.try_lock().map_err(|_| at(&"used by another uplink"))?;
        let path = folder.join(FILE);
        let database = match prepare(&path, 0) {
            Ok(database) => database,
            Err(OpenFault::Damaged(error)) => {
                let aside = put_aside(&path).map_err(|error| at(&error))?;
                tracing::error!(error, aside = %aside.display(), "the queue is damaged: set aside, starting a new one");
                // The new sequence numbers start above all sequence numbers of the damaged queue, because a subscriber
                // may treat a message as a duplicate if it has already received a message with the same number.
                let millis = Reading::now().realtime_ns / 1_000_000;
                prepare(&path, millis).map_err(|fault| at(&fault.text()))?
            }
            Err(OpenFault::Failed(error)) => return Err(at(&error)),
        };
        let fill = read_fill(&database).map_err(|error| at(&error))?;
        let (max_messages, max_bytes) = (settings.max_messages, settings.max_bytes);
        let database = RefCell::new(database);
        Ok(Self { database, max_messages, max_bytes, fill: Cell::new(fill), added: Notify::new(), _lock: lock })
    }

    /// The fill of the queue.
    pub fn fill(&self) -> Fill {
        self.fill.get()
    }

    /// Waits until a message is added after this call.
    pub fn wait(&self) -> impl Future<Output = ()> {
        self.added.notified()
    }

    /// Adds messages. If `seen` is given, stores it in the same transaction. `seen` has two parts: the recorder's text
    /// about the events it has handled, and the number of events missed since the previous text. [`Self::seen`] returns
    /// the text, even after a restart. When this function returns, everything is on disk.
    ///
    /// # Errors
    /// Fails if the disk fails or is full.
    pub fn add(&self, messages: &[(Class, String)], seen: Option<(&str, u64)>) -> Result<(), String> {
        let mut database = self.database.borrow_mut();
        let fill = self.try_add(&mut database, messages, seen).map_err(|error| error.to_string())?;
        self.fill.set(fill);
        self.added.notify_waiters();
        Ok(())
    }

    fn try_add(
        &self,
        database: &mut Connection,
        messages: &[(Class, String)],
        seen: Option<(&str, u64)>,
    ) -> rusqlite::Result<Fill> {
        let mut fill = self.fill.get();
        let transaction = database.transaction()?;
        for (class, body) in messages {
            transaction
                .prepare_cached("INSERT INTO message (class, body) VALUES (?, ?)")?
                .execute(params![*class as i64, body])?;
            fill.messages += 1;
            fill.bytes += length(body);
        }
        while fill.messages > self.max_messages || fill.bytes > self.max_bytes {
            if !drop_oldest(&transaction, &mut fill)? {
                break;
            }
        }
        if let Some((seen, missed)) = seen {
            transaction.execute("INSERT OR REPLACE INTO seen VALUES (0, ?)", [seen])?;
            count_lost(&transaction, MISSED, missed)?;
            fill.missed_events += missed;
        }
        transaction.commit()?;
        Ok(fill)
    }

    /// Returns the text about the events already handled: the text stored by the latest [`Self::add`] with `seen`.
    /// `None` if no text is stored, or if it cannot be read.
    pub fn seen(&self) -> Option<String> {
        let database = self.database.borrow();
        let seen = database.query_row("SELECT text FROM seen", [], |row| row.get(0)).optional();
        seen.unwrap_or_else(|error| {
            tracing::error!(%error, "the queue cannot be read");
            None
        })
    }

    /// Returns the oldest messages of a class, at most `count`.
    ///
    /// # Errors
    /// Fails if the disk cannot be read.
    pub fn oldest(&self, class: Class, count: usize) -> Result<Vec<QueuedMessage>, String> {
        let database = self.database.borrow();
        let read = || {
            let of_class = "SELECT id, body FROM message WHERE class = ? ORDER BY id LIMIT ?";
            let mut query = database.prepare_cached(of_class)?;
            let rows = query.query_map(params![class as i64, i64::try_from(count).unwrap_or(i64::MAX)], |row| {
                Ok(QueuedMessage { sequence: row.get(0)?, body: row.get(1)? })
            })?;
            rows.collect::<rusqlite::Result<Vec<_>>>()
        };
        read().map_err(|error| error.to_string())
    }

    /// Removes acknowledged messages. Messages already dropped are ignored.
    ///
    /// # Errors
    /// Fails if the disk cannot be written. In this case, the messages will be sent again.
    pub fn remove(&self, messages: &[QueuedMessage]) -> Result<(), String> {
        let mut database = self.database.borrow_mut();
        let mut fill = self.fill.get();
        let mut remove = || {
            let transaction = database.transaction()?;
            for message in messages {
                let mut delete = transaction.prepare_cached("DELETE FROM message WHERE id = ?")?;
                if delete.execute([message.sequence])? == 1 {
                    fill.messages -= 1;
                    fill.bytes -= length(&message.body);
                }
            }
            transaction.commit()
        };
        remove().map_err(|error: rusqlite::Error| error.to_string())?;
        self.fill.set(fill);
        Ok(())
    }
}

/// Reads a column that is never negative.
fn count(row: &rusqlite::Row<'_>, column: usize) -> rusqlite::Result<u64> {
    row.get::<_, i64>(column).map(i64::unsigned_abs)
}

fn length(body: &str) -> u64 {
    body.len() as u64
}

enum OpenFault {
    /// The file is not a valid queue.
    Damaged(String),
    /// The file may be valid, but the disk is full or fails, or a newer version wrote the file.
    Failed(String),
}

impl OpenFault {
    fn text(self) -> String {
        match self {
            Self::Damaged(text) | Self::Failed(text) => text,
        }
    }
}

impl From<rusqlite::Error> for OpenFault {
    fn from(error: rusqlite::Error) -> Self {
        match error.sqlite_error_code() {
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => Self::Damaged(error.to_string()),
            _ => Self::Failed(error.to_string()),
        }
    }
}

/// Opens the file and checks it. If the file is new, creates the tables; the first message then gets the sequence
/// number after `latest`.
fn prepare(path: &Path, latest: i64) -> Result<Connection, OpenFault> {
    let database = Connection::open(path)?;
    database.pragma_update(None, "journal_mode", "wal")?;
    database.pragma_update(None, "synchronous", "full")?;
    database.pragma_update(None, "wal_autocheckpoint", CHECKPOINT_PAGES)?;
    let check: String = database.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
    let version: i64 = database.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    if check != "ok" {
        return Err(OpenFault::Damaged(check));
    }
    match version {
        VERSION => return Ok(database),
        0 => {}
        _ => {
            return Err(OpenFault::Failed(format!(
                "{FILE} has layout {version}, must be {VERSION}: written by a newer version of packwatch"
            )));
        }
    }
    // With AUTOINCREMENT, a sequence number is never reused, even after the queue was empty.
    database.execute_batch(&format!(
        "BEGIN;
         CREATE TABLE IF NOT EXISTS message (id INTEGER PRIMARY KEY AUTOINCREMENT, class INTEGER NOT NULL, body TEXT NOT NULL);
         CREATE INDEX IF NOT EXISTS message_class ON message (class, id);
         CREATE TABLE IF NOT EXISTS dropped (class INTEGER PRIMARY KEY, count INTEGER NOT NULL);
         CREATE TABLE IF NOT EXISTS seen (one INTEGER PRIMARY KEY CHECK (one = 0), text TEXT NOT NULL);
         INSERT INTO sqlite_sequence (name, seq) VALUES ('message', {latest});
         PRAGMA user_version = {VERSION};
         COMMIT;"
    ))?;
    Ok(database)
}

/// Renames the file and its write-ahead log. Files that were set aside earlier are replaced.
fn put_aside(path: &Path) -> std::io::Result<PathBuf> {
    let aside = path.with_extension("damaged");
    for suffix in ["", "-wal", "-shm"] {
        let (from, to) = (with_suffix(path, suffix), with_suffix(&aside, suffix));
        match std::fs::rename(&from, &to) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    Ok(aside)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

fn read_fill(database: &Connection) -> rusqlite::Result<Fill> {
    let dropped = |class: i64| {
        let count = database.query_row("SELECT count FROM dropped WHERE class = ?", [class], |row| count(row, 0));
        count.optional().map(Option::unwrap_or_default)
    };
    // The size is in bytes, as in `length`. Without the cast, SQLite would count characters.
    let size = "SELECT count(*), coalesce(sum(length(CAST(body AS BLOB))), 0) FROM message";
    let (messages, bytes) = database.query_row(size, [], |row| Ok((count(row, 0)?, count(row, 1)?)))?;
    let (dropped_samples, dropped_events) = (dropped(Class::Sample as i64)?, dropped(Class::Event as i64)?);
    Ok(Fill { messages, bytes, dropped_samples, dropped_events, missed_events: dropped(MISSED)? })
}

/// Drops the oldest sample. If the queue has no samples, drops the oldest event. If the queue is empty, returns
/// `false`.
fn drop_oldest(transaction: &Transaction<'_>, fill: &mut Fill) -> rusqlite::Result<bool> {
    let oldest = "DELETE FROM message WHERE id = (SELECT id FROM message ORDER BY class, id LIMIT 1)
                  RETURNING class, length(CAST(body AS BLOB))";
    let dropped = transaction
        .prepare_cached(oldest)?
        .query_row([], |row| Ok((row.get::<_, i64>(0)?, count(row, 1)?)))
        .optional()?;
    let Some((class, bytes)) = dropped else { return Ok(false) };
    count_lost(transaction, class, 1)?;
    fill.messages -= 1;
    fill.bytes -= bytes;
    *(if class == Class::Event as i64 { &mut fill.dropped_events } else { &mut fill.dropped_samples }) += 1;
    Ok(true)
}

/// Adds to the number of lost messages of a class.
fn count_lost(transaction: &Transaction<'_>, class: i64, messages: u64) -> rusqlite::Result<()> {
    let count = "INSERT INTO dropped VALUES (?1, ?2) ON CONFLICT (class) DO UPDATE SET count = count + ?2";
    let messages = i64::try_from(messages).unwrap_or(i64::MAX);
    transaction.prepare_cached(count)?.execute([class, messages]).map(|_| ())
}

#[cfg(test)]
mod tests;
