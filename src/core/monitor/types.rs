//! What goes into the [`Monitor`](super::Monitor) and what comes out.

use serde::{Deserialize, Serialize};

use crate::alarm::{AlarmInput, Change, Rule, Selector, Severity, State};
use crate::can::decode::Channel;
use crate::can::e2e::Status;
use crate::can::j1939::NodeEvent;
use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, CellIndex, Fault, Mode, Timestamp};

/// What an interface reports besides data frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "bus_event")]
pub enum BusEvent {
    /// The interface is there and up; frames may come.
    Up,
    /// The interface exists but is down.
    Down,
    /// The interface does not exist (missing at start, or removed).
    Missing,
    /// The kernel or a full queue of ours dropped this many frames since the last report.
    Dropped {
        /// Frames lost.
        frames: u64,
    },
    /// An error frame; `class` is the error class mask of the frame's identifier (linux/can/error.h).
    ErrorFrame {
        /// CAN_ERR_* class bits.
        class: u32,
    },
    /// Frames of ours could not be sent (queue full, interface gone).
    SendFailed {
        /// Frames not sent.
        frames: u64,
    },
}

/// One thing that happened, with the driver's time. Inputs come in the order in which they happened; a
/// time a little before the latest one ([`MERGE_TOLERANCE_NS`]: buses merge out of order) is counted and treated as the
/// latest; further back, the clock was set back and how much time passed is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Input<'a> {
    /// A frame was received.
    Frame {
        /// When the kernel received it.
        time: Timestamp,
        /// Where.
        bus: BusIndex,
        /// What.
        frame: &'a Frame,
    },
    /// Time passed. The driver ticks every [`TICK_PERIOD_MS`] while awake; cyclic frames and time-outs follow from ticks.
    Tick {
        /// Now.
        time: Timestamp,
    },
    /// An interface changed or lost something.
    Bus {
        /// When.
        time: Timestamp,
        /// Which.
        bus: BusIndex,
        /// What.
        event: BusEvent,
    },
    /// The record continues at `time`, but how much time really passed is unknown (a log without stamps between its parts).
    UnknownGap {
        /// The stamp from which the record goes on.
        time: Timestamp,
    },
    /// Somebody on this computer asks for something. Commands of the bus are frames.
    Command {
        /// When.
        time: Timestamp,
        /// What.
        command: Command,
    },
    /// Whether the files that keep what is learned and recorded can be written.
    Store {
        /// When.
        time: Timestamp,
        /// They can.
        works: bool,
    },
}

/// How long before the first input a stored state was taken ([`Monitor::restore`](super::Monitor::restore)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Downtime {
    /// As long as the two stamps say. A state that was taken after "now" ([`MERGE_TOLERANCE_NS`] aside) has another clock's
    /// stamp: then nobody knows.
    #[default]
    AsStamped,
    /// This long, s.
    Seconds(f64),
    /// Nobody knows: as after [`Input::UnknownGap`].
    Unknown,
}

/// As in a journal: seconds, `-` for "as stamped", or `unknown`.
impl std::fmt::Display for Downtime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AsStamped => f.write_str("-"),
            Self::Seconds(seconds) => write!(f, "{seconds:?}"),
            Self::Unknown => f.write_str("unknown"),
        }
    }
}

/// What is neither of the three.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("must be seconds, 0 or more, or unknown")]
pub struct DowntimeParseError;

impl std::str::FromStr for Downtime {
    type Err = DowntimeParseError;

    fn from_str(text: &str) -> Result<Self, DowntimeParseError> {
        match text {
            "-" => Ok(Self::AsStamped),
            "unknown" => Ok(Self::Unknown),
            _ => text
                .parse()
                .ok()
                .filter(|s: &f64| s.is_finite() && *s >= 0.0)
                .map(Self::Seconds)
                .ok_or(DowntimeParseError),
        }
    }
}

