//! The service loop: passes received frames, ticks, commands and configurations to the core, in order.

use std::path::Path;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet, spawn_blocking};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::engine::Engine;
use super::pending_answers::PendingAnswers;
use super::reload::{Reload, ReloadStep, log_outcome};
use super::status_publisher::StatusPublisher;
use super::{INBOX, ServiceError, notify};
use crate::cell::own_model::task::{FitFindings, FitTask};
use crate::control::protocol::{Answer, CommandOutcome, Request};
use crate::control::{PendingRequest, answer};
use crate::io::clock::{MappedClock, Reading, StepDetector};
use crate::io::snapshot_file;
use crate::io::stop::Stop;
use crate::logging;
use crate::monitor::{Command, MERGE_TOLERANCE_NS, Record, TICK_PERIOD_MS};
use crate::quantity::Timestamp;
use crate::store::StoreProgress;

/// Maximum number of records handled between two checks of the timer. A full bus delivers fewer records during one
/// tick.
const BATCH: usize = 256;
/// If the loop has not run for longer than this time, its process was stopped (by SIGSTOP or a debugger), or the
/// computer was overloaded. The sockets then hold frames of a long time, which must be sorted by time before the core
/// receives them. Below this limit, sorting is unnecessary: the core accepts frames that are late by up to
/// [`MERGE_TOLERANCE_NS`].
const MAX_PAUSE_NS: i64 = MERGE_TOLERANCE_NS;
/// Pause between two attempts to collect the frames that arrived during a stop.
const MERGE_ROUND: Duration = Duration::from_millis(10);
/// Maximum number of these attempts. Collecting ends earlier if an attempt finds no frame from the time of the stop.
const MERGE_ROUNDS: usize = 100;
/// Maximum number of records that are merged after a stop. All sockets together hold fewer.
const MAX_MERGED: usize = 1 << 20;
/// Time for the interfaces to send queued frames when the daemon stops.
const DRAIN_LIMIT: Duration = Duration::from_millis(500);

#[derive(Debug)]
pub(super) struct ServiceLoop {
    pub(super) engine: Engine,
    pub(super) inbox: mpsc::Receiver<Record>,
    pub(super) requests: mpsc::Receiver<PendingRequest>,
    pub(super) pending_answers: PendingAnswers,
    pub(super) reload: Reload,
    pub(super) clock: MappedClock,
    pub(super) clock_steps: StepDetector,
    pub(super) batch: Vec<Record>,
    /// When the loop last ran.
    pub(super) ticked: Timestamp,
    pub(super) left_out_reported: Instant,
    pub(super) status_publisher: StatusPublisher,
    /// The running fit of the cell model, on another thread.
    pub(super) model_fit: Option<JoinHandle<(FitTask, FitFindings)>>,
}

impl ServiceLoop {
    /// Runs until `stop`.
    pub(super) async fn run(&mut self, mut stop: Stop) {
        let mut ticks = interval(Duration::from_millis(u64::from(TICK_PERIOD_MS)));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut stored = self.engine.store_progress();
        let watchdog = sd_notify::watchdog_enabled().map(|period| period / 2);
        let (mut fed, mut flushed) = (Instant::now(), Instant::now());
        loop {
            // The branches have this order, so that a busy bus delays neither the stop nor the ticks.
            tokio::select! {
                biased;
                () = stop.wait() => return,
                now = ticks.tick() => {
                    self.status_publisher.note_tick(now);
                    self.pending_answers.note_time(now);
                    let time = self.tick().await;
                    self.begin_model_fit();
                    self.notify_manager(now);
                    self.status_publisher.publish(&self.engine, now, time);
                    if watchdog.is_some_and(|period| now.duration_since(fed) >= period) {
                        notify(&[NotifyState::Watchdog]);
                        fed = now;
                    }
                    // The output files are flushed every second, so that a crash of the daemon loses at most their last
                    // second.
                    if now.duration_since(flushed) >= Duration::from_secs(1) {
                        self.engine.flush();
                        self.log_clock_step();
                        flushed = now;
                    }
                }
                progress = next_progress(&mut stored) => {
                    self.pending_answers.note_progress(&progress);
                    self.engine.handle_store_progress(progress, self.clock.now());
                }
                Some((task, findings)) = next_model_fit(&mut self.model_fit) => {
                    self.engine.monitor.give_model_fit(task, findings);
                }
                // Each connection has at most one waiting request.
                Some(request) = self.requests.recv() => self.answer(request).await,
                // At most one configuration a second is read.
                step = self.reload.next() => self.handle_reload(step).await,
                received = self.inbox.recv_many(&mut self.batch, BATCH) => {
                    if received > 0 {
                        self.merge_after_stop().await;
                        self.handle_batch();
                    }
                }
            }
        }
    }

