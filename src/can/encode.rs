//! What the daemon sends, laid out by a DBC; and input frames made from values (CSV replay, simulator).
//!
//! The outgoing layout is whatever the DBC says (`config/packwatch.dbc` is built in): the daemon and its consumers
//! read the same file and cannot disagree. A value that is not known goes out as the signal's "not available" code
//! (the one its value table calls so, else all ones); a value beyond the signal's range goes out as the range's end.

use std::collections::{BTreeMap, HashMap};

use super::dbc::{Database, Message, Signal};
use super::decode::{InputMap, Page};
use super::signal::SignalPlan;
use super::{CanId, Frame, MAX_DATA};
use crate::quantity::{BusIndex, CellIndex, Channel, Mode};

/// The built-in layout of the outgoing frames.
pub const PACKWATCH_DBC: &str = include_str!("../../config/packwatch.dbc");

/// Lengths a CAN FD frame can have beyond 8 bytes.
const FD_LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

/// A data frame of the shortest kind and length that carries `payload`.
fn frame_of(id: CanId, payload: &[u8; MAX_DATA], len: usize) -> Option<Frame> {
    if len <= 8 {
        return Frame::classic(id, &payload[..len]);
    }
    let len = FD_LENGTHS.into_iter().find(|&step| step >= len)?;
    Frame::fd(id, true, false, &payload[..len])
}

/// Makes input frames from channel values, the reverse of [`InputMap::decode`].
#[derive(Debug, Clone)]
pub struct InputEncoder {
    map: InputMap,
}

impl InputEncoder {
    /// For the signals of a plan.
    pub fn new(map: &InputMap) -> Self {
        Self { map: map.clone() }
    }

    /// Appends one frame per message and multiplexor page that has at least one of the given channels. A value that
    /// is absent or NaN goes out as the signal's "not available" code; a signal that has no such code keeps its
    /// whole frame back, for any other code would be a false value. Bits nobody is bound to are 0.
    pub fn encode(&self, values: &[(Channel, Option<f64>)], frames: &mut Vec<(BusIndex, Frame)>) {
        let values: HashMap<Channel, Option<f64>> = values.iter().copied().collect();
        for message in self.map.messages() {
            for page in &message.pages {
                let given = page.bindings.iter().any(|binding| values.contains_key(&binding.channel));
                if let Some(frame) = given.then(|| encode_page(message.id, page, &values)).flatten() {
                    frames.push((message.bus, frame));
                }
            }
        }
    }
}

fn encode_page(id: CanId, page: &Page, values: &HashMap<Channel, Option<f64>>) -> Option<Frame> {
    let len = usize::from(page.bindings.first()?.len_bytes).min(MAX_DATA);
    let mut payload = [0; MAX_DATA];
    for condition in &page.conditions {
        let &(code, _) = condition.ranges.first()?;
        condition.selector.encode_raw(&mut payload[..len], code).ok()?;
    }
    for binding in &page.bindings {
        let value = values.get(&binding.channel).copied().flatten().map(|value| value / binding.scale);
        let code = match value.and_then(|value| binding.plan.code_beyond_range(value)) {
            Some(code) => code,
            None => *binding.not_available.first()?,
        };
        binding.plan.encode_raw(&mut payload[..len], code).ok()?;
    }
    frame_of(id, &payload, len)
}

/// Identifiers of the outgoing frames; `None` = that frame is not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct OutputIds {
    /// Status frame.
    pub status: Option<CanId>,
    /// Health frame.
    pub health: Option<CanId>,
    /// Alarm frame.
    pub alarm: Option<CanId>,
}

/// What the status frame says; `None` = not known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StatusFields {
    /// Pack SOC, fraction.
    pub soc: Option<f64>,
    /// Its standard deviation, fraction.
    pub soc_std: Option<f64>,
    /// Charge, rest or discharge.
    pub mode: Mode,
    /// Code of the validity.
    pub validity: u8,
    /// Code of the highest severity raised, 0 = none.
    pub highest_severity: u8,
    /// Alarms raised.
    pub active_alarms: usize,
    /// Cell that limits the pack.
    pub limiting_cell: Option<CellIndex>,
}

