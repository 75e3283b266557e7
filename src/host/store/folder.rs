//! Locks the state folder for one daemon and opens the history database in the folder.
//!
//! A damaged database is renamed, reported, and replaced by an empty database.

use std::fmt;
use std::fs::{self, File, Metadata, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use super::database::{Database, OpenError, file_id};
use super::rows::HistoryRow;
use super::stamp::Stamp;
use super::state_files;
use crate::io::place::with_suffix;

pub(super) const DATABASE: &str = "packwatch.db";
/// Name of the file that a daemon keeps locked.
const LOCK: &str = "packwatch.lock";
/// Suffixes of the files that SQLite keeps for a database. The write-ahead log is moved first. If the log stayed behind
/// after a power cut, SQLite would apply it to the next database.
const FILES: [&str; 3] = ["-wal", "-shm", ""];
/// Maximum number of damaged databases that are kept. Without this limit, a disk that damages every file would fill up
/// with damaged databases.
const MAX_SET_ASIDE: u32 = 8;

#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    /// The lock file. The lock is held while this file is open.
    lock: Option<File>,
    /// Description of the damage if the database must be replaced; `None` = no known damage.
    damage: Option<String>,
}

impl fmt::Display for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

impl Folder {
    /// The state folder at `path`, which may not exist yet.
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path, lock: None, damage: None }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the database and its log, bytes; `None` = unknown.
    pub(super) fn database_bytes(&self) -> Option<u64> {
        let path = self.path.join(DATABASE);
        let log = fs::metadata(with_suffix(&path, FILES[0])).map_or(0, |file| file.len());
        fs::metadata(path).ok().map(|file| file.len() + log)
    }

    /// Creates the folder if it does not exist, and locks it for this process. If the lock file has been deleted or
    /// replaced, locks the new file, because another daemon could lock it.
    ///
    /// # Errors
    /// Returns `WouldBlock` if another process has locked the folder, else the reason why the folder cannot be written.
    pub(super) fn lock(&mut self) -> io::Result<()> {
        let path = self.path.join(LOCK);
        let id = |file: io::Result<Metadata>| file.ok().as_ref().map(file_id);
        if self.lock.as_ref().is_some_and(|lock| id(lock.metadata()) == id(fs::metadata(&path))) {
            return Ok(());
        }
        self.lock = None;
        fs::create_dir_all(&self.path)?;
        let file = File::options().create(true).truncate(false).write(true).open(path)?;
        match file.try_lock() {
            Ok(()) => {
                self.lock = Some(file);
                Ok(())
            }
            Err(TryLockError::WouldBlock) => Err(io::ErrorKind::WouldBlock.into()),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }

    /// Opens the database. `pack` is the number of the pack in the stored state (0 = unknown). If the database is
    /// damaged, sets it aside and creates an empty database. Also returns the history rows that report the damage.
    pub(super) fn open(&mut self, now: &Stamp, pack: i64) -> Result<(Database, Vec<HistoryRow>), OpenError> {
        self.lock().map_err(|error| OpenError::Unavailable(format!("{}: {error}", self.path.display())))?;
        let path = self.path.join(DATABASE);
        if path.is_dir() {
            self.mark_damaged("a folder is in its place");
        }
        if self.damage.is_none() {
            match Database::open(&path, now, pack) {
                Err(OpenError::Damaged(why)) => self.damage = Some(why),
                result => return result.map(|database| (database, Vec::new())),
            }
        }
        let place = self.free_place();
        self.set_aside(&place)
            .map_err(|error| OpenError::Unavailable(format!("damaged database not set aside: {error}")))?;
        let why = self.damage.take().unwrap_or_default();
        let name = place.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let detail = format!("{why}; set aside as {name}; a new history starts");
        tracing::error!(error = why, set_aside = %place.display(), "database damaged: a new history starts");
        Ok((Database::open(&path, now, pack)?, vec![HistoryRow::Own { reason: "damaged", detail }]))
    }

    /// Marks the database as damaged. The next call of [`open`](Self::open) replaces the database.
    pub(super) fn mark_damaged(&mut self, why: &str) {
        self.damage = Some(why.to_owned());
    }

    fn set_aside(&self, place: &Path) -> io::Result<()> {
        let path = self.path.join(DATABASE);
        for suffix in FILES {
            let (from, to) = (with_suffix(&path, suffix), with_suffix(place, suffix));
            if to.is_dir() {
                fs::remove_dir_all(&to)?;
            } else if to.exists() {
                fs::remove_file(&to)?;
            }
            if from.exists() {
                fs::rename(from, to)?;
            }
        }
        File::open(&self.path)?.sync_all()
    }

    fn free_place(&self) -> PathBuf {
        let place = |number: u32| self.path.join(format!("{DATABASE}.damaged-{number}"));
        let free = (1..MAX_SET_ASIDE).map(place).find(|place| !place.exists());
        // If all names are in use, the database with the last name is replaced. The first damaged database is the most
        // useful and is kept.
        free.unwrap_or_else(|| place(MAX_SET_ASIDE))
    }
}

/// Whether a folder contains a history or a state.
pub(super) fn is_used(folder: &Path) -> bool {
    state_files::FILES.into_iter().chain([DATABASE]).any(|name| folder.join(name).exists())
}

#[cfg(test)]
mod tests;
