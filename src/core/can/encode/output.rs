//! Encodes the frames that the daemon sends.
//!
//! The layout may be any DBC with the message and signal names of the shipped `config/packwatch.dbc`. An unknown value
//! is sent as the code that the DBC calls "not available". If there is no such code, it is sent as all ones (unsigned),
//! the lowest code (signed) or NaN (float). If the code of a known value is the code for an unknown value, the
//! neighbouring code is sent, except in signals of one bit. The caller keeps the counters of end-to-end protection
//! ([`SendCounters`]).
//!
//! A DBC is rejected if signals are missing, or if a receiver could mistake a value for the value of another rule or
//! page.

use serde::{Deserialize, Serialize};

use super::digest::{DigestFields, DigestPlan};
use super::layout::LayoutMessage;
use super::message::{OutputMessage, PlanFaults, RULES};
use super::reply::{ReplyFields, reply_frame, reply_message};
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::Protection;
use crate::can::secoc::{Authentication, Profile};
use crate::can::{CanId, Frame};
use crate::quantity::catalogue::{PackValues, Part, Quantity as Q};
use crate::quantity::{CellIndex, Mode};

/// Signals with the functions that return their values.
type SignalTable<T, const N: usize> = [(&'static str, fn(&T) -> Option<f64>); N];

const STATUS: SignalTable<StatusFields, 8> = [
    ("Soc", |f| f.soc),
    ("SocStd", |f| f.soc_std),
    ("Mode", |f| f.mode.map(mode_code)),
    ("Validity", |f| Some(f.validity.into())),
    ("HighestSeverity", |f| f.highest_severity.map(f64::from)),
    ("ActiveAlarms", |f| f.active_alarms.map(f64::from)),
    ("LimitingCell", |f| f.limiting_cell.map(|cell| cell.0.into())),
    ("UnknownRules", |f| f.unknown_rules.map(f64::from)),
];

/// Signals of the health frame, on any page. The first [`HEALTH_REQUIRED`] signals are required.
const HEALTH: SignalTable<HealthFields, 18> = [
    ("Capacity", |f| f.capacity_ah),
    ("CapacityStd", |f| f.capacity_std_ah),
    ("Soh", |f| f.soh),
    ("RechargePeriod", |f| f.recharge_period_s),
    ("NormalizedRechargePeriod", |f| f.normalized_recharge_period_s),
    ("UsableCapacity", |f| f.usable_capacity_ah),
    ("UsableCapacityStd", |f| f.usable_capacity_std_ah),
    ("ResistanceRatio", |f| f.resistance_ratio),
    ("RemainingCycles", |f| f.remaining_cycles),
    ("RemainingCyclesLow", |f| f.remaining_cycles_low),
    ("RemainingDays", |f| f.remaining_days),
    ("Lli", |f| f.lli[0]),
    ("LliStd", |f| f.lli[1]),
    ("LamNe", |f| f.lam_ne[0]),
    ("LamNeStd", |f| f.lam_ne[1]),
    ("LamPe", |f| f.lam_pe[0]),
    ("LamPeStd", |f| f.lam_pe[1]),
    ("ModelState", |f| f.model_state.map(f64::from)),
];
const HEALTH_REQUIRED: usize = 8;

/// Signals of the health frame that [`OutputPlan::without_outlook`] leaves out.
const OUTLOOK: [(&str, Q, Part); 18] = [
    ("RemainingEnergy", Q::RemainingEnergy, Part::Mean),
    ("RemainingEnergyStd", Q::RemainingEnergy, Part::Std),
    ("EnergyToFull", Q::EnergyToFull, Part::Mean),
    ("EnergyToFullStd", Q::EnergyToFull, Part::Std),
    ("TimeToEmpty", Q::TimeToEmpty, Part::Mean),
    ("TimeToEmptyStd", Q::TimeToEmpty, Part::Std),
    ("TimeToFull", Q::TimeToFull, Part::Mean),
    ("TimeToFullStd", Q::TimeToFull, Part::Std),
    ("TimeToTarget", Q::TimeToTarget, Part::Mean),
    ("TimeToTargetStd", Q::TimeToTarget, Part::Std),
    ("DischargePower2s", Q::DischargePower2s, Part::Mean),
    ("DischargePower10s", Q::DischargePower10s, Part::Mean),
    ("DischargePower10sStd", Q::DischargePower10s, Part::Std),
    ("DischargePower30s", Q::DischargePower30s, Part::Mean),
    ("ChargePower2s", Q::ChargePower2s, Part::Mean),
    ("ChargePower10s", Q::ChargePower10s, Part::Mean),
    ("ChargePower10sStd", Q::ChargePower10s, Part::Std),
    ("ChargePower30s", Q::ChargePower30s, Part::Mean),
];

/// Signals on every page of the alarm frame.
const ALARM: [&str; 6] = ["Rule", "State", "Severity", "Test", "Cell", "Acknowledged"];

/// Contents of the status frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StatusFields {
    /// Fraction.
    pub soc: Option<f64>,
    /// Fraction.
    pub soc_std: Option<f64>,
    pub mode: Option<Mode>,
    /// Wire code: 0 unavailable, 1 valid, 2 degraded, 3 untrusted.
    pub validity: u8,
    /// Wire code: 0 none, 1 info, 2 warning, 3 severe.
    pub highest_severity: Option<u8>,
    pub active_alarms: Option<u16>,
    pub limiting_cell: Option<CellIndex>,
    /// Wire code of the number of unknown rules: 0 none, 1 some, 2 all.
    pub unknown_rules: Option<u8>,
}

/// Contents of all pages of the health frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HealthFields {
    /// Lowest capacity of a cell.
    pub capacity_ah: Option<f64>,
    pub capacity_std_ah: Option<f64>,
    /// Capacity as a fraction of the rated capacity.
    pub soh: Option<f64>,
    pub recharge_period_s: Option<f64>,
    /// With the reference charger.
    pub normalized_recharge_period_s: Option<f64>,
    pub usable_capacity_ah: Option<f64>,
    pub usable_capacity_std_ah: Option<f64>,
    /// Relative to a new cell.
    pub resistance_ratio: Option<f64>,
    /// Equivalent full cycles until the end of life, median. This value and the following values are optional in the
    /// DBC.
    pub remaining_cycles: Option<f64>,
    /// 5 % quantile of `remaining_cycles`.
    pub remaining_cycles_low: Option<f64>,
    /// Median.
    pub remaining_days: Option<f64>,
    /// Loss of lithium inventory of the cell with the lowest capacity, and its standard deviation, as fractions of a
    /// new cell's inventory.
    pub lli: [Option<f64>; 2],
    /// Loss of active material of the negative electrode of the cell with the lowest capacity, and its standard
    /// deviation, as fractions.
    pub lam_ne: [Option<f64>; 2],
    /// Loss of active material of the positive electrode of the cell with the lowest capacity, and its standard
    /// deviation, as fractions.
    pub lam_pe: [Option<f64>; 2],
    /// Wire code: how well the cells' model is known.
    pub model_state: Option<u8>,
    pub outlook: PackValues,
}

