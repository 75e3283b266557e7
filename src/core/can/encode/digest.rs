//! Encodes the digest frame: number and checksum of all raised alarms, the state of every rule, and one threshold in
//! full precision.
//!
//! In: the raised alarms with the codes in their alarm frames, the states of the rules, and a threshold. Out: the
//! frames of `PACKWATCH_Digest`. The checksum shows a receiver whether its table of raised alarms is complete, for
//! example if alarm frames were lost or the receiver started late.

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
    /// The worst raised alarm has severity info.
    Info = 1,
    /// The worst raised alarm has severity warning.
    Warning = 2,
    /// The worst raised alarm has severity severe.
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
    /// Number of the rule.
    pub rule: u8,
    /// Wire code: 1 info, 2 warning, 3 severe.
    pub severity: u8,
    /// The threshold, in the rule's internal unit.
    pub threshold: f64,
}

/// Contents of all pages of the digest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DigestFields {
    /// Number of raised alarms.
    pub raised: usize,
    /// Wire code of the worst severity: 0 none, 1 info, 2 warning, 3 severe.
    pub worst: u8,
    /// Checksum of the raised alarms.
    pub checksum: TableChecksum,
    /// Longest time between two frames of the same raised alarm (s).
    pub pass_time_s: f64,
    /// States of the rules, in the order of their numbers.
    pub rules: [RuleState; RULE_COUNT],
    /// The threshold to send in this digest; `None` = no threshold is configured.
    pub threshold: Option<ThresholdFields>,
}

/// Checksum of a table of raised alarms: the sum, modulo 65536, of the CRC-16 (polynomial 0x1021, start 0xFFFF) of each
/// entry. A sum does not depend on the order, so a receiver can add and subtract entries as they change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TableChecksum(u16);

impl TableChecksum {
    /// Adds a raised alarm with the codes of its frame; `cell`: `None` = the pack.
    pub fn add(&mut self, rule: u8, severity: u8, cell: Option<CellIndex>, state: u8, is_acknowledged: bool) {
        // 2047 is the code of "the whole pack", as in the alarm frame of the shipped DBC.
        let [low, high] = cell.map_or(2047, |cell| cell.0).to_le_bytes();
        let entry = [rule, severity, low, high, state | u8::from(is_acknowledged) << 3];
        self.0 = self.0.wrapping_add(crc16(0xFFFF, &entry));
    }

    /// The value to send. The code 65535 means "not available", so a sum of 65535 is sent as 65534.
    pub fn value(self) -> u16 {
        self.0.min(u16::MAX - 1)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct DigestPlan {
    pub(super) message: OutputMessage,
    /// Selector codes of the pages, in ascending order.
    pages: Vec<u64>,
    /// Factor from each rule's internal unit to the unit of its `Threshold_...` signal.
    factors: [f64; RULE_COUNT],
}

impl DigestPlan {
    /// Creates the plan; `None` = the database has no digest, or faults were added to `faults`.
    pub(super) fn new(database: &Database, alarm: &OutputMessage, faults: &mut Vec<String>) -> Option<Self> {
        let name = LayoutMessage::Digest.message();
        database.message(name)?;
        let rules = RULES.map(|rule| format!("Rule_{rule}"));
        let rules: Vec<&str> = rules.iter().map(String::as_str).collect();
        // The signals of page 0 and of the rules are required. The signals of the threshold are optional.
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
