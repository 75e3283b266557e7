//! The store fed from a replay: the same database, written at once, in bus time.

use std::path::Path;

use super::database::{Database, StateRecord};
use super::document::Document;
use super::folder::{self, DATABASE, Folder};
use super::history_filter::{CommitDecision, HistoryFilter};
use super::parts::Parts;
use super::rows::Batch;
use super::stamp::Stamp;
use crate::config::StoreConfig;
use crate::monitor::{Event, Monitor};
use crate::quantity::Timestamp;

/// Writes state and history of a replay.
#[derive(Debug)]
pub struct Recorder {
    database: Database,
    /// Keeps others out.
    folder: Folder,
    history_filter: HistoryFilter,
    checkpoint_s: f64,
    checkpointed: Option<Timestamp>,
}

impl Recorder {
    /// Makes the store in a folder that has none.
    ///
    /// # Errors
    /// When there is one, or it cannot be made: a replay must never get into the history of a real pack.
    pub fn create(path: &Path, config: &StoreConfig) -> Result<Self, String> {
        let shown = path.join(DATABASE).display().to_string();
        if folder::has_history(path) {
            return Err(format!("{shown}: exists; a replay needs a state folder of its own, name a new one"));
        }
        let mut folder = Folder::new(path.to_owned(), config.max_half_cycles);
        folder.take().map_err(|error| format!("{}: {error}", path.display()))?;
        let now = Stamp::replayed(Timestamp::ZERO);
        let database = Database::open(&path.join(DATABASE), &now, config.max_half_cycles)
            .map_err(|error| format!("{shown}: {error}"))?;
        let (history_filter, checkpoint_s) = (HistoryFilter::default(), config.checkpoint_s);
        Ok(Self { database, folder, history_filter, checkpoint_s, checkpointed: None })
    }

    /// After an input: writes what its events have taught, and the checkpoint when it is due.
    pub fn record(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let rows = match self.history_filter.take(events) {
            CommitDecision::Commit(rows) => Some(rows),
            CommitDecision::Nothing | CommitDecision::Deferred => None,
        };
        let is_due = now.since(*self.checkpointed.get_or_insert(now)) >= self.checkpoint_s;
        if rows.is_none() && !is_due {
            return Ok(());
        }
        self.checkpointed = Some(now);
        let rows = rows.unwrap_or_else(|| self.history_filter.for_checkpoint(now));
        let rows = Some(rows).filter(|rows| !rows.is_empty());
        let batches: Vec<Batch> = rows.map(|rows| Batch { stamp: Stamp::replayed(now), rows }).into_iter().collect();
        self.write(&batches, monitor, now, false)
    }

    /// The last state, to the last bit.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let batch = Batch { stamp: Stamp::replayed(now), rows: self.history_filter.deferred() };
        let batches = if batch.rows.is_empty() { Vec::new() } else { vec![batch] };
        self.write(&batches, monitor, now, true)
    }

    fn write(&mut self, batches: &[Batch], monitor: &Monitor, now: Timestamp, exact: bool) -> Result<(), String> {
        let document = Document {
            folder: self.folder.to_string(),
            stamp: Stamp::replayed(now),
            snapshot: Box::new(monitor.snapshot()),
        };
        let json = document.to_json().map_err(|error| error.to_string())?;
        let parts = Parts::of(&json).ok_or("a number of the state cannot be read")?;
        let written = self.database.commit(batches, Some(StateRecord { parts, exact, sets_aside: false }));
        written.map_err(|error| format!("{}: {error}", self.folder))
    }
}