/// Contents of one alarm frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AlarmFields {
    pub rule: u8,
    /// Wire code: 0 inactive, 1 active, 2 cleared, 3 pending, 4 latched, 5 suppressed (raised, but its input is
    /// invalid), 6 unknown.
    pub state: Option<u8>,
    /// Wire code: 1 info, 2 warning, 3 severe; `None` = unknown.
    pub severity: Option<u8>,
    pub test: bool,
    pub acknowledged: bool,
    /// `None` = the whole pack.
    pub cell: Option<CellIndex>,
    /// In the rule's internal unit.
    pub value: Option<f64>,
    /// In the rule's internal unit.
    pub threshold: Option<f64>,
}

/// The next end-to-end counters. They must survive a restart, because a receiver rejects counters that jump back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SendCounters {
    status: u8,
    health: u8,
    alarm: u8,
    digest: u8,
    reply: u8,
}

/// The daemon's frames, prepared for encoding.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    status: OutputMessage,
    health: OutputMessage,
    alarm: OutputMessage,
    pages: Vec<u64>,
    /// `None` = the layout has no digest.
    digest: Option<DigestPlan>,
    reply: Option<OutputMessage>,
    freshness: Option<OutputMessage>,
}

/// Properties of one sent message in a layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SentMessage {
    pub message: LayoutMessage,
    pub id: CanId,
    pub format: FrameFormat,
    pub protection: Option<Protection>,
    pub secoc: Option<Authentication>,
    /// `None` = sent only on an event.
    pub cycle_time_ms: Option<u32>,
}

