//! Reads a signal with an alternative layout: another byte order, start bit or sign. If the alternative gives better
//! values, the layout in the DBC may be wrong.

use super::sample::Extent;
use crate::can::signal::{ByteOrder, SignalLayout, SignalPlan, ValueType};

/// Layout faults that `doctor` looks for, in the order of the alternative readings.
pub(crate) const LAYOUT_FAULTS: [&str; 5] = [
    "wrong byte order",
    "signed and unsigned exchanged",
    "wrong byte order and sign of the number",
    "wrong byte order (the start bit is right)",
    "wrong byte order and sign of the number (the start bit is right)",
];

#[derive(Debug, Clone)]
pub(crate) struct AlternativeReading {
    pub(crate) fault: &'static str,
    pub(crate) layout: SignalLayout,
    plan: SignalPlan,
    pub(crate) extent: Extent,
}

impl AlternativeReading {
    pub(super) fn all(layout: &SignalLayout) -> Vec<Self> {
        let other_sign = |layout: SignalLayout| match layout.value_type {
            ValueType::Unsigned => Some(SignalLayout { value_type: ValueType::Signed, ..layout }),
            ValueType::Signed => Some(SignalLayout { value_type: ValueType::Unsigned, ..layout }),
            ValueType::Float32 | ValueType::Float64 => None,
        };
        let swapped = byte_swapped(layout);
        let flipped = order_flipped(layout);
        let others =
            [swapped, other_sign(*layout), swapped.and_then(other_sign), flipped, flipped.and_then(other_sign)];
        let reading = |(fault, layout): (&'static str, Option<SignalLayout>)| {
            // The stated range applies only to the stated layout.
            let plan = SignalLayout { minimum: 0.0, maximum: 0.0, ..layout? }.plan().ok()?;
            Some(AlternativeReading { fault, layout: layout?, plan, extent: Extent::default() })
        };
        LAYOUT_FAULTS.into_iter().zip(others).filter_map(reading).collect()
    }

    pub(super) fn handle(&mut self, payload: &[u8], scale: f64, offset: f64) {
        if let Ok(physical) = self.plan.physical(payload) {
            self.extent.push(physical * scale + offset);
        }
    }
}

/// The layout with the same start bit and the opposite byte order (`@0` for `@1` in the DBC); `None` if the signal lies
/// within a byte.
fn order_flipped(layout: &SignalLayout) -> Option<SignalLayout> {
    let byte_order = match layout.byte_order {
        ByteOrder::LittleEndian => ByteOrder::BigEndian,
        ByteOrder::BigEndian => ByteOrder::LittleEndian,
    };
    (layout.length_bits > 8).then_some(SignalLayout { byte_order, ..*layout })
}

/// The layout of the same whole bytes in the opposite order; `None` if the signal does not fill at least two whole
/// bytes.
fn byte_swapped(layout: &SignalLayout) -> Option<SignalLayout> {
    let whole = layout.length_bits.is_multiple_of(8) && layout.length_bits > 8;
    let (byte, bit) = (layout.start_bit / 8, layout.start_bit % 8);
    match layout.byte_order {
        ByteOrder::LittleEndian if whole && bit == 0 => {
            Some(SignalLayout { byte_order: ByteOrder::BigEndian, start_bit: 8 * byte + 7, ..*layout })
        }
        ByteOrder::BigEndian if whole && bit == 7 => {
            Some(SignalLayout { byte_order: ByteOrder::LittleEndian, start_bit: 8 * byte, ..*layout })
        }
        _ => None,
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    #[test]
    fn whole_bytes_are_swapped_to_other_order() {
        let layout = SignalLayout {
            start_bit: 16,
            length_bits: 16,
            byte_order: ByteOrder::LittleEndian,
            value_type: ValueType::Unsigned,
            factor: 1.0,
            offset: 0.0,
            minimum: 0.0,
            maximum: 0.0,
        };
        let payload = [0, 0, 0x12, 0x34, 0, 0, 0, 0];
        let swapped = byte_swapped(&layout).unwrap();
        assert_eq!(layout.plan().unwrap().raw(&payload), Ok(0x3412));
        assert_eq!(swapped.plan().unwrap().raw(&payload), Ok(0x1234));
        assert_eq!(byte_swapped(&swapped), Some(layout));
        assert_eq!(byte_swapped(&SignalLayout { length_bits: 12, ..layout }), None);
        assert_eq!(byte_swapped(&SignalLayout { length_bits: 8, ..layout }), None);
    }
}
