//! The thread that writes the database, and what it shares with the loop.
//!
//! The loop leaves rows and the latest state and goes on. The thread takes all there is, commits it in one transaction
//! and says up to which ticket everything is on the disk. A disk that fails is tried again with a growing pause; until
//! then every ticket is answered at once, as failed.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::backlog::Backlog;
use super::database::{Database, StateRecord, is_damage};
use super::document::Document;
use super::folder::{Folder, Opening};
use super::parts::Parts;
use super::rows::{Batch, Row};
use super::stamp::{BootId, Stamp};
use crate::quantity::Timestamp;

/// First pause after a failure; it doubles up to the last.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// A disk that is back is found within this.
const LAST_PAUSE: Duration = Duration::from_secs(15);

/// How far the writer is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Progress {
    /// Everything up to this ticket was written, or cannot be now.
    pub ticket: u64,
    /// The last attempt succeeded.
    pub works: bool,
    /// Size of the database and its log after the last success, bytes; `None` = none so far.
    pub file_bytes: Option<u64>,
    /// Commits done.
    pub commits: u64,
    /// Attempts that failed.
    pub failures: u64,
}

/// What the loop leaves for the writer.
#[derive(Debug, Default)]
pub(super) struct WriteQueue {
    queue: Mutex<Queue>,
    wake: Condvar,
}

#[derive(Debug, Default)]
struct Queue {
    backlog: Backlog,
    state: Option<Document>,
    exact: bool,
    /// The stored state is to be kept beside the next one.
    sets_aside: bool,
    ticket: u64,
    /// Something is to be done now.
    wanted: bool,
    stop: bool,
}

/// What the writer takes from the desk.
struct Work {
    batches: Vec<Batch>,
    state: Option<Document>,
    exact: bool,
    sets_aside: bool,
    ticket: u64,
    stop: bool,
}

impl WriteQueue {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves rows and the state they were learned in; returns the ticket of the commit that will hold both.
    pub(super) fn leave(&self, rows: Option<Batch>, state: Document, exact: bool) -> u64 {
        let mut queue = self.lock();
        rows.into_iter().for_each(|batch| queue.backlog.push(batch));
        // A later state has all an earlier one has.
        queue.state = Some(state);
        queue.exact |= exact;
        queue.ticket += 1;
        queue.wanted = true;
        self.wake.notify_one();
        queue.ticket
    }

    /// Keeps rows for the next commit.
    pub(super) fn keep(&self, rows: Batch) {
        self.lock().backlog.push(rows);
    }

    /// Nobody has taken up the stored state: the next one does not overwrite it.
    pub(super) fn set_aside(&self) {
        self.lock().sets_aside = true;
    }

    /// The last thing the writer will be asked.
    pub(super) fn stop(&self) {
        let mut queue = self.lock();
        (queue.stop, queue.wanted) = (true, true);
        self.wake.notify_one();
    }

    /// Rows lost for want of room and not yet told in the history.
    pub(super) fn lost_rows(&self) -> u64 {
        self.lock().backlog.lost()
    }

    /// Waits until something is to be done, or it is time to try again.
    fn take(&self, retry_at: Option<Instant>) -> Work {
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
        // Rows go with the state they were learned in.
        let batches = state.as_ref().map(|state| queue.backlog.take(&state.stamp)).unwrap_or_default();
        let (exact, sets_aside) = (std::mem::take(&mut queue.exact), std::mem::take(&mut queue.sets_aside));
        Work { batches, state, exact, sets_aside, ticket: queue.ticket, stop: queue.stop }
    }

    fn put_back(&self, batches: Vec<Batch>, state: Option<Document>) {
        let mut queue = self.lock();
        queue.backlog.put_back(batches);
        queue.state = queue.state.take().or(state);
    }
}

/// The thread's side.
#[derive(Debug)]
pub(super) struct Writer {
    pub(super) desk: Arc<WriteQueue>,
    pub(super) folder: Folder,
    /// `None` = not reachable so far.
    pub(super) database: Option<Database>,
    pub(super) progress: watch::Sender<Progress>,
    pub(super) retry: Retry,
    /// Commits done.
    pub(super) commits: u64,
    /// Attempts that failed.
    pub(super) failures: u64,
    /// The daemon began with what the database had, or it had nothing.
    pub(super) knows_state: bool,
    /// The stored state is kept beside the next one.
    pub(super) sets_aside: bool,
}