impl SentMessage {
    /// Data id of the protection or the authentication.
    pub fn data_id(&self) -> Option<u16> {
        self.protection.map(|protection| protection.data_id).or(self.secoc.map(|secoc| secoc.data_id))
    }
}

impl OutputPlan {
    /// Finds every message and signal to send, or names every message or signal that is missing or cannot be encoded.
    pub fn new(database: &Database) -> Result<Self, PlanFaults> {
        let mut faults = Vec::new();
        let mut message = |which: LayoutMessage, required: &[&str]| {
            OutputMessage::new(database, which.message(), required, &mut faults)
        };
        let status_names = STATUS.map(|(name, _)| name);
        let health_names: Vec<&str> =
            HEALTH.iter().map(|(name, _)| *name).chain(OUTLOOK.iter().map(|(name, ..)| *name)).collect();
        let status = message(LayoutMessage::Status, &status_names);
        let health = message(LayoutMessage::Health, &health_names[..HEALTH_REQUIRED]);
        let alarm = message(LayoutMessage::Alarm, &ALARM);
        if let Some(alarm) = &alarm {
            alarm.check_rules(&RULES, &mut faults);
        }
        let digest = alarm.as_ref().and_then(|alarm| DigestPlan::new(database, alarm, &mut faults));
        let reply = reply_message(database, &mut faults);
        let freshness = freshness_message(database, &mut faults);
        match (status, health, alarm) {
            (Some(status), Some(health), Some(alarm)) if faults.is_empty() => {
                let pages = health.page_codes();
                let (status, health) = (status.with_places(&status_names), health.with_places(&health_names));
                Ok(Self { status, health, alarm, pages, digest, reply, freshness })
            }
            _ => Err(PlanFaults(faults)),
        }
    }

    /// Leaves out the pages that contain only energy, time and power.
    #[must_use]
    pub fn without_outlook(mut self) -> Self {
        self.health = self.health.without(|place| place.is_some_and(|place| place >= HEALTH.len()));
        self.pages = self.health.page_codes();
        self
    }

    /// Whether the health frame contains energy, time or power.
    pub fn has_outlook(&self) -> bool {
        self.health.places().any(|place| place >= HEALTH.len())
    }

