//! Decodes the command frame. Another ECU sends it to acknowledge or clear alarms, or to report that the pack was
//! replaced.
//!
//! In: a frame whose end-to-end protection or authenticator the caller has checked. Out: the command and its selectors
//! (rule, severity, cell). An undefined code is an error, so that a command is applied completely or not at all.

use super::layout::LayoutMessage;
use super::message::{PlanFaults, RULES};
use crate::can::dbc::{Database, Message};
use crate::can::e2e::Protection;
use crate::can::secoc::Authentication;
use crate::can::signal::SignalPlan;
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{CellIndex, MAX_CELLS};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    Acknowledge,
    /// Clears latched alarms whose value is not beyond the threshold, and the history of past alarms.
    Clear,
    /// Reports that another pack is in the vehicle.
    PackReplaced,
}

/// A command and the alarms that it selects. `None` does not restrict the selection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CommandFields {
    pub command: Command,
    pub rule: Option<u8>,
    /// Wire code of the severity: 1 info, 2 warning, 3 severe.
    pub severity: Option<u8>,
    pub cell: Option<CellIndex>,
}

/// Why a frame is not a command.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct CommandFault(String);

/// The command frame, prepared for decoding.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandPlan {
    id: CanId,
    len: usize,
    protection: Option<Protection>,
    secoc: Option<Authentication>,
    command: SignalPlan,
    rule: SelectorSignal,
    severity: SelectorSignal,
    cell: SelectorSignal,
}

/// A signal that selects alarms.
#[derive(Debug, Clone, PartialEq)]
struct SelectorSignal {
    name: &'static str,
    plan: SignalPlan,
    /// The code that selects all alarms.
    all: Option<u64>,
    /// Other valid codes.
    codes: std::ops::RangeInclusive<u64>,
}

impl CommandPlan {
    /// Finds the message and its signals, or names every message or signal that is missing or cannot be decoded.
    pub fn new(database: &Database) -> Result<Self, PlanFaults> {
        let name = LayoutMessage::Command.message();
        let message = database.message(name).ok_or_else(|| PlanFaults(vec![format!("message {name} is missing")]))?;
        let mut faults = Vec::new();
        let command = signal(message, "Command", &mut faults).map(|(plan, _)| plan);
        let most_cells = u64::try_from(MAX_CELLS).unwrap_or(u64::MAX);
        let last_rule = u64::try_from(RULES.len()).unwrap_or(u64::MAX);
        let rule = SelectorSignal::new(message, "Rule", 1..=last_rule, &mut faults);
        let severity = SelectorSignal::new(message, "Severity", 1..=3, &mut faults);
        let cell = SelectorSignal::new(message, "Cell", 0..=most_cells - 1, &mut faults);
        match (command, rule, severity, cell) {
            (Some(command), Some(rule), Some(severity), Some(cell)) => {
                let (id, len) = (message.id, usize::from(message.len_bytes));
                Ok(Self { id, len, protection: message.e2e, secoc: message.secoc, command, rule, severity, cell })
            }
            _ => Err(PlanFaults(faults)),
        }
    }

    pub fn id(&self) -> CanId {
        self.id
    }

    /// End-to-end protection that the frame must have.
    pub fn protection(&self) -> Option<Protection> {
        self.protection
    }

    /// Authentication that the frame must have.
    pub fn authentication(&self) -> Option<Authentication> {
        self.secoc
    }

    /// Decodes a command. Checks neither protection nor authenticator. Fails if the frame is another message, is too
    /// short, or has an undefined code.
    pub fn decode(&self, frame: &Frame) -> Result<CommandFields, CommandFault> {
        if frame.id() != self.id || frame.kind() == FrameKind::Remote {
            return Err(CommandFault("is not the command message".to_owned()));
        }
        let payload = frame.data();
        if payload.len() < self.len {
            return Err(CommandFault(format!("has {} bytes, must have {}", payload.len(), self.len)));
        }
        // Every signal lies within the message, so `raw` cannot fail.
        let command = match self.command.raw(payload).unwrap_or(0) {
            1 => Command::Acknowledge,
            2 => Command::Clear,
            3 => Command::PackReplaced,
            code => return Err(CommandFault::meaningless("Command", code)),
        };
        Ok(CommandFields {
            command,
            rule: self.rule.read(payload)?,
            severity: self.severity.read(payload)?,
            cell: self.cell.read(payload)?.map(CellIndex),
        })
    }
}

