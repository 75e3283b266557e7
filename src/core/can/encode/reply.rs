//! Encodes the reply to a command frame.
//!
//! In: the outcome of a command or the reason for its refusal, and the counter that the next command must have. Out:
//! the frame `PACKWATCH_Reply`. If checksum, authenticator or freshness is wrong, the caller sets
//! [`ReplyFields::command`] to `None`, so that the reply does not repeat the received command.

use serde::{Deserialize, Serialize};

use super::command::{Command, CommandFields};
use super::layout::LayoutMessage;
use super::message::OutputMessage;
use crate::can::Frame;
use crate::can::dbc::Database;
use crate::can::e2e::Status;

const REQUIRED: [&str; 9] =
    ["Result", "Reason", "Command", "Rule", "Severity", "Cell", "CounterExpected", "Changed", "Refused"];

/// Reason why a command frame was not executed; the values are the wire codes of the signal `Reason`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum CommandRefusal {
    /// The first frame after a start only sets the counter.
    FirstFrame = 1,
    /// Damaged, too short, or from another message.
    WrongChecksum = 2,
    /// The last accepted frame had the same counter.
    RepeatedCounter = 3,
    /// The counter jumped further than allowed.
    WrongCounter = 4,
    /// The frame has an undefined code.
    NoMeaning = 5,
    /// The frame is forged, or its sender has another key.
    NotAuthentic = 8,
    /// The freshness was already used, has expired, or was not announced yet. A value counts as used if this value or a
    /// higher one was accepted. A value has expired if it is below the previous announcement.
    OldFreshness = 9,
    /// Authentic, but many forged frames were received. The command is executed if the sender soon repeats it with
    /// another freshness.
    RepeatNeeded = 10,
}

impl CommandRefusal {
    /// The reason to refuse a frame with this status; `None` = the frame may be executed.
    pub const fn of(status: Status) -> Option<Self> {
        match status {
            Status::Ok | Status::OkSomeLost | Status::Sync => None,
            Status::Initial => Some(Self::FirstFrame),
            Status::Repeated => Some(Self::RepeatedCounter),
            Status::WrongSequence => Some(Self::WrongCounter),
            Status::WrongCrc | Status::NoNewData => Some(Self::WrongChecksum),
        }
    }

    /// Whether checksum, authenticator and freshness were correct.
    pub const fn is_intact(self) -> bool {
        !matches!(self, Self::WrongChecksum | Self::NotAuthentic | Self::OldFreshness)
    }

    /// Description for logs.
    pub const fn words(self) -> &'static str {
        match self {
            Self::FirstFrame => "first frame after a start",
            Self::WrongChecksum => "wrong checksum",
            Self::RepeatedCounter => "repeated counter",
            Self::WrongCounter => "wrong counter",
            Self::NoMeaning => "no meaning",
            Self::NotAuthentic => "not authentic",
            Self::OldFreshness => "old freshness",
            Self::RepeatNeeded => "repeat needed: many forged frames received",
        }
    }
}

/// Contents of the reply.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplyFields {
    /// Numbers of changed alarms and of alarms that refused the change, or the reason why the command was not executed.
    pub outcome: Result<(u32, u32), CommandRefusal>,
    /// `None` = the command could not be decoded, or its frame is not intact.
    pub command: Option<CommandFields>,
    /// `None` = any counter.
    pub counter_expected: Option<u8>,
}

impl ReplyFields {
    /// Wire codes of `Result` (1 accepted, 2 refused) and `Reason` ([`CommandRefusal`], 0 none, 6 not healthy, 7
    /// nothing to do).
    fn result(&self) -> (u8, u8) {
        let replaces_pack = self.command.is_some_and(|fields| fields.command == Command::PackReplaced);
        match self.outcome {
            Err(refusal) => (2, refusal as u8),
            Ok((0, 1..)) => (2, 6),
            Ok((_, 1..)) => (1, 6),
            Ok((0, 0)) if !replaces_pack => (1, 7),
            Ok(_) => (1, 0),
        }
    }

