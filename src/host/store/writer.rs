//! The thread that writes the database, and what it shares with the loop.
//!
//! The loop queues rows and the latest state, and continues. The thread takes everything queued, commits it in one
//! transaction and reports up to which ticket everything is on the disk. It retries a failing disk with a growing pause;
//! until then every ticket is answered at once, as failed.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::backlog::Backlog;
use super::database::{Database, is_damage};
use super::document::StateDocument;
use super::folder::{Folder, OpenedDatabase};
use super::reserve::Reserve;
use super::rows::{HistoryRow, RowBatch};
use super::stamp::{BootId, Stamp};
use super::state_slots::StateRecord;
use crate::config::VehicleIdentity;
use crate::quantity::Timestamp;

/// First pause after a failure; it doubles up to the last.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Nanoseconds in a day.
const NS_PER_DAY: i64 = 86_400_000_000_000;
/// Longest pause: a working disk is found within this.
const LAST_PAUSE: Duration = Duration::from_secs(15);

/// Progress of the writer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StoreProgress {
    /// Everything up to this ticket was written or has failed.
    pub ticket: u64,
    /// The last attempt succeeded.
    pub works: bool,
    /// The disk has room: the reserve is there.
    pub has_room: bool,
    /// Size of the database and its log after the last success, bytes; `None` = none so far.
    pub file_bytes: Option<u64>,
    /// Commits done.
    pub commits: u64,
    /// Attempts that failed.
    pub failures: u64,
}

/// Rows and state on their way from the loop to the writer.
#[derive(Debug, Default)]
pub(super) struct WriteQueue {
    queue: Mutex<QueueState>,
    wake: Condvar,
}

#[derive(Debug, Default)]
struct QueueState {
    backlog: Backlog,
    state: Option<StateDocument>,
    exact: bool,
    /// The next state must not overwrite the stored one.
    sets_aside: bool,
    ticket: u64,
    /// The writer has work.
    wanted: bool,
    stop: bool,
}

/// What the writer takes from the queue at once.
struct PendingWrite {
    batches: Vec<RowBatch>,
    state: Option<StateDocument>,
    exact: bool,
    sets_aside: bool,
    ticket: u64,
    stop: bool,
}

impl WriteQueue {
    fn lock(&self) -> MutexGuard<'_, QueueState> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues rows and their state; returns the ticket of the commit that will contain both.
    pub(super) fn submit(&self, rows: Option<RowBatch>, state: StateDocument, exact: bool) -> u64 {
        let mut queue = self.lock();
        rows.into_iter().for_each(|batch| queue.backlog.push(batch));
        // A later state contains the earlier ones.
        queue.state = Some(state);
        queue.exact |= exact;
        queue.ticket += 1;
        queue.wanted = true;
        self.wake.notify_one();
        queue.ticket
    }

    /// Keeps rows for the next commit.
    pub(super) fn keep(&self, rows: RowBatch) {
        self.lock().backlog.push(rows);
    }

    /// The stored state was not restored: the next one does not overwrite it.
    pub(super) fn set_aside(&self) {
        self.lock().sets_aside = true;
    }

    /// Ends the writer after the work queued so far.
    pub(super) fn stop(&self) {
        let mut queue = self.lock();
        (queue.stop, queue.wanted) = (true, true);
        self.wake.notify_one();
    }

    /// Rows dropped for lack of room whose loss is not yet reported in the history.
    pub(super) fn lost_rows(&self) -> u64 {
        self.lock().backlog.lost()
    }

