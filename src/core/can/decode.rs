//! Decodes input frames to readings.
//!
//! The decoding plan is built once from the configured signals. Each frame needs one look-up by interface and
//! identifier, and one by the code of its multiplexor. Each signal needs a shift and a multiply-add. A signal that is
//! absent because of its multiplexor gives no reading. A signal that is present but unusable gives a reading with its
//! fault. A message is identified by its interface, its identifier, and whether the identifier is standard or extended.

mod message_table;
mod parameter_groups;

pub use parameter_groups::{GroupFrame, GroupSenders, ParameterGroups};

use message_table::MessageTable;

use crate::can::dbc::{Message, Signal};
use crate::can::signal::{LayoutFault, SignalPlan};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Fault};

pub use crate::quantity::{Channel, Reading, SensorIndex};

/// Condition for the presence of a configured signal. The code of one multiplexor, the selector, must lie in one of the
/// ranges, ends included.
#[derive(Debug, Clone, PartialEq)]
pub struct MuxTest {
    /// Position of the selector in the payload.
    pub plan: SignalPlan,
    /// Ranges of codes with which the signal is present.
    pub ranges: Vec<(u64, u64)>,
}

impl MuxTest {
    fn allows(&self, code: u64) -> bool {
        self.ranges.iter().any(|(low, high)| (*low..=*high).contains(&code))
    }
}

/// One configured signal: its position, its conversion and its channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    pub bus: BusIndex,
    pub id: CanId,
    /// Whether frames of the same J1939 parameter group carry the message, whatever their source address and priority.
    pub of_any_source: bool,
    /// Payload length in the DBC, bytes. Used to encode frames, not to decode them.
    pub len_bytes: u16,
    pub plan: SignalPlan,
    /// Conditions that must all hold; empty = always present.
    pub mux: Vec<MuxTest>,
    /// Channel of the signal's readings.
    pub channel: Channel,
    /// Applied after the DBC's factor and offset: value x scale + offset. If the current on the bus is positive for
    /// charging, the scale of the current is -1.
    pub scale: f64,
    /// Added after `scale`, in the program's unit.
    pub offset: f64,
    /// Raw codes (the signal's bits) that mean "not available".
    pub not_available: Vec<u64>,
    /// Allowed values after scale and offset, ends included.
    pub range: (f64, f64),
    /// Values that mean charging, for [`Channel::CurrentDirection`]: the reading is -1 for these values, 1 for all
    /// others. Empty = the reading is the value.
    pub charge: Vec<f64>,
}

impl Binding {
    /// Binds a DBC signal to a channel. The scale is 1, the offset is 0, only the DBC limits the range, and the "not
    /// available" codes come from the value table. The caller then applies the configuration.
    ///
    /// # Errors
    /// The layout of the signal or of one of its multiplexors is invalid.
    pub fn new(bus: BusIndex, message: &Message, signal: &Signal, channel: Channel) -> Result<Self, LayoutFault> {
        let selectors = signal.conditions.iter().filter_map(|condition| {
            let selector = message.signals.get(condition.selector)?;
            Some(selector.layout.plan().map(|plan| MuxTest { plan, ranges: condition.ranges.clone() }))
        });
        Ok(Self {
            bus,
            id: message.id,
            of_any_source: false,
            len_bytes: message.len_bytes,
            plan: signal.layout.plan()?,
            mux: selectors.collect::<Result<_, _>>()?,
            channel,
            scale: 1.0,
            offset: 0.0,
            not_available: signal.not_available_codes(),
            range: (f64::NEG_INFINITY, f64::INFINITY),
            charge: Vec::new(),
        })
    }

    /// Whether the payload carries the signal.
    ///
    /// # Errors
    /// A selector cannot be decoded.
    pub fn holds(&self, payload: &[u8]) -> Result<bool, Fault> {
        for test in &self.mux {
            let code = test.plan.raw(payload)?;
            if !test.allows(code) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Decodes the value, in the program's unit and sign.
    ///
    /// # Errors
    /// The fault that makes the value unusable.
    pub fn value(&self, payload: &[u8]) -> Result<f64, Fault> {
        if !self.not_available.is_empty() && self.not_available.contains(&self.plan.raw(payload)?) {
            return Err(Fault::NotAvailable);
        }
        let value = self.plan.decode(payload)? * self.scale + self.offset;
        if !(self.range.0..=self.range.1).contains(&value) {
            return Err(Fault::OutOfRange);
        }
        Ok(match self.charge.as_slice() {
            [] => value,
            charge if charge.contains(&value) => -1.0,
            _ => 1.0,
        })
    }
}

/// All configured signals, indexed by interface and identifier.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputMap {
    /// The bindings, sorted by message, then channel.
    bindings: Vec<Binding>,
    messages: MessageTable,
    groups: ParameterGroups,
}

impl InputMap {
    /// Creates the map; sorts the bindings by message and channel.
    pub fn new(mut bindings: Vec<Binding>) -> Self {
        bindings.sort_by_key(|binding| (binding.bus, binding.id, binding.channel));
        Self { messages: MessageTable::new(&bindings), groups: ParameterGroups::new(&bindings), bindings }
    }

    /// Passes the readings of one frame to `each`, in the order of [`Channel`]. Multiplexed signals that are absent
    /// give no reading. If a selector cannot be decoded, every signal that depends on it gives a short-frame fault.
    /// Frames that are not configured and remote frames give no readings.
    #[inline]
    pub fn decode(&self, bus: BusIndex, frame: &Frame, each: impl FnMut(Reading)) {
        if frame.kind() != FrameKind::Remote {
            self.messages.decode(&self.bindings, bus, frame, each);
        }
    }

    /// Every configured message: interface, identifier and number of signal groups. The signals of a group are always
    /// present together. A message without multiplexer pages has one group; other messages have at least one group per
    /// page.
    pub fn messages(&self) -> impl Iterator<Item = (BusIndex, CanId, usize)> + '_ {
        self.messages.messages()
    }

    /// Identifiers configured on an interface, ascending, for kernel filters.
    pub fn ids(&self, bus: BusIndex) -> Vec<CanId> {
        self.messages().filter(|(other, ..)| *other == bus).map(|(_, id, _)| id).collect()
    }

    /// The messages that frames of any source address carry.
    pub fn groups(&self) -> &ParameterGroups {
        &self.groups
    }

    /// Every configured channel in ascending order.
    pub fn channels(&self) -> Vec<Channel> {
        let mut channels: Vec<_> = self.bindings.iter().map(|binding| binding.channel).collect();
        channels.sort_unstable();
        channels.dedup();
        channels
    }

    /// The bindings, sorted by interface, identifier and channel.
    pub fn bindings(&self) -> &[Binding] {
        &self.bindings
    }
}

#[cfg(test)]
pub(super) mod tests;