/// When a failed disk is tried again.
#[derive(Debug, Default)]
pub(super) struct Retry {
    pause: Option<Duration>,
    at: Option<Instant>,
}

impl Retry {
    /// After a failure now.
    pub(super) fn after_failure(&mut self) {
        let pause = self.pause.map_or(FIRST_PAUSE, |pause| (2 * pause).min(LAST_PAUSE));
        (self.pause, self.at) = (Some(pause), Some(Instant::now() + pause));
    }

    fn is_due(&self) -> bool {
        self.at.is_none_or(|at| Instant::now() >= at)
    }
}

impl Writer {
    /// Writes until told to stop.
    pub(super) fn run(mut self) {
        loop {
            let work = self.desk.take(self.retry.at);
            let Work { batches, state, exact, sets_aside, ticket, stop } = work;
            self.sets_aside |= sets_aside;
            // The last attempt before the end is made whenever it is.
            let works = if self.retry.is_due() || stop {
                self.write(batches, state, exact)
            } else {
                self.desk.put_back(batches, state);
                false
            };
            let before = self.progress.borrow().file_bytes;
            let file_bytes = if works { self.folder.file_bytes() } else { before };
            let progress = Progress { ticket, works, file_bytes, commits: self.commits, failures: self.failures };
            self.progress.send_if_modified(|told| std::mem::replace(told, progress) != progress);
            if stop {
                return;
            }
        }
    }

    /// One transaction; on failure everything waits for the next. Without a state there is nothing to write, but a
    /// database that could not be opened is tried again.
    fn write(&mut self, batches: Vec<Batch>, state: Option<Document>, exact: bool) -> bool {
        let begun = Instant::now();
        let written = match &state {
            Some(document) => self.commit(&batches, document, exact),
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
                self.desk.lock().backlog.told();
                true
            }
            Err(why) => {
                if self.retry.pause.is_none() {
                    tracing::error!(folder = %self.folder, error = why, "state and history not written; kept in memory");
                }
                self.failures += 1;
                self.retry.after_failure();
                self.desk.put_back(batches, state);
                false
            }
        }
    }

    fn commit(&mut self, batches: &[Batch], document: &Document, exact: bool) -> Result<(), String> {
        let json = document.to_json().map_err(|error| error.to_string())?;
        // A number that is not finite is written as nothing: the state could never be taken up again.
        Document::parse(&json)?;
        let parts = Parts::of(&json).ok_or("a number of the state cannot be read")?;
        drop(json);
        let mut database = match self.database.take() {
            Some(database) => database,
            None => self.reopen(&document.stamp)?,
        };
        match database.commit(batches, Some(StateRecord { parts, exact, sets_aside: self.sets_aside })) {
            Ok(()) => {
                self.sets_aside = false;
                self.database = Some(database);
                Ok(())
            }
            Err(error) if is_damage(&error) => {
                drop(database);
                // The next attempt, soon, replaces it.
                self.folder.mark_damaged(&error.to_string());
                Err(format!("database damaged: {error}"))
            }
            // A connection that failed to read or write is opened anew: it may stand on a file that is gone.
            Err(error) => Err(error.to_string()),
        }
    }

    fn reopen(&mut self, now: &Stamp) -> Result<Database, String> {
        let opening = self.folder.open(now).map_err(|error| error.to_string())?;
        let Opening { mut database, mut rows, state, is_strange, .. } = opening;
        self.sets_aside |= is_strange;
        if !self.knows_state && state.is_some() {
            // The daemon began without it, because the disk came too late: for people to find.
            self.sets_aside = true;
            tracing::error!(folder = %self.folder, "a stored state was found after the start: set aside, not used");
            rows.push(Row::Own { reason: "state_too_late", detail: "set aside".to_owned() });
        }
        self.knows_state = true;
        if !rows.is_empty() {
            let batch = Batch { stamp: *now, rows };
            database.commit(&[batch], None).map_err(|error| error.to_string())?;
        }
        Ok(database)
    }
}
