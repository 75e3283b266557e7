//! Encodes the digest frame: number and checksum of all raised alarms, the state of every rule, and one threshold in
//! full precision.
//!
//! In: raised alarms as wire codes (the codes in an alarm frame), states of the rules, a threshold. Out: frames of
//! `PACKWATCH_Digest`. With the checksum, a receiver detects that its table of raised alarms is incomplete, for example
//! because alarm frames were lost or the receiver started late.

use super::layout::LayoutMessage;
use super::message::{OutputMessage, RULES};
use crate::can::Frame;
use crate::can::dbc::Database;
use crate::can::e2e::crc16;
use crate::quantity::CellIndex;

const RULE_COUNT: usize = RULES.len();

/// State of a rule; the values are the wire codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum RuleState {
    /// Every alarm of the rule is known and not raised.
    None = 0,
    /// The worst raised alarm has this severity.
    Info = 1,
    Warning = 2,
    Severe = 3,
    /// No alarm of the rule is raised, but at least one is unknown.
    Unknown = 4,
    /// No threshold is configured.
    #[default]
    NotWatched = 5,
}

/// A configured threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThresholdFields {
    pub rule: u8,
    /// Wire code: 1 info, 2 warning, 3 severe.
    pub severity: u8,
    /// In the rule's internal unit.
    pub threshold: f64,
}

/// Contents of all pages of the digest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DigestFields {
    pub raised: usize,
    /// Wire code of the worst severity: 0 none, 1 info, 2 warning, 3 severe.
    pub worst: u8,
    pub checksum: TableChecksum,
    /// Longest time between two frames of the same raised alarm (s).
    pub pass_time_s: f64,
    /// In the order of the rule numbers.
    pub rules: [RuleState; RULE_COUNT],
    /// The threshold in this digest; `None` = no threshold is configured.
    pub threshold: Option<ThresholdFields>,
}

/// Checksum of a table of raised alarms: the sum, modulo 65536, of each entry's CRC-16 (polynomial 0x1021, start
/// 0xFFFF). The order does not matter, so a receiver can add and subtract entries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TableChecksum(u16);

impl TableChecksum {
    /// Adds a raised alarm. `rule`, `severity` and `state` are the wire codes in its alarm frame. `cell` is `None` for
    /// the whole pack.
    pub fn add(&mut self, rule: u8, severity: u8, cell: Option<CellIndex>, state: u8, is_acknowledged: bool) {
        // 2047 = the whole pack, as in the alarm frame.
        let [low, high] = cell.map_or(2047, |cell| cell.0).to_le_bytes();
        let entry = [rule, severity, low, high, state | u8::from(is_acknowledged) << 3];
        self.0 = self.0.wrapping_add(crc16(0xFFFF, &entry));
    }

    /// The value to send. 65535 means "not available", so 65534 is sent instead.
    pub fn value(self) -> u16 {
        self.0.min(u16::MAX - 1)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct DigestPlan {
    pub(super) message: OutputMessage,
    /// Selector codes, ascending.
    pages: Vec<u64>,
    /// Factors from internal units to the units of the `Threshold_...` signals.
    factors: [f64; RULE_COUNT],
}

impl DigestPlan {
    /// Creates the plan; `None` = the database has no digest, or faults were added to `faults`.
    pub(super) fn new(database: &Database, alarm: &OutputMessage, faults: &mut Vec<String>) -> Option<Self> {
        let name = LayoutMessage::Digest.message();
        database.message(name)?;
        let rules = RULES.map(|rule| format!("Rule_{rule}"));
        let rules: Vec<&str> = rules.iter().map(String::as_str).collect();
        // The threshold's signals are optional.
        let required = [&["Page", "Raised", "Worst", "TableChecksum", "PassTime"][..], &rules].concat();
        let message = OutputMessage::new(database, name, &required, faults)?.with_places(&rules);
        let factors = RULES.map(|rule| alarm.per_inside_unit(&format!("Threshold_{rule}")));
        Some(Self { pages: message.page_codes(), message, factors })
    }

    /// Encodes a page, counted from 0; `None` = no such page.
    pub(super) fn frame(&self, page: usize, fields: &DigestFields, counter: &mut u8) -> Option<Frame> {
        let code = *self.pages.get(page)?;
        Some(self.message.frame(code, counter, |name, rule| match rule {
            Some(rule) => fields.rules.get(rule).map(|state| f64::from(*state as u8)),
            None => self.value(fields, name),
        }))
    }

    pub(super) fn page_count(&self) -> usize {
        self.pages.len()
    }

    fn value(&self, fields: &DigestFields, name: &str) -> Option<f64> {
        let threshold = fields.threshold.as_ref();
        match name {
            "Raised" => Some(f64::from(u16::try_from(fields.raised).unwrap_or(u16::MAX))),
            "Worst" => Some(fields.worst.into()),
            "TableChecksum" => Some(fields.checksum.value().into()),
            "PassTime" => Some(fields.pass_time_s),
            "ThresholdRule" => threshold.map(|threshold| threshold.rule.into()),
            "ThresholdSeverity" => threshold.map(|threshold| threshold.severity.into()),
            "Threshold" => threshold.map(|of| of.threshold * self.factor(of.rule)),
            _ => None,
        }
    }

    fn factor(&self, rule: u8) -> f64 {
        usize::from(rule).checked_sub(1).and_then(|index| self.factors.get(index)).copied().unwrap_or(1.0)
    }
}

#[cfg(test)]
mod tests;