    /// Waits for work, or until the time of the next retry.
    fn take(&self, retry_at: Option<Instant>) -> PendingWrite {
        let mut queue = self.lock();
        while !queue.wanted {
            match retry_at.map(|at| at.saturating_duration_since(Instant::now())) {
                Some(Duration::ZERO) => break,
                Some(pause) => queue = self.wake.wait_timeout(queue, pause).unwrap_or_else(PoisonError::into_inner).0,
                None => queue = self.wake.wait(queue).unwrap_or_else(PoisonError::into_inner),
            }
        }
        queue.wanted = false;
        let state = queue.state.take();
        // Rows are written with their state.
        let batches = state.as_ref().map(|state| queue.backlog.take(&state.stamp)).unwrap_or_default();
        let (exact, sets_aside) = (std::mem::take(&mut queue.exact), std::mem::take(&mut queue.sets_aside));
        PendingWrite { batches, state, exact, sets_aside, ticket: queue.ticket, stop: queue.stop }
    }

    fn put_back(&self, batches: Vec<RowBatch>, state: Option<StateDocument>) {
        let mut queue = self.lock();
        queue.backlog.put_back(batches);
        queue.state = queue.state.take().or(state);
    }
}

/// The thread's side.
#[derive(Debug)]
pub(super) struct Writer {
    pub(super) write_queue: Arc<WriteQueue>,
    /// Which vehicle the history is of.
    pub(super) vehicle: VehicleIdentity,
    /// Half-cycles older than this are deleted, years.
    pub(super) keep_years: Option<f64>,
    /// The open database has the vehicle.
    pub(super) is_vehicle_noted: bool,
    pub(super) folder: Folder,
    /// Space for a full disk.
    pub(super) reserve: Reserve,
    /// The day, UTC since 1970, for which the chain's end is in the log.
    pub(super) head_day: Option<i64>,
    /// `None` = not open.
    pub(super) database: Option<Database>,
    pub(super) progress: watch::Sender<StoreProgress>,
    pub(super) retry: Retry,
    /// Commits done.
    pub(super) commits: u64,
    /// Attempts that failed.
    pub(super) failures: u64,
    /// The daemon started with the state of the database, or the database had none.
    pub(super) knows_state: bool,
    /// The next state must not overwrite the stored one.
    pub(super) sets_aside: bool,
}

/// The time of the next attempt after a failure.
#[derive(Debug, Default)]
pub(super) struct Retry {
    pause: Option<Duration>,
    at: Option<Instant>,
}

impl Retry {
    /// Notes a failure now.
    pub(super) fn after_failure(&mut self) {
        let pause = self.pause.map_or(FIRST_PAUSE, |pause| (2 * pause).min(LAST_PAUSE));
        (self.pause, self.at) = (Some(pause), Some(Instant::now() + pause));
    }

    fn is_due(&self) -> bool {
        self.at.is_none_or(|at| Instant::now() >= at)
    }
}

impl Writer {
    /// Writes until [`WriteQueue::stop`].
    pub(super) fn run(mut self) {
        self.reserve.make();
        loop {
            let work = self.write_queue.take(self.retry.at);
            let PendingWrite { batches, state, exact, sets_aside, ticket, stop } = work;
            self.sets_aside |= sets_aside;
            // The last attempt before the end does not wait for the pause, nor does one that the reserve may help.
            let is_urgent = stop || (!batches.is_empty() && self.reserve.is_usable());
            let works = if self.retry.is_due() || is_urgent {
                self.write(batches, state, exact)
            } else {
                self.write_queue.put_back(batches, state);
                false
            };
            let before = self.progress.borrow().file_bytes;
            let file_bytes = if works { self.folder.file_bytes() } else { before };
            let has_room = self.reserve.is_whole();
            let (commits, failures) = (self.commits, self.failures);
            let progress = StoreProgress { ticket, works, has_room, file_bytes, commits, failures };
            self.progress.send_if_modified(|last| std::mem::replace(last, progress) != progress);
            if stop {
                return;
            }
        }
    }

