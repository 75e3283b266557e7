//! Plan: what `doctor` expects on the buses. It is derived from the parts of the configuration that can be read.

use super::evidence::SignalLabel;
use super::evidence::usage::MAX_REPORTED;
use crate::can::CanId;
use crate::can::decode::Binding;
use crate::can::guard::GuardConfig;
use crate::can::signal::SignalLayout;
use crate::can::uds::Question;
use crate::cell::{CellModel, Chemistry, Label};
use crate::quantity::{BusIndex, Channel};

/// Everything expected on the buses. Parts missing from a broken configuration are not judged.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Configured interfaces in the order of their numbers; frames of other interfaces may also be received.
    pub interfaces: Vec<InterfacePlan>,
    /// Configured signals that were found in a DBC.
    pub signals: Vec<SignalPlan>,
    /// Signals of the DBC that look like voltages of cells beyond `pack.cells`, ordered by cell number.
    pub more_cells: Vec<SignalPlan>,
    /// Signals of the DBC that are not configured but look like the pack's voltage (if cell voltages are configured) or
    /// a state of charge. The binding of each entry names the channel that the signal probably carries. A signal has
    /// one entry per interface.
    pub unconfigured: Vec<SignalPlan>,
    /// The pack.
    pub pack: PackPlan,
    /// Maximum age of a current, of a voltage and of a temperature (s). An older reading is stale; `None` = never
    /// stale.
    pub max_ages_s: [Option<f64>; 3],
    /// Smallest and largest plausible value of current, cell voltage and temperature; infinite = unlimited.
    pub limits: [(f64, f64); 3],
    /// Protected messages.
    pub guards: Vec<GuardConfig>,
    /// Frames that the daemon sends.
    pub outputs: Vec<OutputPlan>,
    /// Messages that carry configured signals.
    pub messages: Vec<MessagePlan>,
    /// Whether the values come from a CSV file with columns in the program's own units. If so, the report proposes no
    /// change of a bus signal's sign.
    pub is_csv: bool,
}

/// The pack and its cells.
#[derive(Debug, Clone, Default)]
pub struct PackPlan {
    /// Cells in series.
    pub cells: u16,
    /// Whether only the total voltage is measured.
    pub is_total: bool,
    /// Parallel strings.
    pub strings: u16,
    /// The cell model; `None` if it cannot be read.
    pub model: Option<CellModel>,
    /// The label of the cell (chemistry and capacity), if the model is derived from it; `None` if the model comes
    /// from a file.
    pub label: Option<Label>,
    /// Capacity of a cell (Ah). If no capacity is configured, the capacity of the model applies.
    pub capacity_ah: f64,
    /// Ambient temperature (degrees C).
    pub ambient_c: f64,
    /// Largest absolute current at which the pack counts as resting (A).
    pub dead_band_a: f64,
    /// Standard deviation of the white noise that the estimator assumes in a voltage reading (V).
    pub voltage_noise_v: f64,
}

/// One interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterfacePlan {
    /// Name of the interface in the kernel.
    pub name: String,
    /// Whether FD frames are accepted.
    pub fd: bool,
}

/// One configured signal.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalPlan {
    /// Position, channel, scale, offset and the codes for "not available".
    pub binding: Binding,
    /// Layout as written in the DBC.
    pub layout: SignalLayout,
    /// Position in a diagnostic answer; `None` for a signal in a frame.
    pub answer: Option<AnswerSource>,
    /// Table of the configuration, for example `input.temperature[3]`.
    pub table: String,
    /// Name of the message in the DBC.
    pub message: String,
    /// Full name in the DBC: `Message.Signal`.
    pub name: String,
    /// Unit in the DBC.
    pub unit: String,
    /// `scale` in the configuration, used to propose a new value.
    pub scale: f64,
    /// `offset` in the configuration.
    pub offset: f64,
}

/// Rounds to two significant digits, because the capacity of a used pack is not exact.
pub(super) fn two_digits(value: f64) -> f64 {
    format!("{value:.1e}").parse().unwrap_or(value)
}

impl PackPlan {
    /// The key of `[pack]` that states the capacity, and its value for cells of `cell_ah` (Ah).
    pub(super) fn capacity_change(&self, cell_ah: f64) -> (&'static str, String) {
        match self.label {
            Some(_) => ("rated_capacity_ah", two_digits(cell_ah).to_string()),
            None => (self.model_change().0, self.model_change().1.to_owned()),
        }
    }

    /// The key of `[pack]` that states the kind of cell, and a description of its value.
    pub(super) fn model_change(&self) -> (&'static str, &'static str) {
        match self.label {
            Some(_) => ("chemistry", "the chemistry on the label of the cell"),
            None => ("cell_model", "the model of the installed cell"),
        }
    }

    /// The key of `[pack]` that states the chemistry, and its value.
    pub(super) fn chemistry_change(&self, chemistry: Chemistry) -> (&'static str, String) {
        match self.label {
            Some(_) => ("chemistry", format!("{:?}", chemistry.name())),
            None => ("cell_model", format!("a model of a cell of {}", chemistry.name())),
        }
    }
}

