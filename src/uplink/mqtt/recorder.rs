//! Implements the recorder, which selects the documents to queue as samples, and the new events.
//!
//! Input: the daemon's documents. Output: messages in the [`Queue`], even if the broker cannot be reached. The daemon's
//! clock decides when a sample is due. Each document lists the latest events. The recorder finds new events by
//! comparing the lists of two documents, also across its own restart. If so many events occur between two documents
//! that some have left the list, these are missed, and a warning is logged. Events that leave the list while this
//! program does not run are also missed.

use std::cell::Cell;

use packwatch_host::quantity::Timestamp;
use packwatch_host::status::collect::MAX_EVENTS;
use packwatch_host::status::document::StatusDocument;
use serde_json::Value;

use super::payload;
use super::queue::{Class, Fill, Queue};
use crate::status_stream::Documents;

/// A document becomes a sample even if it arrives this much before the sample is due, because documents arrive only
/// about once a second.
const TOLERANCE_S: f64 = 0.5;

/// State of the recorder.
#[derive(Debug)]
pub struct Recorder<'a> {
    queue: &'a Queue,
    period_s: u64,
    due: Option<Timestamp>,
    events: Vec<Value>,
    works: Cell<bool>,
    drops: Cell<bool>,
}

impl<'a> Recorder<'a> {
    /// Creates a recorder that queues a sample every `period_s` seconds; 0 = no samples.
    pub fn new(queue: &'a Queue, period_s: u64) -> Self {
        let events = queue.seen().and_then(|seen| serde_json::from_str(&seen).ok()).unwrap_or_default();
        Self { queue, period_s, due: None, events, works: Cell::new(true), drops: Cell::new(false) }
    }

    /// Handles documents until the stream ends.
    pub async fn run(mut self, mut documents: Documents) {
        while documents.changed().await.is_ok() {
            let document = documents.borrow_and_update().clone();
            if let Some(document) = document {
                self.take(&document);
            }
        }
        std::future::pending().await
    }

    /// Queues the new events of a document, and a sample if a sample is due. If the disk fails, retries with the next
    /// document.
    pub fn take(&mut self, document: &StatusDocument) {
        let news = new_events(&self.events, &document.events);
        if !self.events.is_empty() && news.len() == document.events.len() && news.len() >= MAX_EVENTS {
            tracing::warn!(listed = news.len(), "the daemon had more new events than it lists; some may be missing");
        }
        let mut messages: Vec<_> =
            news.iter().map(|event| (Class::Event, payload::event(document, event).to_string())).collect();
        let next = self.next_due(document.time);
        if next.is_some() {
            messages.push((Class::Sample, payload::sample(document).to_string()));
        }
        if messages.is_empty() {
            return;
        }
        let seen = (!news.is_empty()).then(|| Value::from(document.events.clone()).to_string());
        let before = self.queue.fill();
        let result = self.queue.add(&messages, seen.as_deref());
        self.note_drops(before, self.queue.fill());
        if self.works.replace(result.is_ok()) != result.is_ok() {
            match &result {
                Ok(()) => tracing::info!("the queue can be written again"),
                Err(error) => tracing::error!(error, "the queue cannot be written; samples are lost until it can"),
            }
        }
        if result.is_ok() {
            self.due = next.or(self.due);
            self.events.clone_from(&document.events);
        }
    }

    /// Logs the first drop. Logs again only after a document whose messages caused no drop.
    fn note_drops(&self, before: Fill, now: Fill) {
        let is_dropping = (before.dropped_samples, before.dropped_events) != (now.dropped_samples, now.dropped_events);
        if is_dropping && !self.drops.get() {
            tracing::warn!(
                messages = now.messages,
                bytes = now.bytes,
                "the queue is full: the oldest messages are dropped"
            );
        }
        self.drops.set(is_dropping);
    }

    /// If a sample is due `now`, returns the time of the next sample. After a pause or a clock step, the schedule
    /// restarts.
    fn next_due(&self, now: Timestamp) -> Option<Timestamp> {
        if self.period_s == 0 {
            return None;
        }
        #[expect(clippy::cast_precision_loss, reason = "at most 86,400")]
        let period_s = self.period_s as f64;
        let Some(due) = self.due else { return Some(now.plus_secs(period_s)) };
        let late_s = now.since(due);
        let is_in_rhythm = (-TOLERANCE_S..period_s).contains(&late_s);
        let is_other_clock = late_s < -period_s - TOLERANCE_S;
        match (is_in_rhythm, late_s >= period_s || is_other_clock) {
            (true, _) => Some(due.plus_secs(period_s)),
            (false, true) => Some(now.plus_secs(period_s)),
            (false, false) => None,
        }
    }
}

/// Returns the events of `now` that `before` does not list. The list `now` begins with the end of `before`, because the
/// daemon drops its oldest events.
fn new_events<'a>(before: &[Value], now: &'a [Value]) -> &'a [Value] {
    let kept = (0..=before.len()).find_map(|dropped| {
        let end = &before[dropped..];
        now.starts_with(end).then_some(end.len())
    });
    &now[kept.unwrap_or(0)..]
}

#[cfg(test)]
mod tests;
