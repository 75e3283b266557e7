//! The frames the daemon sends, as the outgoing DBC lays them out.
//!
//! The shipped `config/packwatch.dbc` is the default; another DBC serves when it has the same message and signal
//! names. An unknown value is sent as the code the DBC's value table calls "not available", else as all ones
//! (unsigned), the lowest code (signed) or NaN (float). A known value never takes that code: it saturates before it.
//!
//! A DBC that lacks something, or in which a value could be read as another rule's or page's, is refused with all its
//! faults at once.

use crate::can::dbc::{Database, DbcError, Message, Signal};
use crate::can::encode::frame_of;
use crate::can::signal::{SignalPlan, ValueType};
use crate::can::{CanId, Frame, MAX_DATA};
use crate::quantity::{CellIndex, Mode};

/// The DBC that ships with the program.
///
/// # Errors
/// Never for the file as shipped (a test reads it).
pub fn default_database() -> Result<Database, DbcError> {
    Database::parse(include_str!("../../../config/packwatch.dbc"))
}

/// Everything an [`OutputPlan`] misses in its DBC, one line each.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct PlanFaults(pub Vec<String>);

/// Signals of the status frame.
const STATUS: [&str; 7] = ["Soc", "SocStd", "Mode", "Validity", "HighestSeverity", "ActiveAlarms", "LimitingCell"];

/// Signals of the health frame, whatever its pages.
const HEALTH: [&str; 8] = [
    "Capacity",
    "CapacityStd",
    "Soh",
    "RechargePeriod",
    "NormalizedRechargePeriod",
    "UsableCapacity",
    "UsableCapacityStd",
    "ResistanceRatio",
];

/// Signals on every page of the alarm frame.
const ALARM: [&str; 5] = ["Rule", "State", "Severity", "Test", "Cell"];

/// The alarm rules in the order of their numbers, which start at 1: each has its `Value_...` and `Threshold_...`, for
/// their units differ.
const RULES: [&str; 6] =
    ["CapacityLow", "UsableCapacityLow", "RechargePeriodLow", "InputMissing", "InputImplausible", "EstimateUntrusted"];

/// Identifiers to send with instead of the DBC's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct IdOverrides {
    /// PACKWATCH_Status.
    pub status: Option<CanId>,
    /// PACKWATCH_Health.
    pub health: Option<CanId>,
    /// PACKWATCH_Alarm.
    pub alarm: Option<CanId>,
}

/// Contents of the status frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StatusFields {
    /// Fraction.
    pub soc: Option<f64>,
    /// Fraction.
    pub soc_std: Option<f64>,
    /// What the pack does.
    pub mode: Option<Mode>,
    /// Code of the wire: 0 unavailable, 1 valid, 2 degraded, 3 untrusted.
    pub validity: u8,
    /// Code of the wire: 0 none, 1 info, 2 warning, 3 severe.
    pub highest_severity: Option<u8>,
    /// Number of active alarms.
    pub active_alarms: Option<u16>,
    /// The cell that limits discharge.
    pub limiting_cell: Option<CellIndex>,
}

/// Contents of all pages of the health frame; `None` = not available.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HealthFields {
    /// Ah.
    pub capacity_ah: Option<f64>,
    /// Ah.
    pub capacity_std_ah: Option<f64>,
    /// Fraction of the rated capacity.
    pub soh: Option<f64>,
    /// s.
    pub recharge_period_s: Option<f64>,
    /// s.
    pub normalized_recharge_period_s: Option<f64>,
    /// Ah.
    pub usable_capacity_ah: Option<f64>,
    /// Ah.
    pub usable_capacity_std_ah: Option<f64>,
    /// Relative to new, 1 = as new.
    pub resistance_ratio: Option<f64>,
}

/// Contents of one alarm frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AlarmFields {
    /// Number of the rule.
    pub rule: u8,
    /// Code of the wire: 0 inactive, 1 active, 2 cleared; `None` = unknown.
    pub state: Option<u8>,
    /// Code of the wire: 1 info, 2 warning, 3 severe; `None` = unknown.
    pub severity: Option<u8>,
    /// A test, not a real alarm.
    pub test: bool,
    /// `None` = the pack as a whole.
    pub cell: Option<CellIndex>,
    /// In the rule's inside unit.
    pub value: Option<f64>,
    /// In the rule's inside unit.
    pub threshold: Option<f64>,
}

/// How to make the daemon's frames.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    status: MessagePlan,
    health: MessagePlan,
    alarm: MessagePlan,
    /// Selector codes of the health frame, ascending.
    pages: Vec<u64>,
}

#[derive(Debug, Clone, PartialEq)]
struct MessagePlan {
    id: CanId,
    len: usize,
    cycle_time_ms: Option<u32>,
    fields: Vec<Field>,
}

