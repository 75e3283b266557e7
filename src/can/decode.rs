//! The plan that turns input frames into readings.
//!
//! Built once from the configured signals; per frame it is a look-up by interface and identifier, a look at the
//! multiplexors, and a shift and a multiply-add per signal. A signal whose multiplexor says that it is not in this
//! payload gives nothing; one that is there but unusable gives a reading with its fault. The same identifier on
//! another interface is another message, and so is the extended identifier of the same number.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::can::dbc::{Message, Signal};
use crate::can::signal::{LayoutFault, SignalPlan};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, CellIndex, Fault};

/// Which temperature sensor, in the order of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SensorIndex(pub u16);

/// What a configured signal feeds. The order is the order in which the readings of one frame are
/// handed on: a voltage triggers the estimator, so current and temperature of the same frame come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// Pack current, A, positive = discharge after the configured sign.
    Current,
    /// A temperature sensor, degrees C.
    Temperature(SensorIndex),
    /// Total pack voltage, V.
    PackVoltage,
    /// One cell's voltage, V.
    CellVoltage(CellIndex),
}

impl Condition {
    fn holds(&self, payload: &[u8]) -> Result<bool, Fault> {
        let code = self.selector.raw(payload)?;
        Ok(self.ranges.iter().any(|&(low, high)| (low..=high).contains(&code)))
    }
}

/// One signal on one interface and what it feeds.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    /// Interface.
    pub bus: BusIndex,
    /// Message.
    pub id: CanId,
    /// Payload length the DBC states, bytes.
    pub len_bytes: u16,
    /// All must hold for the signal to be in the payload.
    pub conditions: Vec<Condition>,
    /// Where it is and how it is scaled.
    pub plan: SignalPlan,
    /// What it feeds.
    pub channel: Channel,
    /// Factor from the DBC's unit and sign to ours, not 0; -1 turns a current that is positive for charging.
    pub scale: f64,
    /// Raw codes that mean "not available".
    pub not_available: Vec<u64>,
}

impl Binding {
    /// Binds a signal of a DBC to a channel. "Not available" codes are those of the DBC's value table.
    ///
    /// # Errors
    /// When the layout of the signal or of one of its multiplexors cannot be read from any payload.
    pub fn new(bus: BusIndex, message: &Message, signal: &Signal, channel: Channel) -> Result<Self, LayoutFault> {
        let conditions = signal.multiplex.conditions.iter().map(|condition| {
            let selector = message.signals[condition.selector].layout.plan()?;
            Ok(Condition { selector, ranges: condition.ranges.clone() })
        });
        Ok(Self {
            bus,
            id: message.id,
            len_bytes: message.len_bytes,
            conditions: conditions.collect::<Result<_, LayoutFault>>()?,
            plan: signal.layout.plan()?,
            channel,
            scale: 1.0,
            not_available: signal.not_available_codes(),
        })
    }

    /// The value in the program's unit and sign, or why there is none.
    fn value(&self, payload: &[u8]) -> Result<f64, Fault> {
        if !self.not_available.is_empty() && self.not_available.contains(&self.plan.raw(payload)?) {
            return Err(Fault::NotAvailable);
        }
        Ok(self.plan.decode(payload)? * self.scale)
    }
}

/// The signals of a message that are in the payload under the same conditions.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Page {
    pub(super) conditions: Vec<Condition>,
    /// In channel order.
    pub(super) bindings: Vec<Binding>,
}

