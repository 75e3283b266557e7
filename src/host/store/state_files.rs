//! Writes and reads the stored state: two files next to the database, written in turn. A power cut or damage to one
//! file therefore destroys at most one of the two states.
//!
//! | file | contents |
//! | --- | --- |
//! | `state-a.json.zst`, `state-b.json.zst` | the latest state and the one before it |
//! | `state-aside.json.zst` | a state that could not be restored, kept until a start can restore it |
//!
//! A file contains a zstd frame of JSON, and a skippable frame with the SHA-256 of the first frame. Therefore `zstdcat`
//! prints the JSON, and every flipped bit is detected. The file is written to a temporary name, synced and renamed, and
//! the folder is synced. A state therefore survives a power cut once its write has returned. The newest state is the
//! valid file with the highest number.
//!
//! Numbers are stored with nine digits or six decimals (see [`rounded`]), which halves the size to about 70 kB for a
//! pack of 96 cells.

use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::ser::{CompactFormatter, Formatter};
use sha2::{Digest, Sha256};

use super::rows::HistoryRow;
use super::stamp::Stamp;
use crate::monitor::Snapshot;

/// The format that this program reads and writes.
pub(super) const FORMAT: u32 = 1;
pub(super) const FILES: [&str; 2] = ["state-a.json.zst", "state-b.json.zst"];
/// Name of the file of a state that was set aside.
pub(super) const ASIDE: &str = "state-aside.json.zst";
/// Name of a state file while it is being written.
const PART: &str = "state.json.zst.part";
/// Log and history text about a state that is set aside.
pub(super) const SET_ASIDE: &str = "set aside for the first start at which it fits";
/// Compression level. The level is low because learned values and alarms are sent only after the state has been
/// compressed and stored. Level 19 makes files a sixth smaller and takes fifty times as long.
const LEVEL: i32 = 1;
/// Maximum size of the JSON, bytes: ten times the size for the largest pack.
const MAX_JSON_BYTES: u64 = 64 << 20;
/// Head of the frame that contains the hash: the magic number of a skippable zstd frame, and the length of the hash.
const HASH_HEAD: [u8; 8] = [0x50, 0x2A, 0x4D, 0x18, 32, 0, 0, 0];

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StateDocument {
    pub format: u32,
    /// Number of the state, counting all written states.
    pub number: i64,
    /// The state folder that the state belongs to. The folder is stored because two daemons may share a runtime folder.
    pub folder: String,
    /// Number of the pack that was connected; 0 = unknown.
    pub pack: i64,
    /// Number of rows in the history when the state was taken.
    pub history_rows: i64,
    pub stamp: Stamp,
    pub snapshot: Box<Snapshot>,
}

/// Why a state cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum StateFault {
    /// The file cannot be read, or has changed since it was written.
    Damaged(String),
    /// Another version of the program wrote the state.
    Unfit(String),
}

impl StateDocument {
    pub(super) fn parse(json: &[u8]) -> Result<Self, StateFault> {
        #[derive(Deserialize)]
        struct Head {
            format: u32,
        }
        let unfit = |error: serde_json::Error| StateFault::Unfit(format!("not a state: {error}"));
        let Head { format } = serde_json::from_slice(json).map_err(unfit)?;
        if format != FORMAT {
            return Err(StateFault::Unfit(format!("format {format}, must be {FORMAT}")));
        }
        serde_json::from_slice(json).map_err(unfit)
    }

    /// Writes JSON to a temporary name and renames it. The file is in memory, so it is not synced.
    pub(super) fn write_json(&self, path: &Path) -> io::Result<()> {
        let part = path.with_extension("json.part");
        fs::write(&part, serde_json::to_vec(self)?)?;
        fs::rename(&part, path)
    }

    /// Encodes the contents of the state's file.
    ///
    /// # Errors
    /// Fails if the result cannot be read back. The reason is a number that is not finite, which is written as `null`.
    fn encode(&self) -> Result<Vec<u8>, String> {
        let mut json = Vec::new();
        self.serialize(&mut serde_json::Serializer::with_formatter(&mut json, Rounding(CompactFormatter)))
            .map_err(|error| error.to_string())?;
        if let Err(StateFault::Damaged(why) | StateFault::Unfit(why)) = Self::parse(&json) {
            return Err(why);
        }
        let mut file = zstd::bulk::compress(&json, LEVEL).map_err(|error| error.to_string())?;
        let hash = Sha256::digest(&file);
        file.extend_from_slice(&HASH_HEAD);
        file.extend_from_slice(&hash);
        Ok(file)
    }

    fn decode(file: &[u8]) -> Result<Self, StateFault> {
        let damaged = |why: &str| StateFault::Damaged(why.to_owned());
        let (frame, hash) = file
            .split_last_chunk::<32>()
            .and_then(|(rest, hash)| Some((rest.strip_suffix(&HASH_HEAD)?, hash)))
            .ok_or_else(|| damaged("no hash at the end of the file"))?;
        if Sha256::digest(frame)[..] != *hash {
            return Err(damaged("the hash does not match"));
        }
        let mut json = Vec::new();
        zstd::Decoder::with_buffer(frame)
            .and_then(|decoder| decoder.take(MAX_JSON_BYTES).read_to_end(&mut json))
            .map_err(|error| StateFault::Damaged(error.to_string()))?;
        Self::parse(&json)
    }

