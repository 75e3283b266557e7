//! Determines the reports to the service manager: the readiness and a status line.
//!
//! A service with a valid configuration is ready when the first usable reading has arrived, or when the wait for this
//! reading has ended. The status line states every problem. The line is reported when it changes, but at most once per
//! [`STATUS_PERIOD`]; readiness and the result of a reload are reported at once. The caller passes the times and sends
//! the returned reports, so this file needs no service manager.

use std::time::Duration;

use tokio::time::Instant;

use crate::config::channel_words;
use crate::io::socket::LinkState;
use crate::monitor::{BusEvent, Event, EventKind, Monitor};
use crate::quantity::{Channel, DAY_S};

/// Longest configurable wait for the first reading (s). The unit's `TimeoutStartSec` is longer.
pub const MAX_READY_TIMEOUT_S: f64 = 60.0;
/// Default wait for the first reading (s). This wait is ten times the wake-up time of a bus, but too short to look like
/// a start that hangs.
pub const DEFAULT_READY_TIMEOUT_S: f64 = 10.0;
const STATUS_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of lost signals that the line names. Further signals are counted.
const MAX_NAMED: usize = 3;
/// Longest line, bytes. A terminal can show a line of this length.
const MAX_LINE: usize = 1500;

#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct ManagerUpdate {
    pub(super) ready: bool,
    pub(super) status: Option<String>,
}

#[derive(Debug)]
pub(super) struct Readiness {
    interfaces: Vec<(String, LinkState)>,
    began: Instant,
    timeout: Duration,
    /// Time from the start to the first usable reading.
    first_after: Option<Duration>,
    is_ready: bool,
    lost: Vec<Channel>,
    inputs: usize,
    is_asleep: bool,
    store_works: bool,
    refused: Option<String>,
    restored: Option<String>,
    reported: String,
    reported_at: Option<Instant>,
    /// Whether something has changed since the line was built. Without a change, a tick builds no line.
    is_changed: bool,
}

impl Readiness {
    /// Creates the readiness of a service that starts now with these interfaces and waits at most `timeout` for the
    /// first reading.
    pub(super) fn new(names: &[String], timeout: Duration, restored: Option<String>, now: Instant) -> Self {
        Self {
            interfaces: names.iter().map(|name| (name.clone(), LinkState::Unknown)).collect(),
            began: now,
            timeout,
            first_after: None,
            is_ready: false,
            lost: Vec::new(),
            inputs: 0,
            is_asleep: false,
            store_works: true,
            refused: None,
            restored,
            reported: String::new(),
            reported_at: None,
            is_changed: true,
        }
    }

    /// Updates the readiness with an event of the core.
    pub(super) fn note(&mut self, event: &Event) {
        match event.kind {
            EventKind::Bus { bus, what } => {
                let state = match what {
                    BusEvent::Up => LinkState::Up,
                    BusEvent::Down => LinkState::Down,
                    BusEvent::Missing => LinkState::Missing,
                    BusEvent::Dropped { .. } | BusEvent::ErrorFrame { .. } | BusEvent::SendFailed { .. } => return,
                };
                if let Some(interface) = self.interfaces.get_mut(bus.index()) {
                    interface.1 = state;
                }
            }
            EventKind::Store { works } => self.store_works = works,
            _ => return,
        }
        self.is_changed = true;
    }

    /// Records the result of a reload. `refused` is the reason if the configuration was rejected.
    pub(super) fn note_reload(&mut self, refused: Option<String>) {
        self.refused = refused;
        self.is_changed = true;
    }

    /// Checks the state of the core, and returns the report that is due.
    pub(super) fn poll(&mut self, monitor: &Monitor, now: Instant) -> ManagerUpdate {
        let waited = now.duration_since(self.began);
        if self.first_after.is_none() && monitor.has_usable_reading() {
            self.first_after = Some(waited);
            self.is_changed = true;
        }
        let is_due = self.reported_at.is_none_or(|reported_at| now.duration_since(reported_at) >= STATUS_PERIOD);
        let ready = !self.is_ready && (self.first_after.is_some() || waited >= self.timeout);
        if !is_due && !ready {
            return ManagerUpdate::default();
        }
        self.is_ready |= ready;
        self.is_changed |= ready;
        self.check_inputs(monitor);
        ManagerUpdate { ready, status: self.new_line(now) }
    }

