//! Finds the configured message of a J1939 frame by its parameter group.
//!
//! A DBC gives one identifier, with one source address, to a parameter group. On the bus, the source address is the one
//! that the sender has claimed. Such a frame is therefore handled as a frame with the configured identifier. If several
//! configured messages belong to one group, each is found by its own identifier only.

use super::Binding;
use crate::can::j1939::{any_source, parameter_group};
use crate::can::{CanId, Frame};
use crate::quantity::BusIndex;

/// The configured identifier of each parameter group that frames of any source address carry.
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
            .collect();
        groups.sort_unstable();
        groups.dedup();
        let alone = groups.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)).filter_map(|same| match same {
            [(bus, group, id, true)] => Some((*bus, *group, *id)),
            _ => None,
        });
        Self { groups: alone.collect() }
    }

    /// The frame with the identifier of the configured message that it carries; `None` = the frame keeps its
    /// identifier.
    #[inline]
    pub fn configured(&self, bus: BusIndex, frame: &Frame) -> Option<Frame> {
        if self.groups.is_empty() { None } else { self.find(bus, frame.id()).map(|id| frame.with_id(id)) }
    }

    fn find(&self, bus: BusIndex, id: CanId) -> Option<CanId> {
        let group = parameter_group(id)?;
        let place = self.groups.binary_search_by_key(&(bus, group), |&(bus, group, _)| (bus, group)).ok()?;
        Some(self.groups[place].2)
    }

    /// Identifiers and masks of the extended frames that an interface must receive.
    pub fn patterns(&self, bus: BusIndex) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.groups.iter().filter(move |group| group.0 == bus).map(|group| any_source(group.1))
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
        let configured = ParameterGroups::new(bindings).configured(BusIndex(0), &frame)?;
        assert_eq!(configured.data(), frame.data());
        Some(configured.id())
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
        // The group EF00 has a destination, which is not a part of the group's number.
        assert!(found(&[message(0x18EF_FFFE, true)], CanId::Extended(0x18EF_12F4)).is_some());
    }

    #[test]
    fn exact_and_ambiguous_messages_keep_their_identifier() {
        let sent = CanId::Extended(0x18FF_50F4);
        assert_eq!(found(&[message(0x18FF_50FE, false)], sent), None);
        assert_eq!(found(&[message(0x18FF_50F3, true), message(0x18FF_50F4, true)], sent), None);
    }

    #[test]
    fn patterns_pass_any_source_of_group() {
        let groups = ParameterGroups::new(&[message(0x18FF_50FE, true), message(0x18EF_FFFE, true)]);
        let passes = |id: u32| groups.patterns(BusIndex(0)).any(|(wanted, mask)| id & mask == wanted);
        for (id, wanted) in [(0x18FF_50F4, true), (0x0CFF_5000, true), (0x18FF_51F4, false), (0x18EF_12F4, true)] {
            assert_eq!(passes(id), wanted, "{id:X}");
        }
        assert_eq!(groups.patterns(BusIndex(1)).count(), 0);
    }
}