    /// Reads a file; `None` = the file does not exist.
    fn read(path: &Path) -> Result<Option<Self>, StateFault> {
        match fs::read(path) {
            Ok(file) => Self::decode(&file).map(Some),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(StateFault::Damaged(error.to_string())),
        }
    }
}

struct Rounding(CompactFormatter);

impl Formatter for Rounding {
    fn write_f64<W: ?Sized + io::Write>(&mut self, writer: &mut W, value: f64) -> io::Result<()> {
        self.0.write_f64(writer, rounded(value))
    }
}

/// Rounds a number below 1,000 to nine significant digits, and a larger number to six decimals. Whole numbers
/// (identities) and very large numbers (times) stay exact.
fn rounded(value: f64) -> f64 {
    let text = match value.abs() {
        size if value.fract() == 0.0 || size >= 1e9 => return value,
        size if size < 1000.0 => format!("{value:.8e}"),
        _ => format!("{value:.6}"),
    };
    text.parse().unwrap_or(value)
}

/// The state files of a folder, and which of them is written next.
#[derive(Debug)]
pub(super) struct StateFiles {
    folder: PathBuf,
    /// Index in [`FILES`] of the file that the next state is written to.
    next: usize,
    number: i64,
    /// Index in [`FILES`] of a state that the next write sets aside first; `None` = no state.
    aside: Option<usize>,
}

#[derive(Debug, Default)]
pub(super) struct FoundStates {
    pub newest: Option<StateDocument>,
    pub aside: Option<StateDocument>,
    /// Faults of the files, for the history.
    pub faults: Vec<HistoryRow>,
}

impl StateFiles {
    /// Opens the state files of a folder, which may not exist yet. Also returns the states in the files.
    pub(super) fn open(folder: &Path) -> (Self, FoundStates) {
        let mut files = Self { folder: folder.to_owned(), next: 0, number: 0, aside: None };
        let mut found = FoundStates::default();
        let mut report = |reason: &'static str, file: &str, why: String| {
            tracing::error!(reason, file, error = why, "stored state not used");
            found.faults.push(HistoryRow::Own { reason, detail: format!("{file}: {why}") });
        };
        for (place, name) in FILES.into_iter().enumerate() {
            match StateDocument::read(&folder.join(name)) {
                Ok(None) => {}
                Ok(Some(document)) if document.number > files.number => {
                    (files.number, files.next) = (document.number, 1 - place);
                    found.newest = Some(document);
                }
                Ok(Some(_)) => {}
                Err(StateFault::Damaged(why)) => report("state_damaged", name, format!("damaged: {why}")),
                Err(StateFault::Unfit(why)) => {
                    report("state_unfit", name, format!("{why}; {SET_ASIDE}"));
                    files.aside = Some(place);
                }
            }
        }
        found.aside = StateDocument::read(&folder.join(ASIDE)).ok().flatten();
        (files, found)
    }

    /// Makes the next write set the newest state aside. The state is then kept until a start can restore it.
    pub(super) fn set_aside(&mut self) {
        self.aside = Some(1 - self.next);
    }

    /// Whether the file of the newest state still exists.
    pub(super) fn is_present(&self) -> bool {
        self.folder.join(FILES[1 - self.next]).exists()
    }

    /// Overwrites the older state. The new state is durable when this function returns. Returns the size of the file.
    pub(super) fn write(&mut self, document: StateDocument) -> Result<u64, String> {
        let named = |name: &str, error: io::Error| format!("{}: {error}", self.folder.join(name).display());
        let file = StateDocument { number: self.number + 1, ..document }.encode()?;
        if let Some(place) = self.aside {
            replace(&self.folder.join(FILES[place]), &self.folder.join(ASIDE)).map_err(|error| named(ASIDE, error))?;
            (self.next, self.aside) = (place, None);
        }
        let (part, path) = (self.folder.join(PART), self.folder.join(FILES[self.next]));
        File::create(&part)
            .and_then(|mut part| {
                part.write_all(&file)?;
                part.sync_all()
            })
            .and_then(|()| replace(&part, &path))
            .and_then(|()| File::open(&self.folder)?.sync_all())
            .map_err(|error| {
                // The incomplete file is deleted to free its space.
                let _ = fs::remove_file(&part);
                named(FILES[self.next], error)
            })?;
        (self.number, self.next) = (self.number + 1, 1 - self.next);
        Ok(file.len() as u64)
    }
}

pub(super) fn forget(folder: &Path) -> io::Result<()> {
    for name in FILES.into_iter().chain([ASIDE]) {
        match fs::remove_file(folder.join(name)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    File::open(folder)?.sync_all()
}

/// Renames a file, replacing another file or a folder of that name.
fn replace(from: &Path, to: &Path) -> io::Result<()> {
    if to.is_dir() {
        fs::remove_dir_all(to)?;
    }
    fs::rename(from, to)
}

#[cfg(test)]
mod tests;
