//! The loop's side of the status sockets: counts what the loop does, and once a second hands over what is to be told.

use tokio::time::Instant;

use super::engine::Engine;

use crate::io::socket::{LinkEvent, LinkMessage, LinkOutput};
use crate::monitor::TICK_PERIOD_MS;
use crate::quantity::Timestamp;
use crate::status::collect::{Before, Identity, Sources};
use crate::status::counters::LoopCounters;
use crate::status::document::ConfigFile;
use crate::status::{PERIOD, StatusServer};

/// What the loop tells of itself.
#[derive(Debug)]
pub(super) struct StatusPublisher {
    pub(super) server: Option<StatusServer>,
    pub(super) identity: Identity,
    pub(super) counters: LoopCounters,
    told: Option<Instant>,
    /// Of the first document: the first tick has taken the stored state up, and no frame was counted yet.
    before: Option<Before>,
}

impl StatusPublisher {
    pub(super) fn new(server: Option<StatusServer>, identity: Identity) -> Self {
        Self { server, identity, counters: LoopCounters::default(), told: None, before: None }
    }

    /// A tick that was due then comes now.
    pub(super) fn note_tick(&mut self, due: Instant) {
        self.counters.note_tick(due.elapsed().as_secs_f64(), f64::from(TICK_PERIOD_MS) / 1e3);
    }

    /// The frames among these have their estimates now.
    pub(super) fn note_frames(&mut self, batch: &[LinkMessage], now: Timestamp) {
        let frames = batch.iter().filter(|received| matches!(received.what, LinkEvent::Frame(_)));
        frames.for_each(|received| self.counters.latency.record(now.since(received.time)));
    }

    /// The configuration was read again, and taken over (`Ok`) or not.
    pub(super) fn note_reload(&mut self, taken: Result<Option<ConfigFile>, ()>) {
        match taken {
            Ok(file) => {
                self.counters.service.reloads += 1;
                self.identity.config = file;
            }
            Err(()) => self.counters.service.reloads_refused += 1,
        }
    }

    /// With a tick that was due then: hands a document over when it is time for one.
    pub(super) fn tell(&mut self, engine: &Engine, links: &[LinkOutput], tick: Instant, now: Timestamp) {
        let Some(server) = &self.server else { return };
        if self.told.is_some_and(|told| tick.duration_since(told) < PERIOD) {
            return;
        }
        self.told = Some(tick);
        let sources = Sources {
            identity: &self.identity,
            monitor: &engine.monitor,
            links,
            before: self.before.get_or_insert_with(|| Before::of(&engine.monitor)),
            counters: &self.counters,
            clients: server.clients(),
            events: &engine.recent,
            store: engine.store_status(),
        };
        let is_taken = server.offer(sources.draft(now));
        self.counters.service.documents_skipped += u64::from(!is_taken);
    }
}
