//! Tests that encoded frames decode to the original values.

use super::*;
use crate::can::FrameKind;
use crate::can::decode::tests::{bind, cell, map, nested, readings, sensor};
use crate::quantity::Fault;
use proptest::prelude::*;

type Values = Vec<(Channel, Option<f64>)>;

/// Returns the frames and the number of values that no frame carries.
fn encode(map: &InputMap, values: &[(Channel, Option<f64>)]) -> (Vec<Frame>, usize) {
    let mut frames = Vec::new();
    let lost = InputEncoder::new(map).encode(values, &mut frames);
    (frames.into_iter().map(|(_, frame)| frame).collect(), lost)
}

fn round_trip(map: &InputMap, values: &[(Channel, Option<f64>)]) -> Vec<(Channel, Result<f64, Fault>)> {
    encode(map, values).0.iter().flat_map(|frame| readings(map, 0, frame)).collect()
}

fn near(found: Result<f64, Fault>, wanted: f64, within: f64) -> bool {
    found.is_ok_and(|found| (found - wanted).abs() <= within)
}

#[test]
fn direction_and_magnitude_encode_signed_current() {
    let direction = |name| Binding { charge: vec![1.0], ..bind(name, Channel::CurrentDirection) };
    let magnitude = bind("Pack.Voltage", Channel::Current);
    // The direction is in the magnitude's message or in a later message.
    for direction in [Binding { offset: 40.0, ..direction("Pack.Temperature") }, direction("Nested.Always")] {
        let map = InputMap::new(vec![direction, magnitude.clone()]);
        for current_a in [12.3, -12.3, 0.0] {
            let found = round_trip(&map, &[(Channel::Current, Some(current_a))]);
            let [(Channel::CurrentDirection, Ok(sign)), (Channel::Current, Ok(magnitude_a))] = found[..] else {
                unreachable!("{found:?}")
            };
            assert!((sign * magnitude_a - current_a).abs() < 1e-9, "{found:?}");
        }
    }
}

#[test]
fn messages_and_pages_decode_to_encoded_values() {
    let values: Values = vec![
        (Channel::PackVoltage, Some(355.1)),
        (Channel::Current, Some(-12.3)),
        (sensor(0), Some(25.0)),
        (sensor(1), Some(-7.25)),
        (cell(0), Some(3.321)),
        (cell(1), Some(3.322)),
        (cell(2), Some(3.323)),
    ];
    let (frames, lost) = encode(&map(), &values);
    assert_eq!((frames.len(), lost), (3, 0), "one plain message and two pages");
    assert!(frames.iter().all(|frame| frame.kind() == FrameKind::Classic));
    let found = round_trip(&map(), &values);
    for (channel, wanted) in &values {
        let readings: Vec<_> = found.iter().filter(|(name, _)| name == channel).collect();
        // The second temperature is on both pages of the multiplexed message, so it is received twice.
        assert_eq!(readings.len(), if *channel == sensor(1) { 2 } else { 1 }, "{channel:?}");
        assert!(readings.iter().all(|(_, value)| near(*value, wanted.unwrap(), 1e-9)), "{channel:?}: {readings:?}");
    }
}

#[test]
fn nested_pages_decode_without_foreign_signals() {
    let values: Values =
        vec![(sensor(0), Some(20.0)), (sensor(1), Some(21.0)), (cell(0), Some(3.7)), (cell(1), Some(3.75))];
    let (frames, lost) = encode(&nested(), &values);
    assert_eq!(lost, 0);
    assert!(frames.iter().all(|frame| matches!(frame.kind(), FrameKind::Fd { .. }) && frame.len() == 16));
    for frame in &frames {
        let found = readings(&nested(), 0, frame);
        for (channel, value) in &found {
            let (_, wanted) = values.iter().find(|(name, _)| name == channel).unwrap();
            assert!(near(*value, wanted.unwrap(), 1e-9), "{channel:?} in {frame:?}: {value:?}");
        }
    }
    let decoded = round_trip(&nested(), &values);
    assert!(values.iter().all(|(channel, _)| decoded.iter().any(|(name, _)| name == channel)), "{decoded:?}");
}

