//! Finds the index of a message by interface and identifier.
//!
//! A look-up needs one memory access for a standard identifier, and a binary search for an extended identifier.

use crate::can::CanId;
use crate::quantity::BusIndex;

const STANDARD_IDS: usize = 0x800;
/// No message.
const NONE: u32 = u32::MAX;

/// Maps interface and identifier to the message's index in the list that was passed to `new`.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct IdTable {
    buses: Vec<BusTable>,
}

#[derive(Debug, Clone, PartialEq)]
struct BusTable {
    /// Index by standard identifier. The table has 8 KiB, but look-ups use only a few cache lines of it.
    standard: Box<[u32; STANDARD_IDS]>,
    /// Sorted.
    others: Vec<(CanId, u32)>,
}

impl BusTable {
    fn new() -> Self {
        Self { standard: Box::new([NONE; STANDARD_IDS]), others: Vec::new() }
    }
}

impl IdTable {
    /// If several messages have the same interface and identifier, the first is used.
    pub(crate) fn new(messages: impl IntoIterator<Item = (BusIndex, CanId)>) -> Self {
        let mut table = Self::default();
        for ((bus, id), number) in messages.into_iter().zip(0..NONE) {
            if table.buses.len() <= bus.index() {
                table.buses.resize_with(bus.index() + 1, BusTable::new);
            }
            table.buses[bus.index()].put(id, number);
        }
        table
    }

    /// Index of the message; at least `u32::MAX` if the message is not in the table.
    #[inline]
    pub(crate) fn number(&self, bus: BusIndex, id: CanId) -> usize {
        let Some(ids) = self.buses.get(bus.index()) else { return usize::MAX };
        let number = match id {
            CanId::Standard(raw) if usize::from(raw) < STANDARD_IDS => ids.standard[usize::from(raw)],
            _ => ids.others.binary_search_by_key(&id, |(id, _)| *id).map_or(NONE, |at| ids.others[at].1),
        };
        // Lossless: `usize` has at least 32 bits on all supported machines.
        number as usize
    }
}

impl BusTable {
    fn put(&mut self, id: CanId, number: u32) {
        match id {
            CanId::Standard(raw) if usize::from(raw) < STANDARD_IDS => {
                let place = &mut self.standard[usize::from(raw)];
                *place = (*place).min(number);
            }
            _ => {
                if let Err(at) = self.others.binary_search_by_key(&id, |(id, _)| *id) {
                    self.others.insert(at, (id, number));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_found_by_bus_kind_and_number() {
        let given = [
            (BusIndex(1), CanId::Extended(0x100)),
            (BusIndex(1), CanId::Standard(0x100)),
            (BusIndex(3), CanId::Standard(0x7FF)),
            (BusIndex(1), CanId::Extended(0x1FFF_FFFF)),
            (BusIndex(1), CanId::Standard(0x100)),
        ];
        let table = IdTable::new(given);
        let numbers: Vec<usize> = (0..given.len()).collect();
        let found = |bus, id| numbers.get(table.number(BusIndex(bus), id)).copied();
        assert_eq!(found(1, CanId::Extended(0x100)), Some(0));
        assert_eq!(found(1, CanId::Standard(0x100)), Some(1), "the first of two entries");
        assert_eq!(found(3, CanId::Standard(0x7FF)), Some(2));
        assert_eq!(found(1, CanId::Extended(0x1FFF_FFFF)), Some(3));
        for (bus, id) in [(0, 0x100), (2, 0x100), (3, 0x100), (9, 0x100), (1, 0)] {
            assert_eq!(found(bus, CanId::Standard(id)), None, "{bus} {id:X}");
        }
        assert_eq!(found(1, CanId::Standard(u16::MAX)), None, "not a valid identifier");
    }
}
