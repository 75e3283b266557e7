//! Replaces the pack in the store while no daemon runs.

use std::path::Path;

use super::database::is_damage;
use super::folder::{self, DATABASE, Folder};
use super::rows::RowBatch;
use super::stamp::{BootId, Stamp};
use super::state_files::{self, StateFiles};
use crate::io::clock::Reading;
use crate::quantity::Timestamp;

/// Closes the history of the pack in a state folder and opens that of the next pack; forgets the state. Returns the number of the
/// next pack.
///
/// # Errors
/// When there is no store, a daemon uses it, or it cannot be written; then nothing has changed.
pub fn replace_pack(path: &Path) -> Result<i64, String> {
    let file = path.join(DATABASE);
    let named = |error: String| format!("{}: {error}", file.display());
    if !folder::is_used(path) {
        return Err(named("no daemon runs, and there is no history; name its folder with --state".to_owned()));
    }
    let mut folder = Folder::new(path.to_owned());
    folder.lock().map_err(|error| match error.kind() {
        std::io::ErrorKind::WouldBlock => named(
            "a daemon uses it but does not listen on the control socket; name its socket with --control".to_owned(),
        ),
        _ => named(error.to_string()),
    })?;
    let now = Stamp::now(Timestamp::from_nanos(Reading::now().realtime_ns), BootId::current());
    let known = StateFiles::open(path).1.newest.map_or(0, |state| state.pack);
    // As the daemon opens it: damage is found, and reported in the history that is closed.
    let mut replace = || {
        let (mut database, rows) = folder.open(&now, known).map_err(|error| named(error.to_string()))?;
        let replaced = database.commit(&[RowBatch { stamp: now, rows }]).and_then(|()| database.replace_pack(&now));
        replaced.map_err(|error| {
            if is_damage(&error) {
                folder.mark_damaged(&error.to_string());
            }
            named(error.to_string())
        })
    };
    // Damage that the first attempt finds is set aside by the second.
    let pack = replace().or_else(|_| replace())?;
    // A state of a closed pack is not restored; it would be if the database were lost.
    state_files::forget(path).map_err(|error| named(error.to_string()))?;
    Ok(pack)
}