/// What people may ask of the daemon.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "command")]
pub enum Command {
    /// The alarms were seen.
    Acknowledge(Selector),
    /// Latched alarms end, past ones are forgotten; nothing learned is.
    Clear(Selector),
    /// Another pack is connected: what was learned of the old one does not hold for it.
    PackReplaced,
    /// Send a rule's alarm frame, marked as a test, for a while.
    Test {
        /// Which rule.
        rule: Rule,
        /// How long, s.
        seconds: f64,
    },
}

/// Who asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// Somebody on this computer.
    Local,
    /// A frame.
    Bus(BusIndex),
}

impl Input<'_> {
    /// The driver's time of this input.
    pub fn time(&self) -> Timestamp {
        match *self {
            Input::Frame { time, .. }
            | Input::Tick { time }
            | Input::Bus { time, .. }
            | Input::UnknownGap { time }
            | Input::Command { time, .. }
            | Input::Store { time, .. } => time,
        }
    }
}

/// Period of the driver's ticks, ms: ten times faster than the fastest sensible cyclic frame needs.
pub const TICK_PERIOD_MS: u32 = 10;

/// Steps back in time up to this are frames of several interfaces merged out of order, ns; beyond, the record's
/// clock was set back.
pub const MERGE_TOLERANCE_NS: i64 = 1_000_000_000;

/// A frame to send.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transmit {
    /// Time of the input that caused it.
    pub time: Timestamp,
    /// Where to.
    pub bus: BusIndex,
    /// What.
    pub frame: Frame,
    /// It tells what was learned or what became of an alarm: health, alarm and J1939 frames, all of them, so that frames of
    /// one identifier, and the parts of one transfer, are all of one kind.
    pub announces: bool,
}

/// Validity of the published estimates, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Validity {
    /// No estimate yet, or none any more: a cell's voltage has not come for too long.
    Unavailable = 0,
    /// Inputs fresh, filter consistent.
    Valid = 1,
    /// Current or temperature is stale or implausible: the estimate is coasting and its deviation grows.
    Degraded = 2,
    /// The filter's innovations contradict its covariance.
    Untrusted = 3,
}