/// What the health frame says; `None` = not known.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HealthFields {
    /// Capacity, Ah.
    pub capacity_ah: Option<f64>,
    /// Its standard deviation, Ah.
    pub capacity_std_ah: Option<f64>,
    /// Capacity over rated capacity, fraction.
    pub soh: Option<f64>,
    /// Recharge period, s.
    pub recharge_period_s: Option<f64>,
    /// The same for a reference charger and temperature, s.
    pub normalized_recharge_period_s: Option<f64>,
    /// Usable capacity, Ah.
    pub usable_capacity_ah: Option<f64>,
    /// Its standard deviation, Ah.
    pub usable_capacity_std_ah: Option<f64>,
    /// Resistance relative to new.
    pub resistance_ratio: Option<f64>,
}

/// What the alarm frame says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlarmFields {
    /// Number of the rule.
    pub rule: u8,
    /// Code of the state.
    pub state: u8,
    /// Code of the severity.
    pub severity: u8,
    /// Which cell; `None` = the pack.
    pub cell: Option<CellIndex>,
    /// The value, in the rule's unit.
    pub value: Option<f64>,
    /// What it is compared with.
    pub threshold: Option<f64>,
}

/// One outgoing signal.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Field {
    plan: SignalPlan,
    not_available: u64,
    /// 100 where the DBC counts in percent what is a fraction inside.
    scale: f64,
}

impl Field {
    fn put(&self, payload: &mut [u8], value: Option<f64>) {
        let code = value.and_then(|value| self.plan.code(value * self.scale)).unwrap_or(self.not_available);
        // The plan fits its message (checked by `OutputPlan::new`), and a code its own bits.
        let _ = self.plan.encode_raw(payload, code);
    }

    /// A number that is a code or a count, not a quantity; beyond the bits: not available.
    fn put_code(&self, payload: &mut [u8], code: Option<u64>) {
        let code = code.filter(|&code| code <= self.plan.all_ones()).unwrap_or(self.not_available);
        let _ = self.plan.encode_raw(payload, code);
    }
}

/// A message with its fields by name.
#[derive(Debug, Clone, PartialEq)]
struct MessagePlan {
    id: CanId,
    len: usize,
    fields: Vec<(&'static str, Field)>,
}

impl MessagePlan {
    fn field(&self, name: &str) -> Option<&Field> {
        self.fields.iter().find(|(known, _)| *known == name).map(|(_, field)| field)
    }

    fn put(&self, payload: &mut [u8; MAX_DATA], name: &str, value: Option<f64>) {
        if let Some(field) = self.field(name) {
            field.put(&mut payload[..self.len], value);
        }
    }

    fn put_code(&self, payload: &mut [u8; MAX_DATA], name: &str, code: Option<u64>) {
        if let Some(field) = self.field(name) {
            field.put_code(&mut payload[..self.len], code);
        }
    }

