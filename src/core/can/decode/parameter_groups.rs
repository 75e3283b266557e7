//! Finds the configured message of a J1939 frame by its parameter group.
//!
//! A DBC gives a parameter group one identifier, which includes a source address. On the bus, a frame has the source
//! address that its sender has claimed. The frame is therefore handled as a frame with the configured identifier.
//! Exceptions are groups with several configured messages, and groups with a destination address, such as EF00, which
//! any node uses for its own purposes.
//!
//! If several packs on one bus send the same group, only the frames of one pack are used ([`GroupSenders`]).

use super::Binding;
use crate::can::j1939::{any_source, has_destination, parameter_group};
use crate::can::{CanId, Frame};
use crate::quantity::{BusIndex, Timestamp};

/// If the sender of a group is silent for this time (s), another sender is used. The slowest usual group sends five
/// frames in this time.
const SILENT_S: f64 = 5.0;

/// Configured identifiers of the parameter groups that are accepted from any source address.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParameterGroups {
    /// Interface, parameter group number, configured identifier; sorted.
    groups: Vec<(BusIndex, u32, CanId)>,
}

impl ParameterGroups {
    /// Collects the groups of the bindings.
    pub fn new<'b>(bindings: impl IntoIterator<Item = &'b Binding>) -> Self {
        let mut groups: Vec<_> = bindings
            .into_iter()
            .filter_map(|of| Some((of.bus, parameter_group(of.id)?, of.id, of.of_any_source)))
            .filter(|(_, group, ..)| !has_destination(*group))
            .collect();
        groups.sort_unstable();
        groups.dedup();
        let alone = groups.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)).filter_map(|same| match same {
            [(bus, group, id, true)] => Some((*bus, *group, *id)),
            _ => None,
        });
        Self { groups: alone.collect() }
    }

    /// Finds the configured message of a frame received at `now`.
    #[inline]
    pub fn configured(&self, now: Timestamp, bus: BusIndex, frame: &Frame, senders: &mut GroupSenders) -> GroupFrame {
        if self.groups.is_empty() {
            return GroupFrame::Other;
        }
        match self.find(bus, frame.id()) {
            None => GroupFrame::Other,
            Some(id) if senders.is_chosen(now, bus, id, frame.id()) => GroupFrame::Configured(frame.with_id(id)),
            Some(_) => GroupFrame::OfAnotherSender,
        }
    }

    fn find(&self, bus: BusIndex, id: CanId) -> Option<CanId> {
        let group = parameter_group(id)?;
        let place = self.groups.binary_search_by_key(&(bus, group), |&(bus, group, _)| (bus, group)).ok()?;
        Some(self.groups[place].2)
    }

    /// Whether this configured message is accepted from any source address.
    pub fn has_any_source(&self, bus: BusIndex, id: CanId) -> bool {
        self.find(bus, id) == Some(id)
    }

    /// Identifiers and masks of the extended frames to receive.
    pub fn patterns(&self, bus: BusIndex) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.groups.iter().filter(move |group| group.0 == bus).map(|group| any_source(group.1))
    }
}

/// A received frame, compared with the configured groups.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GroupFrame {
    /// The frame does not belong to a configured group and keeps its identifier.
    Other,
    /// The frame with the identifier of the configured message.
    Configured(Frame),
    /// The frame belongs to a configured group, but its sender is not used.
    OfAnotherSender,
}

/// The sender that is used for each group. It is the first address that sends the group, or the configured source
/// address as soon as this address sends the group. If the sender is silent for 5 s, for example because it claimed a
/// new address, an address that was never heard before replaces it. An address that has already sent the group belongs
/// to another node, so it does not replace the sender.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GroupSenders {
    chosen: Vec<ChosenSender>,
}

#[derive(Debug, Clone, PartialEq)]
struct ChosenSender {
    bus: BusIndex,
    configured: CanId,
    source: u8,
    latest: Timestamp,
    /// Bit `n % 64` of word `n / 64`: address `n` belongs to another node.
    others: [u64; 4],
}

