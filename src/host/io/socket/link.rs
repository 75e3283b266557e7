//! Serves one CAN interface during the daemon's whole life. A [`Link`] receives and sends, and continues when the
//! interface goes down, is removed or returns. It reports every change as a [`BusEvent`]. No failure of an interface
//! ends the program.
//!
//! If the interface goes down, its socket is kept and stays bound, so the first frame after the interface comes up
//! again is not lost. If the interface is removed, its socket can no longer be used, even if an interface of the same
//! name returns. A new socket is then opened. One task uses the socket for both directions, because the kernel hides
//! the daemon's own frames only from the socket that sent them.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use nix::errno::Errno;
use tokio::io::unix::AsyncFd;
use tokio::io::{Interest, Ready};
use tokio::sync::mpsc;
use tokio::time::{Instant, Interval, MissedTickBehavior, interval, sleep_until};

use super::counters::{LinkHealth, LinkState, SharedHealth};
use super::raw::{CALL_BATCH, RawRead, RawSocket, every_frame, explained, filters, index_of};
use super::wire::Wire;
use crate::can::{CanId, Frame};
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::monitor::{BusEvent, Record};
use crate::quantity::{BusIndex, Timestamp};

/// First pause before an interface that is down or missing is checked again.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// Maximum pause before such a check. A check costs a few system calls. If a missing interface returns, frames that
/// arrive before the check are lost.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);
/// Number of frames read before other tasks run. A full 1 Mbit/s bus sends this many frames in 8 ms, which is less than
/// one tick of the daemon (10 ms).
const READ_BATCH: usize = 64;
/// Maximum number of frames that wait to be sent. With default periods, the daemon sends fewer frames than this in one
/// second, even in an alarm flood (at most 100 alarm frames a second).
const SEND_QUEUE: usize = 256;

/// Settings of a link.
#[derive(Debug, Clone)]
pub struct LinkConfig {
    /// Number of the interface.
    pub bus: BusIndex,
    /// Kernel name.
    pub interface: String,
    /// Whether FD frames are accepted.
    pub fd: bool,
    /// Wanted identifiers, ascending.
    pub ids: Vec<CanId>,
    /// Further extended identifiers, as pairs of identifier and mask.
    pub patterns: Vec<(u32, u32)>,
    /// Whether every frame is wanted.
    pub all: bool,
    /// Size of the receive buffer to request, bytes.
    pub receive_buffer_bytes: usize,
}

/// The sending end of a link. When this value is dropped, the link ends after sending the queued frames.
#[derive(Debug)]
pub struct LinkOutput {
    queue: mpsc::Sender<QueuedFrame>,
    unsent: Arc<AtomicU64>,
    health: Arc<SharedHealth>,
}

#[derive(Debug)]
struct QueuedFrame {
    since: Instant,
    frame: Frame,
}

impl LinkOutput {
    /// Queues a frame. If the queue is full, the frame is dropped and counted.
    pub fn send(&self, frame: Frame) {
        if self.queue.try_send(QueuedFrame { since: Instant::now(), frame }).is_err() {
            self.unsent.fetch_add(1, Ordering::Relaxed);
            self.health.count(|counts| counts.send_queue_full += 1);
        }
    }

    /// Counters of the link.
    pub fn health(&self) -> LinkHealth {
        self.health.change(|_| ())
    }
}

#[cfg(test)]
impl LinkOutput {
    /// A sending end without a link, and a function that takes the next queued frame.
    pub(crate) fn captured() -> (Self, impl FnMut() -> Option<Frame>) {
        let (queue, mut outgoing) = mpsc::channel(SEND_QUEUE);
        let output = Self { queue, unsent: Arc::default(), health: Arc::default() };
        (output, move || outgoing.try_recv().ok().map(|queued: QueuedFrame| queued.frame))
    }
}

/// Why the link stops using a socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ServiceEnd {
    Stopped,
    /// The socket can no longer be used.
    Dead,
}

/// One interface.
#[derive(Debug)]
pub struct Link {
    config: LinkConfig,
    clock: MappedClock,
    inbox: mpsc::Sender<Record>,
    outgoing: mpsc::Receiver<QueuedFrame>,
    unsent: Arc<AtomicU64>,
    health: Arc<SharedHealth>,
    state: LinkState,
    state_since: Timestamp,
    /// Number of frames lost since the last report: dropped by the kernel, malformed, or dropped because the daemon's
    /// inbox was full.
    lost: u64,
    report: Interval,
    pause: Duration,
    last_problem: Option<String>,
}

