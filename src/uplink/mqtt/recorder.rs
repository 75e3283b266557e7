//! Selects which documents are queued as samples, and which of their events are new.
//!
//! Input: the daemon's documents. Output: messages in the [`Queue`], even if the broker cannot be reached. The daemon's
//! clock decides when a sample is due.
//!
//! Each document lists the latest events, and the daemon numbers its events from its start. From these numbers, the
//! recorder finds the new events, even after its own restart. New events that the document no longer lists are missed.
//! They are counted, logged, and queued as one event `events_missed` in their place. A restart of the daemon is queued
//! as an event `daemon_restarted`, because events that the previous run reported after its last received document are
//! unknown.

use std::cell::Cell;

use packwatch_host::quantity::Timestamp;
use packwatch_host::status::document::StatusDocument;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::payload;
use super::queue::{Class, Fill, Queue};
use crate::status_stream::Documents;

/// A document becomes a sample even if it arrives up to this much before the sample is due. Documents arrive only about
/// once a second, so the next document could be late.
const TOLERANCE_S: f64 = 0.5;

/// The events already handled: the daemon's run, which its start identifies, and the number of its latest event.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Handled {
    started: Timestamp,
    count: u64,
}

/// State of the recorder.
#[derive(Debug)]
pub struct Recorder<'a> {
    queue: &'a Queue,
    period_s: u64,
    due: Option<Timestamp>,
    handled: Option<Handled>,
    /// Whether another version of the uplink wrote the record of handled events into the queue, in a form that this
    /// version cannot read.
    has_other_note: bool,
    is_numbered: bool,
    works: Cell<bool>,
    drops: Cell<bool>,
}

impl<'a> Recorder<'a> {
    /// Creates a recorder that queues a sample every `period_s` seconds; 0 = no samples.
    pub fn new(queue: &'a Queue, period_s: u64) -> Self {
        let seen = queue.seen();
        let handled = seen.as_ref().and_then(|seen| serde_json::from_str(seen).ok());
        let has_other_note = seen.is_some() && handled.is_none();
        let (works, drops) = (Cell::new(true), Cell::new(false));
        Self { queue, period_s, due: None, handled, has_other_note, is_numbered: true, works, drops }
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
        let (events, missed) = self.new_events(document);
        let mut messages: Vec<_> =
            events.iter().map(|event| (Class::Event, payload::event(document, event).to_string())).collect();
        let next = self.next_due(document.time);
        if next.is_some() {
            messages.push((Class::Sample, payload::sample(document).to_string()));
        }
        let handled = Handled { started: document.started, count: document.event_count };
        if messages.is_empty() && self.handled == Some(handled) {
            return;
        }
        let seen = serde_json::to_string(&handled).unwrap_or_default();
        let before = self.queue.fill();
        let result = self.queue.add(&messages, (self.handled != Some(handled)).then_some((&seen, missed)));
        self.note_drops(before, self.queue.fill());
        if self.works.replace(result.is_ok()) != result.is_ok() {
            match &result {
                Ok(()) => tracing::info!("the queue can be written again"),
                Err(error) => tracing::error!(error, "the queue cannot be written; samples are lost until it can"),
            }
        }
        if result.is_ok() {
            self.due = next.or(self.due);
            self.handled = Some(handled);
            if missed > 0 {
                tracing::warn!(missed, "the daemon no longer lists some of its events");
            }
        }
    }

    /// The events to queue, and the number of missed events. On the very first document, only the listed events are
    /// new, because events before the first start of the uplink do not count as missed.
    fn new_events(&mut self, document: &StatusDocument) -> (Vec<Value>, u64) {
        let (total, listed) = (document.event_count, document.events.len() as u64);
        if total < listed {
            if std::mem::replace(&mut self.is_numbered, false) {
                tracing::error!("the daemon does not number its events: no events are sent; use the same version");
            }
            return (Vec::new(), 0);
        }
        let is_same_run = self.handled.is_some_and(|it| it.started == document.started && it.count <= total);
        let handled = match self.handled {
            Some(handled) if is_same_run => handled.count,
            Some(_) => 0,
            // It is unknown which events the other version has handled. All events so far count as handled, although
            // some of them may not have been queued.
            None if self.has_other_note => total,
            None => total - listed,
        };
        let missed = (total - listed).saturating_sub(handled);
        let time = document.time.nanos();
        let mut events = Vec::new();
        if !is_same_run && (self.handled.is_some() || self.has_other_note) {
            events.push(json!({ "event": "daemon_restarted", "time": time }));
        }
        if missed > 0 {
            events.push(json!({ "event": "events_missed", "time": time, "severity": "warning", "missed": missed }));
        }
        let known = usize::try_from(handled.saturating_sub(total - listed)).unwrap_or(usize::MAX);
        events.extend(document.events.iter().skip(known).cloned());
        (events, missed)
    }

    /// Logs that the full queue drops messages. While each document causes further drops, the log is not repeated.
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

#[cfg(test)]
mod tests;
