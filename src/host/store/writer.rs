//! The thread that writes to the disk, and the queue that it shares with the service loop.
//!
//! The loop queues rows and the latest state, and gets a number for them: the ticket. The thread takes all queued work,
//! commits the rows, and writes the state if it is due. Then it reports the last ticket, and whether the attempt
//! succeeded. The thread retries a failing disk after increasing pauses. During a pause, a ticket is reported at once
//! as failed, unless rows are queued and the reserve (disk space that is kept for this case) has space left. A failing
//! database does not prevent the state from being written.
//!
//! A start reapplies the alarm changes of rows that are newer than the stored state. Therefore the rows in the database
//! must directly follow the stored state. To ensure this, the first rows after a start, after a failure and in a new
//! database are written together with a state.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::backlog::Backlog;
use super::database::{Database, RowLimits, is_damage};
use super::folder::Folder;
use super::reserve::Reserve;
use super::rows::{HistoryRow, RowBatch};
use super::segments::NS_PER_DAY;
use super::stamp::{BootId, Stamp};
use super::state_files::{StateDocument, StateFiles};
use crate::config::VehicleIdentity;
use crate::quantity::Timestamp;

/// First pause after a failure. Each further pause is twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Maximum pause. If the disk works again, the writer detects it within this time.
const LAST_PAUSE: Duration = Duration::from_secs(15);

/// Progress of the writer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StoreProgress {
    /// All work up to this ticket was written or has failed.
    pub ticket: u64,
    /// Whether the last attempt succeeded.
    pub works: bool,
    /// Whether the disk has room, that is, the reserve is unused.
    pub has_room: bool,
    /// Whether another program has deleted or replaced the database while it was open. The rows in it are lost.
    pub was_replaced: bool,
    /// Size of the database and its log after the last success, bytes; `None` = no success yet.
    pub file_bytes: Option<u64>,
    /// Successful commits.
    pub commits: u64,
    /// Number of failed attempts.
    pub failures: u64,
    /// Size of the last written state, bytes.
    pub state_bytes: u64,
    /// Number of the connected pack in the history; 0 = unknown.
    pub pack: i64,
    /// Number of rows in the history.
    pub rows: i64,
}

/// Queue of the rows and the state that the loop passes to the writer.
#[derive(Debug, Default)]
pub(super) struct WriteQueue {
    queue: Mutex<QueueState>,
    wake: Condvar,
}

#[derive(Debug, Default)]
struct QueueState {
    backlog: Backlog,
    state: Option<StateDocument>,
    /// Whether the state must be written.
    is_state_due: bool,
    /// Whether the stored state must be set aside before the next state is written.
    sets_aside: bool,
    ticket: u64,
    wanted: bool,
    stop: bool,
}

struct PendingWrite {
    batches: Vec<RowBatch>,
    state: Option<StateDocument>,
    is_state_due: bool,
    sets_aside: bool,
    ticket: u64,
    stop: bool,
}

impl WriteQueue {
    fn lock(&self) -> MutexGuard<'_, QueueState> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues rows and the state after them. The state is written if `is_state_due`, or if the rows do not continue the
    /// stored state. Returns the ticket of the commit.
    pub(super) fn submit(&self, rows: Option<RowBatch>, state: StateDocument, is_state_due: bool) -> u64 {
        let mut queue = self.lock();
        rows.into_iter().for_each(|batch| queue.backlog.push(batch));
        // A later state includes the earlier ones.
        queue.state = Some(state);
        queue.is_state_due |= is_state_due;
        queue.ticket += 1;
        queue.wanted = true;
        self.wake.notify_one();
        queue.ticket
    }

    /// Keeps rows until the next commit.
    pub(super) fn keep(&self, rows: RowBatch) {
        self.lock().backlog.push(rows);
    }

    /// Requests that the stored state, which was not restored, is set aside before the next state is written.
    pub(super) fn set_aside(&self) {
        self.lock().sets_aside = true;
    }

    /// Ends the writer after it has done the work that is already queued.
    pub(super) fn stop(&self) {
        let mut queue = self.lock();
        (queue.stop, queue.wanted) = (true, true);
        self.wake.notify_one();
    }

    #[cfg(test)]
    pub(super) fn submitted(&self) -> u64 {
        self.lock().ticket
    }