/// Something worth a line in a log or a history row. Core events go to the driver, which logs them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event")]
pub enum EventKind {
    /// The pack's mode changed; the new mode held for its minimum duration.
    Mode {
        /// Mode left.
        from: Mode,
        /// Mode entered.
        to: Mode,
    },
    /// One half-cycle of one cell is complete.
    HalfCycle {
        /// Which cell.
        cell: CellIndex,
        /// Charge or discharge.
        mode: Mode,
        /// Charge moved, Ah, positive.
        charge_ah: f64,
        /// SOC swing, fraction, positive; `None` when its beginning was not estimated.
        swing: Option<f64>,
        /// Its standard deviation.
        swing_std: Option<f64>,
        /// Duration, s.
        duration_s: f64,
        /// Mean cell current, A, positive = discharge.
        mean_current_a: f64,
        /// Mean temperature, degrees C; `None` when no sensor was valid.
        mean_temperature_c: Option<f64>,
    },
    /// The capacity filter ran.
    Capacity {
        /// Which cell.
        cell: CellIndex,
        /// What the half-cycle alone says, Ah; `None` = it carried no information.
        measured_ah: Option<f64>,
        /// Its standard deviation, Ah.
        measured_std_ah: Option<f64>,
        /// Estimate after the update, Ah.
        capacity_ah: f64,
        /// Its standard deviation, Ah.
        capacity_std_ah: f64,
        /// Usable capacity at the configured load, Ah.
        usable_capacity_ah: Option<f64>,
        /// Its standard deviation, Ah.
        usable_capacity_std_ah: Option<f64>,
        /// Resistance relative to new.
        resistance_ratio: f64,
        /// Its standard deviation.
        resistance_ratio_std: f64,
    },
    /// A half-cycle is over: what remains of the life of the cell whose life ends first. Told while it is known, and once
    /// when it no longer is (nothing in it, then).
    RemainingLife {
        /// Which cell.
        cell: Option<CellIndex>,
        /// Equivalent full cycles until its capacity passes the end of life, median.
        cycles: Option<f64>,
        /// 5 % quantile.
        cycles_low: Option<f64>,
        /// 95 % quantile.
        cycles_high: Option<f64>,
        /// Days, if it goes on being used as of late, median.
        days: Option<f64>,
        /// 5 % quantile.
        days_low: Option<f64>,
        /// 95 % quantile.
        days_high: Option<f64>,
    },
    /// A charge is over that covered the recharge window, or enough of it to be told.
    RechargePeriod {
        /// Seconds between the two configured SOC values; `None` = it did not cover the whole window in one go.
        seconds: Option<f64>,
        /// Seconds the reference charger would need; `None` = not every cell's capacity was learned yet, or the
        /// charge covered too little.
        normalised_s: Option<f64>,
        /// Its standard deviation, s.
        normalised_std_s: Option<f64>,
    },
    /// Something became of an alarm.
    Alarm {
        /// Which rule.
        rule: Rule,
        /// Which cell; `None` = the pack.
        cell: Option<CellIndex>,
        /// What.
        change: Change,
        /// Where it is in its life now.
        state: State,
        /// Whether it is raised now.
        active: bool,
        /// Its severity.
        severity: Severity,
        /// The value that decided; `None` = unknown.
        value: Option<f64>,
        /// Probability that the truth is beyond the threshold; `None` = the value has no standard deviation.
        probability: Option<f64>,
        /// The threshold it is compared with.
        threshold: f64,
        /// Times it was raised.
        occurrences: u32,
        /// Whether somebody has seen it since.
        acknowledged: bool,
    },
    /// Somebody asked for something.
    Command {
        /// Who.
        source: Source,
        /// What.
        #[serde(rename = "request")]
        command: Command,
        /// Alarms changed.
        changed: u32,
        /// What could not be done: alarms that are not healthy, a test without output.
        refused: u32,
    },
    /// A command frame was not obeyed.
    BadCommand {
        /// Interface it came on.
        bus: BusIndex,
        /// Its protection was in order, what it asks has no meaning; otherwise it failed its check.
        intact: bool,
    },
    /// A test of a rule's alarm frame began or ended.
    Test {
        /// Which rule.
        rule: Rule,
        /// It began.
        running: bool,
    },
    /// Another pack is connected. What was learned of the old one, for the records.
    PackReplaced {
        /// Capacity of its weakest cell, Ah; `None` = nothing was learned.
        capacity_ah: Option<f64>,
        /// Its standard deviation, Ah.
        capacity_std_ah: Option<f64>,
    },
    /// The configuration is another one from here on.
    Reconfigured {
        /// Alarms, raised or past, that ended because no threshold watches them any more.
        alarms_ended: u32,
    },
    /// A stored state has an alarm that no configured threshold watches any more: it is over.
    AlarmDropped {
        /// Which rule.
        rule: Rule,
        /// Its severity.
        severity: Severity,
        /// Which cell; `None` = the pack.
        cell: Option<CellIndex>,
        /// Whether it was raised.
        active: bool,
        /// Times it was raised.
        occurrences: u32,
    },
    /// Which pack is connected is known, for the first time or anew.
    PackIdentity {
        /// As the signal says it.
        identity: f64,
    },
    /// Whether files can be written has changed.
    Store {
        /// They can.
        works: bool,
    },
    /// A signal turned bad (told once per change, then counted).
    SignalBad {
        /// Which signal.
        channel: Channel,
        /// Why.
        fault: Fault,
    },
    /// A signal is good again.
    SignalGood {
        /// Which signal.
        channel: Channel,
        /// Bad readings in between.
        bad_readings: u64,
    },
    /// A protected message turned from usable to failing, or back (told on change, then counted). A first frame, and as many
    /// missing ones as its check allows to be lost, turn nothing.
    Protection {
        /// Which interface.
        bus: BusIndex,
        /// Which message.
        id: CanId,
        /// The status of its check that turned it.
        status: Status,
        /// Whether it is usable from here on.
        usable: bool,
        /// Checks without a usable frame since it was last usable: so far, or when it is back, all of them.
        count: u64,
    },
    /// More frames of one identifier come than are taken in; or no more.
    Flood {
        /// Which interface.
        bus: BusIndex,
        /// Which message.
        id: CanId,
        /// Whether it began.
        active: bool,
        /// Frames dropped in this flood: 1 when it begins, all of them when it ends.
        dropped: u64,
    },
    /// An interface event.
    Bus {
        /// Which interface.
        bus: BusIndex,
        /// What.
        what: BusEvent,
    },
    /// The J1939 node's address or what it tells changed.
    J1939 {
        /// What.
        what: NodeEvent,
    },
    /// Nobody measured for this long (asleep, or the log has a hole).
    Gap {
        /// Seconds; `None` = unknown.
        seconds: Option<f64>,
    },
    /// An input's time was before the latest one.
    TimeBackwards {
        /// By how much, s.
        seconds: f64,
    },
    /// A cell's filter could not go on and started again from its voltage.
    FilterReset {
        /// Which cell.
        cell: CellIndex,
    },
    /// The estimate of a cell can (not) be trusted.
    Trust {
        /// Which cell.
        cell: CellIndex,
        /// Whether its innovations agree with its covariance.
        trusted: bool,
        /// Mean normalised innovation squared over the window.
        mean_nis: f64,
    },
}