    /// Writes one transaction; on failure everything waits for the next. Without a state there is nothing to write, but a
    /// database that could not be opened is opened again.
    fn write(&mut self, batches: Vec<RowBatch>, state: Option<StateDocument>, exact: bool) -> bool {
        let begun = Instant::now();
        let written = match &state {
            Some(document) => self.commit(&batches, document, exact).or_else(|error| {
                if batches.is_empty() {
                    return Err(error);
                }
                // What is learned is tried again at once: with the reserve's space, or because space has come back.
                self.reserve.release_if_full();
                self.commit(&batches, document, exact)
            }),
            None if self.retry.pause.is_none() => return true,
            None => self.reopen(&Stamp::now(Timestamp::ZERO, BootId::current())).map(|database| {
                self.database = Some(database);
            }),
        };
        match written {
            Ok(()) => {
                tracing::debug!(took = ?begun.elapsed(), batches = batches.len(), "state stored");
                if self.retry.pause.is_some() {
                    tracing::info!(folder = %self.folder, "state and history are written again");
                }
                self.retry = Retry::default();
                self.commits += u64::from(state.is_some());
                self.write_queue.lock().backlog.commit();
                self.reserve.restore();
                true
            }
            Err(why) => {
                if self.retry.pause.is_none() {
                    tracing::error!(folder = %self.folder, error = why, "state and history not written; kept in memory");
                }
                self.failures += 1;
                self.retry.after_failure();
                self.write_queue.put_back(batches, state);
                false
            }
        }
    }

    pub(super) fn commit(&mut self, batches: &[RowBatch], document: &StateDocument, exact: bool) -> Result<(), String> {
        let record = StateRecord::new(document, exact, self.sets_aside)?;
        let mut database = match self.database.take() {
            Some(database) => database,
            None => self.reopen(&document.stamp)?,
        };
        if !self.is_vehicle_noted {
            database.set_vehicle(&self.vehicle).map_err(|error| error.to_string())?;
            self.is_vehicle_noted = true;
        }
        if batches.is_empty() {
            database.set_horizon_ns(self.keep_years.and_then(|years| document.stamp.years_ago_ns(years)));
        }
        // Opening it may have found a state to set aside.
        let record = StateRecord { sets_aside: self.sets_aside, ..record };
        match database.commit(batches, Some(record)) {
            Ok(()) => {
                self.sets_aside = false;
                self.log_head(&database, &document.stamp);
                self.database = Some(database);
                Ok(())
            }
            Err(error) if is_damage(&error) => {
                drop(database);
                // The next attempt replaces it.
                self.folder.mark_damaged(&error.to_string());
                Err(format!("database damaged: {error}"))
            }
            // A connection that failed is opened again: its file may have been deleted.
            Err(error) => Err(error.to_string()),
        }
    }

    /// Logs the chain's end with each day's first commit: a chain that was written again does not fit it.
    fn log_head(&mut self, database: &Database, now: &Stamp) {
        let day = now.wall_ns.div_euclid(NS_PER_DAY);
        if self.head_day.replace(day) != Some(day) {
            let (rows, hash) = database.head();
            tracing::info!(
                rows,
                hash,
                "end of the history's chain; to be compared: packwatch history verify --noted ROWS:HASH"
            );
        }
    }

    fn reopen(&mut self, now: &Stamp) -> Result<Database, String> {
        self.is_vehicle_noted = false;
        let opening = self.folder.open(now).map_err(|error| error.to_string())?;
        let OpenedDatabase { mut database, mut rows, state, is_unreadable, .. } = opening;
        self.sets_aside |= is_unreadable;
        if !self.knows_state && state.is_some() {
            // The daemon started without it because the disk came too late. It is kept for the user.
            self.sets_aside = true;
            tracing::error!(folder = %self.folder, "a stored state was found after the start: set aside, not used");
            rows.push(HistoryRow::Own { reason: "state_too_late", detail: "set aside".to_owned() });
        }
        self.knows_state = true;
        if !rows.is_empty() {
            let batch = RowBatch { stamp: *now, rows };
            database.commit(&[batch], None).map_err(|error| error.to_string())?;
        }
        Ok(database)
    }
}
