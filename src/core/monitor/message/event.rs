//! Events of the [`Monitor`](crate::monitor::Monitor): what the driver logs and the history records.

use serde::{Deserialize, Serialize};
use strum::IntoStaticStr;

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
use crate::quantity::catalogue::RecordedValues;
use crate::quantity::{BusIndex, CellIndex, Fault, Mode, Timestamp};

/// Something worth a line in a log or a history row. Core events go to the driver, which logs them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, IntoStaticStr)]
#[serde(rename_all = "snake_case", tag = "event")]
#[strum(serialize_all = "snake_case")]
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
        /// Measurement by the half-cycle alone, Ah; `None` = it carried no information.
        measured_ah: Option<f64>,
        /// Its standard deviation, Ah.
        measured_std_ah: Option<f64>,
        /// The estimates after it.
        #[serde(flatten)]
        values: RecordedValues,
    },
    /// What a cell has lost, after a half-cycle, once its capacity was measured; parts of the model's new cell.
    LossModes {
        /// Which cell.
        cell: CellIndex,
        /// Loss of lithium inventory.
        lli: f64,
        /// Its standard deviation.
        lli_std: f64,
        /// Loss of active material of the negative electrode.
        lam_ne: f64,
        /// Its standard deviation.
        lam_ne_std: f64,
        /// Loss of active material of the positive electrode.
        lam_pe: f64,
        /// Its standard deviation.
        lam_pe_std: f64,
    },
    /// Remaining life after a half-cycle, of the cell whose life ends first. Sent while it is known, and once, without any
    /// value, when it no longer is.
    RemainingLife {
        /// Which cell.
        cell: Option<CellIndex>,
        /// Equivalent full cycles until its capacity passes the end of life, median.
        cycles: Option<f64>,
        /// 5 % quantile.
        cycles_low: Option<f64>,
        /// 95 % quantile.
        cycles_high: Option<f64>,
        /// Days, with the use of the recent past, median.
        days: Option<f64>,
        /// 5 % quantile.
        days_low: Option<f64>,
        /// 95 % quantile.
        days_high: Option<f64>,
    },
    /// End of a charge that covered the recharge window, or enough of it.
    RechargePeriod {
        /// Seconds between the two configured SOC values; `None` = it did not cover the whole window in one go.
        seconds: Option<f64>,
        /// Seconds the reference charger would need; `None` = not every cell's capacity was learned yet, or the
        /// charge covered too little.
        normalised_s: Option<f64>,
        /// Its standard deviation, s.
        normalised_std_s: Option<f64>,
    },
    /// An alarm changed.
    Alarm {
        /// Which rule.
        rule: Rule,
        /// Which cell; `None` = the pack.
        cell: Option<CellIndex>,
        /// The change.
        change: Change,
        /// Its state now.
        state: AlarmState,
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
        /// Whether it has been acknowledged since.
        acknowledged: bool,
    },
    /// A command was executed.
    Command {
        /// Its origin.
        source: Source,
        /// The command.
        #[serde(rename = "request")]
        command: Command,
        /// Alarms changed.
        changed: u32,
        /// What was refused: alarms that are not healthy, a test without output.
        refused: u32,
    },
    /// A command frame was rejected.
    BadCommand {
        /// Interface it came on.
        bus: BusIndex,
        /// Its checksum was right.
        intact: bool,
        /// Why it was rejected.
        reason: CommandRefusal,
    },
    /// A test of a rule's alarm frame began or ended.
    Test {
        /// Which rule.
        rule: Rule,
        /// It began.
        running: bool,
    },
    /// Another pack is connected. Last values learned of the old one, for the records.
    PackReplaced {
        /// Capacity of its weakest cell, Ah; `None` = nothing was learned.
        capacity_ah: Option<f64>,
        /// Its standard deviation, Ah.
        capacity_std_ah: Option<f64>,
    },
    /// A pack that was connected before came back: what was learned of it is restored.
    PackReturned {
        /// Its number.
        identity: f64,
        /// Capacity of its weakest cell, Ah; `None` = not of every cell known.
        capacity_ah: Option<f64>,
        /// Its standard deviation, Ah.
        capacity_std_ah: Option<f64>,
    },
    /// Another configuration holds from here on.
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
    /// The identity of the connected pack is known, for the first time or after a change.
    PackIdentity {
        /// As the signal says it.
        identity: f64,
    },
    /// Whether files can be written has changed.
    Store {
        /// They can.
        works: bool,
    },
    /// A signal turned bad (reported once per change, then counted).
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
    /// A protected message turned from usable to failing, or back (reported on change, then counted). A first frame, and as many
    /// missing ones as its check allows to be lost, turn nothing.
    Protection(GuardChange),
    /// More frames of one identifier come than the limit allows; or no more.
    Flood(FloodChange),
    /// A second sender of an unprotected input message was found, or is gone.
    SecondSender(SenderChange),
    /// Another sender uses our own identifiers, or does no more.
    OwnIdentifier(OwnIdChange),
    /// Diagnostic messages of a controller were lost (reported at most once a minute, all are counted).
    MessageLoss(MessageLoss),
    /// Diagnostic requests are sent, or no more.
    Poll(PollChange),
    /// An interface event.
    Bus {
        /// Which interface.
        bus: BusIndex,
        /// Its report.
        what: BusEvent,
    },
    /// The J1939 node's address or its trouble codes changed.
    J1939 {
        /// The change.
        what: NodeEvent,
    },
    /// The buses fell silent as a whole while no current flowed, or carry inputs again: the vehicle sleeps.
    BusAsleep {
        /// They sleep from now on.
        asleep: bool,
        /// How long they slept, s, when they wake.
        seconds: Option<f64>,
    },
    /// Nothing was measured for this long (asleep, or the log has a hole).
    Gap {
        /// Seconds; `None` = unknown.
        seconds: Option<f64>,
    },
    /// An input's time was before the latest one.
    TimeBackwards {
        /// By how much, s.
        seconds: f64,
    },
    /// The model of the cells was learned from what the vehicle noted of them; or it turned out that it cannot be.
    Model {
        /// How well it is known now.
        state: ModelState,
        /// Capacity of the mean cell, Ah; `None` = nothing was learned.
        capacity_ah: Option<f64>,
        /// Its standard deviation, Ah.
        capacity_std_ah: Option<f64>,
        /// Root mean square of the residuals, V.
        residual_v: Option<f64>,
        /// The chemistry that explains the voltages better than that on the label.
        chemistry: Option<Chemistry>,
        /// The model before was the better one and holds again.
        is_taken_back: bool,
    },
    /// A cell stands out from its pack in a way that shows what is wrong with it.
    Finding(CellFault),
    /// A cell's filter failed and started again from its voltage.
    FilterReset {
        /// Which cell.
        cell: CellIndex,
    },
    /// The estimate of a cell can (not) be trusted.
    Trust {
        /// Which cell.
        cell: CellIndex,
        /// Whether its innovations agree with its covariance, and its model is not another cell's.
        trusted: bool,
        /// Mean normalised innovation squared over the window; for a model of another cell its mismatch in the same scale.
        mean_nis: f64,
    },
}

impl EventKind {
    /// Its name, everywhere: in files of events, in summaries, on the screen.
    pub fn name(&self) -> &'static str {
        self.into()
    }
}

/// How well the model of the cells is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelState {
    /// That of the label: nothing is learned yet.
    Prior,
    /// Learned in part.
    Learning,
    /// Learned: what is left unknown is small.
    Learned,
    /// The voltages contradict it: another chemistry explains them better.
    Unfit,
    /// From a model file: nothing is learned.
    Given,
}

impl ModelState {
    /// Its code of the wire.
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

/// An event and when it happened.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Time of the input that caused it.
    pub time: Timestamp,
    /// The event.
    #[serde(flatten)]
    pub kind: EventKind,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_is_stored_under_its_name() {
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