impl SignalPlan {
    pub(super) fn label(&self) -> SignalLabel {
        let name = self.name.rsplit_once('.').map_or(self.name.as_str(), |(_, name)| name);
        SignalLabel::new(&self.message, name, &self.unit)
    }

    pub(super) fn shares_bits(&self, other: &Self) -> bool {
        let (a, b) = (&self.binding, &other.binding);
        let is_together = (a.bus, a.id, &a.mux) == (b.bus, b.id, &b.mux);
        is_together
            && match (self.answer, other.answer) {
                (None, None) => self.layout.overlaps(&other.layout),
                (Some(a), Some(b)) => {
                    let bits = |answer: AnswerSource, layout: &SignalLayout| {
                        let (first, last) = layout.span();
                        let begin = 8 * answer.first_byte as u64;
                        (begin + u64::from(first), begin + u64::from(last))
                    };
                    let (ours, theirs) = (bits(a, &self.layout), bits(b, &other.layout));
                    a.question == b.question && ours.0 <= theirs.1 && theirs.0 <= ours.1
                }
                (None, Some(_)) | (Some(_), None) => false,
            }
    }
}

/// Position of a signal in a diagnostic answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AnswerSource {
    /// The question that is answered.
    pub question: Question,
    /// First byte of the signal's layout. Byte 0 is the first byte after the service and the identifier, which the
    /// answer repeats.
    pub first_byte: usize,
}

/// One message with configured signals.
#[derive(Debug, Clone, PartialEq)]
pub struct MessagePlan {
    /// Interface.
    pub bus: BusIndex,
    /// Identifier.
    pub id: CanId,
    /// Name in the DBC.
    pub name: String,
    /// Cycle time stated in the DBC (`GenMsgCycleTime`) (s).
    pub cycle_time_s: Option<f64>,
    /// Number of multiplexer pages with configured signals.
    pub pages: usize,
}

/// One frame that the daemon sends.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputPlan {
    /// Interfaces.
    pub buses: Vec<BusIndex>,
    /// Identifier.
    pub id: CanId,
    /// Name of the frame, for example `status`.
    pub name: &'static str,
    /// Table of the frame in the configuration.
    pub table: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Current,
    Voltage,
    Temperature,
    Reported,
}

impl Kind {
    pub(super) fn of(channel: Channel) -> Self {
        match channel {
            Channel::Current => Self::Current,
            Channel::PackVoltage | Channel::CellVoltage(_) => Self::Voltage,
            Channel::Temperature(_) => Self::Temperature,
            Channel::ReportedSoc
            | Channel::ReportedSoh
            | Channel::SupplyVoltage
            | Channel::Balancing(_)
            | Channel::PackIdentity
            | Channel::CurrentDirection
            | Channel::Contactor => Self::Reported,
        }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Current => "current",
            Self::Voltage => "voltage",
            Self::Temperature => "temperature",
            Self::Reported => "reported value",
        }
    }
}

/// A signal in which the pack reports its state of charge or health. `index` is its index in `signals` (if it is
/// configured) or in `unconfigured`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Witness {
    pub(super) is_configured: bool,
    pub(super) index: usize,
}

impl Plan {
    /// The signals in which the pack reports its charge or health, the configured signals first. The record of the
    /// pack's use ([`super::evidence::usage`]) stores their values in the same order.
    pub(super) fn witnesses(&self) -> Vec<Witness> {
        let is_witness =
            |signal: &SignalPlan| matches!(signal.binding.channel, Channel::ReportedSoc | Channel::ReportedSoh);
        let of = |is_configured: bool, signals: &[SignalPlan]| {
            let found = (0..signals.len()).filter(|index| is_witness(&signals[*index]));
            found.map(|index| Witness { is_configured, index }).collect::<Vec<_>>()
        };
        let mut all = of(true, &self.signals);
        all.extend(of(false, &self.unconfigured));
        all.truncate(MAX_REPORTED);
        all
    }

    pub(super) fn witness(&self, Witness { is_configured, index }: Witness) -> &SignalPlan {
        if is_configured { &self.signals[index] } else { &self.unconfigured[index] }
    }

    /// Whether the current is sent as a magnitude and a direction.
    pub(super) fn has_direction(&self) -> bool {
        self.signals.iter().any(|signal| signal.binding.channel == Channel::CurrentDirection)
    }

    /// Maximum age of a reading of the channel (s).
    pub(super) fn max_age_s(&self, channel: Channel) -> f64 {
        self.max_ages_s.get(Kind::of(channel) as usize).copied().flatten().unwrap_or(f64::INFINITY)
    }

    /// Smallest and largest plausible value of the channel, in its unit. `None` = unlimited; limits of 0 and 0 also
    /// mean unlimited.
    pub(super) fn plausible(&self, channel: Channel) -> Option<(f64, f64)> {
        let (low, high) = *self.limits.get(Kind::of(channel) as usize)?;
        let cells = if channel == Channel::PackVoltage { f64::from(self.pack.cells) } else { 1.0 };
        ((low, high) != (0.0, 0.0)).then_some((low * cells, high * cells))
    }
}