struct OpenSocket {
    socket: AsyncFd<RawSocket>,
    mapper: StampMapper,
    /// Frames of the latest call; kept to reuse the memory.
    received: Vec<RawRead>,
    dropped_total: u32,
    /// The next frame to send, which waits for room in the kernel.
    pending: Option<QueuedFrame>,
}

/// Registers a socket with the runtime. Socket errors also wake the task, because a socket is neither readable nor
/// writable after its interface is removed.
#[expect(
    deprecated,
    reason = "its successor needs unsafe, which this crate forbids; RawSocket keeps its one descriptor open while it lives"
)]
fn watch(socket: RawSocket) -> io::Result<AsyncFd<RawSocket>> {
    AsyncFd::with_interest(socket, Interest::READABLE | Interest::WRITABLE | Interest::ERROR)
}

impl Link {
    /// Creates a link that is not yet running, and its sending end. Must be called inside the runtime.
    pub fn new(config: LinkConfig, clock: MappedClock, inbox: mpsc::Sender<Record>) -> (Self, LinkOutput) {
        let (queue, outgoing) = mpsc::channel(SEND_QUEUE);
        let unsent = Arc::new(AtomicU64::new(0));
        // Losses are reported at most every 250 ms, so that a stalled bus does not fill the journal.
        let mut report = interval(Duration::from_millis(250));
        report.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let health = Arc::<SharedHealth>::default();
        let output = LinkOutput { queue, unsent: Arc::clone(&unsent), health: Arc::clone(&health) };
        let link = Self {
            config,
            clock,
            inbox,
            outgoing,
            unsent,
            health,
            state: LinkState::Unknown,
            state_since: clock.now(),
            lost: 0,
            report,
            pause: FIRST_PAUSE,
            last_problem: None,
        };
        (link, output)
    }

    /// Runs the interface until the sending end is dropped.
    pub async fn run(mut self) {
        loop {
            let end = match self.open().await {
                Some(open) => self.serve(open).await,
                None => self.wait().await,
            };
            if end == ServiceEnd::Stopped {
                return;
            }
        }
    }

    async fn open(&mut self) -> Option<OpenSocket> {
        let LinkConfig { interface, fd, ids, patterns, all, receive_buffer_bytes, .. } = &self.config;
        let filters = if *all { every_frame() } else { filters(ids, patterns) };
        let opened = RawSocket::open(interface, *fd, &filters, *receive_buffer_bytes).and_then(|socket| {
            let error = socket.take_error()?;
            Ok((watch(socket)?, error))
        });
        let (socket, error) = match opened {
            Ok(opened) => opened,
            Err(error) => {
                self.problem(&error);
                self.enter(LinkState::Missing).await;
                return None;
            }
        };
        self.last_problem = None;
        self.note_buffer(socket.get_ref());
        let state = if error.is_none() { LinkState::Up } else { LinkState::Down };
        let mapper = StampMapper::new(self.clock, Reading::now());
        self.enter(state).await;
        let received = Vec::with_capacity(CALL_BATCH);
        Some(OpenSocket { socket, mapper, received, dropped_total: 0, pending: None })
    }

    async fn serve(&mut self, mut open: OpenSocket) -> ServiceEnd {
        let end = self.serve_open(&mut open).await;
        self.note_dropped(&mut open);
        end
    }

    async fn serve_open(&mut self, open: &mut OpenSocket) -> ServiceEnd {
        let mut look_at = Instant::now() + self.pause;
        loop {
            let interest = match open.pending {
                Some(_) => Interest::READABLE | Interest::ERROR | Interest::WRITABLE,
                None => Interest::READABLE | Interest::ERROR,
            };
            let step = tokio::select! {
                ready = open.socket.ready(interest) => match ready {
                    Ok(mut guard) => {
                        let ready = guard.ready();
                        // Clear readiness before the work. If the socket becomes ready during the work, the runtime
                        // sets readiness again.
                        guard.clear_ready_matching(if ready.is_writable() { Ready::WRITABLE } else { Ready::EMPTY });
                        guard.clear_ready_matching(Ready::READABLE | Ready::ERROR);
                        Ok(())
                    }
                    Err(error) => { self.problem(&error); return ServiceEnd::Dead; }
                },
                next = self.outgoing.recv(), if open.pending.is_none() => Err(next),
                _ = self.report.tick() => {
                    self.note_dropped(open);
                    if self.has_losses() {
                        // A frame after an event must not have an earlier time than the event, so frames in the socket
                        // are read first.
                        let noticed = Reading::now();
                        if !self.receive_all(open).await {
                            return ServiceEnd::Dead;
                        }
                        self.report_losses(open.mapper.event(noticed)).await;
                    }
                    continue;
                }
                () = sleep_until(look_at), if self.state != LinkState::Up => {
                    look_at = Instant::now() + self.lengthen_pause();
                    if self.look(open).await { continue } else { return ServiceEnd::Dead }
                }
            };
            match step {
                Err(None) => return ServiceEnd::Stopped,
                Err(Some(outgoing)) => open.pending = Some(outgoing),
                Ok(()) => {
                    if !self.receive_all(open).await {
                        return ServiceEnd::Dead;
                    }
                }
            }
            if !self.send_pending(open).await {
                return ServiceEnd::Dead;
            }
        }
    }

