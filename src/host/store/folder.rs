//! The state folder: locks it for one daemon and opens its database, damaged or not.
//!
//! A damaged database is renamed, replaced by its readable rows, and reported. A database of a newer program is not
//! touched.
//!
//! A power cut during a replacement loses nothing; the next start completes it:
//!
//! | in the folder | time of the cut | action |
//! | --- | --- | --- |
//! | `packwatch.db.part`, `packwatch.db.pages` | while it was filled | deleted, filled again |
//! | `packwatch.db.new` | after it was complete | takes the place of the database |
//!
//! So the damaged database is moved only when its saved rows, its state and the report are on the disk.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::database::{Database, OpenError};
use super::document::StateDocument;
use super::retention::RowLimits;
use super::rows::{HistoryRow, RowBatch};
use super::salvage;
use super::stamp::Stamp;
use super::state_slots::StateRecord;
use super::wal::{self, Fault};
use crate::io::place::with_suffix;
use crate::monitor::LearnedCell;

/// Name of the database.
pub(super) const DATABASE: &str = "packwatch.db";
/// Name of its replacement while that is filled.
const PART: &str = "packwatch.db.part";
/// Name of the database of a salvage with the rows as they were found.
const PAGES: &str = "packwatch.db.pages";
/// Name of its replacement that is complete.
const NEW: &str = "packwatch.db.new";
/// Name of the file that a daemon locks while it uses the folder.
const LOCK: &str = "packwatch.lock";
/// Suffixes of SQLite's further files of a database.
const COMPANIONS: [&str; 2] = ["-wal", "-shm"];
/// Damaged databases kept; a disk that damages every file must not fill up with them.
const MAX_SET_ASIDE: u32 = 8;
/// Least time between two replacements by one process: one writes up to some 20 MB, and a full or failing disk would cause
/// one at every attempt.
const REPLACEMENT_PAUSE: Duration = Duration::from_secs(600);

/// Words for a state that is set aside.
pub(super) const SET_ASIDE: &str = "set aside, used at the first start at which it fits";

/// See the module.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    limits: RowLimits,
    /// Locked as long as this lives.
    lock: Option<File>,
    /// Damage of the database, which is to be replaced; `None` = no known damage.
    damaged: Option<String>,
    /// Time of the last attempt to replace it.
    replaced: Option<Instant>,
}

/// A database that was opened.
#[derive(Debug)]
pub(super) struct OpenedDatabase {
    pub database: Database,
    /// Rows about the opening, for the history.
    pub rows: Vec<HistoryRow>,
    /// Its state, or that of the damaged database before it; `None` = none.
    pub state: Option<StateDocument>,
    /// A state that was set aside earlier.
    pub aside: Option<StateDocument>,
    /// What the history knows of the cells, when there is no good state.
    pub learned: Vec<LearnedCell>,
    /// Whether it holds a state that this program cannot read and must not overwrite.
    pub is_unreadable: bool,
    /// Whether nothing had to be set aside and nothing was lost.
    pub is_sound: bool,
}

impl fmt::Display for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

impl Folder {
    /// A folder that need not exist yet.
    pub(super) fn new(path: PathBuf, limits: RowLimits) -> Self {
        Self { path, limits, lock: None, damaged: None, replaced: None }
    }

    /// Its path.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the database and its log, bytes; `None` = unknown.
    pub(super) fn file_bytes(&self) -> Option<u64> {
        let path = self.path.join(DATABASE);
        let log = fs::metadata(with_suffix(&path, COMPANIONS[0])).map_or(0, |file| file.len());
        fs::metadata(path).ok().map(|file| file.len() + log)
    }

