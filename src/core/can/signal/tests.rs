//! Compares signal plans with bit-by-bit decoding and with published vectors.

use proptest::prelude::*;

use super::*;

fn layout(start_bit: u16, length_bits: u16, byte_order: ByteOrder, value_type: ValueType) -> SignalLayout {
    SignalLayout {
        start_bit,
        length_bits,
        byte_order,
        value_type,
        factor: 1.0,
        offset: 0.0,
        minimum: 0.0,
        maximum: 0.0,
    }
}

/// Reference decoder: reads bit by bit in DBC numbering.
fn bit_by_bit(layout: &SignalLayout, payload: &[u8]) -> u64 {
    let (mut byte, mut bit) = (usize::from(layout.start_bit / 8), layout.start_bit % 8);
    let mut code = 0_u64;
    for n in 0..layout.length_bits {
        let value = u64::from(payload[byte] >> bit & 1);
        match layout.byte_order {
            ByteOrder::LittleEndian => {
                code |= value << n;
                (byte, bit) = if bit == 7 { (byte + 1, 0) } else { (byte, bit + 1) };
            }
            ByteOrder::BigEndian => {
                code = code << 1 | value;
                (byte, bit) = if bit == 0 { (byte + 1, 7) } else { (byte, bit - 1) };
            }
        }
    }
    code
}

fn any_layout() -> impl Strategy<Value = SignalLayout> {
    let kind = prop_oneof![
        (1_u16..=64).prop_map(|n| (n, ValueType::Unsigned)),
        (1_u16..=64).prop_map(|n| (n, ValueType::Signed)),
        Just((32, ValueType::Float32)),
        Just((64, ValueType::Float64)),
    ];
    (0_u16..512, kind, any::<bool>()).prop_map(|(start, (length, value_type), little)| {
        layout(start, length, if little { ByteOrder::LittleEndian } else { ByteOrder::BigEndian }, value_type)
    })
}

fn fitting_layout() -> impl Strategy<Value = SignalLayout> {
    any_layout().prop_filter("ends within 64 bytes", |l| l.plan().is_ok())
}

#[test]
fn motorola_12_bit_signal_matches_published_vector() {
    let payload = [0xC6, 0x93, 0x56, 0x5F, 0x94, 0x0A, 0xF9, 0x62];
    let plan = SignalLayout { factor: 0.5, ..layout(23, 12, ByteOrder::BigEndian, ValueType::Signed) }.plan().unwrap();
    assert_eq!(plan.decode(&payload), Ok(690.5));
}

#[test]
fn intel_signed_16_bit_signal_decodes_kona_current() {
    let plan =
        SignalLayout { factor: 0.1, ..layout(32, 16, ByteOrder::LittleEndian, ValueType::Signed) }.plan().unwrap();
    assert_eq!(plan.decode(&[0, 0, 0, 0, 0xF6, 0xFF, 0, 0]), Ok(-1.0));
    assert_eq!(plan.decode(&[0, 0, 0, 0, 0x22, 0]), Ok(3.4000000000000004));
}

#[test]
fn short_payload_gives_short_frame_fault() {
    let plan = layout(32, 16, ByteOrder::LittleEndian, ValueType::Unsigned).plan().unwrap();
    assert_eq!(plan.bytes_needed(), 6);
    assert_eq!(plan.decode(&[0; 5]), Err(Fault::ShortFrame));
    assert_eq!(plan.decode(&[0; 6]), Ok(0.0));
}

#[test]
fn nan_and_infinity_are_not_finite() {
    let plan = layout(0, 32, ByteOrder::LittleEndian, ValueType::Float32).plan().unwrap();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert_eq!(plan.decode(&bad.to_le_bytes()), Err(Fault::NotFinite));
    }
    assert_eq!(plan.decode(&1.5_f32.to_le_bytes()), Ok(1.5));
    let plan = layout(7, 64, ByteOrder::BigEndian, ValueType::Float64).plan().unwrap();
    assert_eq!(plan.decode(&f64::NAN.to_be_bytes()), Err(Fault::NotFinite));
    assert_eq!(plan.decode(&(-2.25_f64).to_be_bytes()), Ok(-2.25));
}

#[test]
fn codes_on_limit_are_in_range() {
    let plan =
        SignalLayout { factor: 0.1, maximum: 409.4, ..layout(0, 12, ByteOrder::LittleEndian, ValueType::Unsigned) }
            .plan()
            .unwrap();
    assert!(plan.decode(&4094_u16.to_le_bytes()).is_ok());
    assert_eq!(plan.decode(&4095_u16.to_le_bytes()), Err(Fault::OutOfRange));
    assert_eq!(plan.physical(&4095_u16.to_le_bytes()), Ok(409.5));
}