impl Page {
    fn is_present(&self, payload: &[u8]) -> Result<bool, Fault> {
        for condition in &self.conditions {
            if !condition.holds(payload)? {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// One message with what is wanted from it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BoundMessage {
    pub(super) bus: BusIndex,
    pub(super) id: CanId,
    /// Pages in the order of their first channel.
    pub(super) pages: Vec<Page>,
}

/// All configured input signals.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputMap {
    /// Sorted by interface and identifier.
    messages: Vec<BoundMessage>,
}

impl InputMap {
    /// The plan for these signals, in any order.
    pub fn new(mut bindings: Vec<Binding>) -> Self {
        // Stable order whatever the configuration's: by message, then by channel.
        bindings.sort_by_key(|binding| (binding.bus, binding.id, binding.channel));
        let mut messages: Vec<BoundMessage> = Vec::new();
        for binding in bindings {
            if messages.last().is_none_or(|last| (last.bus, last.id) != (binding.bus, binding.id)) {
                messages.push(BoundMessage { bus: binding.bus, id: binding.id, pages: Vec::new() });
            }
            let Some(message) = messages.last_mut() else { continue };
            match message.pages.iter_mut().find(|page| page.conditions == binding.conditions) {
                Some(page) => page.bindings.push(binding),
                None => message.pages.push(Page { conditions: binding.conditions.clone(), bindings: vec![binding] }),
            }
        }
        Self { messages }
    }

    /// Hands on what a frame says, current and temperature before voltages. A frame nobody asked for, and a
    /// remote request, say nothing.
    pub fn decode(&self, bus: BusIndex, frame: &Frame, mut each: impl FnMut(Reading)) {
        if frame.kind() == FrameKind::Remote {
            return;
        }
        let Ok(index) = self.messages.binary_search_by_key(&(bus, frame.id()), |message| (message.bus, message.id))
        else {
            return;
        };
        let payload = frame.data();
        for page in &self.messages[index].pages {
            let present = page.is_present(payload);
            if present == Ok(false) {
                continue;
            }
            for binding in &page.bindings {
                let value = present.and_then(|_| binding.value(payload));
                each(Reading { channel: binding.channel, value });
            }
        }
    }

    /// Identifiers wanted from an interface, for the kernel's filters.
    pub fn ids(&self, bus: BusIndex) -> impl Iterator<Item = CanId> + '_ {
        self.messages.iter().filter(move |message| message.bus == bus).map(|message| message.id)
    }

    /// Every channel that is fed.
    pub fn channels(&self) -> impl Iterator<Item = Channel> + '_ {
        self.messages
            .iter()
            .flat_map(|message| &message.pages)
            .flat_map(|page| page.bindings.iter().map(|binding| binding.channel))
    }