impl CommandFault {
    fn meaningless(signal: &str, code: u64) -> Self {
        Self(format!("{signal} is {code}, which has no meaning"))
    }
}

impl SelectorSignal {
    fn new(
        message: &Message,
        name: &'static str,
        codes: std::ops::RangeInclusive<u64>,
        faults: &mut Vec<String>,
    ) -> Option<Self> {
        let (plan, all) = signal(message, name, faults)?;
        Some(Self { name, plan, all, codes })
    }

    fn read<T: TryFrom<u64>>(&self, payload: &[u8]) -> Result<Option<T>, CommandFault> {
        match self.plan.raw(payload).unwrap_or(u64::MAX) {
            code if Some(code) == self.all => Ok(None),
            code if self.codes.contains(&code) => Ok(T::try_from(code).ok()),
            code => Err(CommandFault::meaningless(self.name, code)),
        }
    }
}

/// Finds a signal and the code of "all" in its value table. The signal must not be multiplexed.
fn signal(message: &Message, name: &str, faults: &mut Vec<String>) -> Option<(SignalPlan, Option<u64>)> {
    let mut fault = |what: String| faults.push(format!("signal {}.{name}{what}", message.name));
    let Some(signal) = message.signal(name) else {
        fault(" is missing".to_owned());
        return None;
    };
    let all = signal.values.iter().find(|(_, word)| word == "all").and_then(|(code, _)| u64::try_from(*code).ok());
    match signal.layout.plan() {
        Ok(_) if !signal.conditions.is_empty() => fault(": multiplexed, must always be present".to_owned()),
        Ok(plan) if plan.bytes_needed() > usize::from(message.len_bytes) => {
            fault(format!(": extends beyond the message's {} bytes", message.len_bytes));
        }
        Ok(plan) => return Some((plan, all)),
        Err(error) => fault(format!(": {error}")),
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::encode::{LayoutBase, LayoutSettings, MessageSettings, layout};

    fn plan() -> CommandPlan {
        let settings = LayoutSettings { command: Some(MessageSettings::default()), ..Default::default() };
        CommandPlan::new(&layout(LayoutBase::BuiltIn { rated_capacity_ah: 2.6 }, &settings).unwrap()).unwrap()
    }

    /// Codes: command, rule, severity, cell.
    fn frame(codes: [u64; 4]) -> Frame {
        let bits = codes[0] << 16 | codes[1] << 20 | codes[2] << 25 | codes[3] << 27;
        Frame::classic(CanId::Standard(1715), &bits.to_le_bytes()).unwrap()
    }

    #[test]
    fn command_decodes_kind_and_selected_alarms() {
        let fields = plan().decode(&frame([2, 14, 3, 95])).unwrap();
        let wanted =
            CommandFields { command: Command::Clear, rule: Some(14), severity: Some(3), cell: Some(CellIndex(95)) };
        assert_eq!(fields, wanted);
        let all = plan().decode(&frame([1, 31, 0, 2047])).unwrap();
        let wanted = CommandFields { command: Command::Acknowledge, rule: None, severity: None, cell: None };
        assert_eq!(all, wanted);
        assert_eq!(plan().decode(&frame([3, 31, 0, 2047])).unwrap().command, Command::PackReplaced);
    }

    #[test]
    fn undefined_code_is_rejected() {
        for (codes, signal, code) in [
            ([0, 31, 0, 2047], "Command", 0),
            ([4, 31, 0, 2047], "Command", 4),
            ([1, 0, 0, 2047], "Rule", 0),
            ([1, 19, 0, 2047], "Rule", 19),
            ([1, 31, 0, 1024], "Cell", 1024),
        ] {
            assert_eq!(plan().decode(&frame(codes)), Err(CommandFault::meaningless(signal, code)));
        }
    }

    #[test]
    fn other_and_short_messages_are_rejected() {
        let refusal = |frame: &Frame| plan().decode(frame).unwrap_err().to_string();
        let other = Frame::classic(CanId::Standard(1714), &[0xFF; 8]).unwrap();
        assert_eq!(refusal(&other), "is not the command message");
        assert_eq!(refusal(&Frame::remote(CanId::Standard(1715), 8).unwrap()), "is not the command message");
        let short = Frame::classic(CanId::Standard(1715), &[0; 7]).unwrap();
        assert_eq!(refusal(&short), "has 7 bytes, must have 8");
    }
}
