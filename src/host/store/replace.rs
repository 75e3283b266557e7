//! Replaces the pack in the store while no daemon runs.

use std::path::Path;

use super::database::is_damage;
use super::folder::{self, DATABASE, Folder};
use super::rows::{HistoryRow, RowBatch};
use super::stamp::{BootId, Stamp};
use super::state_files::{self, StateFiles};
use crate::io::clock::Reading;
use crate::quantity::Timestamp;

/// A replaced pack.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReplacedPack {
    /// Number of the next pack.
    pub next: i64,
    /// The damage of the history, and the name under which it was set aside; `None` = no damage.
    pub damage: Option<String>,
}

/// Closes the history of the pack in a state folder, opens the history of the next pack, and deletes the state.
///
/// # Errors
/// Fails if the folder contains no store, if a daemon uses the folder, or if the folder cannot be written. In the first
/// two cases, nothing has changed.
pub fn replace_pack(path: &Path) -> Result<ReplacedPack, String> {
    let file = path.join(DATABASE);
    let named = |error: String| format!("{}: {error}", file.display());
    if !folder::is_used(path) {
        return Err(named("no daemon is running and no history found; give the state folder with --state".to_owned()));
    }
    let mut folder = Folder::new(path.to_owned());
    folder.lock().map_err(|error| match error.kind() {
        std::io::ErrorKind::WouldBlock => named(
            "in use by a daemon that does not answer on the control socket; give its socket with --control".to_owned(),
        ),
        _ => named(error.to_string()),
    })?;
    let now = Stamp::now(Timestamp::from_nanos(Reading::now().realtime_ns), BootId::current());
    let known = StateFiles::open(path).1.newest.map_or(0, |state| state.pack);
    // Opens the folder in the same way as the daemon, so that damage is found and recorded before the history is
    // closed.
    let mut replace = || {
        let (mut database, rows) = folder.open(&now, known).map_err(|error| named(error.to_string()))?;
        let damage = rows.iter().find_map(HistoryRow::detail).map(str::to_owned);
        let replaced = database.commit(&[RowBatch { stamp: now, rows }]).and_then(|()| database.replace_pack(&now));
        let next = replaced.map_err(|error| {
            if is_damage(&error) {
                folder.mark_damaged(&error.to_string());
            }
            named(error.to_string())
        })?;
        Ok(ReplacedPack { next, damage })
    };
    // If the first attempt finds damage, the second attempt sets the database aside.
    let replaced = replace().or_else(|_: String| replace())?;
    // The state of a closed pack must never be restored. The store knows from the history which packs are closed. The
    // state is deleted in case the history is lost later.
    state_files::forget(path).map_err(|error| named(error.to_string()))?;
    Ok(replaced)
}