    /// Returns the line if it has changed, regardless of the period.
    pub(super) fn line_now(&mut self, monitor: &Monitor, now: Instant) -> Option<String> {
        self.check_inputs(monitor);
        self.new_line(now)
    }

    pub(super) fn is_ready(&self) -> bool {
        self.is_ready
    }

    fn check_inputs(&mut self, monitor: &Monitor) {
        let is_asleep = monitor.asleep_since().is_some();
        self.is_changed |= is_asleep != self.is_asleep;
        self.is_asleep = is_asleep;
        if self.inputs == monitor.inputs() && monitor.lost_inputs().eq(self.lost.iter().copied()) {
            return;
        }
        self.lost.clear();
        self.lost.extend(monitor.lost_inputs());
        self.inputs = monitor.inputs();
        self.is_changed = true;
    }

    /// Returns the line if it differs from the last reported line.
    fn new_line(&mut self, now: Instant) -> Option<String> {
        if !std::mem::take(&mut self.is_changed) {
            return None;
        }
        let line = self.line();
        if line == self.reported {
            return None;
        }
        self.reported.clone_from(&line);
        self.reported_at = Some(now);
        Some(line)
    }

    fn line(&self) -> String {
        let mut line = self.state();
        for problem in self.problems() {
            line.push_str("; ");
            line.push_str(&problem);
        }
        one_line(&line, MAX_LINE)
    }

    /// The beginning of the line, which states whether there is input.
    fn state(&self) -> String {
        let count = self.interfaces.len();
        let mut line = match self.first_after {
            None if !self.is_ready => "waiting for the first usable reading".to_owned(),
            None => format!("running without input: no usable reading in {} s", self.timeout.as_secs_f64()),
            Some(_) if self.is_asleep => "running: buses asleep".to_owned(),
            Some(_) if !self.lost.is_empty() && self.lost.len() == self.inputs => "running without input".to_owned(),
            Some(after) => {
                let plural = if count == 1 { "" } else { "s" };
                format!("running: {count} interface{plural}, first reading after {:.1} s", after.as_secs_f64())
            }
        };
        if let Some(restored) = &self.restored {
            line.push_str(", ");
            line.push_str(restored);
        }
        line
    }

    fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (name, interface) in &self.interfaces {
            match interface {
                LinkState::Missing => problems.push(format!("{name} is missing")),
                LinkState::Down => problems.push(format!("{name} is down")),
                LinkState::Up | LinkState::Unknown => {}
            }
        }
        if !self.lost.is_empty() && self.first_after.is_some() {
            let mut names: Vec<_> = self.lost.iter().take(MAX_NAMED).map(|&channel| channel_words(channel)).collect();
            if self.lost.len() > MAX_NAMED {
                names.push("...".to_owned());
            }
            problems.push(format!("{} of {} signals lost ({})", self.lost.len(), self.inputs, names.join(", ")));
        }
        if !self.store_works {
            problems.push("a file cannot be written".to_owned());
        }
        problems.extend(self.refused.as_ref().map(|why| format!("reload rejected: {why}")));
        problems
    }
}

/// Describes a restored state of this age (s).
pub(super) fn describe_restored(age_s: Option<f64>) -> String {
    match age_s {
        Some(age_s) => format!("restored state {} old", describe_duration(age_s)),
        None => "restored state of unknown age".to_owned(),
    }
}

fn describe_duration(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s if s < 2.0 * DAY_S => format!("{:.0} h", s / 3600.0),
        s => format!("{:.0} days", s / DAY_S),
    }
}

/// Replaces control characters and shortens the text to `limit` bytes. A line feed in the text would start another
/// assignment in the message to the service manager.
pub(super) fn one_line(text: &str, limit: usize) -> String {
    let line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if line.len() <= limit {
        return line;
    }
    let end = (0..=limit - 3).rev().find(|&end| line.is_char_boundary(end)).unwrap_or(0);
    format!("{}...", &line[..end])
}

#[cfg(test)]
mod tests;