    pub(super) fn messages(&self) -> &[BoundMessage] {
        &self.messages
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::can::dbc::Database;
    use crate::quantity::CellIndex;

    /// Pack current and a multiplexed message of two cells a page.
    pub(crate) const DBC: &str = r#"VERSION ""
BU_: BMS
BO_ 256 Pack: 4 BMS
 SG_ Current : 7|16@0- (0.1,0) [-3000|3000] "A" BMS
 SG_ Temperature : 16|8@1+ (1,-40) [-40|210] "degC" BMS
BO_ 257 Cells: 5 BMS
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" BMS
 SG_ Cell1 m0 : 8|16@1+ (0.001,0) [0|5] "V" BMS
 SG_ Cell2 m0 : 24|16@1+ (0.001,0) [0|5] "V" BMS
 SG_ Cell3 m1 : 8|16@1+ (0.001,0) [0|5] "V" BMS
VAL_ 256 Temperature 255 "not available" ;
"#;

    pub(crate) fn map() -> InputMap {
        let dbc = Database::parse(DBC).expect("parses");
        let bind = |name: &str, channel| {
            let (message, signal) = dbc.signal(name).expect("is there");
            Binding::new(BusIndex(0), message, signal, channel).expect("readable")
        };
        let cell = |n| Channel::CellVoltage(CellIndex(n));
        InputMap::new(vec![
            bind("Cells.Cell3", cell(2)),
            bind("Cells.Cell2", cell(1)),
            bind("Pack.Temperature", Channel::Temperature(SensorIndex(0))),
            bind("Cells.Cell1", cell(0)),
            Binding { scale: -1.0, ..bind("Pack.Current", Channel::Current) },
        ])
    }

    fn read(bus: u8, id: CanId, data: &[u8]) -> Vec<(Channel, Result<f64, Fault>)> {
        let mut readings = Vec::new();
        let frame = Frame::classic(id, data).expect("short enough");
        map().decode(BusIndex(bus), &frame, |reading| readings.push((reading.channel, reading.value)));
        readings
    }

    const PACK: CanId = CanId::Standard(256);
    const CELLS: CanId = CanId::Standard(257);

    #[test]
    fn values_come_in_channel_order_with_the_configured_sign() {
        let found = read(0, PACK, &[0x00, 0x64, 65, 0]);
        assert_eq!(found, [(Channel::Current, Ok(-10.0)), (Channel::Temperature(SensorIndex(0)), Ok(25.0))]);
    }

    #[test]
    fn only_the_page_that_is_there_is_read() {
        let found = read(0, CELLS, &[1, 0x10, 0x0E, 0xFF, 0xFF]);
        assert_eq!(found, [(Channel::CellVoltage(CellIndex(2)), Ok(3.6))]);
        assert_eq!(read(0, CELLS, &[7, 0, 0, 0, 0]), []);
    }

    #[test]
    fn bad_readings_say_why() {
        let found = read(0, PACK, &[0x7F, 0xFF, 255, 0]);
        let values: Vec<_> = found.iter().map(|f| f.1).collect();
        assert_eq!(values, [Err(Fault::OutOfRange), Err(Fault::NotAvailable)]);
        let short = read(0, CELLS, &[0, 0x10, 0x0E]);
        assert_eq!(short.iter().map(|f| f.1).collect::<Vec<_>>(), [Ok(3.6), Err(Fault::ShortFrame)]);
        assert_eq!(read(0, CELLS, &[]).len(), 3);
    }

    #[test]
    fn another_interface_another_kind_of_identifier_and_remote_requests_are_other_things() {
        assert_eq!(read(1, PACK, &[0; 4]), []);
        assert_eq!(read(0, CanId::Extended(256), &[0; 4]), []);
        let mut readings = 0;
        map().decode(BusIndex(0), &Frame::remote(PACK, 4).expect("short"), |_| readings += 1);
        assert_eq!(readings, 0);
    }

    #[test]
    fn wanted_identifiers_are_listed_once_per_interface() {
        assert_eq!(map().ids(BusIndex(0)).collect::<Vec<_>>(), [PACK, CELLS]);
        assert_eq!(map().ids(BusIndex(1)).count(), 0);
    }
}

/// One multiplexor a bound signal depends on: the selector's code must lie in one of the ranges (ends included).
#[derive(Debug, Clone, PartialEq)]
pub struct MuxTest {
    /// Where the selector is.
    pub plan: SignalPlan,
    /// Codes for which the signal is there.
    pub ranges: Vec<(u64, u64)>,
}

/// One configured signal: where it comes from and what it means.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    /// Interface.
    pub bus: BusIndex,
    /// Message.
    pub id: CanId,
    /// Payload length the DBC states (used when frames are made, not when they are read).
    pub len_bytes: u16,
    /// The signal.
    pub plan: SignalPlan,
    /// All must hold; empty = always there.
    pub mux: Vec<MuxTest>,
    /// What it feeds.
    pub channel: Channel,
    /// Applied after the DBC's factor and offset: value x scale + offset (a current whose bus counts charging
    /// positive has scale -1).
    pub scale: f64,
    /// See `scale`.
    pub offset: f64,
    /// Raw codes (the signal's bits) that mean "not available".
    pub not_available: Vec<u64>,
    /// Allowed values after scale and offset, both ends included.
    pub range: (f64, f64),
}

