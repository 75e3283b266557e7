//! Replaces the pack in the store while no daemon runs.

use std::path::Path;

use super::database::is_damage;
use super::folder::{self, DATABASE, Folder, OpenedDatabase};
use super::retention::RowLimits;
use super::rows::RowBatch;
use super::stamp::{BootId, Stamp};
use crate::io::clock::Reading;
use crate::quantity::Timestamp;

/// Closes the history of the pack in a state folder and opens that of the next pack; returns its number.
///
/// # Errors
/// When there is no store, a daemon uses it, or it cannot be written; then nothing has changed.
pub fn replace_pack(path: &Path) -> Result<i64, String> {
    let file = path.join(DATABASE);
    let named = |error: String| format!("{}: {error}", file.display());
    if !folder::has_history(path) {
        return Err(named("no daemon runs, and there is no history; name its folder with --state".to_owned()));
    }
    let mut folder = Folder::new(path.to_owned(), RowLimits::NONE);
    folder.lock().map_err(|error| match error.kind() {
        std::io::ErrorKind::WouldBlock => named(
            "a daemon uses it but does not listen on the control socket; name its socket with --control".to_owned(),
        ),
        _ => named(error.to_string()),
    })?;
    let now = Stamp::now(Timestamp::from_nanos(Reading::now().realtime_ns), BootId::current());
    // As the daemon opens it: damage is found, and reported in the history that is closed.
    let opening = folder.open(&now).map_err(|error| named(error.to_string()))?;
    let OpenedDatabase { mut database, rows, .. } = opening;
    if !rows.is_empty() {
        database.commit(&[RowBatch { stamp: now, rows }], None).map_err(|error| named(error.to_string()))?;
    }
    match database.replace_pack(&now) {
        Err(error) if is_damage(&error) => {
            drop(database);
            folder.mark_damaged(&error.to_string());
            let mut rebuilt = folder.open(&now).map_err(|error| named(error.to_string()))?.database;
            rebuilt.replace_pack(&now)
        }
        replaced => replaced,
    }
    .map_err(|error| named(error.to_string()))
}