    fn log_clock_step(&mut self) {
        if let Some(seconds) = self.clock_steps.step_s(Reading::now()) {
            tracing::warn!(
                seconds,
                "wall clock stepped: times of estimates and events keep the old clock until a restart"
            );
        }
    }

    /// If the core requests a fit, runs it on another thread, because frames and ticks cannot wait that long.
    fn begin_model_fit(&mut self) {
        if self.model_fit.is_none()
            && let Some(task) = self.engine.monitor.take_model_fit()
        {
            self.model_fit = Some(spawn_blocking(move || {
                let findings = task.run();
                (task, findings)
            }));
        }
    }

    /// Notifies the service manager when the service is ready and when the status line changes. Once a minute, also
    /// logs the number of dropped log lines.
    fn notify_manager(&mut self, now: Instant) {
        if now.duration_since(self.left_out_reported) >= Duration::from_secs(60) {
            self.left_out_reported = now;
            let lines = logging::take_left_out();
            if lines > 0 {
                tracing::warn!(left_out = lines, "log lines dropped");
            }
        }
        let Engine { readiness, monitor, .. } = &mut self.engine;
        let update = readiness.poll(monitor, now);
        let ready = update.ready.then_some(NotifyState::Ready);
        let status = update.status.as_deref().map(NotifyState::Status);
        if ready.is_some() || status.is_some() {
            let prefix = if update.ready { "ready; " } else { "" };
            tracing::info!("{prefix}{}", update.status.as_deref().unwrap_or("as before"));
            notify(&ready.into_iter().chain(status).collect::<Vec<_>>());
        }
    }

    /// Handles the input that was received before the tick, then the tick. Returns the time of the tick.
    async fn tick(&mut self) -> Timestamp {
        self.drain().await;
        let time = self.clock.now();
        self.ticked = time;
        self.engine.poll_store(time);
        self.engine.handle(&Record::tick(time));
        time
    }

    /// Answers a request of the control socket. If a command changes stored data, its answer waits until the data are
    /// on disk.
    async fn answer(&mut self, PendingRequest { request, answer: client }: PendingRequest) {
        let alarms = self.engine.monitor.alarms();
        let answer = match request {
            Request::Alarms { all } => answer::list(alarms, self.clock.now(), all),
            Request::Command(command) => match answer::meaningless(alarms, &command) {
                Some(error) => error,
                None => match self.apply_command(command).await {
                    (Err(error), _) => error,
                    (Ok(outcome), None) => Answer::Outcome(outcome),
                    (Ok(outcome), Some(ticket)) => {
                        return self.pending_answers.hold(ticket, outcome, client, Instant::now());
                    }
                },
            },
        };
        // The client may have closed the connection.
        let _ = client.send(answer);
    }

    /// Handles the input that was received before the command, then passes the command to the core. Returns the outcome
    /// and the ticket (number) of the commit.
    async fn apply_command(&mut self, command: Command) -> (Result<CommandOutcome, Answer>, Option<u64>) {
        self.drain().await;
        let time = self.clock.now();
        let ticket = self.engine.handle(&Record::command(time, command));
        let Engine { monitor, outputs, .. } = &self.engine;
        (answer::outcome(monitor.alarms(), &command, &outputs.events, time), ticket)
    }

    /// If the process was stopped, collects everything that has arrived on all interfaces since then. The core then
    /// receives these frames in order of time and before the present tick, so that the core's time does not go
    /// backwards.
    async fn merge_after_stop(&mut self) {
        if self.clock.now().nanos() - self.ticked.nanos() <= MAX_PAUSE_NS {
            return;
        }
        let resumed = self.clock.now();
        self.ticked = resumed;
        for _ in 0..MERGE_ROUNDS {
            // During this pause, each interface task reads its socket.
            tokio::time::sleep(MERGE_ROUND).await;
            let before = self.batch.len();
            while self.batch.len() < MAX_MERGED
                && let Ok(received) = self.inbox.try_recv()
            {
                self.batch.push(received);
            }
            if self.batch[before..].iter().all(|record| record.time >= resumed) {
                return;
            }
        }
    }

