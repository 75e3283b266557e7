//! The state folder: one daemon at a time, the database opened whatever happened to it.
//!
//! A damaged database is set aside under another name and reported, what can be read of it is taken over. One that a
//! newer program wrote is left alone.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use super::database::{Database, OpenError};
use super::document::Document;
use super::rows::Row;
use super::salvage;
use super::stamp::Stamp;
use super::wal;

/// Name of the database.
pub(crate) const DATABASE: &str = "packwatch.db";
/// Name of the file whose lock says that a daemon works here.
const LOCK: &str = "packwatch.lock";
/// Files SQLite has beside a database.
const COMPANIONS: [&str; 2] = ["-wal", "-shm"];
/// Damaged databases kept; a disk that damages every file must not fill up with them.
const MAX_SET_ASIDE: u32 = 8;

/// See the module.
#[derive(Debug)]
pub(crate) struct Folder {
    path: PathBuf,
    max_half_cycles: u32,
    /// Held as long as this lives.
    lock: Option<File>,
    /// A database just set aside, whose rows are still to be saved: where it is, and why it was.
    set_aside: Option<(PathBuf, String)>,
}

/// A database that was opened.
#[derive(Debug)]
pub(crate) struct Opening {
    pub(crate) database: Database,
    /// What to write into the history about it.
    pub(crate) rows: Vec<Row>,
    /// The state it holds, or a damaged one before it held; `None` = none.
    pub(crate) state: Option<Document>,
    /// Whether nothing had to be set aside and nothing was lost.
    pub(crate) is_sound: bool,
}

impl fmt::Display for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

impl Folder {
    /// Of a path that need not exist yet.
    pub(crate) fn new(path: PathBuf, max_half_cycles: u32) -> Self {
        Self { path, max_half_cycles, lock: None, set_aside: None }
    }

    /// Its path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the database and its log; `None` = cannot be seen.
    pub(crate) fn file_bytes(&self) -> Option<u64> {
        let path = self.path.join(DATABASE);
        let log = fs::metadata(with_suffix(&path, COMPANIONS[0])).map_or(0, |file| file.len());
        fs::metadata(path).ok().map(|file| file.len() + log)
    }

    /// Makes the folder where it is missing, and takes it for this process.
    ///
    /// # Errors
    /// `WouldBlock` when another process has it, else why it cannot be written.
    pub(crate) fn take(&mut self) -> io::Result<()> {
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

    /// Opens the database; a damaged one is set aside and a new one made.
    pub(crate) fn open(&mut self, now: &Stamp) -> Result<Opening, OpenError> {
        self.take().map_err(|error| OpenError::Unavailable(format!("{}: {error}", self.path.display())))?;
        let path = self.path.join(DATABASE);
        if self.set_aside.is_none() {
            match self.open_good(&path, now) {
                Err(OpenError::Damaged(why)) => self.set_aside(&why),
                result => return result,
            }
        }
        let mut database = Database::open(&path, now, self.max_half_cycles)?;
        let Some((damaged, why)) = self.set_aside.take() else {
            // Could not be moved away: opening it once more has failed above, or has not.
            return Ok(Opening { database, rows: Vec::new(), state: None, is_sound: false });
        };
        let saved = salvage::salvage(&damaged, &mut database);
        tracing::warn!(
            capacities = saved.capacities,
            alarms = saved.alarms,
            resets = saved.resets,
            half_cycles = saved.half_cycles,
            refused = saved.refused,
            state = saved.state.is_some(),
            "taken over from the damaged database"
        );
        let detail = format!("{why}; set aside as {}; {saved}", name_of(&damaged));
        let rows = vec![Row::Own { reason: "damaged", detail }];
        Ok(Opening { database, rows, state: saved.state, is_sound: false })
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
        let lost = wal::damage(&with_suffix(path, "-wal"));
        let database = Database::open(path, now, self.max_half_cycles)?;
        let (mut rows, mut is_sound, mut state) = (Vec::new(), !was_emptied, None);
        let mut tell = |why: String| {
            tracing::error!(error = why, "the stored state is damaged");
            rows.push(Row::Own { reason: "state_damaged", detail: why });
            is_sound = false;
        };
        if let Some(why) = lost {
            tell(why);
        }
        match database.state()? {
            Ok(None) => {}
            Ok(Some(stored)) => {
                match Document::parse(&stored.json) {
                    Ok(document) => state = Some(document),
                    Err(why) => tell(why),
                }
                if let Some(why) = stored.lost_later {
                    tell(format!("{why}; an earlier state is used"));
                }
            }
            Err(why) => tell(why),
        }
        Ok(Opening { database, rows, state, is_sound })
    }

    /// Gives a damaged database another name, with what SQLite has beside it.
    pub(crate) fn set_aside(&mut self, why: &str) {
        let path = self.path.join(DATABASE);
        let place = |number: u32| self.path.join(format!("{DATABASE}.damaged-{number}"));
        let free = (1..MAX_SET_ASIDE).map(place).find(|place| !place.exists());
        // All taken: the latest makes room, the first is what somebody will want to read.
        let place = free.unwrap_or_else(|| place(MAX_SET_ASIDE));
        if place.is_dir() {
            let _ = fs::remove_dir_all(&place);
        }
        match fs::rename(&path, &place) {
            Ok(()) => {
                tracing::error!(error = why, set_aside = %place.display(), "the database is damaged");
                self.set_aside = Some((place.clone(), why.to_owned()));
            }
            Err(error) => tracing::error!(why, %error, "the database is damaged, and cannot be set aside"),
        }
        for companion in COMPANIONS {
            let _ = fs::rename(with_suffix(&path, companion), with_suffix(&place, companion));
        }
    }
}

pub(super) fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}