#[test]
fn encoding_rounds_to_nearest_and_saturates() {
    let plan = SignalLayout {
        factor: 0.1,
        offset: -40.0,
        minimum: -40.0,
        maximum: -15.0,
        ..layout(0, 8, ByteOrder::LittleEndian, ValueType::Unsigned)
    }
    .plan()
    .unwrap();
    assert_eq!(plan.code(-39.96), Some(0));
    assert_eq!(plan.code(-39.94), Some(1));
    assert_eq!(plan.code(f64::NEG_INFINITY), Some(0));
    assert_eq!(plan.code(1e300), Some(250), "the range ends before the bits");
    assert_eq!(plan.code_beyond_range(1e300), Some(255));
    assert_eq!(plan.code(f64::NAN), None);
    let mut payload = [0xAA];
    assert_eq!(plan.encode(&mut payload, f64::NAN), Err(Fault::NotFinite));
    assert_eq!(payload, [0xAA]);
}

#[test]
fn negative_factor_reverses_range() {
    let plan = SignalLayout {
        factor: -0.5,
        minimum: -10.0,
        maximum: 0.0,
        ..layout(0, 8, ByteOrder::LittleEndian, ValueType::Unsigned)
    }
    .plan()
    .unwrap();
    assert_eq!(plan.code(-100.0), Some(20));
    assert_eq!(plan.decode(&[20]), Ok(-10.0));
    assert_eq!(plan.decode(&[21]), Err(Fault::OutOfRange));
}

#[test]
fn signed_codes_saturate_at_both_ends() {
    let plan = layout(0, 4, ByteOrder::LittleEndian, ValueType::Signed).plan().unwrap();
    assert_eq!((plan.code(-100.0), plan.code(100.0)), (Some(0b1000), Some(0b0111)));
    let plan = layout(0, 64, ByteOrder::LittleEndian, ValueType::Unsigned).plan().unwrap();
    assert_eq!((plan.code(-1.0), plan.code(1e30)), (Some(0), Some(u64::MAX)));
}

#[test]
fn invalid_layout_error_states_allowed_values() {
    let good = layout(0, 8, ByteOrder::LittleEndian, ValueType::Unsigned);
    let refused = |l: SignalLayout| l.plan().unwrap_err().to_string();
    assert_eq!(refused(SignalLayout { length_bits: 0, ..good }), "length is 0 bits, must be 1 to 64");
    assert_eq!(refused(SignalLayout { length_bits: 65, ..good }), "length is 65 bits, must be 1 to 64");
    assert!(refused(SignalLayout { start_bit: 505, ..good }).contains("bit 512"));
    assert!(refused(SignalLayout { value_type: ValueType::Float32, ..good }).contains("must be 32"));
    assert!(refused(SignalLayout { factor: 0.0, ..good }).contains("factor is 0"));
    assert!(refused(SignalLayout { offset: f64::NAN, ..good }).contains("offset"));
    assert!(refused(SignalLayout { minimum: 2.0, maximum: 1.0, ..good }).contains("[2|1]"));
}

#[test]
fn code_wider_than_signal_is_rejected() {
    let plan = layout(4, 4, ByteOrder::LittleEndian, ValueType::Unsigned).plan().unwrap();
    let mut payload = [0x0A];
    assert_eq!(plan.encode_raw(&mut payload, 16), Err(Fault::OutOfRange));
    assert_eq!(plan.encode_raw(&mut [], 1), Err(Fault::ShortFrame));
    assert_eq!(payload, [0x0A]);
}

#[test]
fn nearest_equals_round_for_special_numbers() {
    let half_below = 0.5_f64.next_down();
    let ends =
        [0.0, -0.0, 0.5, half_below, 0.5_f64.next_up(), 1.5, 2.5, 4503599627370495.5, 4503599627370497.0, 1e18, 1e19];
    let odd = [9223372036854774784.0, 9223372036854775808.0, f64::MAX, f64::INFINITY, f64::MIN_POSITIVE, 1e-320];
    for number in ends.into_iter().chain(odd).flat_map(|number| [number, -number]) {
        assert_eq!(nearest(number), number.round() as i64, "{number:?}");
    }
    assert_eq!(nearest(f64::NAN), 0);
}

/// Reference for [`SignalPlan::code`], in a number type that holds every code.
fn code_by_definition(layout: &SignalLayout, value: f64) -> u64 {
    let (low, high) = layout.code_limits();
    let code = (((value - layout.offset) / layout.factor).round() as i128).clamp(low, high);
    (code as u64) & layout.plan().unwrap().all_ones()
}