    fn value(&self, name: &str) -> Option<f64> {
        let (result, reason) = self.result();
        let count = |of: fn(&(u32, u32)) -> u32| self.outcome.as_ref().ok().map(|counts| f64::from(of(counts)));
        match name {
            "Result" => Some(result.into()),
            "Reason" => Some(reason.into()),
            "Command" => self.command.map(|fields| match fields.command {
                Command::Acknowledge => 1.0,
                Command::Clear => 2.0,
                Command::PackReplaced => 3.0,
            }),
            "Rule" => self.command?.rule.map(f64::from),
            "Severity" => self.command?.severity.map(f64::from),
            "Cell" => self.command?.cell.map(|cell| f64::from(cell.0)),
            "CounterExpected" => self.counter_expected.map(f64::from),
            "Changed" => count(|(changed, _)| *changed),
            "Refused" => count(|(_, refused)| *refused),
            _ => None,
        }
    }
}

/// Prepares the reply message; `None` = the database has no reply, or faults were added to `faults`.
pub(super) fn reply_message(database: &Database, faults: &mut Vec<String>) -> Option<OutputMessage> {
    let name = LayoutMessage::Reply.message();
    database.message(name)?;
    OutputMessage::new(database, name, &REQUIRED, faults)
}

pub(super) fn reply_frame(message: &OutputMessage, fields: &ReplyFields, counter: &mut u8) -> Frame {
    message.frame(0, counter, |name, _| fields.value(name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::encode::default_database;
    use crate::quantity::CellIndex;

    /// Raw codes of the signals, in the order of [`REQUIRED`].
    fn codes(fields: &ReplyFields) -> [u64; 9] {
        let database = default_database().unwrap();
        let plan = reply_message(&database, &mut Vec::new()).unwrap();
        let frame = reply_frame(&plan, fields, &mut 0);
        let code = |name: &str| {
            let (_, signal) = database.signal(&format!("PACKWATCH_Reply.{name}")).unwrap();
            signal.layout.plan().unwrap().raw(frame.data()).unwrap()
        };
        REQUIRED.map(code)
    }

    fn fields(outcome: Result<(u32, u32), CommandRefusal>, command: Command) -> ReplyFields {
        let command = CommandFields { command, rule: Some(9), severity: None, cell: Some(CellIndex(5)) };
        ReplyFields { outcome, command: Some(command), counter_expected: Some(255) }
    }

    #[test]
    fn outcome_encodes_result_reason_and_counts() {
        assert_eq!(codes(&fields(Ok((2, 0)), Command::Clear)), [1, 0, 2, 9, 0, 5, 255, 2, 0]);
        assert_eq!(codes(&fields(Ok((2, 3)), Command::Clear)), [1, 6, 2, 9, 0, 5, 255, 2, 3]);
        assert_eq!(codes(&fields(Ok((0, 3)), Command::Clear)), [2, 6, 2, 9, 0, 5, 255, 0, 3]);
        assert_eq!(codes(&fields(Ok((0, 0)), Command::Acknowledge)), [1, 7, 1, 9, 0, 5, 255, 0, 0]);
        assert_eq!(codes(&fields(Ok((0, 0)), Command::PackReplaced))[..2], [1, 0]);
        assert_eq!(
            codes(&fields(Ok((4000, 4000)), Command::Clear))[7..],
            [62, 14],
            "counts saturate below the code for not available"
        );
    }

    #[test]
    fn refused_frame_encodes_reason_without_counts() {
        for (status, reason) in
            [(Status::Initial, 1), (Status::WrongCrc, 2), (Status::Repeated, 3), (Status::WrongSequence, 4)]
        {
            let refusal = CommandRefusal::of(status).unwrap();
            assert_eq!(codes(&fields(Err(refusal), Command::Clear)), [2, reason, 2, 9, 0, 5, 255, 63, 15]);
        }
        let unread = ReplyFields { outcome: Err(CommandRefusal::NoMeaning), command: None, counter_expected: None };
        assert_eq!(codes(&unread), [2, 5, 15, 31, 0, 2047, 511, 63, 15]);
    }

    #[test]
    fn usable_statuses_are_executed() {
        for status in Status::ALL {
            assert_eq!(CommandRefusal::of(status).is_none(), status.is_usable(), "{status:?}");
        }
    }
}