/// An event and when it happened.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Time of the input that caused it.
    pub time: Timestamp,
    /// What.
    #[serde(flatten)]
    pub kind: EventKind,
}

/// One cell's estimate after one voltage update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Time of the voltage reading.
    pub time: Timestamp,
    /// Which cell.
    pub cell: CellIndex,
    /// State of charge, fraction.
    pub soc: f64,
    /// Its standard deviation.
    pub soc_std: f64,
    /// Branch voltages, V; NaN beyond the model's branches.
    pub branch_v: [f64; crate::cell::MAX_BRANCHES],
    /// Learned capacity, Ah.
    pub capacity_ah: f64,
    /// Its standard deviation, Ah.
    pub capacity_std_ah: f64,
    /// Resistance relative to new.
    pub resistance_ratio: f64,
    /// Its standard deviation.
    pub resistance_ratio_std: f64,
    /// Measured minus predicted voltage, V.
    pub innovation_v: f64,
    /// Its predicted standard deviation, V.
    pub innovation_std_v: f64,
    /// Whether the reading passed the gate and moved the estimate.
    pub accepted: bool,
    /// The voltage used, V.
    pub voltage_v: f64,
    /// The cell current used, A, positive = discharge.
    pub current_a: f64,
    /// The temperature used, degrees C.
    pub temperature_c: f64,
}

/// Where the Monitor puts what came out; the caller empties it. Reused from input to input, so that the
/// steady state allocates nothing.
#[derive(Debug, Default)]
pub struct Outputs {
    /// Frames to send.
    pub frames: Vec<Transmit>,
    /// Events to log.
    pub events: Vec<Event>,
    /// Estimates, only when `want_estimates`.
    pub estimates: Vec<Estimate>,
    /// Whether anybody wants `estimates`.
    pub want_estimates: bool,
    /// What the alarm engine was told, only when `want_alarm_inputs`; not what a restore or another configuration did to it.
    pub alarm_inputs: Vec<(Timestamp, AlarmInput)>,
    /// Whether anybody wants `alarm_inputs`.
    pub want_alarm_inputs: bool,
}

impl Outputs {
    /// Whether nothing has come out.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty() && self.frames.is_empty() && self.estimates.is_empty() && self.alarm_inputs.is_empty()
    }

    /// Empties the lists, keeps their memory.
    pub fn clear(&mut self) {
        self.frames.clear();
        self.events.clear();
        self.estimates.clear();
        self.alarm_inputs.clear();
    }
}
