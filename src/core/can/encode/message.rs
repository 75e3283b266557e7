//! Prepares a message of the layout (the DBC of the sent frames) for encoding.
//!
//! In: values by signal name. Out: frames. If a message cannot be encoded, all its faults are reported. The signals of
//! a multiplexed message form pages: a frame contains one page, and the multiplexor signal (selector) names it.

use super::layout::{DEFAULT_PERIOD_MS, HEADER_SIGNALS};
use crate::can::dbc::{Database, FrameFormat, Message, Signal};
use crate::can::e2e::Protection;
use crate::can::frame::is_frame_length;
use crate::can::secoc::Authentication;
use crate::can::signal::{SignalPlan, ValueType};
use crate::can::{CanId, Frame, MAX_DATA};

/// All faults of a DBC, one per line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct PlanFaults(pub Vec<String>);

/// The alarm rules in the order of their numbers, from 1. Each rule has its own `Value_...` and `Threshold_...`
/// signals, because the units differ.
pub(super) const RULES: [&str; 18] = [
    "CapacityLow",
    "UsableCapacityLow",
    "RechargePeriodLow",
    "InputMissing",
    "InputImplausible",
    "EstimateUntrusted",
    "ResistanceHigh",
    "SocLow",
    "TemperatureHigh",
    "CellImbalance",
    "RemainingLifeLow",
    "BmsDisagrees",
    "StoreFailed",
    "BusFault",
    "CellLeak",
    "ConnectionResistance",
    "ChannelFaulty",
    "ThermalEvent",
];

#[derive(Debug, Clone, PartialEq)]
pub(super) struct OutputMessage {
    pub(super) id: CanId,
    pub(super) format: FrameFormat,
    pub(super) protection: Option<Protection>,
    pub(super) secoc: Option<Authentication>,
    pub(super) cycle_time_ms: u32,
    len: usize,
    fields: Vec<OutputField>,
}

#[derive(Debug, Clone, PartialEq)]
struct OutputField {
    name: String,
    /// Index in the list passed to [`OutputMessage::with_places`].
    place: Option<usize>,
    plan: SignalPlan,
    not_available: u64,
    /// Factor from the internal unit: 100 if the DBC's unit is % or %/d, else 1.
    per_inside_unit: f64,
    /// Selector codes with which the signal is present; empty = always.
    pages: Vec<(u64, u64)>,
    is_multiplexor: bool,
}

impl OutputMessage {
    /// Prepares a message, which must have all `required` signals.
    pub(super) fn new(database: &Database, name: &str, required: &[&str], faults: &mut Vec<String>) -> Option<Self> {
        let Some(message) = database.message(name) else {
            faults.push(format!("message {name} is missing"));
            return None;
        };
        check_length(message, faults);
        for signal in required.iter().filter(|signal| message.signal(signal).is_none()) {
            faults.push(format!("signal {name}.{signal} is missing"));
        }
        let is_header = |signal: &&Signal| HEADER_SIGNALS.contains(&signal.name.as_str());
        let fields = message.signals.iter().filter(|signal| !is_header(signal)).filter_map(|signal| {
            OutputField::new(message, signal)
                .map_err(|fault| faults.push(format!("signal {name}.{}: {fault}", signal.name)))
                .ok()
        });
        let fields: Vec<_> = fields.collect();
        check_pages(name, &fields, faults);
        Some(Self {
            id: message.id,
            format: message.format,
            protection: message.e2e,
            secoc: message.secoc,
            cycle_time_ms: message.cycle_time_ms.unwrap_or(DEFAULT_PERIOD_MS),
            len: usize::from(message.len_bytes),
            fields,
        })
    }

    /// Checks that every rule has a value signal and a threshold signal, and that both are on the rule's page only.
    pub(super) fn check_rules(&self, rules: &[&str], faults: &mut Vec<String>) {
        if self.fields.iter().any(|field| field.name == "Rule" && !field.is_multiplexor) {
            faults.push("signal PACKWATCH_Alarm.Rule must be the multiplexor (M)".to_owned());
        }
        for (number, rule) in (1..).zip(rules) {
            for name in [format!("Value_{rule}"), format!("Threshold_{rule}")] {
                let Some(field) = self.fields.iter().find(|field| field.name == name) else {
                    faults.push(format!("signal PACKWATCH_Alarm.{name} is missing"));
                    continue;
                };
                let found: Vec<_> = (1..).take(rules.len()).filter(|page| field.is_on(*page)).collect();
                if found != [number] {
                    faults.push(format!(
                        "signal PACKWATCH_Alarm.{name} is present for rules {found:?}, must be present for rule {number} only"
                    ));
                }
            }
        }
    }

    /// Factor from the internal unit to a signal's unit; 1 if the signal is missing.
    pub(super) fn per_inside_unit(&self, name: &str) -> f64 {
        self.fields.iter().find(|field| field.name == name).map_or(1.0, |field| field.per_inside_unit)
    }

    /// First selector code of every page. A message without pages has only page 0.
    pub(super) fn page_codes(&self) -> Vec<u64> {
        let mut codes: Vec<_> = self.fields.iter().filter_map(|field| Some(field.pages.first()?.0)).collect();
        codes.sort_unstable();
        codes.dedup();
        if codes.is_empty() { vec![0] } else { codes }
    }

    fn data_len(&self) -> usize {
        self.len.saturating_sub(self.secoc.map_or(0, |secoc| secoc.profile.trailer_bytes()))
    }

    /// Stores the index of each signal's name in `names`, so that encoding need not search.
    pub(super) fn with_places(mut self, names: &[&str]) -> Self {
        for field in &mut self.fields {
            field.place = names.iter().position(|name| *name == field.name);
        }
        self
    }

