//! Decodes input frames to readings.
//!
//! In: frames. Out: readings in the program's units and signs. A signal that is absent because of its multiplexor gives
//! no reading. A signal that is present but unusable gives a reading with its fault. Each frame needs one look-up by
//! interface and identifier, and one by multiplexor code. Each signal needs a shift and a multiply-add.

mod message_table;
mod parameter_groups;

pub use parameter_groups::{GroupFrame, GroupSenders, ParameterGroups};

use message_table::MessageTable;

use crate::can::dbc::{Message, Signal};
use crate::can::signal::{LayoutFault, SignalPlan};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Fault};

pub use crate::quantity::{Channel, Reading, SensorIndex};

/// Condition for the presence of a signal: the code of a multiplexor (the selector) lies in a range.
#[derive(Debug, Clone, PartialEq)]
pub struct MuxTest {
    pub plan: SignalPlan,
    /// Ranges of codes, ends included.
    pub ranges: Vec<(u64, u64)>,
}

impl MuxTest {
    fn allows(&self, code: u64) -> bool {
        self.ranges.iter().any(|(low, high)| (*low..=*high).contains(&code))
    }
}

/// One configured signal.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    pub bus: BusIndex,
    pub id: CanId,
    /// Whether any frame of the same J1939 parameter group carries the message, whatever its source address and
    /// priority.
    pub of_any_source: bool,
    /// Payload length in the DBC, bytes. Used only to encode frames.
    pub len_bytes: u16,
    pub plan: SignalPlan,
    /// Conditions that must all hold; empty = always present.
    pub mux: Vec<MuxTest>,
    pub channel: Channel,
    /// Applied after the DBC's factor and offset: value x scale + offset. The scale is -1 for a current that is
    /// positive for charging on the bus.
    pub scale: f64,
    pub offset: f64,
    /// Raw codes that mean "not available".
    pub not_available: Vec<u64>,
    /// Allowed values after scale and offset, ends included.
    pub range: (f64, f64),
    /// Values of [`Channel::CurrentDirection`] that mean charging. The reading is -1 for these values and 1 for all
    /// others. If the list is empty, the reading is the value itself.
    pub charge: Vec<f64>,
}

impl Binding {
    /// Binds a DBC signal to a channel, with scale 1, offset 0 and no range except the DBC's. The caller then applies
    /// the configuration. Fails if the layout of the signal or of a multiplexor is invalid.
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

    /// Whether the signal is present. Fails if a selector cannot be decoded.
    pub fn holds(&self, payload: &[u8]) -> Result<bool, Fault> {
        for test in &self.mux {
            let code = test.plan.raw(payload)?;
            if !test.allows(code) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// The value in the program's unit and sign, or the fault that makes it unusable.
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
    bindings: Vec<Binding>,
    messages: MessageTable,
    groups: ParameterGroups,
}

impl InputMap {
    /// Creates the map of these bindings.
    pub fn new(mut bindings: Vec<Binding>) -> Self {
        bindings.sort_by_key(|binding| (binding.bus, binding.id, binding.channel));
        Self { messages: MessageTable::new(&bindings), groups: ParameterGroups::new(&bindings), bindings }
    }

    /// Passes the readings of one frame to `each`, in the order of [`Channel`]. If a selector cannot be decoded, every
    /// signal that depends on it gives a short-frame fault. Remote frames give no readings.
    #[inline]
    pub fn decode(&self, bus: BusIndex, frame: &Frame, each: impl FnMut(Reading)) {
        if frame.kind() != FrameKind::Remote {
            self.messages.decode(&self.bindings, bus, frame, each);
        }
    }

    /// Every configured message: interface, identifier and number of signal groups. A group consists of signals that
    /// are always present together.
    pub fn messages(&self) -> impl Iterator<Item = (BusIndex, CanId, usize)> + '_ {
        self.messages.messages()
    }

    /// Identifiers on an interface, ascending, for kernel filters.
    pub fn ids(&self, bus: BusIndex) -> Vec<CanId> {
        self.messages().filter(|(other, ..)| *other == bus).map(|(_, id, _)| id).collect()
    }

    /// The J1939 messages that are accepted from any source address.
    pub fn groups(&self) -> &ParameterGroups {
        &self.groups
    }

    /// All channels in ascending order.
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