#[test]
fn missing_value_is_encoded_as_not_available() {
    let values = [(Channel::Current, Some(5.0)), (sensor(0), None), (Channel::PackVoltage, Some(350.0))];
    let found = round_trip(&map(), &values);
    let wanted =
        [(Channel::Current, Ok(5.0)), (sensor(0), Err(Fault::NotAvailable)), (Channel::PackVoltage, Ok(350.0))];
    assert_eq!(found, wanted);
    let unnamed = round_trip(&map(), &[(Channel::Current, Some(5.0)), (Channel::PackVoltage, Some(350.0))]);
    assert_eq!(unnamed, wanted, "a channel that is absent is unknown, too");
    let nan = round_trip(&map(), &[values[0], (sensor(0), Some(f64::NAN)), values[2]]);
    assert_eq!(nan, wanted);
}

#[test]
fn missing_value_without_code_is_encoded_as_invalid() {
    let found = round_trip(&map(), &[(sensor(0), Some(25.0))]);
    let refused = Err(Fault::OutOfRange);
    assert_eq!(found, [(Channel::Current, refused), (sensor(0), Ok(25.0)), (Channel::PackVoltage, refused)]);
    let float = round_trip(
        &InputMap::new(vec![bind("Nested.Wide", cell(1)), bind("Nested.Always", sensor(0))]),
        &[(sensor(0), Some(25.0))],
    );
    assert_eq!(float, [(sensor(0), Ok(25.0)), (cell(1), Err(Fault::NotFinite))]);
}

#[test]
fn frame_without_code_for_missing_is_omitted_and_counted() {
    // Every raw code of the third cell's signal is a valid voltage, so no code can say that the voltage is missing.
    // Without this voltage, the multiplexer page with the signal cannot be sent.
    let (frames, lost) = encode(&map(), &[(sensor(1), Some(1.0))]);
    assert_eq!((frames.len(), lost), (1, 0));
    let two = InputMap::new(vec![bind("Cells.Cell3", cell(2)), bind("Cells.Air", sensor(1))]);
    assert_eq!(encode(&two, &[(sensor(1), Some(1.0))]), (vec![], 1));
    assert_eq!(encode(&two, &[(sensor(1), Some(1.0)), (cell(2), Some(3.3))]).1, 0);
    assert_eq!(encode(&two, &[(Channel::PackVoltage, Some(350.0))]), (vec![], 1), "no frame carries this value");
}

#[test]
fn no_values_give_no_frame_unless_not_available_code() {
    assert_eq!(encode(&map(), &[]), (vec![], 0));
    assert_eq!(encode(&map(), &[(cell(0), None), (Channel::Current, None)]), (vec![], 0));
    let found = round_trip(&map(), &[(sensor(0), None)]);
    assert!(found.contains(&(sensor(0), Err(Fault::NotAvailable))), "{found:?}");
}

#[test]
fn value_outside_range_decodes_as_fault() {
    let all = [(Channel::Current, Some(1.0)), (sensor(0), Some(1.0)), (Channel::PackVoltage, Some(512.0))];
    assert_eq!(round_trip(&map(), &all)[2], (Channel::PackVoltage, Err(Fault::OutOfRange)));
    let far = [(Channel::PackVoltage, Some(f64::INFINITY))];
    assert!(round_trip(&map(), &far).contains(&(Channel::PackVoltage, Err(Fault::OutOfRange))));
}

proptest! {
    #[test]
    fn encoded_values_decode_within_half_a_code(
        current in -3000.0..3000.0, air in -300.0..300.0, pack in 0.0..500.0, cells in prop::array::uniform3(0.0..5.0),
        known in prop::array::uniform6(any::<bool>()),
    ) {
        let channels = [Channel::Current, sensor(1), Channel::PackVoltage, cell(0), cell(1), cell(2)];
        let numbers = [current, air, pack, cells[0], cells[1], cells[2]];
        let half = [0.05, 0.005, 0.05, 0.0005, 0.0005, 0.0005];
        let values: Values = (0..6).map(|n| (channels[n], known[n].then_some(numbers[n]))).collect();
        for (channel, value) in round_trip(&map(), &values) {
            let Some(n) = channels.iter().position(|name| *name == channel) else { continue };
            if known[n] {
                prop_assert!(near(value, numbers[n], half[n] + 1e-9), "{channel:?} {value:?} for {}", numbers[n]);
            } else {
                prop_assert!(value.is_err(), "{channel:?} was unknown but decodes to {value:?}");
            }
        }
    }
}