    /// Number of rows that were dropped for lack of room and are not yet reported in the history.
    pub(super) fn lost_rows(&self) -> u64 {
        self.lock().backlog.lost()
    }

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
        let is_state_due = std::mem::take(&mut queue.is_state_due);
        // Rows and the state after them are taken together: the state records the number of the last row.
        let batches = state.as_ref().map(|state| queue.backlog.take(&state.stamp)).unwrap_or_default();
        let sets_aside = std::mem::take(&mut queue.sets_aside);
        PendingWrite { batches, state, is_state_due, sets_aside, ticket: queue.ticket, stop: queue.stop }
    }

    fn put_back(&self, batches: Vec<RowBatch>, state: Option<StateDocument>) {
        let mut queue = self.lock();
        queue.backlog.put_back(batches);
        queue.state = queue.state.take().or(state);
    }
}

#[derive(Debug)]
pub(super) struct Writer {
    pub(super) write_queue: Arc<WriteQueue>,
    pub(super) vehicle: VehicleIdentity,
    pub(super) limits: RowLimits,
    pub(super) folder: Folder,
    pub(super) state_files: StateFiles,
    pub(super) reserve: Reserve,
    /// Latest day (UTC, since 1970) on which the end of the hash chain was logged.
    pub(super) head_day: Option<i64>,
    /// The open database; `None` = the database is not open.
    pub(super) database: Option<Database>,
    pub(super) progress: watch::Sender<StoreProgress>,
    pub(super) retry: Retry,
    /// Whether the daemon has read the folder's states.
    pub(super) knows_state: bool,
    /// Whether the next commit must write the state.
    pub(super) needs_state: bool,
    /// Whether the database was found deleted or replaced while it was open, and the history does not say so yet.
    pub(super) was_replaced: bool,
}

#[derive(Debug, Default)]
pub(super) struct Retry {
    pause: Option<Duration>,
    at: Option<Instant>,
}

