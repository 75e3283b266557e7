//! Chooses the record of a checkpoint: a delta to the last full record, or a new full record.

use super::packed::{self, DamagedRecord};
use super::parts::JsonParts;

/// A larger part of the full record is written in full.
const MAX_DELTA: f64 = 0.6;
/// Stored bytes are padded to a multiple of this, so that SQLite overwrites a record in place: a page of 1,024 bytes of
/// an overflowing row holds 1,020.
const ROOM_STEP: usize = 1020;

/// The last full record, and the sizes of the deltas to it.
#[derive(Debug, Default)]
pub(super) struct DeltaEncoder {
    base: Option<BaseRecord>,
    /// Bytes reserved for a delta.
    delta_room: usize,
}

#[derive(Debug)]
struct BaseRecord {
    serial: i64,
    parts: JsonParts,
    full_bytes: usize,
    /// The smallest delta to it so far.
    least_delta: usize,
    /// Bytes of the deltas beyond the smallest: a newer base would have saved them.
    excess: usize,
}

/// A state, encoded for the database.
#[derive(Debug)]
pub(super) struct EncodedState {
    /// Number of the record.
    pub(super) number: i64,
    /// Whether it is a full record.
    pub(super) is_full: bool,
    /// Bytes of the record.
    pub(super) length: usize,
    /// The record, padded with zeros.
    pub(super) bytes: Vec<u8>,
    /// The state: a base for later deltas.
    parts: JsonParts,
}

impl DeltaEncoder {
    /// Resumes after a start, from the stored full record of number `serial`.
    pub(super) fn with_base(serial: i64, record: &[u8], delta_room: usize) -> Result<Self, DamagedRecord> {
        let parts = packed::read_full(record, serial)?;
        let base = BaseRecord { serial, parts, full_bytes: record.len(), least_delta: usize::MAX, excess: 0 };
        Ok(Self { base: Some(base), delta_room })
    }

    /// The full record's number and state.
    pub(super) fn base(&self) -> Option<(i64, &JsonParts)> {
        self.base.as_ref().map(|base| (base.serial, &base.parts))
    }

    /// Encodes a state as the record of number `number`; `exact` asks for a full record.
    pub(super) fn encode(&self, parts: JsonParts, number: i64, exact: bool) -> EncodedState {
        let delta = self.base.as_ref().filter(|base| !exact && base.excess <= base.full_bytes);
        let record = delta.and_then(|base| {
            let record = packed::delta(&parts, &base.parts, base.serial, number);
            ((record.len() as f64) <= MAX_DELTA * base.full_bytes as f64).then_some(record)
        });
        let is_full = record.is_none();
        let mut bytes = record.unwrap_or_else(|| packed::full(&parts, number));
        let length = bytes.len();
        let room = length.next_multiple_of(ROOM_STEP);
        bytes.resize(if is_full { room } else { room.max(self.delta_room) }, 0);
        EncodedState { number, is_full, length, bytes, parts }
    }

    /// Notes that a record is on the disk.
    pub(super) fn note_stored(&mut self, packed: EncodedState) {
        if packed.is_full {
            let full_bytes = packed.length;
            let (serial, parts) = (packed.number, packed.parts);
            self.base = Some(BaseRecord { serial, parts, full_bytes, least_delta: usize::MAX, excess: 0 });
        } else if let Some(base) = &mut self.base {
            base.least_delta = base.least_delta.min(packed.length);
            base.excess += packed.length - base.least_delta;
            self.delta_room = packed.bytes.len();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(seed: u32, numbers: usize) -> JsonParts {
        let value = |n: usize| f64::from(seed) * 1e-3 + (n as f64).sqrt();
        let numbers: Vec<f64> = (0..numbers).map(value).collect();
        JsonParts::of(&serde_json::to_vec(&numbers).unwrap()).unwrap()
    }

    #[test]
    fn a_state_that_has_moved_on_for_good_becomes_the_new_base() {
        let mut delta_encoder = DeltaEncoder::default();
        let mut fulls = 0;
        for minute in 0..300 {
            // Half of the numbers move now and then, and then stay.
            let mut parts = state(minute / 60 * 60, 1000);
            parts.bits[..300].copy_from_slice(&state(minute, 300).bits);
            let packed = delta_encoder.encode(parts, i64::from(minute) + 1, false);
            fulls += u32::from(packed.is_full);
            delta_encoder.note_stored(packed);
        }
        assert!((5..=15).contains(&fulls), "{fulls} full records for 5 changes");
    }

    #[test]
    fn a_delta_as_large_as_a_full_record_is_written_in_full() {
        let mut delta_encoder = DeltaEncoder::default();
        let first = delta_encoder.encode(state(1, 10), 1, false);
        assert!(first.is_full && first.bytes.len() == ROOM_STEP);
        delta_encoder.note_stored(first);
        assert!(delta_encoder.encode(state(99, 2000), 2, false).is_full);
        assert!(!delta_encoder.encode(state(1, 10), 2, false).is_full);
        assert!(delta_encoder.encode(state(1, 10), 2, true).is_full);
    }
}
