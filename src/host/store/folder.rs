//! The state folder: one daemon at a time, the database opened whatever happened to it.
//!
//! A damaged database is replaced by what can be read of it, kept under another name and reported. One that a newer
//! program wrote is left alone.
//!
//! A power cut in the middle of a replacement loses nothing and is made good at the next start:
//!
//! | in the folder | the cut was | what is done |
//! | --- | --- | --- |
//! | `packwatch.db.part` | while it was filled | done away with, begun again |
//! | `packwatch.db.new` | after it was complete | it takes the place of the database, whatever is there |
//!
//! So the damaged one goes only when all that was saved of it, with the state and the report, is on the disk.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::database::{Database, OpenError, StateRecord};
use super::document::Document;
use super::parts::Parts;
use super::rows::{Batch, Row};
use super::salvage;
use super::stamp::Stamp;
use super::wal::{self, Fault};

/// Name of the database.
pub(super) const DATABASE: &str = "packwatch.db";
/// Name of its replacement while that is filled.
const PART: &str = "packwatch.db.part";
/// Name of its replacement that is complete.
const NEW: &str = "packwatch.db.new";
/// Name of the file whose lock says that a daemon works here.
const LOCK: &str = "packwatch.lock";
/// Files SQLite has beside a database.
const COMPANIONS: [&str; 2] = ["-wal", "-shm"];
/// Damaged databases kept; a disk that damages every file must not fill up with them.
const MAX_SET_ASIDE: u32 = 8;
/// Between two replacements by one process: one writes up to some 20 MB, and a full or failing disk would have another at
/// every attempt.
const REPLACEMENT_PAUSE: Duration = Duration::from_secs(600);

/// What is said of a state that is set aside.
pub(super) const SET_ASIDE: &str = "set aside, used at the first start at which it fits";

/// See the module.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    max_half_cycles: u32,
    /// Held as long as this lives.
    lock: Option<File>,
    /// Why the database is to be replaced; `None` = nothing is known against it.
    damaged: Option<String>,
    /// When it was tried last.
    replaced: Option<Instant>,
}

/// A database that was opened.
#[derive(Debug)]
pub(super) struct Opening {
    pub database: Database,
    /// What to write into the history about it.
    pub rows: Vec<Row>,
    /// The state it holds, or a damaged one before it held; `None` = none.
    pub state: Option<Document>,
    /// A state that was set aside earlier.
    pub aside: Option<Document>,
    /// Whether the database holds a state that this program cannot read: it must not be overwritten.
    pub is_strange: bool,
    /// Whether nothing had to be set aside and nothing was lost.
    pub is_sound: bool,
}

impl fmt::Display for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

impl Folder {
    /// Of a path that need not exist yet.
    pub(super) fn new(path: PathBuf, max_half_cycles: u32) -> Self {
        Self { path, max_half_cycles, lock: None, damaged: None, replaced: None }
    }

    /// Its path.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the database and its log; `None` = cannot be seen.
    pub(super) fn file_bytes(&self) -> Option<u64> {
        let path = self.path.join(DATABASE);
        let log = fs::metadata(with_suffix(&path, COMPANIONS[0])).map_or(0, |file| file.len());
        fs::metadata(path).ok().map(|file| file.len() + log)
    }

