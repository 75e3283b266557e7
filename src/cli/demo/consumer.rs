//! The ECU that receives the demo's frames. It decodes the frames with the DBC alone.

use crate::alarm::Rule;
use crate::can::Frame;
use crate::can::dbc::{Database, Message, Signal};
use packwatch_host::failure::Failure;

pub(super) struct Consumer {
    database: Database,
    unknown_frames: u64,
}

impl Consumer {
    pub(super) fn new(dbc: &str) -> Result<Self, Failure> {
        let database = Database::parse(dbc).map_err(|e| Failure::new(format!("config/packwatch.dbc: {e}")))?;
        Ok(Self { database, unknown_frames: 0 })
    }

    /// Handles a received frame; counts it if the DBC does not define it.
    pub(super) fn receive(&mut self, frame: &Frame) {
        self.unknown_frames += u64::from(self.message(frame).is_none());
    }

    /// Number of frames that the DBC does not define.
    pub(super) fn unknown_frames(&self) -> u64 {
        self.unknown_frames
    }

    /// Whether the frame reports a raised alarm of `rule`.
    pub(super) fn is_alarm(&self, frame: &Frame, rule: Rule) -> bool {
        let value = |name: &str| {
            let signal = self.message(frame)?.signal(name)?;
            signal.layout.plan().ok()?.decode(frame.data()).ok()
        };
        value("Rule") == Some(f64::from(rule as u8)) && value("State") == Some(1.0)
    }

    /// Formats every signal of the frame: `Message: Signal value unit, ...`.
    pub(super) fn explain(&self, frame: &Frame) -> String {
        let Some(message) = self.message(frame) else { return "not in the DBC".to_owned() };
        let present = message.signals.iter().filter(|signal| is_present(message, signal, frame.data()));
        let words: Vec<String> = present.map(|signal| explain_signal(signal, frame.data())).collect();
        format!("{}: {}", message.name, words.join(", "))
    }

    fn message(&self, frame: &Frame) -> Option<&Message> {
        self.database.messages.iter().find(|message| message.id == frame.id())
    }
}

fn is_present(message: &Message, signal: &Signal, data: &[u8]) -> bool {
    signal.conditions.iter().all(|condition| {
        let selector = &message.signals[condition.selector];
        let code = selector.layout.plan().ok().and_then(|plan| plan.raw(data).ok());
        code.is_some_and(|code| condition.ranges.iter().any(|&(low, high)| (low..=high).contains(&code)))
    })
}

fn explain_signal(signal: &Signal, data: &[u8]) -> String {
    let Ok(plan) = signal.layout.plan() else { return format!("{} unreadable", signal.name) };
    let code = plan.raw(data).ok().and_then(|code| i64::try_from(code).ok());
    let named = signal.values.iter().find(|(value, _)| Some(*value) == code);
    match (named, plan.decode(data)) {
        (Some((_, name)), _) => format!("{} {name}", signal.name),
        (None, Ok(value)) => {
            let rounded = (value * 1e6).round() / 1e6; // the product of factor and code is not exact in binary
            format!("{} {rounded} {}", signal.name, signal.unit).trim_end().to_owned()
        }
        (None, Err(fault)) => format!("{} {fault:?}", signal.name),
    }
}
