//! The store of a replay: the same database, written synchronously, in bus time.

use std::path::Path;

use super::database::Database;
use super::document::StateDocument;
use super::folder::{self, DATABASE, Folder};
use super::history_filter::HistoryFilter;
use super::rows::{HistoryRow, RowBatch};
use super::stamp::Stamp;
use super::state_slots::StateRecord;
use crate::config::{StoreConfig, VehicleIdentity};
use crate::monitor::{Event, Monitor};
use crate::quantity::Timestamp;

/// Writes state and history of a replay.
#[derive(Debug)]
pub struct Recorder {
    database: Database,
    /// Locked against other processes.
    folder: Folder,
    history_filter: HistoryFilter,
    checkpoint_s: f64,
    keep_years: Option<f64>,
    checkpointed: Option<Timestamp>,
}

impl Recorder {
    /// Creates the store in a folder that has none.
    ///
    /// # Errors
    /// When there is one, or it cannot be created: a replay must never get into the history of a real pack.
    pub fn create(path: &Path, config: &StoreConfig, vehicle: &VehicleIdentity) -> Result<Self, String> {
        let shown = path.join(DATABASE).display().to_string();
        if folder::has_history(path) {
            return Err(format!("{shown}: exists; a replay needs a state folder of its own, name a new one"));
        }
        let mut folder = Folder::new(path.to_owned(), config.into());
        folder.lock().map_err(|error| format!("{}: {error}", path.display()))?;
        let now = Stamp::replayed(Timestamp::ZERO);
        let database =
            Database::open(&path.join(DATABASE), &now, config.into()).map_err(|error| format!("{shown}: {error}"))?;
        database.set_vehicle(vehicle).map_err(|error| format!("{shown}: {error}"))?;
        let (history_filter, checkpoint_s) = (HistoryFilter::default(), config.checkpoint_s);
        let keep_years = config.keep_years;
        Ok(Self { database, folder, history_filter, checkpoint_s, keep_years, checkpointed: None })
    }

    /// Writes the rows of one input's events, and the checkpoint when it is due.
    pub fn record(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let rows = self.history_filter.take(events);
        let is_due = now.since(*self.checkpointed.get_or_insert(now)) >= self.checkpoint_s;
        if rows.is_none() && !is_due {
            return Ok(());
        }
        self.checkpointed = Some(now);
        let rows = rows.unwrap_or_else(|| self.history_filter.for_checkpoint(now));
        self.write(rows, monitor, now, false)
    }

    /// Writes the last state, unrounded.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let rows = self.history_filter.deferred();
        self.write(rows, monitor, now, true)
    }

    fn write(&mut self, rows: Vec<HistoryRow>, monitor: &Monitor, now: Timestamp, exact: bool) -> Result<(), String> {
        let stamp = Stamp::replayed(now);
        self.database.set_horizon_ns(self.keep_years.and_then(|years| stamp.years_ago_ns(years)));
        let folder = self.folder.to_string();
        let document = StateDocument { folder, stamp, snapshot: Box::new(monitor.snapshot().for_restart()) };
        let batch = (!rows.is_empty()).then_some(RowBatch { stamp, rows });
        let written = self.database.commit(batch.as_slice(), Some(StateRecord::new(&document, exact, false)?));
        written.map_err(|error| format!("{}: {error}", self.folder))
    }
}
