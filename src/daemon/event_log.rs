//! Core events as log lines: on change, with fields, by severity. Error frames are told once, then as a count: a
//! bus without a partner makes thousands a second. And as JSON lines, all of them.

use std::io::{self, Write};

use crate::alarm::Severity;
use crate::monitor::{BusEvent, Event, EventKind};
use crate::quantity::Timestamp;

/// Error frames of one interface are summed up this often, s.
const ERROR_SUMMARY_S: f64 = 10.0;

/// Writes one event as a line of JSON: the form of `--events` in `run` and `replay`.
pub(crate) fn write_line(out: &mut impl Write, event: &Event) -> io::Result<()> {
    serde_json::to_writer(&mut *out, event)?;
    out.write_all(b"\n")
}

/// Error frames of one interface.
#[derive(Debug, Clone, Copy, Default)]
struct ErrorFrames {
    told: Option<Timestamp>,
    untold: u64,
}

/// Logs events.
#[derive(Debug)]
pub(crate) struct EventLog {
    interfaces: Vec<String>,
    errors: Vec<ErrorFrames>,
}

impl EventLog {
    /// For these interfaces, in the order of the configuration.
    pub(crate) fn new(interfaces: Vec<String>) -> Self {
        let errors = vec![ErrorFrames::default(); interfaces.len()];
        Self { interfaces, errors }
    }

    /// Logs one event.
    pub(crate) fn log(&mut self, event: &Event) {
        match event.kind {
            EventKind::Bus { bus, what } => self.log_bus(event.time, bus.index(), what),
            EventKind::Alarm { severity, active: true, .. } if severity != Severity::Info => {
                tracing::warn!(kind = ?event.kind, "alarm");
            }
            EventKind::Alarm { .. } => tracing::info!(kind = ?event.kind, "alarm"),
            EventKind::SignalBad { .. }
            | EventKind::FilterReset { .. }
            | EventKind::TimeBackwards { .. }
            | EventKind::Trust { trusted: false, .. } => {
                tracing::warn!(kind = ?event.kind, "input or estimate not usable")
            }
            EventKind::Mode { .. }
            | EventKind::HalfCycle { .. }
            | EventKind::Capacity { .. }
            | EventKind::RechargePeriod { .. }
            | EventKind::SignalGood { .. }
            | EventKind::Gap { .. }
            | EventKind::Trust { trusted: true, .. } => tracing::info!(kind = ?event.kind, "event"),
        }
    }

    fn log_bus(&mut self, time: Timestamp, bus: usize, what: BusEvent) {
        let interface = self.interfaces.get(bus).map_or("?", String::as_str);
        match what {
            BusEvent::Up => tracing::info!(interface, "interface up"),
            BusEvent::Down => tracing::warn!(interface, "interface down"),
            BusEvent::Missing => tracing::warn!(interface, "interface missing"),
            BusEvent::Dropped { frames } => tracing::warn!(interface, frames, "frames lost on receiving"),
            BusEvent::SendFailed { frames } => tracing::warn!(interface, frames, "frames not sent"),
            BusEvent::ErrorFrame { class } => {
                let Some(errors) = self.errors.get_mut(bus) else { return };
                errors.untold += 1;
                if errors.told.is_none_or(|told| time.since(told) >= ERROR_SUMMARY_S) {
                    let frames = std::mem::take(&mut errors.untold);
                    errors.told = Some(time);
                    tracing::warn!(interface, frames, class = format_args!("{class:#x}"), "error frames");
                }
            }
        }
    }
}