    async fn drain(&mut self) {
        for _ in 0..INBOX / BATCH {
            // Lets the interface tasks read from and write to their sockets.
            tokio::task::yield_now().await;
            self.merge_after_stop().await;
            while self.batch.len() < BATCH
                && let Ok(received) = self.inbox.try_recv()
            {
                self.batch.push(received);
            }
            if self.batch.is_empty() {
                break;
            }
            self.handle_batch();
        }
    }

    /// Handles a batch in order of time; records of one interface keep their order.
    fn handle_batch(&mut self) {
        self.batch.sort_by_key(|record| record.time);
        for received in &self.batch {
            self.engine.handle(received);
        }
        // The latency is counted after the last record, when all frames of the batch have been handled.
        self.status_publisher.note_frames(&self.batch, self.clock.now());
        self.batch.clear();
    }

    async fn handle_reload(&mut self, step: ReloadStep) {
        let read = match step {
            ReloadStep::Requested => return self.notify_reloading(),
            ReloadStep::Read(read) => read,
        };
        // Input received before this point belongs to the old configuration.
        self.drain().await;
        let time = self.clock.now();
        let mut file = None;
        let taken = read.and_then(|config| {
            file = config.file;
            self.engine.reconfigure(config.monitor, time)
        });
        log_outcome(&taken);
        self.status_publisher.note_reload(if taken.is_ok() { Ok(file) } else { Err(()) });
        let Engine { readiness, monitor, .. } = &mut self.engine;
        readiness.note_reload(taken.err().map(|faults| faults.join("; ")));
        let line = readiness.line_now(monitor, Instant::now());
        // If a further reload waits, only the end of the last reload is reported.
        let ready = (readiness.is_ready() && !self.reload.is_busy()).then_some(NotifyState::Ready);
        let status = line.as_deref().map(NotifyState::Status);
        notify(&ready.into_iter().chain(status).collect::<Vec<_>>());
    }

    fn notify_reloading(&self) {
        // Before the service is ready, the manager would mistake the end of a reload for readiness.
        if !self.engine.readiness.is_ready() {
            return;
        }
        let mut states = vec![NotifyState::Reloading];
        // systemd 253 and later requires the time.
        states.extend(NotifyState::monotonic_usec_now());
        notify(&states);
    }

    /// Sends queued frames, closes the files and stores the state.
    pub(super) async fn finish(mut self, mut links: JoinSet<()>, snapshot: Option<&Path>) -> Result<(), ServiceError> {
        self.engine.release_all();
        self.engine.links.clear();
        self.inbox.close();
        let drained = async { while links.join_next().await.is_some() {} };
        if timeout(DRAIN_LIMIT, drained).await.is_err() {
            tracing::warn!("some queued frames were not sent before the stop");
        }
        // The state is stored before the files are closed, because closing a file may block if its disk does not
        // respond.
        self.engine.close_store(self.clock.now());
        let stored = snapshot.map_or(Ok(()), |path| {
            snapshot_file::write(path, &self.engine.monitor.snapshot())
                .map_err(|error| ServiceError::File { path: path.to_owned(), error })
        });
        self.engine.close_files();
        tracing::info!("stopped");
        stored
    }
}

/// Waits for the next progress of the store. If the store's thread has ended before the loop, reports a failure once.
async fn next_progress(stored: &mut Option<watch::Receiver<StoreProgress>>) -> StoreProgress {
    let Some(receiver) = stored else { return std::future::pending().await };
    if receiver.changed().await.is_ok() {
        return *receiver.borrow_and_update();
    }
    let last = *receiver.borrow();
    *stored = None;
    tracing::error!("the store's thread has ended: state and history are no longer written");
    StoreProgress { works: false, failures: last.failures + 1, ..last }
}

/// Waits for a fit. Returns `None` if the fit failed; the core then runs the fit itself.
async fn next_model_fit(fit: &mut Option<JoinHandle<(FitTask, FitFindings)>>) -> Option<(FitTask, FitFindings)> {
    let Some(running) = fit else { return std::future::pending().await };
    let found = running.await.ok();
    *fit = None;
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn ended_store_thread_is_reported_once() {
        let last = StoreProgress { ticket: 7, works: true, ..StoreProgress::default() };
        let (sender, progress) = watch::channel(last);
        drop(sender);
        let mut stored = Some(progress);
        assert_eq!(next_progress(&mut stored).await, StoreProgress { works: false, failures: 1, ..last });
        assert!(
            timeout(Duration::from_millis(20), next_progress(&mut stored)).await.is_err(),
            "the failure is reported only once"
        );
    }
}