    /// Reads until the socket is empty. After every [`READ_BATCH`] frames, other tasks run. Returns `false` if the
    /// socket is dead.
    async fn receive_all(&mut self, open: &mut OpenSocket) -> bool {
        loop {
            for _ in 0..READ_BATCH / CALL_BATCH {
                open.received.clear();
                match open.socket.get_ref().receive(&mut open.received) {
                    Ok(()) => {
                        // One clock reading serves all frames, because one call read them at the same moment.
                        let reading = Reading::now();
                        for received in &open.received {
                            self.take(&mut open.mapper, received, reading).await;
                        }
                        if open.received.len() < CALL_BATCH {
                            open.mapper.socket_emptied(reading);
                            return true;
                        }
                    }
                    Err(Errno::EAGAIN) => return true,
                    Err(Errno::EINTR) => {}
                    Err(error) => {
                        if !self.survives(error).await {
                            return false;
                        }
                    }
                }
            }
            tokio::task::yield_now().await;
        }
    }

    fn is_wanted(&self, id: CanId) -> bool {
        let fits = |&(wanted, mask): &(u32, u32)| matches!(id, CanId::Extended(raw) if raw & mask == wanted);
        self.config.all || self.config.ids.binary_search(&id).is_ok() || self.config.patterns.iter().any(fits)
    }

    async fn take(&mut self, mapper: &mut StampMapper, received: &RawRead, reading: Reading) {
        let time = mapper.arrival(received.stamps, reading);
        // Frames that were in the socket when the interface went down do not show that the interface is up again.
        if self.state != LinkState::Up && time > self.state_since {
            self.enter_at(LinkState::Up, time).await;
        }
        let bus = self.config.bus;
        let record = match received.what {
            Wire::Frame(frame) if !self.is_wanted(frame.id()) => return,
            Wire::Frame(frame) => Record::frame(time, bus, &frame),
            Wire::Error(class) => Record::bus(time, bus, BusEvent::ErrorFrame { class }),
            Wire::Malformed => {
                self.lost += 1;
                self.health.count(|counts| counts.malformed += 1);
                return;
            }
        };
        if self.inbox.try_send(record).is_err() {
            self.lost += 1;
            self.health.count(|counts| counts.queue_dropped += 1);
        }
    }

    fn note_dropped(&mut self, open: &mut OpenSocket) {
        let total = open.socket.get_ref().dropped_total();
        let dropped = u64::from(total.wrapping_sub(std::mem::replace(&mut open.dropped_total, total)));
        self.lost += dropped;
        self.health.count(|counts| counts.kernel_dropped += dropped);
    }

    /// Sends the waiting frame if there is room. Returns `false` if the socket is dead.
    async fn send_pending(&mut self, open: &mut OpenSocket) -> bool {
        let Some(outgoing) = open.pending.take() else { return true };
        // Drop the frame if the interface is not up, or if the frame has waited so long that it is outdated.
        let useless = self.state != LinkState::Up || outgoing.since.elapsed() > Duration::from_millis(500);
        let result = if useless { Err(Errno::ENETDOWN) } else { open.socket.get_ref().send(&outgoing.frame) };
        match result {
            Ok(()) => self.health.count(|counts| counts.sent += 1),
            Err(Errno::EAGAIN | Errno::EINTR) => open.pending = Some(outgoing),
            Err(error) => {
                self.count_unsent();
                return useless || error == Errno::ENOBUFS || self.survives(error).await;
            }
        }
        true
    }