impl Binding {
    /// Binds a DBC signal to a channel: scale 1, offset 0, no range beyond the DBC's, "not available" as the value
    /// table says. The caller changes what the configuration changes.
    ///
    /// # Errors
    /// When the layout of the signal or of one of its multiplexors cannot be read.
    pub fn new(bus: BusIndex, message: &Message, signal: &Signal, channel: Channel) -> Result<Self, LayoutFault> {
        let selectors = signal.multiplex.conditions.iter().filter_map(|condition| {
            let selector = message.signals.get(condition.selector)?;
            Some(selector.layout.plan().map(|plan| MuxTest { plan, ranges: condition.ranges.clone() }))
        });
        Ok(Self {
            bus,
            id: message.id,
            len_bytes: message.len_bytes,
            plan: signal.layout.plan()?,
            mux: selectors.collect::<Result<_, _>>()?,
            channel,
            scale: 1.0,
            offset: 0.0,
            not_available: signal.not_available_codes(),
            range: (f64::NEG_INFINITY, f64::INFINITY),
        })
    }

    /// Whether the payload carries the signal.
    fn holds(&self, payload: &[u8]) -> Result<bool, Fault> {
        for test in &self.mux {
            let code = test.plan.raw(payload)?;
            if !test.ranges.iter().any(|(low, high)| (*low..=*high).contains(&code)) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// The value in the program's unit and sign, or why there is none.
    pub(crate) fn value(&self, payload: &[u8]) -> Result<f64, Fault> {
        if !self.not_available.is_empty() && self.not_available.contains(&self.plan.raw(payload)?) {
            return Err(Fault::NotAvailable);
        }
        let value = self.plan.decode(payload)? * self.scale + self.offset;
        if value >= self.range.0 && value <= self.range.1 { Ok(value) } else { Err(Fault::OutOfRange) }
    }
}

/// All configured signals, found by interface and identifier.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputMap {
    /// Sorted by message, then channel.
    bindings: Vec<Binding>,
    /// Per interface, sorted by identifier: where in `bindings` the message's signals are.
    messages: Vec<Vec<(CanId, Range<usize>)>>,
}

impl InputMap {
    /// Sorts the bindings by message and channel.
    pub fn new(mut bindings: Vec<Binding>) -> Self {
        bindings.sort_by_key(|binding| (binding.bus, binding.id, binding.channel));
        let mut messages: Vec<Vec<(CanId, Range<usize>)>> = Vec::new();
        for (index, binding) in bindings.iter().enumerate() {
            if messages.len() <= binding.bus.index() {
                messages.resize(binding.bus.index() + 1, Vec::new());
            }
            let Some(ids) = messages.get_mut(binding.bus.index()) else { continue };
            match ids.last_mut() {
                Some((id, range)) if *id == binding.id => range.end = index + 1,
                _ => ids.push((binding.id, index..index + 1)),
            }
        }
        Self { bindings, messages }
    }

    /// Hands the readings of one frame to `each`, in the order of [`Channel`]: of multiplexed signals only those
    /// that are there. When a selector cannot be read, every signal that depends on it is a short frame. Frames
    /// that are not configured, and remote frames, give nothing.
    #[inline]
    pub fn decode(&self, bus: BusIndex, frame: &Frame, mut each: impl FnMut(Reading)) {
        let Some(ids) = self.messages.get(bus.index()) else { return };
        let Ok(found) = ids.binary_search_by_key(&frame.id(), |(id, _)| *id) else { return };
        if frame.kind() == FrameKind::Remote {
            return;
        }
        for binding in &self.bindings[ids[found].1.clone()] {
            let value = match binding.holds(frame.data()) {
                Ok(false) => continue,
                Ok(true) => binding.value(frame.data()),
                Err(fault) => Err(fault),
            };
            each(Reading { channel: binding.channel, value });
        }
    }

    /// Identifiers configured on an interface, ascending, for kernel filters.
    pub fn ids(&self, bus: BusIndex) -> Vec<CanId> {
        self.messages.get(bus.index()).map(|ids| ids.iter().map(|(id, _)| *id).collect()).unwrap_or_default()
    }

    /// Every configured channel, ascending, each once.
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