#[derive(Debug, Clone, PartialEq)]
struct Field {
    name: String,
    plan: SignalPlan,
    not_available: u64,
    /// 100 where the DBC's unit is %.
    per_inside_unit: f64,
    /// Codes of the message's multiplexor for which the signal is there; empty = always.
    pages: Vec<(u64, u64)>,
    is_multiplexor: bool,
}

impl OutputPlan {
    /// Finds every message and signal the daemon sends.
    ///
    /// # Errors
    /// All that is missing or cannot be written, by name.
    pub fn new(database: &Database, ids: &IdOverrides) -> Result<Self, PlanFaults> {
        let mut faults = Vec::new();
        let status = MessagePlan::new(database, "PACKWATCH_Status", ids.status, &STATUS, &mut faults);
        let health = MessagePlan::new(database, "PACKWATCH_Health", ids.health, &HEALTH, &mut faults);
        let alarm = MessagePlan::new(database, "PACKWATCH_Alarm", ids.alarm, &ALARM, &mut faults);
        if let Some(alarm) = &alarm {
            alarm.check_rules(&mut faults);
        }
        match (status, health, alarm) {
            (Some(status), Some(health), Some(alarm)) if faults.is_empty() => {
                let pages = health.page_codes();
                Ok(Self { status, health, alarm, pages })
            }
            _ => Err(PlanFaults(faults)),
        }
    }

    /// Identifiers of status, health and alarm frame.
    pub fn ids(&self) -> [CanId; 3] {
        [self.status.id, self.health.id, self.alarm.id]
    }

    /// Cycle times the DBC states for status, health and alarm frame, ms.
    pub fn cycle_times_ms(&self) -> [Option<u32>; 3] {
        [self.status.cycle_time_ms, self.health.cycle_time_ms, self.alarm.cycle_time_ms]
    }

    /// Pages the health frame has, at least 1.
    pub fn health_pages(&self) -> usize {
        self.pages.len()
    }

    /// The status frame.
    pub fn status(&self, fields: &StatusFields) -> Frame {
        let mode = fields.mode.map(|mode| match mode {
            Mode::Unknown => 0.0,
            Mode::Charge => 1.0,
            Mode::Rest => 2.0,
            Mode::Discharge => 3.0,
        });
        self.status.frame(0, |name| match name {
            "Soc" => fields.soc,
            "SocStd" => fields.soc_std,
            "Mode" => mode,
            "Validity" => Some(f64::from(fields.validity)),
            "HighestSeverity" => fields.highest_severity.map(f64::from),
            "ActiveAlarms" => fields.active_alarms.map(f64::from),
            "LimitingCell" => fields.limiting_cell.map(|cell| f64::from(cell.0)),
            _ => None,
        })
    }

    /// One page of the health frame, counted from 0; beyond the last it starts again.
    pub fn health(&self, page: usize, fields: &HealthFields) -> Frame {
        let code = self.pages.get(page % self.pages.len().max(1)).copied().unwrap_or(0);
        self.health.frame(code, |name| match name {
            "Capacity" => fields.capacity_ah,
            "CapacityStd" => fields.capacity_std_ah,
            "Soh" => fields.soh,
            "RechargePeriod" => fields.recharge_period_s,
            "NormalizedRechargePeriod" => fields.normalized_recharge_period_s,
            "UsableCapacity" => fields.usable_capacity_ah,
            "UsableCapacityStd" => fields.usable_capacity_std_ah,
            "ResistanceRatio" => fields.resistance_ratio,
            _ => None,
        })
    }

    /// One alarm. Value and threshold go into the rule's own `Value_...` and `Threshold_...`.
    pub fn alarm(&self, fields: &AlarmFields) -> Frame {
        self.alarm.frame(u64::from(fields.rule), |name| match name {
            "State" => fields.state.map(f64::from),
            "Severity" => fields.severity.map(f64::from),
            "Test" => Some(if fields.test { 1.0 } else { 0.0 }),
            "Cell" => fields.cell.map(|cell| f64::from(cell.0)),
            name if name.starts_with("Value_") => fields.value,
            name if name.starts_with("Threshold_") => fields.threshold,
            _ => None,
        })
    }
}

impl MessagePlan {
    fn new(
        database: &Database,
        name: &str,
        id: Option<CanId>,
        required: &[&str],
        faults: &mut Vec<String>,
    ) -> Option<Self> {
        let Some(message) = database.message(name) else {
            faults.push(format!("message {name} is missing"));
            return None;
        };
        if usize::from(message.len_bytes) > MAX_DATA {
            faults.push(format!("message {name}: {} bytes, must be at most {MAX_DATA}", message.len_bytes));
        }
        for signal in required.iter().filter(|signal| message.signal(signal).is_none()) {
            faults.push(format!("signal {name}.{signal} is missing"));
        }
        let fields = message.signals.iter().filter_map(|signal| {
            Field::new(message, signal)
                .map_err(|fault| faults.push(format!("signal {name}.{}: {fault}", signal.name)))
                .ok()
        });
        let fields: Vec<_> = fields.collect();
        check_pages(name, &fields, faults);
        Some(Self {
            id: id.unwrap_or(message.id),
            len: usize::from(message.len_bytes),
            cycle_time_ms: message.cycle_time_ms,
            fields,
        })
    }

