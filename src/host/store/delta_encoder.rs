//! Which bytes stand for the state at a checkpoint: a delta to the last full record, or a new full one.

use super::packed::{self, Damaged};
use super::parts::Parts;

/// A delta beyond this part of the full record is not worth it.
const MAX_DELTA: f64 = 0.6;
/// Stored bytes are filled up to a multiple of this, so that SQLite overwrites a record in place: a page of 1,024 bytes
/// of an overflowing row holds 1,020.
const ROOM_STEP: usize = 1020;

/// The last full record and how well deltas to it do.
#[derive(Debug, Default)]
pub(super) struct DeltaEncoder {
    base: Option<Base>,
    /// Bytes kept for a delta.
    delta_room: usize,
}

#[derive(Debug)]
struct Base {
    serial: i64,
    parts: Parts,
    full_bytes: usize,
    /// The smallest delta to it so far.
    least_delta: usize,
    /// Bytes the deltas have cost beyond the smallest: what a newer base would have saved.
    excess: usize,
}

/// A state as it is to be stored.
#[derive(Debug)]
pub(super) struct Packed {
    /// Number of the full record it is or is based on.
    pub(super) serial: i64,
    /// Whether it is a full one.
    pub(super) is_full: bool,
    /// Bytes of the record.
    pub(super) length: usize,
    /// The record, filled up with zeros.
    pub(super) bytes: Vec<u8>,
    /// The state, for a base to come.
    parts: Parts,
}

impl DeltaEncoder {
    /// After a start: the full record that is stored.
    pub(super) fn with_base(serial: i64, record: &[u8], delta_room: usize) -> Result<Self, Damaged> {
        let parts = packed::read_full(record)?;
        let base = Base { serial, parts, full_bytes: record.len(), least_delta: usize::MAX, excess: 0 };
        Ok(Self { base: Some(base), delta_room })
    }

    /// The full record's number and state.
    pub(super) fn base(&self) -> Option<(i64, &Parts)> {
        self.base.as_ref().map(|base| (base.serial, &base.parts))
    }

    /// Packs a state; `exact` asks for a full record.
    pub(super) fn pack(&self, parts: Parts, exact: bool) -> Packed {
        let serial = self.base.as_ref().map_or(0, |base| base.serial);
        let delta = self.base.as_ref().filter(|base| !exact && base.excess <= base.full_bytes);
        let record = delta.and_then(|base| {
            let record = packed::delta(&parts, &base.parts, base.serial);
            ((record.len() as f64) <= MAX_DELTA * base.full_bytes as f64).then_some(record)
        });
        match record {
            Some(record) => {
                let room = self.delta_room.max(record.len().next_multiple_of(ROOM_STEP));
                Packed { serial, is_full: false, length: record.len(), bytes: filled(record, room), parts }
            }
            None => {
                let record = packed::full(&parts);
                let room = record.len().next_multiple_of(ROOM_STEP);
                let length = record.len();
                Packed { serial: serial + 1, is_full: true, length, bytes: filled(record, room), parts }
            }
        }
    }

    /// It is stored.
    pub(super) fn stored(&mut self, packed: Packed) {
        if packed.is_full {
            let full_bytes = packed.length;
            let (serial, parts) = (packed.serial, packed.parts);
            self.base = Some(Base { serial, parts, full_bytes, least_delta: usize::MAX, excess: 0 });
        } else if let Some(base) = &mut self.base {
            base.least_delta = base.least_delta.min(packed.length);
            base.excess += packed.length - base.least_delta;
            self.delta_room = packed.bytes.len();
        }
    }
}

fn filled(mut record: Vec<u8>, room: usize) -> Vec<u8> {
    record.resize(room, 0);
    record
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(seed: u32, numbers: usize) -> Parts {
        let value = |n: usize| f64::from(seed) * 1e-3 + (n as f64).sqrt();
        let numbers: Vec<f64> = (0..numbers).map(value).collect();
        Parts::of(&serde_json::to_vec(&numbers).unwrap()).unwrap()
    }

    #[test]
    fn a_state_that_has_moved_on_for_good_becomes_the_new_base() {
        let mut delta_encoder = DeltaEncoder::default();
        let mut fulls = 0;
        for minute in 0..300 {
            // Half of the numbers move now and then, and stay where they are.
            let mut parts = state(minute / 60 * 60, 1000);
            parts.bits[..300].copy_from_slice(&state(minute, 300).bits);
            let packed = delta_encoder.pack(parts, false);
            fulls += u32::from(packed.is_full);
            delta_encoder.stored(packed);
        }
        assert!((5..=15).contains(&fulls), "{fulls} full records for 5 changes");
    }

    #[test]
    fn a_delta_as_large_as_a_full_record_is_written_in_full() {
        let mut delta_encoder = DeltaEncoder::default();
        let first = delta_encoder.pack(state(1, 10), false);
        assert!(first.is_full && first.bytes.len() == ROOM_STEP);
        delta_encoder.stored(first);
        assert!(delta_encoder.pack(state(99, 2000), false).is_full);
        assert!(!delta_encoder.pack(state(1, 10), false).is_full);
        assert!(delta_encoder.pack(state(1, 10), true).is_full);
    }
}