    fn frame(&self, payload: &[u8; MAX_DATA]) -> Option<Frame> {
        frame_of(self.id, payload, self.len)
    }
}

const STATUS: &str = "PACKWATCH_Status";
const HEALTH: &str = "PACKWATCH_Health";
const ALARM: &str = "PACKWATCH_Alarm";

const STATUS_FIELDS: [&str; 7] =
    ["Soc", "SocStd", "Mode", "Validity", "HighestSeverity", "ActiveAlarms", "LimitingCell"];
const HEALTH_FIELDS: [&str; 8] = [
    "Capacity",
    "CapacityStd",
    "Soh",
    "RechargePeriod",
    "NormalizedRechargePeriod",
    "UsableCapacity",
    "UsableCapacityStd",
    "ResistanceRatio",
];
const ALARM_FIELDS: [&str; 5] = ["Rule", "State", "Severity", "Test", "Cell"];

/// The outgoing frames.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    status: Option<MessagePlan>,
    health: Option<MessagePlan>,
    /// Selector of the health pages and, per page, its code and which fields are on it.
    page_selector: Option<Field>,
    pages: Vec<(u64, Vec<&'static str>)>,
    alarm: Option<MessagePlan>,
    /// Value and threshold of each rule, by the rule's number.
    alarm_values: BTreeMap<u64, (Field, Field)>,
}

impl OutputPlan {
    /// The plan for the messages that have an identifier.
    ///
    /// # Errors
    /// Everything that is missing from the DBC or does not fit its message, one line each.
    pub fn new(dbc: &Database, ids: &OutputIds) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let mut find = |name: &str, id: Option<CanId>| {
            let message = dbc.message(name);
            if id.is_some() && message.is_none() {
                faults.push(format!("message {name} is missing"));
            }
            id.zip(message)
        };
        let status = find(STATUS, ids.status);
        let health = find(HEALTH, ids.health);
        let alarm = find(ALARM, ids.alarm);
        let status = status.map(|(id, message)| message_plan(message, id, &STATUS_FIELDS, &mut faults));
        let pages = health.map(|(_, message)| health_pages(message)).unwrap_or_default();
        let page_selector = health.and_then(|(_, m)| m.signals.iter().find(|s| s.is_multiplexor));
        let page_selector = page_selector.zip(health).and_then(|(s, (_, m))| field(m, s, &mut faults));
        let health = health.map(|(id, message)| message_plan(message, id, &HEALTH_FIELDS, &mut faults));
        let alarm_values = alarm.map(|(_, message)| alarm_values(message, &mut faults)).unwrap_or_default();
        let alarm = alarm.map(|(id, message)| message_plan(message, id, &ALARM_FIELDS, &mut faults));
        let plan = Self { status, health, page_selector, pages, alarm, alarm_values };
        if faults.is_empty() { Ok(plan) } else { Err(faults) }
    }

    /// The status frame; `None` when it has no identifier.
    pub fn status(&self, fields: &StatusFields) -> Option<Frame> {
        let plan = self.status.as_ref()?;
        let mut payload = [0; MAX_DATA];
        plan.put(&mut payload, "Soc", fields.soc);
        plan.put(&mut payload, "SocStd", fields.soc_std);
        let mode = match fields.mode {
            Mode::Unknown => 0,
            Mode::Charge => 1,
            Mode::Rest => 2,
            Mode::Discharge => 3,
        };
        plan.put_code(&mut payload, "Mode", Some(mode));
        plan.put_code(&mut payload, "Validity", Some(u64::from(fields.validity)));
        plan.put_code(&mut payload, "HighestSeverity", Some(u64::from(fields.highest_severity)));
        // More alarms than the field can count: its largest count.
        let count = u32::try_from(fields.active_alarms).unwrap_or(u32::MAX);
        plan.put(&mut payload, "ActiveAlarms", Some(f64::from(count)));
        plan.put_code(&mut payload, "LimitingCell", fields.limiting_cell.map(|cell| u64::from(cell.0)));
        plan.frame(&payload)
    }

    /// How many frames the health message takes.
    pub fn health_pages(&self) -> usize {
        self.pages.len()
    }

    /// One page of the health message; `None` when it has no identifier or no such page.
    pub fn health(&self, page: usize, fields: &HealthFields) -> Option<Frame> {
        let plan = self.health.as_ref()?;
        let (code, names) = self.pages.get(page)?;
        let mut payload = [0; MAX_DATA];
        if let Some(selector) = &self.page_selector {
            selector.put_code(&mut payload[..plan.len], Some(*code));
        }
        for name in names {
            let value = match *name {
                "Capacity" => fields.capacity_ah,
                "CapacityStd" => fields.capacity_std_ah,
                "Soh" => fields.soh,
                "RechargePeriod" => fields.recharge_period_s,
                "NormalizedRechargePeriod" => fields.normalized_recharge_period_s,
                "UsableCapacity" => fields.usable_capacity_ah,
                "UsableCapacityStd" => fields.usable_capacity_std_ah,
                "ResistanceRatio" => fields.resistance_ratio,
                _ => None,
            };
            plan.put(&mut payload, name, value);
        }
        plan.frame(&payload)
    }