    /// Makes the folder where it is missing, and takes it for this process.
    ///
    /// # Errors
    /// `WouldBlock` when another process has it, else why it cannot be written.
    pub(super) fn take(&mut self) -> io::Result<()> {
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

    /// Opens the database; a damaged one is replaced by what can be read of it.
    pub(super) fn open(&mut self, now: &Stamp) -> Result<Opening, OpenError> {
        self.take().map_err(|error| OpenError::Unavailable(format!("{}: {error}", self.path.display())))?;
        let was_replaced = self.finish_replacement()?;
        if was_replaced {
            self.damaged = None;
        }
        let path = self.path.join(DATABASE);
        if self.damaged.is_none() {
            match self.open_good(&path, now) {
                Err(OpenError::Damaged(why)) => self.damaged = Some(why),
                result => {
                    return result.map(|opening| Opening { is_sound: opening.is_sound && !was_replaced, ..opening });
                }
            }
        }
        if let Some(why) = self.damaged.clone() {
            self.fill_replacement(&why, now)?;
            self.finish_replacement()?;
            self.damaged = None;
        }
        let opening = self.open_good(&path, now)?;
        Ok(Opening { is_sound: false, ..opening })
    }

    /// The database is damaged: the next opening replaces it.
    pub(super) fn mark_damaged(&mut self, why: &str) {
        self.damaged = Some(why.to_owned());
    }

    /// Saves what can be read of the database, with the report of it, in a file that is then complete.
    pub(super) fn fill_replacement(&mut self, why: &str, now: &Stamp) -> Result<(), OpenError> {
        if self.replaced.is_some_and(|last| last.elapsed() < REPLACEMENT_PAUSE) {
            return Err(OpenError::Unavailable(format!(
                "damaged: {why}; it was replaced less than {} s ago, and waits",
                REPLACEMENT_PAUSE.as_secs()
            )));
        }
        self.replaced = Some(Instant::now());
        let part = self.path.join(PART);
        remove(&part);
        let filled = self.fill(&part, why, now);
        if filled.is_err() {
            // Room for the next attempt, and for others.
            remove(&part);
        }
        filled?;
        fs::rename(&part, self.path.join(NEW)).and_then(|()| self.sync()).map_err(unavailable)
    }

    fn fill(&self, part: &Path, why: &str, now: &Stamp) -> Result<(), OpenError> {
        let mut database = Database::open(part, now, self.max_half_cycles)?;
        let saved = salvage::salvage(&self.path.join(DATABASE), &mut database)?;
        tracing::error!(
            error = why,
            capacities = saved.capacities,
            alarms = saved.alarms,
            resets = saved.resets,
            half_cycles = saved.half_cycles,
            refused = saved.refused,
            state = saved.state.is_some(),
            "the database is damaged: what can be read of it is taken over"
        );
        let detail = format!("{why}; set aside as {}; {saved}", name_of(&self.free_place()));
        let rows = vec![Row::Own { reason: "damaged", detail }];
        let json = saved.state.and_then(|state| state.to_json().ok());
        let parts = json.as_deref().and_then(Parts::of);
        let state = parts.map(|parts| StateRecord { parts, exact: true, sets_aside: false });
        database.commit(&[Batch { stamp: *now, rows }], state)?;
        Ok(database.close()?)
    }

    /// Puts a complete replacement in the database's place; false when there is none.
    fn finish_replacement(&self) -> Result<bool, OpenError> {
        let (path, new) = (self.path.join(DATABASE), self.path.join(NEW));
        if !new.is_file() {
            return Ok(false);
        }
        let place = self.free_place();
        let moved = || -> io::Result<()> {
            // The log first: beside the new one it would be taken for its own.
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

    /// Where the next damaged database is kept.
    fn free_place(&self) -> PathBuf {
        let place = |number: u32| self.path.join(format!("{DATABASE}.damaged-{number}"));
        let free = (1..MAX_SET_ASIDE).map(place).find(|place| !place.exists());
        // All taken: the latest makes room, the first is what somebody will want to read.
        free.unwrap_or_else(|| place(MAX_SET_ASIDE))
    }

    /// Makes names last on the disk.
    fn sync(&self) -> io::Result<()> {
        File::open(&self.path)?.sync_all()
    }

    fn open_good(&self, path: &Path, now: &Stamp) -> Result<Opening, OpenError> {
        if path.is_dir() {
            return Err(OpenError::Damaged("a folder in its place".to_owned()));
        }
        let was_emptied = fs::metadata(path).is_ok_and(|file| file.len() == 0);
        if was_emptied {
            // A power cut right after it was made leaves this too.
            tracing::warn!(path = %path.display(), "the database was empty: state and history begin anew");
        }
        // Before SQLite opens it, as it then makes the log anew.
        let fault = wal::fault(&with_suffix(path, "-wal"));
        let database = Database::open(path, now, self.max_half_cycles)?;
        let (mut rows, mut is_sound, mut state) = (Vec::new(), !was_emptied, None);
        let mut is_strange = false;
        let mut tell = |reason: &'static str, why: String| {
            tracing::error!(reason, error = why, "the stored state is not used");
            rows.push(Row::Own { reason, detail: why });
            is_sound = false;
        };
        match fault {
            Some(Fault::Damaged(why)) => tell("state_damaged", why),
            Some(Fault::LastStep(page)) => tracing::warn!(
                page,
                "the last step of the database's write-ahead log is not whole: the power was cut in it, or it is damaged"
            ),
            None => {}
        }
        match database.state()? {
            Ok(None) => {}
            Ok(Some(stored)) => {
                match Document::parse(&stored.json) {
                    Ok(document) => state = Some(document),
                    // Its hash is good: another version wrote it.
                    Err(why) => {
                        is_strange = true;
                        tell("state_unfit", format!("{why}; {SET_ASIDE}"));
                    }
                }
                if let Some(why) = stored.lost_later {
                    tell("state_damaged", format!("{why}; an earlier state is used"));
                }
            }
            Err(why) => tell("state_damaged", why),
        }
        let aside = database.state_aside();
        Ok(Opening { database, rows, state, aside, is_strange, is_sound })
    }
}

/// Whether a folder holds a history, or one that is about to take its place.
pub(super) fn has_history(folder: &Path) -> bool {
    [DATABASE, NEW].iter().any(|name| folder.join(name).exists())
}

/// Does away with a database and what SQLite has beside it, or a folder of that name.
fn remove(path: &Path) {
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    for companion in COMPANIONS {
        let _ = fs::remove_file(with_suffix(path, companion));
    }
}

/// Moves what is there, in place of anything.
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

/// A path with something behind its name.
pub fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

#[cfg(test)]
mod tests;