    /// Handles a socket error and records the interface's state. Returns `false` if the socket is dead.
    async fn survives(&mut self, error: Errno) -> bool {
        let (state, is_known, is_alive) = match error {
            Errno::ENETDOWN => (Some(LinkState::Down), true, true),
            Errno::ENODEV | Errno::ENXIO => (Some(LinkState::Missing), true, false),
            // The interface cannot carry this frame; the caller counts it.
            Errno::EINVAL | Errno::EMSGSIZE => (None, false, true),
            _ => (Some(LinkState::Down), false, false),
        };
        if !is_known {
            self.problem(&error.into());
        }
        if let Some(state) = state {
            self.enter(state).await;
        }
        is_alive
    }

    /// Checks whether an interface that was down is up again. Returns `false` if the socket is bound to a removed
    /// interface.
    async fn look(&mut self, open: &OpenSocket) -> bool {
        if index_of(&self.config.interface).ok() != Some(open.socket.get_ref().index) {
            return false;
        }
        if let Ok(None) = RawSocket::open(&self.config.interface, false, &[], 0).and_then(|probe| probe.take_error()) {
            self.enter(LinkState::Up).await;
        }
        true
    }

    /// Waits before the next attempt to open a socket, and drops the frames to send.
    async fn wait(&mut self) -> ServiceEnd {
        let until = Instant::now() + self.lengthen_pause();
        loop {
            tokio::select! {
                () = sleep_until(until) => return ServiceEnd::Dead,
                next = self.outgoing.recv() => match next {
                    Some(_) => self.count_unsent(),
                    None => return ServiceEnd::Stopped,
                },
                _ = self.report.tick() => self.report_losses(self.clock.now()).await,
            }
        }
    }

    fn count_unsent(&self) {
        self.unsent.fetch_add(1, Ordering::Relaxed);
        self.health.count(|counts| counts.send_failed += 1);
    }

    fn lengthen_pause(&mut self) -> Duration {
        let pause = self.pause;
        self.pause = (pause * 2).min(LONGEST_PAUSE);
        pause
    }

    /// Records the interface's state. Reports an event if the state is new.
    async fn enter(&mut self, state: LinkState) {
        self.enter_at(state, self.clock.now()).await;
    }

    /// Like [`enter`](Self::enter), at the time of the frame or event that shows the state.
    async fn enter_at(&mut self, state: LinkState, time: Timestamp) {
        if self.state == state {
            return;
        }
        self.state = state;
        self.state_since = time;
        if state == LinkState::Up {
            self.pause = FIRST_PAUSE;
        }
        self.health.enter(state);
        let event = match state {
            LinkState::Up => BusEvent::Up,
            LinkState::Down => BusEvent::Down,
            LinkState::Missing | LinkState::Unknown => BusEvent::Missing,
        };
        self.notify(time, event).await;
    }

    fn has_losses(&self) -> bool {
        self.lost > 0 || self.unsent.load(Ordering::Relaxed) > 0
    }

    async fn report_losses(&mut self, time: Timestamp) {
        let frames = std::mem::take(&mut self.lost);
        if frames > 0 {
            self.notify(time, BusEvent::Dropped { frames }).await;
        }
        let frames = self.unsent.swap(0, Ordering::Relaxed);
        if frames > 0 {
            self.notify(time, BusEvent::SendFailed { frames }).await;
        }
    }

    /// Reports an event. Events are never dropped. If the inbox is full, the link waits. In that time, the kernel
    /// queues frames, or drops and counts them.
    async fn notify(&self, time: Timestamp, event: BusEvent) {
        // An error means that the daemon is stopping and no longer receives.
        let _ = self.inbox.send(Record::bus(time, self.config.bus, event)).await;
    }

    /// Logs a problem unless it is the same as the last logged problem.
    fn problem(&mut self, error: &io::Error) {
        let text = explained(error);
        if self.last_problem.as_ref() != Some(&text) {
            tracing::warn!(interface = self.config.interface, error = text, "interface cannot be used");
            self.last_problem = Some(text);
        }
    }

    fn note_buffer(&self, socket: &RawSocket) {
        let granted_bytes = socket.receive_buffer_bytes().unwrap_or(0);
        tracing::debug!(
            interface = self.config.interface,
            index = socket.index,
            identifiers = self.config.ids.len(),
            asked_bytes = self.config.receive_buffer_bytes,
            granted_bytes,
            "socket open"
        );
    }
}