impl GroupSenders {
    fn is_chosen(&mut self, now: Timestamp, bus: BusIndex, configured: CanId, sent: CanId) -> bool {
        let address = |id: CanId| id.raw().to_le_bytes()[0];
        let source = address(sent);
        let Some(chosen) = self.chosen.iter_mut().find(|known| (known.bus, known.configured) == (bus, configured))
        else {
            self.chosen.push(ChosenSender { bus, configured, source, latest: now, others: [0; 4] });
            return true;
        };
        let is_heard = chosen.others[usize::from(source / 64)] & 1 << (source % 64) != 0;
        let is_silent = now.since(chosen.latest) > SILENT_S;
        let is_used = source == chosen.source || source == address(configured) || is_silent && !is_heard;
        let other = if is_used { std::mem::replace(&mut chosen.source, source) } else { source };
        if other != chosen.source {
            chosen.others[usize::from(other / 64)] |= 1 << (other % 64);
        }
        if is_used {
            chosen.latest = now;
        }
        is_used
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::decode::tests::{bind, cell};

    fn message(id: u32, of_any_source: bool) -> Binding {
        Binding { id: CanId::Extended(id), of_any_source, ..bind("Cells.Cell1", cell(0)) }
    }

    fn found(bindings: &[Binding], id: CanId) -> Option<CanId> {
        let frame = Frame::classic(id, &[1, 2]).unwrap();
        let (now, mut senders) = (Timestamp::from_secs(0.0), GroupSenders::default());
        match ParameterGroups::new(bindings).configured(now, BusIndex(0), &frame, &mut senders) {
            GroupFrame::Configured(configured) => {
                assert_eq!(configured.data(), frame.data());
                Some(configured.id())
            }
            GroupFrame::Other => None,
            GroupFrame::OfAnotherSender => panic!("no sender was chosen"),
        }
    }

    #[test]
    fn one_sender_of_group_is_used() {
        let groups = ParameterGroups::new(&[message(0x18FF_50FE, true)]);
        let mut senders = GroupSenders::default();
        let mut is_used = |(time_s, id): (f64, u32)| {
            let frame = Frame::classic(CanId::Extended(id), &[1]).unwrap();
            let found = groups.configured(Timestamp::from_secs(time_s), BusIndex(0), &frame, &mut senders);
            matches!(found, GroupFrame::Configured(_))
        };
        let [a, b, c, d, later, configured] = [0xF3, 0xF4, 0x80, 0x81, 0x82, 0xFE].map(|source| 0x18FF_5000 + source);
        // The first sender is used until it is silent for 5 s, or until the configured address sends.
        assert_eq!([(0.0, a), (1.0, b), (2.0, a), (6.9, c)].map(&mut is_used), [true, false, true, false]);
        assert_eq!([(8.0, b), (8.1, c)].map(&mut is_used), [false, false], "other nodes that were heard before");
        assert_eq!([(8.2, d), (8.3, a)].map(&mut is_used), [true, false], "the sender has claimed a new address");
        assert_eq!([(9.0, configured), (10.0, b), (11.0, configured)].map(&mut is_used), [true, false, true]);
        assert_eq!([(17.0, d), (17.1, later)].map(&mut is_used), [false, true]);
    }

    #[test]
    fn group_is_found_from_any_source_and_priority() {
        let (any, id) = (message(0x18FF_50FE, true), CanId::Extended(0x18FF_50FE));
        for sent in [0x18FF_50F4, 0x18FF_50FE, 0x0CFF_5000] {
            assert_eq!(found(std::slice::from_ref(&any), CanId::Extended(sent)), Some(id), "{sent:X}");
        }
        for sent in [CanId::Extended(0x18FF_51F4), CanId::Extended(0x19FF_50F4), CanId::Standard(0x4FE)] {
            assert_eq!(found(std::slice::from_ref(&any), sent), None, "{sent}");
        }
        // Any node may use the group EF00.
        assert_eq!(found(&[message(0x18EF_21FE, true)], CanId::Extended(0x18EF_21F4)), None);
    }

    #[test]
    fn exact_and_ambiguous_messages_keep_their_identifier() {
        let sent = CanId::Extended(0x18FF_50F4);
        assert_eq!(found(&[message(0x18FF_50FE, false)], sent), None);
        assert_eq!(found(&[message(0x18FF_50F3, true), message(0x18FF_50F4, true)], sent), None);
    }

    #[test]
    fn patterns_pass_any_source_of_group() {
        let groups = ParameterGroups::new(&[message(0x18FF_50FE, true), message(0x18EF_21FE, true)]);
        let passes = |id: u32| groups.patterns(BusIndex(0)).any(|(wanted, mask)| id & mask == wanted);
        for (id, wanted) in [(0x18FF_50F4, true), (0x0CFF_5000, true), (0x18FF_51F4, false), (0x18EF_21F4, false)] {
            assert_eq!(passes(id), wanted, "{id:X}");
        }
        assert_eq!(groups.patterns(BusIndex(1)).count(), 0);
    }
}