    /// Every rule must have its value and its threshold, on its own page and on no other rule's.
    fn check_rules(&self, faults: &mut Vec<String>) {
        if self.fields.iter().any(|field| field.name == "Rule" && !field.is_multiplexor) {
            faults.push("signal PACKWATCH_Alarm.Rule must be the multiplexor (M)".to_owned());
        }
        for (number, rule) in (1..).zip(RULES) {
            for name in [format!("Value_{rule}"), format!("Threshold_{rule}")] {
                let Some(field) = self.fields.iter().find(|field| field.name == name) else {
                    faults.push(format!("signal PACKWATCH_Alarm.{name} is missing"));
                    continue;
                };
                let found: Vec<_> = (1..).take(RULES.len()).filter(|page| field.is_on(*page)).collect();
                if found != [number] {
                    faults.push(format!(
                        "signal PACKWATCH_Alarm.{name} is there for the rules {found:?}, must be for {number} alone"
                    ));
                }
            }
        }
    }

    /// First selector code of every page; a message without pages has the one page 0.
    fn page_codes(&self) -> Vec<u64> {
        let mut codes: Vec<_> = self.fields.iter().filter_map(|field| Some(field.pages.first()?.0)).collect();
        codes.sort_unstable();
        codes.dedup();
        if codes.is_empty() { vec![0] } else { codes }
    }

    fn frame(&self, page: u64, value: impl Fn(&str) -> Option<f64>) -> Frame {
        let mut payload = [0; MAX_DATA];
        for field in self.fields.iter().filter(|field| field.is_on(page)) {
            let code =
                if field.is_multiplexor { page.min(field.plan.all_ones()) } else { field.code(value(&field.name)) };
            // Cannot fail: the plan was checked against the message's length, and the code fits the signal.
            let _ = field.plan.encode_raw(&mut payload, code);
        }
        frame_of(self.id, self.len, &payload).unwrap_or_else(|| empty_frame(self.id))
    }
}

/// The multiplexor must be able to say every page, or a page would go out under another one's number.
fn check_pages(message: &str, fields: &[Field], faults: &mut Vec<String>) {
    for selector in fields.iter().filter(|field| field.is_multiplexor) {
        let highest = selector.plan.all_ones();
        for field in fields.iter().filter(|field| field.pages.iter().any(|(first, _)| *first > highest)) {
            let (name, selector) = (&field.name, &selector.name);
            faults
                .push(format!("signal {message}.{name} is on a page above {highest}, the highest {selector} can say"));
        }
    }
}

/// Never sent: lengths were checked when the plan was made.
fn empty_frame(id: CanId) -> Frame {
    Frame::classic(id, &[]).expect("a classic frame may be empty")
}

impl Field {
    fn new(message: &Message, signal: &Signal) -> Result<Self, String> {
        let plan = signal.layout.plan().map_err(|fault| fault.to_string())?;
        if plan.bytes_needed() > usize::from(message.len_bytes) {
            return Err(format!("reaches past the message's {} bytes", message.len_bytes));
        }
        let pages = match signal.multiplex.conditions.as_slice() {
            [] => Vec::new(),
            [condition] => condition.ranges.clone(),
            _ => return Err("nested multiplexing, must be one multiplexor".to_owned()),
        };
        let customary = match plan.value_type() {
            ValueType::Unsigned => plan.all_ones(),
            ValueType::Signed => 1 << (plan.length_bits() - 1),
            ValueType::Float32 => u64::from(f32::NAN.to_bits()),
            ValueType::Float64 => f64::NAN.to_bits(),
        };
        Ok(Self {
            name: signal.name.clone(),
            plan,
            not_available: signal.not_available_codes().first().copied().unwrap_or(customary),
            per_inside_unit: if signal.unit == "%" { 100.0 } else { 1.0 },
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
            // One bit cannot spare a code.
            Some(code) if code == self.not_available && self.plan.length_bits() > 1 => self.beside(code),
            Some(code) => code,
        }
    }

    /// The code next to one that is taken: one below, or above where there is none below.
    fn beside(&self, taken: u64) -> u64 {
        let lowest = match self.plan.value_type() {
            ValueType::Signed => 1 << (self.plan.length_bits() - 1),
            ValueType::Unsigned | ValueType::Float32 | ValueType::Float64 => 0,
        };
        if taken == lowest { taken + 1 } else { taken.wrapping_sub(1) & self.plan.all_ones() }
    }
}

#[cfg(test)]
mod tests;