    /// Whether the alarm frame has a value and a threshold for a rule (always, when it has no identifier).
    pub fn knows_rule(&self, rule: u8) -> bool {
        self.alarm.is_none() || self.alarm_values.contains_key(&u64::from(rule))
    }

    /// The alarm frame; `None` when it has no identifier.
    pub fn alarm(&self, fields: &AlarmFields) -> Option<Frame> {
        let plan = self.alarm.as_ref()?;
        let mut payload = [0; MAX_DATA];
        plan.put_code(&mut payload, "Rule", Some(u64::from(fields.rule)));
        plan.put_code(&mut payload, "State", Some(u64::from(fields.state)));
        plan.put_code(&mut payload, "Severity", Some(u64::from(fields.severity)));
        plan.put_code(&mut payload, "Test", Some(0));
        plan.put_code(&mut payload, "Cell", fields.cell.map(|cell| u64::from(cell.0)));
        if let Some((value, threshold)) = self.alarm_values.get(&u64::from(fields.rule)) {
            value.put(&mut payload[..plan.len], fields.value);
            threshold.put(&mut payload[..plan.len], fields.threshold);
        }
        plan.frame(&payload)
    }
}

fn message_plan(message: &Message, id: CanId, names: &[&'static str], faults: &mut Vec<String>) -> MessagePlan {
    let len = usize::from(message.len_bytes);
    if len > MAX_DATA {
        faults.push(format!("message {} has {len} bytes, a frame carries at most {MAX_DATA}", message.name));
    }
    let mut fields = Vec::with_capacity(names.len());
    for &name in names {
        match message.signal(name) {
            Some(signal) => fields.extend(field(message, signal, faults).map(|field| (name, field))),
            None => faults.push(format!("signal {}.{name} is missing", message.name)),
        }
    }
    MessagePlan { id, len: len.min(MAX_DATA), fields }
}

fn field(message: &Message, signal: &Signal, faults: &mut Vec<String>) -> Option<Field> {
    let plan =
        signal.layout.plan().map_err(|fault| faults.push(format!("signal {}.{}: {fault}", message.name, signal.name)));
    let plan = plan.ok()?;
    if plan.bytes_needed() > usize::from(message.len_bytes) {
        faults.push(format!(
            "signal {}.{} reaches past its message's {} bytes",
            message.name, signal.name, message.len_bytes
        ));
        return None;
    }
    let not_available = signal.not_available_codes().first().copied().unwrap_or(plan.all_ones());
    let scale = if signal.unit == "%" { 100.0 } else { 1.0 };
    Some(Field { plan, not_available, scale })
}

/// The selector's code under which a signal is in the payload, when it is under just one.
fn page_of(signal: &Signal) -> Option<u64> {
    signal.multiplex.conditions.first()?.ranges.first().map(|&(low, _)| low)
}

/// Codes of the health pages and the fields on each; one page without a selector when nothing is multiplexed.
fn health_pages(message: &Message) -> Vec<(u64, Vec<&'static str>)> {
    let mut pages: BTreeMap<u64, Vec<&'static str>> = BTreeMap::new();
    for name in HEALTH_FIELDS {
        if let Some(signal) = message.signal(name) {
            pages.entry(page_of(signal).unwrap_or(0)).or_default().push(name);
        }
    }
    pages.into_iter().collect()
}

/// The signals `Value_*` and `Threshold_*` of every rule, by the multiplexor's code.
fn alarm_values(message: &Message, faults: &mut Vec<String>) -> BTreeMap<u64, (Field, Field)> {
    let mut found = BTreeMap::new();
    for value in message.signals.iter().filter(|signal| signal.name.starts_with("Value_")) {
        let threshold_name = value.name.replacen("Value_", "Threshold_", 1);
        let Some(threshold) = message.signal(&threshold_name) else {
            faults.push(format!("signal {}.{threshold_name} is missing", message.name));
            continue;
        };
        let fields = field(message, value, faults).zip(field(message, threshold, faults));
        found.extend(page_of(value).zip(fields));
    }
    found
}

#[cfg(test)]
mod tests;