    /// The sent messages: status, health and alarm, then digest, reply and freshness if the layout has them.
    pub fn messages(&self) -> impl Iterator<Item = SentMessage> + '_ {
        let always = [
            (LayoutMessage::Status, &self.status),
            (LayoutMessage::Health, &self.health),
            (LayoutMessage::Alarm, &self.alarm),
        ];
        let digest = self.digest.iter().map(|digest| (LayoutMessage::Digest, &digest.message));
        let reply = self.reply.iter().map(|reply| (LayoutMessage::Reply, reply));
        let freshness = self.freshness.iter().map(|message| (LayoutMessage::Freshness, message));
        always.into_iter().chain(digest).chain(reply).chain(freshness).map(|(message, plan)| SentMessage {
            message,
            id: plan.id,
            format: plan.format,
            protection: plan.protection,
            secoc: plan.secoc,
            cycle_time_ms: (message != LayoutMessage::Reply).then_some(plan.cycle_time_ms),
        })
    }

    /// Identifiers of the sent messages, in the order of [`messages`](Self::messages).
    pub fn ids(&self) -> Vec<CanId> {
        self.messages().map(|message| message.id).collect()
    }

    /// Advances the counter of a message as if `frames` frames had been sent.
    pub fn skip(&self, message: LayoutMessage, frames: u64, counters: &mut SendCounters) {
        let Some(protection) = self.messages().find(|sent| sent.message == message).and_then(|sent| sent.protection)
        else {
            return;
        };
        let counter = match message {
            LayoutMessage::Status => &mut counters.status,
            LayoutMessage::Health => &mut counters.health,
            LayoutMessage::Alarm => &mut counters.alarm,
            LayoutMessage::Digest => &mut counters.digest,
            LayoutMessage::Reply => &mut counters.reply,
            LayoutMessage::Command | LayoutMessage::Freshness => return,
        };
        let codes = u64::from(protection.profile.max_counter()) + 1;
        let skipped = (u64::from(*counter) + frames % codes) % codes;
        *counter = u8::try_from(skipped).unwrap_or(0);
    }

    /// Authentication of a sent message.
    pub fn authentication(&self, message: LayoutMessage) -> Option<Authentication> {
        match message {
            LayoutMessage::Status => self.status.secoc,
            LayoutMessage::Health => self.health.secoc,
            LayoutMessage::Alarm => self.alarm.secoc,
            LayoutMessage::Digest => self.digest.as_ref()?.message.secoc,
            LayoutMessage::Reply => self.reply.as_ref()?.secoc,
            LayoutMessage::Freshness => self.freshness.as_ref()?.secoc,
            LayoutMessage::Command => None,
        }
    }

    /// Whether the layout has a reply.
    pub fn has_reply(&self) -> bool {
        self.reply.is_some()
    }

    /// Number of pages of the digest; 0 = no digest.
    pub fn digest_pages(&self) -> usize {
        self.digest.as_ref().map_or(0, DigestPlan::page_count)
    }

    /// Number of pages of the health frame, at least 1.
    pub fn health_pages(&self) -> usize {
        self.pages.len()
    }

    /// Encodes the status frame.
    pub fn status(&self, fields: &StatusFields, counters: &mut SendCounters) -> Frame {
        self.status.frame(0, &mut counters.status, |_, place| value_of(&STATUS, fields, place))
    }

    /// Encodes a page of the health frame. `page` counts from 0 and wraps around.
    pub fn health(&self, page: usize, fields: &HealthFields, counters: &mut SendCounters) -> Frame {
        let code = self.pages.get(page % self.pages.len().max(1)).copied().unwrap_or(0);
        self.health.frame(code, &mut counters.health, |_, place| {
            let outlook = place.and_then(|place| OUTLOOK.get(place.checked_sub(HEALTH.len())?));
            match outlook {
                Some((_, quantity, part)) => fields.outlook.part(*quantity, *part),
                None => value_of(&HEALTH, fields, place),
            }
        })
    }

    /// Encodes one alarm. Value and threshold are in the rule's own `Value_...` and `Threshold_...` signals.
    pub fn alarm(&self, fields: &AlarmFields, counters: &mut SendCounters) -> Frame {
        let bit = |set: bool| Some(if set { 1.0 } else { 0.0 });
        self.alarm.frame(u64::from(fields.rule), &mut counters.alarm, |name, _| match name {
            "State" => fields.state.map(f64::from),
            "Severity" => fields.severity.map(f64::from),
            "Test" => bit(fields.test),
            "Acknowledged" => bit(fields.acknowledged),
            "Cell" => fields.cell.map(|cell| f64::from(cell.0)),
            name if name.starts_with("Value_") => fields.value,
            name if name.starts_with("Threshold_") => fields.threshold,
            _ => None,
        })
    }
}

impl OutputPlan {
    /// Encodes a page of the digest, counted from 0; `None` = no such page.
    pub fn digest(&self, page: usize, fields: &DigestFields, counters: &mut SendCounters) -> Option<Frame> {
        self.digest.as_ref()?.frame(page, fields, &mut counters.digest)
    }

    /// The announcement frame, to which the caller adds the freshness.
    pub fn freshness(&self) -> Option<Frame> {
        self.freshness.as_ref().map(|message| message.frame(0, &mut 0, |_, _| None))
    }

    /// Encodes the reply to a command.
    pub fn reply(&self, fields: &ReplyFields, counters: &mut SendCounters) -> Option<Frame> {
        self.reply.as_ref().map(|message| reply_frame(message, fields, &mut counters.reply))
    }
}

/// The announcement message; `None` = the database does not announce the freshness of commands.
fn freshness_message(database: &Database, faults: &mut Vec<String>) -> Option<OutputMessage> {
    let name = LayoutMessage::Freshness.message();
    database.message(name)?.secoc.filter(|secoc| secoc.profile == Profile::Announcement)?;
    OutputMessage::new(database, name, &[], faults)
}

type SignalValue<T> = (&'static str, fn(&T) -> Option<f64>);

fn value_of<T>(signals: &[SignalValue<T>], fields: &T, place: Option<usize>) -> Option<f64> {
    signals.get(place?).and_then(|(_, value)| value(fields))
}

fn mode_code(mode: Mode) -> f64 {
    match mode {
        Mode::Unknown => 0.0,
        Mode::Charge => 1.0,
        Mode::Rest => 2.0,
        Mode::Discharge => 3.0,
    }
}

#[cfg(test)]
mod tests;
