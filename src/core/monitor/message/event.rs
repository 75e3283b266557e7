//! Events of the [`Monitor`](crate::monitor::Monitor). The driver (the program around the core) logs them, and the
//! history records them.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantNames};

use super::command::{Command, Source};
use super::record::BusEvent;
use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::can::decode::Channel;
use crate::can::encode::CommandRefusal;
use crate::can::flood::FloodChange;
use crate::can::guard::GuardChange;
use crate::can::j1939::NodeEvent;
use crate::can::own_frames::OwnIdChange;
use crate::can::poll::PollChange;
use crate::can::rate::SenderChange;
use crate::can::uds::MessageLoss;
use crate::cell::Chemistry;
use crate::cell_faults::CellFault;
use crate::quantity::catalogue::{RecordedPackValues, RecordedValues};
use crate::quantity::{BusIndex, CellIndex, Fault, Mode, Timestamp};

/// Kind of an event, with its data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, IntoStaticStr, VariantNames)]
#[serde(rename_all = "snake_case", tag = "event")]
#[strum(serialize_all = "snake_case")]
pub enum EventKind {
    /// The pack's mode (charge, rest, discharge or unknown) changed.
    Mode {
        /// The mode that ended.
        from: Mode,
        /// The mode that began.
        to: Mode,
    },
    /// A half-cycle (a charge or a discharge) of a cell is complete.
    HalfCycle {
        cell: CellIndex,
        mode: Mode,
        /// Charge moved (Ah), positive.
        charge_ah: f64,
        /// SOC swing, fraction; positive if the SOC rose during a charge or fell during a discharge. `None` if the SOC
        /// at the start or the end was not estimated.
        swing: Option<f64>,
        /// Standard deviation of the swing.
        swing_std: Option<f64>,
        /// Duration (s).
        duration_s: f64,
        /// Mean cell current (A), positive = discharge.
        mean_current_a: f64,
        /// Mean temperature (degrees C); `None` without a temperature reading.
        mean_temperature_c: Option<f64>,
    },
    /// The capacity estimate of a cell was updated after a half-cycle.
    Capacity {
        cell: CellIndex,
        /// Capacity measured by this half-cycle alone (Ah); `None` if the half-cycle contains no usable information.
        measured_ah: Option<f64>,
        /// Standard deviation of the measurement (Ah).
        measured_std_ah: Option<f64>,
        /// The estimates after the update.
        #[serde(flatten)]
        values: RecordedValues,
    },
    /// Lithium and active material that a cell has lost, as fractions of what the model's new cell contains. Sent after
    /// a half-cycle, once the cell's capacity has been measured.
    LossModes {
        cell: CellIndex,
        /// Loss of lithium inventory.
        lli: f64,
        /// Standard deviation of the lithium loss.
        lli_std: f64,
        /// Loss of active material of the negative electrode.
        lam_ne: f64,
        /// Standard deviation of the negative electrode's loss.
        lam_ne_std: f64,
        /// Loss of active material of the positive electrode.
        lam_pe: f64,
        /// Standard deviation of the positive electrode's loss.
        lam_pe_std: f64,
    },
    /// Shortest remaining life of all cells. Sent after a half-cycle while this life is known, and once without values
    /// when it becomes unknown.
    RemainingLife {
        cell: Option<CellIndex>,
        /// Equivalent full cycles until the capacity falls to its end-of-life value, median.
        cycles: Option<f64>,
        /// 5 % quantile of `cycles`.
        cycles_low: Option<f64>,
        /// 95 % quantile of `cycles`.
        cycles_high: Option<f64>,
        /// Days at the recent rate of use, median.
        days: Option<f64>,
        /// 5 % quantile of `days`.
        days_low: Option<f64>,
        /// 95 % quantile of `days`.
        days_high: Option<f64>,
    },
    /// Energy and power of the pack after a half-cycle. Not sent while they are unknown.
    Outlook {
        /// The values at the end of the half-cycle.
        #[serde(flatten)]
        values: RecordedPackValues,
    },
    /// A charge has ended that covered all or enough of the recharge window (a configured SOC range).
    RechargePeriod {
        /// Time between the two ends of the window (s); `None` if the charge did not cover the whole window without
        /// interruption.
        seconds: Option<f64>,
        /// Time that the reference charger would need (s); `None` if the capacity of a cell has not been learned, or if
        /// the charge covered too little of the window.
        normalised_s: Option<f64>,
        /// Standard deviation of the normalised period (s).
        normalised_std_s: Option<f64>,
    },
    /// An alarm changed.
    Alarm {
        rule: Rule,
        /// Index of the cell; `None` = the pack.
        cell: Option<CellIndex>,
        change: Change,
        /// State of the alarm after the change.
        state: AlarmState,
        /// Whether the alarm is raised now.
        active: bool,
        severity: Severity,
        /// The value that the rule compares with the threshold; `None` = unknown.
        value: Option<f64>,
        /// Probability that the true value is beyond the threshold; `None` if the value has no standard deviation.
        probability: Option<f64>,
        threshold: f64,
        /// Number of times the alarm was raised.
        occurrences: u32,
        /// Whether the alarm has been acknowledged since it was raised.
        acknowledged: bool,
    },
    /// A command was executed.
    Command {
        source: Source,
        #[serde(rename = "request")]
        command: Command,
        /// Number of changed alarms.
        changed: u32,
        /// Number of refusals: alarms that cannot be cleared because their values are not healthy, a poll command
        /// without configured requests, or a test without configured output.
        refused: u32,
    },
    /// A command frame was rejected.
    BadCommand {
        /// Interface that received the frame.
        bus: BusIndex,
        /// Whether the frame is intact: its checksum is right, or its authenticator and freshness are right.
        intact: bool,
        /// Reason for the rejection.
        reason: CommandRefusal,
    },
    /// A test of a rule's alarm frame started or ended.
    Test {
        rule: Rule,
        /// Whether the test started.
        running: bool,
    },
    /// Another pack is connected. The event records the last learned capacity of the old pack.
    PackReplaced {
        /// Capacity of the old pack's weakest cell (Ah); `None` if the capacity of a cell was not learned.
        capacity_ah: Option<f64>,
        /// Standard deviation of the capacity (Ah).
        capacity_std_ah: Option<f64>,
    },
    /// A previously connected pack returned, and its learned values were restored.
    PackReturned {
        /// Number of the pack.
        identity: f64,
        /// Capacity of the pack's weakest cell (Ah); `None` if the capacity of a cell has not been learned.
        capacity_ah: Option<f64>,
        /// Standard deviation of the capacity (Ah).
        capacity_std_ah: Option<f64>,
    },
    /// A new configuration applies from this time.
    Reconfigured {
        /// Number of pending, raised or past alarms that ended because the new configuration has no threshold for them.
        alarms_ended: u32,
    },
    /// A stored alarm ended because the configuration no longer has a threshold for it.
    AlarmDropped {
        rule: Rule,
        severity: Severity,
        /// Index of the cell; `None` = the pack.
        cell: Option<CellIndex>,
        /// Whether the alarm was raised.
        active: bool,
        /// Number of times the alarm was raised.
        occurrences: u32,
    },
    /// The identity of the connected pack became known, for the first time or after a change.
    PackIdentity {
        /// Value of the identity signal.
        identity: f64,
    },
    /// Writing the files (learned state and records) started to fail, or works again.
    Store {
        /// Whether the files can be written.
        works: bool,
    },
    /// A signal turned bad. Further bad readings are only counted.
    SignalBad {
        /// The signal.
        channel: Channel,
        /// The fault.
        fault: Fault,
    },
    /// A signal turned good again.
    SignalGood {
        channel: Channel,
        /// Number of bad readings since the signal turned bad.
        bad_readings: u64,
    },
    /// A protected message started to fail the end-to-end check, or became usable again. The result of the first frame
    /// is not reported. Lost frames are reported only if more frames are lost than the check allows.
    Protection(GuardChange),
    /// A message started or stopped exceeding its frame limit.
    Flood(FloodChange),
    /// A second sender of an unprotected input message appeared or disappeared.
    SecondSender(SenderChange),
    /// Another node started or stopped using identifiers of the daemon's frames.
    OwnIdentifier(OwnIdChange),
    /// Diagnostic messages of a controller were lost. Reported at most once a minute; every loss is counted.
    MessageLoss(MessageLoss),
    /// The daemon started or stopped sending diagnostic requests.
    Poll(PollChange),
    /// An interface reported an event.
    Bus {
        /// The interface.
        bus: BusIndex,
        /// The event.
        what: BusEvent,
    },
    /// The J1939 node's address or its trouble codes changed.
    J1939 {
        /// The change.
        what: NodeEvent,
    },
    /// The vehicle fell asleep (all buses are silent and no current flows), or woke up (inputs arrive again).
    BusAsleep {
        /// Whether the vehicle fell asleep.
        asleep: bool,
        /// Duration of the sleep (s); `None` when the vehicle falls asleep.
        seconds: Option<f64>,
    },
    /// Nothing was measured for a while: the computer was asleep, or the log has a gap.
    Gap {
        /// Duration (s); `None` = unknown.
        seconds: Option<f64>,
    },
    /// The driver's clock was set back: the time of an input was more than one second before the latest time.
    TimeBackwards {
        /// Size of the step back (s).
        seconds: f64,
    },
    /// The cell model was learned from the vehicle's data, the previous model is used again, or the data fit another
    /// chemistry better.
    Model {
        /// State of the model after the change.
        state: ModelState,
        /// Capacity of the mean cell (Ah); `None` if nothing was learned.
        capacity_ah: Option<f64>,
        /// Standard deviation of the capacity (Ah).
        capacity_std_ah: Option<f64>,
        /// Root mean square of the residuals (V).
        residual_v: Option<f64>,
        /// The chemistry that explains the voltages better than the label's chemistry.
        chemistry: Option<Chemistry>,
        /// Whether the previous model was better and is used again.
        is_taken_back: bool,
    },
    /// The cell-fault detector has found a fault of a cell, a module or a sensor.
    Finding(CellFault),
    /// A cell's filter failed and was restarted from the cell's voltage.
    FilterReset {
        /// Index of the cell.
        cell: CellIndex,
    },
    /// A cell's estimate became trusted or untrusted.
    Trust {
        cell: CellIndex,
        /// Whether the estimate is trusted: `mean_nis` is at most the consistency limit.
        trusted: bool,
        /// Mean normalised innovation squared over the consistency window. It is higher if the model does not fit
        /// the cell, the current is doubtful, the cell's voltage is frozen, or the estimate is impossible.
        mean_nis: f64,
    },
}