    /// Removes the signals whose [index](Self::with_places) is chosen.
    pub(super) fn without(mut self, is_chosen: impl Fn(Option<usize>) -> bool) -> Self {
        self.fields.retain(|field| !is_chosen(field.place));
        self
    }

    /// The [indices](Self::with_places) of all signals.
    pub(super) fn places(&self) -> impl Iterator<Item = usize> + '_ {
        self.fields.iter().filter_map(|field| field.place)
    }

    /// Encodes a page. `value` returns a signal's value from its name and its [index](Self::with_places). `counter` is
    /// the next end-to-end counter, which this function advances. If the message is authenticated, its trailer is left
    /// 0; the caller fills it in when it knows the freshness.
    pub(super) fn frame(
        &self,
        page: u64,
        counter: &mut u8,
        value: impl Fn(&str, Option<usize>) -> Option<f64>,
    ) -> Frame {
        let mut payload = [0; MAX_DATA];
        for field in self.fields.iter().filter(|field| field.is_on(page)) {
            let code = if field.is_multiplexor {
                page.min(field.plan.all_ones())
            } else {
                field.code(value(&field.name, field.place))
            };
            // Cannot fail: the position was checked, and the code fits.
            let _ = field.plan.encode_raw(&mut payload, code);
        }
        if let (Some(protection), Some(payload)) = (self.protection, payload.get_mut(..self.data_len())) {
            // A counter restored from another profile may exceed this profile's largest counter.
            let now = (*counter).min(protection.profile.max_counter());
            // Cannot fail: length and data id were checked.
            let _ = protection.protect(payload, now);
            *counter = protection.profile.next_counter(now);
        }
        let frame = match self.format {
            FrameFormat::Classic => Frame::classic(self.id, payload.get(..self.len).unwrap_or(&[])),
            FrameFormat::Fd { brs } => Frame::fd_padded(self.id, brs, false, self.len, &payload),
        };
        // The frame always exists, because the length was checked.
        frame.unwrap_or(Frame::empty(self.id))
    }
}

fn check_length(message: &Message, faults: &mut Vec<String>) {
    let (name, len) = (&message.name, usize::from(message.len_bytes));
    if len > MAX_DATA {
        faults.push(format!("message {name}: {len} bytes, must be at most {MAX_DATA}"));
    } else if len > 8 && message.format == FrameFormat::Classic {
        faults.push(format!("message {name}: {len} bytes, must be at most 8 in classic frames"));
    }
    let Some(Protection { profile, data_id }) = message.e2e else { return };
    let (least, most) = (profile.header_bytes(), profile.max_bytes());
    if !(least..=most).contains(&len) || !is_frame_length(len) || data_id > profile.max_data_id() {
        let (word, largest) = (profile.name(), profile.max_data_id());
        faults.push(format!(
            "message {name}: {len} bytes and data id {data_id}, must be a valid frame length of {least} to {most} and at \
             most {largest} with protection {word}"
        ));
    }
}

/// Checks that the multiplexor has a code for every page. Otherwise, a page would be sent with another page's code.
fn check_pages(message: &str, fields: &[OutputField], faults: &mut Vec<String>) {
    for selector in fields.iter().filter(|field| field.is_multiplexor) {
        let highest = selector.plan.all_ones();
        for field in fields.iter().filter(|field| field.pages.iter().any(|(first, _)| *first > highest)) {
            let (name, selector) = (&field.name, &selector.name);
            faults
                .push(format!("signal {message}.{name} is on a page above {highest}, the highest code of {selector}"));
        }
    }
}

impl OutputField {
    fn new(message: &Message, signal: &Signal) -> Result<Self, String> {
        let plan = signal.layout.plan().map_err(|fault| fault.to_string())?;
        if plan.bytes_needed() > usize::from(message.len_bytes) {
            return Err(format!("extends beyond the message's {} bytes", message.len_bytes));
        }
        let pages = match signal.conditions.as_slice() {
            [] => Vec::new(),
            [condition] => condition.ranges.clone(),
            _ => return Err("nested multiplexing, must have a single multiplexor".to_owned()),
        };
        let customary = match plan.value_type() {
            ValueType::Unsigned => plan.all_ones(),
            ValueType::Signed => 1 << (plan.length_bits() - 1),
            ValueType::Float32 => u64::from(f32::NAN.to_bits()),
            ValueType::Float64 => f64::NAN.to_bits(),
        };
        Ok(Self {
            name: signal.name.clone(),
            place: None,
            plan,
            not_available: signal.not_available_codes().first().copied().unwrap_or(customary),
            per_inside_unit: if matches!(signal.unit.as_str(), "%" | "%/d") { 100.0 } else { 1.0 },
            pages,
            is_multiplexor: signal.is_multiplexor,
        })
    }

    fn is_on(&self, page: u64) -> bool {
        self.pages.is_empty() || self.pages.iter().any(|(low, high)| (*low..=*high).contains(&page))
    }

    fn code(&self, value: Option<f64>) -> u64 {
        let code = value.and_then(|value| self.plan.code(value * self.per_inside_unit));
        match code {
            None => self.not_available,
            // The value has the code that means "not available", so a neighbouring code is sent. A signal of one bit
            // has no other code to spare.
            Some(code) if code == self.not_available && self.plan.length_bits() > 1 => self.neighbour(code),
            Some(code) => code,
        }
    }

    /// The code below the "not available" code, or the code above if "not available" is the lowest code.
    fn neighbour(&self, taken: u64) -> u64 {
        let lowest = match self.plan.value_type() {
            ValueType::Signed => 1 << (self.plan.length_bits() - 1),
            ValueType::Unsigned | ValueType::Float32 | ValueType::Float64 => 0,
        };
        if taken == lowest { taken + 1 } else { taken.wrapping_sub(1) & self.plan.all_ones() }
    }
}
