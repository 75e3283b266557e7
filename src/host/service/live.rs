//! The running loop: what the interfaces receive, the ticks, and what people ask, handed to the core in their order.

use std::path::Path;
use std::time::Duration;

use sd_notify::NotifyState;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use super::engine::Engine;
use super::reload::Reload;
use super::status_publisher::StatusPublisher;
use super::stop::Stop;
use super::{INBOX, ServiceError, notify};

use crate::control::protocol::{Answer, Request};
use crate::control::{Asked, answer};
use crate::io::clock::MappedClock;
use crate::io::snapshot_file;
use crate::io::socket::{LinkEvent, LinkMessage, LinkOutput};
use crate::logging;
use crate::monitor::{Command, Input, TICK_PERIOD_MS};
use crate::quantity::Timestamp;
use crate::store::Progress;

/// Of these, handed over between two looks at the timer: under one tick's time of a full bus.
const BATCH: usize = 256;
/// Time the interfaces have to send what is queued when the daemon stops.
const DRAIN_LIMIT: Duration = Duration::from_millis(500);
/// How often it is told how many lines were left out of the log.
const LEFT_OUT_PERIOD: Duration = Duration::from_secs(60);
/// How often files are handed to the operating system: what a crash of the daemon can lose.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

/// The running loop.
#[derive(Debug)]
pub(super) struct Loop {
    pub(super) engine: Engine,
    pub(super) inbox: mpsc::Receiver<LinkMessage>,
    pub(super) requests: mpsc::Receiver<Asked>,
    pub(super) reload: Reload,
    pub(super) clock: MappedClock,
    pub(super) outputs: Vec<LinkOutput>,
    pub(super) batch: Vec<LinkMessage>,
    pub(super) left_out_told: Instant,
    pub(super) status_publisher: StatusPublisher,
}

impl Loop {
    pub(super) async fn run(&mut self, mut stop: Stop) {
        let mut ticks = interval(Duration::from_millis(u64::from(TICK_PERIOD_MS)));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut stored = self.engine.store_progress();
        let watchdog = sd_notify::watchdog_enabled().map(|period| period / 2);
        let (mut fed, mut flushed) = (Instant::now(), Instant::now());
        loop {
            // In this order: a bus that never falls silent must hold up neither the stop nor the ticks.
            tokio::select! {
                biased;
                () = stop.wait() => return,
                now = ticks.tick() => {
                    self.status_publisher.note_tick(now);
                    let time = self.tick().await;
                    self.tell_manager(now);
                    self.status_publisher.tell(&self.engine, &self.outputs, now, time);
                    if watchdog.is_some_and(|period| now.duration_since(fed) >= period) {
                        notify(&[NotifyState::Watchdog]);
                        fed = now;
                    }
                    if now.duration_since(flushed) >= FLUSH_PERIOD {
                        self.engine.flush();
                        flushed = now;
                    }
                }
                progress = next_progress(&mut stored) => {
                    self.engine.settle(progress, self.clock.now(), &self.outputs);
                }
                // Each is taken between two ticks, and there are never more than connections.
                Some(asked) = self.requests.recv() => self.answer(asked).await,
                // At most one a second is read.
                step = self.reload.next() => self.handle_reload(step).await,
                received = self.inbox.recv_many(&mut self.batch, BATCH) => {
                    if received > 0 { self.handle_batch() }
                }
            }
        }
    }

    /// Says when the service is ready, and how it is when that has changed.
    fn tell_manager(&mut self, now: Instant) {
        if now.duration_since(self.left_out_told) >= LEFT_OUT_PERIOD {
            self.left_out_told = now;
            let lines = logging::take_left_out();
            if lines > 0 {
                tracing::warn!(left_out = lines, "lines left out of the log");
            }
        }
        let Engine { readiness, monitor, .. } = &mut self.engine;
        let told = readiness.poll(monitor, now);
        let ready = told.ready.then_some(NotifyState::Ready);
        let status = told.status.as_deref().map(NotifyState::Status);
        if ready.is_some() || status.is_some() {
            let prefix = if told.ready { "ready; " } else { "" };
            tracing::info!("{prefix}{}", told.status.as_deref().unwrap_or("as before"));
            notify(&ready.into_iter().chain(status).collect::<Vec<_>>());
        }
    }