impl EventKind {
    /// Name of the event in event files, summaries and on the screen.
    pub fn name(&self) -> &'static str {
        self.into()
    }

    /// Names of all kinds.
    pub fn names() -> &'static [&'static str] {
        Self::VARIANTS
    }
}

/// State of the cell model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelState {
    /// The model is derived from the label; nothing has been learned yet.
    Prior,
    /// The model is partly learned.
    Learning,
    /// The model is learned, and its remaining uncertainty is small.
    Learned,
    /// The voltages contradict the model: another chemistry explains them better.
    Unfit,
    /// The model comes from a model file; nothing is learned.
    Given,
}

impl ModelState {
    /// Code in CAN frames.
    pub fn code(self) -> u8 {
        match self {
            Self::Prior => 0,
            Self::Learning => 1,
            Self::Learned => 2,
            Self::Unfit => 3,
            Self::Given => 4,
        }
    }
}

/// An event with its time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Time of the input that caused the event.
    pub time: Timestamp,
    #[serde(flatten)]
    pub kind: EventKind,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn event_is_stored_under_its_name() {
        let kinds = [
            EventKind::J1939 { what: NodeEvent::Claimed { address: 128 } },
            EventKind::FilterReset { cell: CellIndex(0) },
            EventKind::BusAsleep { asleep: true, seconds: None },
        ];
        for kind in kinds {
            let stored = serde_json::to_value(kind).expect("a document");
            assert_eq!(stored["event"], kind.name());
        }
    }
}
