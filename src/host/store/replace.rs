//! Another pack, told while no daemon runs.

use std::path::Path;

use super::folder::{self, DATABASE, Folder, Opening};
use super::rows::Batch;
use super::stamp::{BootId, Stamp};
use crate::config::DEFAULT_MAX_HALF_CYCLES;
use crate::io::clock::Reading;
use crate::quantity::Timestamp;

/// Closes the history of the pack in a state folder and opens the next one's; its number.
///
/// # Errors
/// When there is no store, a daemon works with it, or it cannot be written: nothing is changed then.
pub fn replace_pack(path: &Path) -> Result<i64, String> {
    let file = path.join(DATABASE);
    let named = |error: String| format!("{}: {error}", file.display());
    if !folder::has_history(path) {
        return Err(named("no daemon runs, and there is no history; --state says where it is kept".to_owned()));
    }
    let mut folder = Folder::new(path.to_owned(), DEFAULT_MAX_HALF_CYCLES);
    folder.take().map_err(|error| match error.kind() {
        std::io::ErrorKind::WouldBlock => named(
            "a daemon works with it but does not listen where it was asked; --control says where it does".to_owned(),
        ),
        _ => named(error.to_string()),
    })?;
    let now = Stamp::now(Timestamp::from_nanos(Reading::now().realtime_ns), BootId::current());
    // As the daemon opens it: what is damaged is noticed, and told in the history that is closed.
    let opening = folder.open(&now).map_err(|error| named(error.to_string()))?;
    let Opening { mut database, rows, .. } = opening;
    if !rows.is_empty() {
        database.commit(&[Batch { stamp: now, rows }], None).map_err(|error| named(error.to_string()))?;
    }
    database.replace_pack(&now).map_err(|error| named(error.to_string()))
}
