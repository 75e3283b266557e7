//! The store of a replay. A [`Recorder`] writes the same files as the daemon's store, with two differences: each write
//! is finished when the call returns, and rows and states have the times of the log.

use std::path::Path;

use super::checkpoint::CheckpointSchedule;
use super::database::{Database, RowLimits};
use super::folder::{self, DATABASE, Folder};
use super::history_filter::{HistoryCommit, HistoryFilter};
use super::rows::RowBatch;
use super::stamp::Stamp;
use super::state_files::{FORMAT, StateDocument, StateFiles};
use crate::config::{StoreConfig, VehicleIdentity};
use crate::monitor::{Event, Monitor};
use crate::quantity::Timestamp;

/// Writes state and history of a replay.
#[derive(Debug)]
pub struct Recorder {
    database: Database,
    state_files: StateFiles,
    /// The folder, locked against other processes.
    folder: Folder,
    history_filter: HistoryFilter,
    limits: RowLimits,
    schedule: CheckpointSchedule,
}

impl Recorder {
    /// Creates the store in a folder that contains no store.
    ///
    /// # Errors
    /// Fails if the folder contains a store, because a replay must never be written into the history of a real pack.
    /// Also fails if the store cannot be created.
    pub fn create(path: &Path, config: &StoreConfig, vehicle: &VehicleIdentity) -> Result<Self, String> {
        let shown = path.join(DATABASE).display().to_string();
        if folder::is_used(path) {
            return Err(format!("{}: already contains a state; a replay needs a new state folder", path.display()));
        }
        if path.exists() && !path.is_dir() {
            return Err(format!("{}: is a file, must be a folder for state and history", path.display()));
        }
        let mut folder = Folder::new(path.to_owned());
        folder.lock().map_err(|error| format!("{}: {error}", path.display()))?;
        let now = Stamp::replayed(Timestamp::ZERO);
        let database = Database::open(&path.join(DATABASE), &now, 0).map_err(|error| format!("{shown}: {error}"))?;
        database.set_vehicle(vehicle).map_err(|error| format!("{shown}: {error}"))?;
        Ok(Self {
            database,
            state_files: StateFiles::open(path).0,
            folder,
            history_filter: HistoryFilter::default(),
            limits: config.into(),
            schedule: CheckpointSchedule::new(config.checkpoint_s),
        })
    }

    /// Writes the rows of the events of one input. If there are no rows to write now and a checkpoint is due, writes
    /// the checkpoint.
    pub fn record(&mut self, events: &[Event], monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let is_due = self.schedule.is_due(now, 0.0);
        match self.history_filter.take(events) {
            Some(commit) => self.write(commit, monitor, now),
            None if is_due => {
                let commit = self.history_filter.checkpoint(now);
                self.write(commit, monitor, now)
            }
            None => Ok(()),
        }
    }

    /// Writes the last state.
    pub fn finish(mut self, monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let commit = self.history_filter.finish();
        self.write(commit, monitor, now)
    }

    fn write(&mut self, commit: HistoryCommit, monitor: &Monitor, now: Timestamp) -> Result<(), String> {
        let HistoryCommit { rows, with_state } = commit;
        let row_count = rows.len();
        let stamp = Stamp::replayed(now);
        let written = match rows.is_empty() {
            true => self.database.apply(&self.limits, &stamp),
            false => self.database.commit(&[RowBatch { stamp, rows }]),
        };
        written.map_err(|error| format!("{}: {error}", self.folder))?;
        let state = with_state.then(|| StateDocument {
            format: FORMAT,
            number: 0,
            folder: self.folder.to_string(),
            pack: self.database.pack(),
            history_rows: self.database.rows(),
            stamp,
            snapshot: Box::new(monitor.snapshot().for_restart()),
        });
        let bytes = state.map(|state| self.state_files.write(state)).transpose()?;
        self.schedule.note_written(now, row_count, bytes);
        Ok(())
    }
}