    /// Creates the folder where it is missing, and locks it for this process.
    ///
    /// # Errors
    /// `WouldBlock` when another process has locked it, else why it cannot be written.
    pub(super) fn lock(&mut self) -> io::Result<()> {
        if self.lock.is_some() {
            return Ok(());
        }
        fs::create_dir_all(&self.path)?;
        let file = File::options().create(true).truncate(false).write(true).open(self.path.join(LOCK))?;
        match file.try_lock() {
            Ok(()) => {
                self.lock = Some(file);
                Ok(())
            }
            Err(TryLockError::WouldBlock) => Err(io::ErrorKind::WouldBlock.into()),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }

    /// Opens the database; replaces a damaged one by its readable rows.
    pub(super) fn open(&mut self, now: &Stamp) -> Result<OpenedDatabase, OpenError> {
        self.lock().map_err(|error| OpenError::Unavailable(format!("{}: {error}", self.path.display())))?;
        let was_replaced = self.finish_replacement()?;
        if was_replaced {
            self.damaged = None;
        }
        let path = self.path.join(DATABASE);
        if self.damaged.is_none() {
            match self.open_good(&path, now) {
                Err(OpenError::Damaged(why)) => self.damaged = Some(why),
                result => {
                    return result
                        .map(|opening| OpenedDatabase { is_sound: opening.is_sound && !was_replaced, ..opening });
                }
            }
        }
        if let Some(why) = self.damaged.clone() {
            self.fill_replacement(&why, now)?;
            self.finish_replacement()?;
            self.damaged = None;
        }
        let opening = self.open_good(&path, now)?;
        Ok(OpenedDatabase { is_sound: false, ..opening })
    }

    /// Notes that the database is damaged: the next opening replaces it.
    pub(super) fn mark_damaged(&mut self, why: &str) {
        self.damaged = Some(why.to_owned());
    }

    /// Saves the readable rows of the database and a report in a complete replacement file.
    pub(super) fn fill_replacement(&mut self, why: &str, now: &Stamp) -> Result<(), OpenError> {
        if self.replaced.is_some_and(|last| last.elapsed() < REPLACEMENT_PAUSE) {
            return Err(OpenError::Unavailable(format!(
                "damaged: {why}; replaced less than {} s ago, so the next replacement waits",
                REPLACEMENT_PAUSE.as_secs()
            )));
        }
        self.replaced = Some(Instant::now());
        let part = self.path.join(PART);
        let pages = self.path.join(PAGES);
        [&part, &pages].into_iter().for_each(|path| remove(path));
        let filled = self.fill(&part, why, now);
        remove(&pages);
        if filled.is_err() {
            // Frees the space for the next attempt and for other programs.
            remove(&part);
        }
        filled?;
        fs::rename(&part, self.path.join(NEW)).and_then(|()| self.sync()).map_err(unavailable)
    }

    fn fill(&self, part: &Path, why: &str, now: &Stamp) -> Result<(), OpenError> {
        let mut database = Database::open(part, now, self.limits)?;
        let saved = salvage::salvage(&self.path.join(DATABASE), &self.path.join(PAGES), &mut database)?;
        tracing::error!(
            error = why,
            capacities = saved.capacities,
            alarms = saved.alarms,
            resets = saved.resets,
            half_cycles = saved.half_cycles,
            refused = saved.refused,
            state = saved.state.is_some(),
            "the database is damaged: its readable rows are copied to a new one"
        );
        let detail = format!("{why}; set aside as {}; {saved}", name_of(&self.free_place()));
        let rows = vec![HistoryRow::Own { reason: "damaged", detail }];
        let state = saved.state.and_then(|state| StateRecord::new(&state, true, false).ok());
        database.commit(&[RowBatch { stamp: *now, rows }], state)?;
        Ok(database.close()?)
    }

    /// Moves a complete replacement to the database's place; `false` = there is none.
    fn finish_replacement(&self) -> Result<bool, OpenError> {
        let (path, new) = (self.path.join(DATABASE), self.path.join(NEW));
        if !new.is_file() {
            return Ok(false);
        }
        let place = self.free_place();
        let moved = || -> io::Result<()> {
            // The log first: SQLite would take it for the log of the new database.
            for companion in COMPANIONS {
                move_over(&with_suffix(&path, companion), &with_suffix(&place, companion))?;
            }
            move_over(&path, &place)?;
            self.sync()?;
            fs::rename(&new, &path)?;
            self.sync()
        };
        moved().map_err(unavailable)?;
        tracing::warn!(set_aside = %place.display(), "the damaged database is replaced");
        Ok(true)
    }

    /// The name for the next damaged database.
    fn free_place(&self) -> PathBuf {
        let place = |number: u32| self.path.join(format!("{DATABASE}.damaged-{number}"));
        let free = (1..MAX_SET_ASIDE).map(place).find(|place| !place.exists());
        // All are in use: the latest is replaced; the first is the most useful to a reader.
        free.unwrap_or_else(|| place(MAX_SET_ASIDE))
    }

    /// Syncs the folder's names to the disk.
    fn sync(&self) -> io::Result<()> {
        File::open(&self.path)?.sync_all()
    }

    fn open_good(&self, path: &Path, now: &Stamp) -> Result<OpenedDatabase, OpenError> {
        if path.is_dir() {
            return Err(OpenError::Damaged("a folder is in its place".to_owned()));
        }
        let was_emptied = fs::metadata(path).is_ok_and(|file| file.len() == 0);
        if was_emptied {
            // A power cut right after its creation leaves this too.
            tracing::warn!(path = %path.display(), "the database was empty: state and history start again");
        }
        // Before SQLite opens it and resets the log.
        let fault = wal::fault(&with_suffix(path, "-wal"));
        let database = Database::open(path, now, self.limits)?;
        let (mut rows, mut is_sound, mut state) = (Vec::new(), !was_emptied, None);
        let mut is_unreadable = false;
        let mut report = |reason: &'static str, why: String| {
            tracing::error!(reason, error = why, "the stored state is not used");
            rows.push(HistoryRow::Own { reason, detail: why });
            is_sound = false;
        };
        match fault {
            Some(Fault::Damaged(why)) => report("state_damaged", why),
            Some(Fault::LastStep(page)) => tracing::warn!(
                page,
                "the last transaction of the database's write-ahead log is incomplete: the power was cut, or it is damaged"
            ),
            None => {}
        }
        match database.state()? {
            Ok(None) => {}
            Ok(Some(stored)) => {
                match StateDocument::parse(&stored.json) {
                    Ok(document) => state = Some(document),
                    // Its hash is good: another version wrote it.
                    Err(why) => {
                        is_unreadable = true;
                        report("state_unfit", format!("{why}; {SET_ASIDE}"));
                    }
                }
                if let Some(why) = stored.fault {
                    report("state_damaged", why);
                }
            }
            Err(why) => report("state_damaged", why),
        }
        let aside = database.state_aside();
        let learned = if state.is_none() { database.learned()? } else { Vec::new() };
        Ok(OpenedDatabase { database, rows, state, aside, learned, is_unreadable, is_sound })
    }
}

/// Whether a folder holds a history or the complete replacement of one.
pub(super) fn has_history(folder: &Path) -> bool {
    [DATABASE, NEW].iter().any(|name| folder.join(name).exists())
}

/// Deletes a database with SQLite's further files, or a folder of that name.
fn remove(path: &Path) {
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    for companion in COMPANIONS {
        let _ = fs::remove_file(with_suffix(path, companion));
    }
}

/// Moves a file or folder, over anything of the new name; does nothing without it.
fn move_over(from: &Path, to: &Path) -> io::Result<()> {
    if !from.exists() {
        return Ok(());
    }
    if to.is_dir() {
        fs::remove_dir_all(to)?;
    } else if to.exists() && from.is_dir() {
        fs::remove_file(to)?;
    }
    fs::rename(from, to)
}

fn unavailable(error: io::Error) -> OpenError {
    OpenError::Unavailable(format!("the replacement of a damaged database: {error}"))
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

#[cfg(test)]
mod tests;