impl Retry {
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
        // If the vehicle's identity cannot be written to the database, closes the database. It is opened again later,
        // and a failure is reported then.
        self.database = self.database.take().filter(|database| database.set_vehicle(&self.vehicle).is_ok());
        loop {
            let work = self.write_queue.take(self.retry.at);
            let PendingWrite { batches, state, is_state_due, sets_aside, ticket, stop } = work;
            self.needs_state |= is_state_due;
            if sets_aside {
                self.state_files.set_aside();
            }
            // The last attempt before the end, and an attempt that may succeed with the reserve, do not wait for the
            // pause.
            let is_urgent = stop || (!batches.is_empty() && self.reserve.is_usable());
            let mut progress = *self.progress.borrow();
            progress.works = if self.retry.is_due() || is_urgent {
                self.write(batches, state, &mut progress)
            } else {
                self.write_queue.put_back(batches, state);
                false
            };
            (progress.ticket, progress.has_room) = (ticket, self.reserve.is_whole());
            progress.was_replaced |= self.progress.borrow().was_replaced;
            self.progress.send_if_modified(|last| std::mem::replace(last, progress) != progress);
            if stop {
                return;
            }
        }
    }

    /// Writes rows and state. If writing fails, rows and state wait for the next attempt. Without a state, nothing is
    /// written, but a database that was closed after a failure is opened again if possible.
    fn write(
        &mut self,
        mut batches: Vec<RowBatch>,
        state: Option<StateDocument>,
        progress: &mut StoreProgress,
    ) -> bool {
        let begun = Instant::now();
        let is_learned = !batches.is_empty();
        let written = match &state {
            Some(document) => self
                .commit_urgently(&mut batches, document)
                .map(|bytes| progress.state_bytes = bytes.unwrap_or(progress.state_bytes)),
            None if self.retry.pause.is_none() => return true,
            None => self.open(&Stamp::now(Timestamp::ZERO, BootId::current())).map(drop),
        };
        match written {
            Ok(()) => {
                tracing::debug!(took = ?begun.elapsed(), is_learned, "state stored");
                if self.retry.pause.is_some() {
                    tracing::info!(folder = %self.folder, "state and history can be written again");
                }
                self.retry = Retry::default();
                progress.commits += u64::from(state.is_some());
                progress.file_bytes = self.folder.database_bytes();
                if let Some(database) = &self.database {
                    (progress.pack, progress.rows) = (database.pack(), database.rows());
                }
                self.reserve.restore();
                true
            }
            Err(why) => {
                if self.retry.pause.is_none() {
                    tracing::error!(folder = %self.folder, error = why, "state and history not written; kept in memory");
                }
                progress.failures += 1;
                self.needs_state = true;
                self.retry.after_failure();
                self.write_queue.put_back(batches, state);
                false
            }
        }
    }

    /// Calls [`Writer::commit`]. If rows cannot be written, tries again after each step that the reserve releases.
    /// Also tries again once without a release, because space may be available again, and because a second attempt
    /// sets a damaged database aside.
    fn commit_urgently(
        &mut self,
        batches: &mut Vec<RowBatch>,
        document: &StateDocument,
    ) -> Result<Option<u64>, String> {
        let is_learned = !batches.is_empty();
        let mut is_first = true;
        loop {
            let written = self.commit(batches, document);
            let may_help = is_learned && (self.reserve.release_if_full() || std::mem::take(&mut is_first));
            if written.is_ok() || !may_help {
                return written;
            }
        }
    }

    /// Commits the rows, removes them from `batches`, and writes the state if it is due. Returns the size of the state.
    pub(super) fn commit(
        &mut self,
        batches: &mut Vec<RowBatch>,
        document: &StateDocument,
    ) -> Result<Option<u64>, String> {
        let rows = self.commit_rows(batches, &document.stamp);
        if rows.is_ok() {
            batches.clear();
            self.write_queue.lock().backlog.commit();
        } else if !self.knows_state {
            // A state that has not been read yet must not be overwritten.
            return rows.map(|()| None);
        }
        if rows.is_ok() && !self.needs_state && self.state_files.is_present() {
            return Ok(None);
        }
        let mut document = document.clone();
        if let Some(database) = &self.database {
            (document.pack, document.history_rows) = (database.pack(), database.rows());
        }
        let state = self.state_files.write(document);
        self.needs_state = rows.is_err() || state.is_err();
        rows.and(state.map(Some))
    }

    fn commit_rows(&mut self, batches: &[RowBatch], now: &Stamp) -> Result<(), String> {
        let limits = self.limits;
        self.close_if_replaced();
        let database = self.open(now)?;
        let written = if batches.is_empty() { database.apply(&limits, now) } else { database.commit(batches) };
        if let Err(error) = written {
            // After a failure the connection is opened again, because its file may have been deleted.
            self.database = None;
            if is_damage(&error) {
                self.folder.mark_damaged(&error.to_string());
            }
            return Err(error.to_string());
        }
        if self.close_if_replaced() {
            return Err("the database was deleted or replaced during the commit".to_owned());
        }
        self.log_head(now);
        Ok(())
    }

    /// Closes the database if another program has deleted or replaced its files. Afterwards, [`open`](Self::open) uses
    /// the file that now has the database's name, or creates a file.
    fn close_if_replaced(&mut self) -> bool {
        let is_replaced = self.database.as_ref().is_some_and(|database| !database.has_its_names());
        if is_replaced {
            tracing::error!(folder = %self.folder, "another program has deleted or replaced the open database");
            (self.database, self.was_replaced) = (None, true);
            self.progress.send_modify(|progress| progress.was_replaced = true);
        }
        is_replaced
    }

    /// Logs the end of the hash chain with the first commit of each day. If the chain is rewritten later, it does not
    /// match the logged end.
    fn log_head(&mut self, now: &Stamp) {
        let day = now.wall_ns.div_euclid(NS_PER_DAY);
        if let Some(database) = &self.database
            && self.head_day.replace(day) != Some(day)
        {
            let (rows, hash) = database.head();
            tracing::info!(
                rows,
                hash,
                "end of the history's chain; compare it with: packwatch history verify --noted ROWS:HASH"
            );
        }
    }

    fn open(&mut self, now: &Stamp) -> Result<&mut Database, String> {
        let database = match self.database.take() {
            Some(database) => database,
            None => self.reopen(now)?,
        };
        Ok(self.database.insert(database))
    }

    fn reopen(&mut self, now: &Stamp) -> Result<Database, String> {
        let pack = self.progress.borrow().pack;
        self.needs_state = true;
        let (mut database, mut rows) = self.folder.open(now, pack).map_err(|error| error.to_string())?;
        if self.was_replaced {
            let detail = "another program deleted or replaced the open database".to_owned();
            rows.push(HistoryRow::Own { reason: "replaced", detail });
        }
        if !self.knows_state {
            let (files, found) = StateFiles::open(self.folder.path());
            self.state_files = files;
            rows.extend(found.faults);
            if found.newest.is_some() {
                // The disk became available after the daemon had started without this state. Keep the state for the
                // user.
                self.state_files.set_aside();
                tracing::error!(folder = %self.folder, "stored state found after the start: set aside, not used");
                rows.push(HistoryRow::Own { reason: "state_too_late", detail: "set aside".to_owned() });
            }
        }
        database
            .set_vehicle(&self.vehicle)
            .and_then(|()| database.commit(&[RowBatch { stamp: *now, rows }]))
            .map_err(|error| error.to_string())?;
        (self.knows_state, self.was_replaced) = (true, false);
        Ok(database)
    }
}
