//! Publishes the daemon's status once a second, and counts the work of the loop.

use tokio::time::Instant;

use super::engine::Engine;
use crate::monitor::{Record, RecordKind, TICK_PERIOD_MS};
use crate::quantity::Timestamp;
use crate::status::PERIOD;
use crate::status::StatusServer;
use crate::status::collect::{CounterBaseline, ServiceIdentity, Sources};
use crate::status::counters::{Latency, ServiceCounters};
use crate::status::document::ConfigFile;

#[derive(Debug)]
pub(super) struct StatusPublisher {
    server: Option<StatusServer>,
    identity: ServiceIdentity,
    counters: ServiceCounters,
    latency: Latency,
    published: Option<Instant>,
    /// Counts of earlier runs. They are taken with the first document. At that time, the first tick has restored the
    /// stored state, and no frame has been counted yet.
    before: Option<CounterBaseline>,
}

impl StatusPublisher {
    pub(super) fn new(server: Option<StatusServer>, identity: ServiceIdentity) -> Self {
        let (counters, latency) = (ServiceCounters::default(), Latency::default());
        Self { server, identity, counters, latency, published: None, before: None }
    }

    /// Counts a tick that was due at `due`.
    pub(super) fn note_tick(&mut self, due: Instant) {
        self.counters.note_tick(due.elapsed().as_secs_f64(), f64::from(TICK_PERIOD_MS) / 1e3);
    }

    /// Records the latency of each frame of a batch. The estimates of the batch are available at `now`.
    pub(super) fn note_frames(&mut self, batch: &[Record], now: Timestamp) {
        let frames = batch.iter().filter(|received| matches!(received.kind, RecordKind::Frame { .. }));
        frames.for_each(|received| self.latency.record(now.since(received.time)));
    }

    /// Counts a reload. `Ok` means that the configuration was applied.
    pub(super) fn note_reload(&mut self, taken: Result<Option<ConfigFile>, ()>) {
        match taken {
            Ok(file) => {
                self.counters.reloads += 1;
                self.identity.config = file;
            }
            Err(()) => self.counters.reloads_refused += 1,
        }
    }

    /// Publishes a document, unless the last one was published less than one [`PERIOD`] ago. `tick` is the time at
    /// which the current tick was due.
    pub(super) fn publish(&mut self, engine: &Engine, tick: Instant, now: Timestamp) {
        let Some(server) = &self.server else { return };
        if self.published.is_some_and(|published| tick.duration_since(published) < PERIOD) {
            return;
        }
        self.published = Some(tick);
        let sources = Sources {
            identity: &self.identity,
            monitor: &engine.monitor,
            links: &engine.links,
            before: self.before.get_or_insert_with(|| CounterBaseline::of(&engine.monitor)),
            counters: self.counters,
            latency: &self.latency,
            clients: server.clients(),
            events: &engine.recent,
            store: engine.store_status(),
        };
        let is_taken = server.offer(sources.draft(now));
        self.counters.documents_skipped += u64::from(!is_taken);
    }
}