    /// What came before the tick is handed over before it; its time.
    async fn tick(&mut self) -> Timestamp {
        self.drain().await;
        let time = self.clock.now();
        self.engine.look_after_store(time, &self.outputs);
        self.engine.handle(&Input::Tick { time }, &self.outputs);
        time
    }

    /// Somebody on this computer asks.
    async fn answer(&mut self, asked: Asked) {
        let alarms = self.engine.monitor.alarms();
        let answer = match asked.request {
            Request::Alarms { all } => answer::list(alarms, self.clock.now(), all),
            Request::Command(command) => match answer::meaningless(alarms, &command) {
                Some(error) => error,
                None => self.apply_command(command).await,
            },
        };
        // A client that has gone wants no answer.
        let _ = asked.answer.send(answer);
    }

    /// Hands a command to the core like any other input, after what came before it.
    async fn apply_command(&mut self, command: Command) -> Answer {
        self.drain().await;
        let time = self.clock.now();
        self.engine.handle(&Input::Command { time, command }, &self.outputs);
        let Engine { monitor, outputs, .. } = &self.engine;
        answer::outcome(monitor.alarms(), &command, &outputs.events, time)
    }

    /// Hands over what the interfaces have received so far.
    pub(super) async fn drain(&mut self) {
        for _ in 0..INBOX / BATCH {
            // Lets the interfaces' tasks take what is in their sockets, and send.
            tokio::task::yield_now().await;
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

    /// Interfaces merge by time; what one interface delivered keeps its order.
    fn handle_batch(&mut self) {
        self.batch.sort_by_key(|received| received.time);
        let mut has_frame = false;
        for received in &self.batch {
            let LinkMessage { time, bus, what } = *received;
            let input = match &what {
                LinkEvent::Frame(frame) => Input::Frame { time, bus, frame },
                LinkEvent::Event(event) => Input::Bus { time, bus, event: *event },
            };
            self.engine.handle(&input, &self.outputs);
            has_frame |= matches!(what, LinkEvent::Frame(_));
        }
        // What comes of any of them leaves after the last: that is when all have their estimates.
        if has_frame {
            self.status_publisher.note_frames(&self.batch, self.clock.now());
        }
        self.batch.clear();
    }

    /// Sends what is queued, closes the files, stores the state.
    pub(super) async fn finish(mut self, mut links: JoinSet<()>, snapshot: Option<&Path>) -> Result<(), ServiceError> {
        self.engine.let_go(&self.outputs);
        self.outputs.clear();
        self.inbox.close();
        let drained = async { while links.join_next().await.is_some() {} };
        if timeout(DRAIN_LIMIT, drained).await.is_err() {
            tracing::warn!("not every queued frame was sent before the stop");
        }
        // The state first: the files may hang on a disk that does not answer.
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

/// How far the store is, once that has changed; when its thread has ended before the loop, that it works no longer.
async fn next_progress(stored: &mut Option<watch::Receiver<Progress>>) -> Progress {
    let Some(receiver) = stored else { return std::future::pending().await };
    if receiver.changed().await.is_ok() {
        return *receiver.borrow_and_update();
    }
    let last = *receiver.borrow();
    *stored = None;
    tracing::error!("the store's thread has ended: state and history are not written any more");
    Progress { works: false, failures: last.failures + 1, ..last }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_store_whose_thread_is_gone_is_told_to_fail_once() {
        let last = Progress { ticket: 7, works: true, ..Progress::default() };
        let (told, progress) = watch::channel(last);
        drop(told);
        let mut stored = Some(progress);
        assert_eq!(next_progress(&mut stored).await, Progress { works: false, failures: 1, ..last });
        assert!(timeout(Duration::from_millis(20), next_progress(&mut stored)).await.is_err(), "once");
    }
}