proptest! {
    #[test]
    fn nearest_equals_round_for_any_number(number in prop_oneof![any::<f64>(), -1e3..1e3f64, (-1000..1000i32).prop_map(|n| f64::from(n) / 2.0)]) {
        prop_assert_eq!(nearest(number), number.round() as i64);
    }

    #[test]
    fn code_matches_reference_for_any_value(
        l in fitting_layout(),
        value in prop_oneof![any::<f64>(), -1e6..1e6f64, Just(f64::INFINITY), Just(f64::NEG_INFINITY), -1e20..1e20f64],
    ) {
        let is_integer = matches!(l.value_type, ValueType::Unsigned | ValueType::Signed);
        prop_assume!(is_integer && !value.is_nan());
        prop_assert_eq!(l.plan().unwrap().code(value), Some(code_by_definition(&l, value)));
    }

    #[test]
    fn raw_equals_bit_by_bit_decoding(l in fitting_layout(), payload in prop::collection::vec(any::<u8>(), 64)) {
        prop_assert_eq!(l.plan().unwrap().raw(&payload), Ok(bit_by_bit(&l, &payload)));
    }

    #[test]
    fn encoded_codes_decode_and_keep_other_bits(
        l in fitting_layout(), before in prop::collection::vec(any::<u8>(), 64), code in any::<u64>(),
    ) {
        let plan = l.plan().unwrap();
        let code = code & plan.all_ones();
        // The shortest payload that carries the signal, and the longest possible payload.
        for length in [plan.bytes_needed(), 64] {
            let mut after = before[..length].to_vec();
            plan.encode_raw(&mut after, code).unwrap();
            prop_assert_eq!(plan.raw(&after), Ok(code));
            plan.encode_raw(&mut after, plan.raw(&before).unwrap()).unwrap();
            prop_assert_eq!(&after[..], &before[..length]);
        }
    }

    #[test]
    fn encode_then_decode_is_within_half_a_code(
        l in fitting_layout(), factor in prop_oneof![1e-6..1e3_f64, -1e3..-1e-6_f64], offset in -1e6..1e6_f64, share in 0.0..1.0_f64,
    ) {
        let l = SignalLayout { factor, offset, ..l };
        let plan = l.plan().unwrap();
        let (low, high) = match l.value_type {
            ValueType::Float32 | ValueType::Float64 => (-1e6, 1e6),
            _ => {
                let (low, high) = l.representable();
                (low as f64 * factor + offset, high as f64 * factor + offset)
            }
        };
        let value = low + share * (high - low);
        let mut payload = [0; 64];
        plan.encode(&mut payload, value).unwrap();
        let back = plan.decode(&payload).unwrap();
        let allowed = match l.value_type {
            ValueType::Float32 => 1e-6 * (value.abs() + offset.abs()),
            ValueType::Float64 => 1e-12 * (value.abs() + offset.abs()),
            _ => 0.5000001 * factor.abs() + 1e-12 * (value.abs() + offset.abs()),
        };
        prop_assert!((back - value).abs() <= allowed, "{value} decoded as {back}");
    }

    #[test]
    fn arbitrary_layouts_and_bytes_never_panic(
        l in any_layout(), factor in any::<f64>(), offset in any::<f64>(), limits in any::<(f64, f64)>(), length in 0..=70_u16,
        mut payload in prop::collection::vec(any::<u8>(), 0..=70), value in any::<f64>(), code in any::<u64>(),
    ) {
        let any = SignalLayout { factor, offset, minimum: limits.0, maximum: limits.1, length_bits: length, ..l };
        for l in [any, SignalLayout { length_bits: l.length_bits, ..any }, SignalLayout { factor: 1.0, ..l }] {
            if let Ok(plan) = l.plan() {
                let _ = (plan.raw(&payload), plan.decode(&payload), plan.code_beyond_range(value));
                let _ = (plan.encode(&mut payload, value), plan.encode_raw(&mut payload, code));
            }
        }
    }
}

#[test]
fn overlap_is_detected_across_byte_orders() {
    let layout = |start_bit, length_bits, byte_order| SignalLayout {
        start_bit,
        length_bits,
        byte_order,
        value_type: ValueType::Signed,
        factor: -0.5,
        offset: 1.0,
        minimum: 0.0,
        maximum: 0.0,
    };
    let little = layout(4, 8, ByteOrder::LittleEndian);
    // Bits 11 to 8 and 23 to 20.
    let big = layout(11, 8, ByteOrder::BigEndian);
    assert!(little.overlaps(&big) && big.overlaps(&little));
    assert!(
        !layout(12, 8, ByteOrder::LittleEndian).overlaps(&big) && layout(20, 4, ByteOrder::LittleEndian).overlaps(&big)
    );
    assert_eq!((little.end_byte(), big.end_byte()), (2, 3));
    assert_eq!(little.extent(), (-62.5, 65.0));
}
