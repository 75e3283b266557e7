//! Tests which frames an input map decodes, which frames it ignores, and which readings and faults it gives.

use proptest::prelude::*;

use super::*;
use crate::can::dbc::Database;
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};
use crate::quantity::CellIndex;

/// A plain message with the voltage first and the current last, a multiplexed message whose signal `Air` is present on
/// every page (for every value of the multiplexer), and a message with nested pages.
pub(crate) const DBC: &str = r#"VERSION ""
BU_: BMS
BO_ 256 Pack: 6 BMS
 SG_ Voltage : 0|16@1+ (0.1,0) [0|500] "V" BMS
 SG_ Temperature : 16|8@1+ (1,-40) [-40|210] "degC" BMS
 SG_ Current : 31|16@0- (0.1,0) [-3000|3000] "A" BMS
BO_ 257 Cells: 7 BMS
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" BMS
 SG_ Cell1 m0 : 8|16@1+ (0.001,0) [0|5] "V" BMS
 SG_ Cell2 m0 : 24|16@1+ (0.001,0) [0|5] "V" BMS
 SG_ Cell3 m1 : 8|16@1+ (0.001,0) [0|0] "V" BMS
 SG_ Air : 40|16@1- (0.01,0) [-300|300] "degC" BMS
BO_ 2147483905 Nested: 16 BMS
 SG_ Outer M : 0|8@1+ (1,0) [0|0] "" BMS
 SG_ Inner m3M : 8|8@1+ (1,0) [0|0] "" BMS
 SG_ Always : 16|8@1+ (1,0) [0|254] "degC" BMS
 SG_ Middle m3 : 24|8@1+ (1,0) [0|254] "degC" BMS
 SG_ Deep m7 : 64|16@1+ (0.001,0) [0|5] "V" BMS
 SG_ Wide m0 : 96|32@1- (1,0) [0|0] "V" BMS
SG_MUL_VAL_ 2147483905 Inner Outer 3-3;
SG_MUL_VAL_ 2147483905 Middle Outer 3-5, 9-9;
SG_MUL_VAL_ 2147483905 Deep Inner 7-8;
SG_MUL_VAL_ 2147483905 Wide Outer 4-6;
SIG_VALTYPE_ 2147483905 Wide : 1;
VAL_ 256 Temperature 255 "not available" ;
"#;

pub(crate) fn bind(name: &str, channel: Channel) -> Binding {
    let dbc = Database::parse(DBC).unwrap();
    let (message, signal) = dbc.signal(name).unwrap();
    Binding::new(BusIndex(0), message, signal, channel).unwrap()
}

pub(crate) const fn cell(n: u16) -> Channel {
    Channel::CellVoltage(CellIndex(n))
}

pub(crate) const fn sensor(n: u16) -> Channel {
    Channel::Temperature(SensorIndex(n))
}

/// The first two messages. On the bus, the current is positive for charging.
pub(crate) fn map() -> InputMap {
    InputMap::new(vec![
        bind("Cells.Cell3", cell(2)),
        bind("Cells.Cell2", cell(1)),
        bind("Cells.Air", sensor(1)),
        bind("Pack.Temperature", sensor(0)),
        bind("Pack.Voltage", Channel::PackVoltage),
        bind("Cells.Cell1", cell(0)),
        Binding { scale: -1.0, ..bind("Pack.Current", Channel::Current) },
    ])
}

/// The message with nested pages.
pub(crate) fn nested() -> InputMap {
    InputMap::new(vec![
        bind("Nested.Deep", cell(0)),
        bind("Nested.Middle", sensor(1)),
        bind("Nested.Always", sensor(0)),
        bind("Nested.Wide", cell(1)),
    ])
}

#[test]
fn messages_have_at_least_one_group_per_page() {
    let both = InputMap::new([map().bindings(), nested().bindings()].concat());
    let found: Vec<_> = both.messages().map(|(bus, id, groups)| (bus.0, id.to_string(), groups)).collect();
    assert_eq!(found, [(0, "100".to_owned(), 1), (0, "101".to_owned(), 3), (0, "00000101".to_owned(), 4)]);
}

pub(crate) fn readings(map: &InputMap, bus: u8, frame: &Frame) -> Vec<(Channel, Result<f64, Fault>)> {
    let mut found = Vec::new();
    map.decode(BusIndex(bus), frame, |reading| found.push((reading.channel, reading.value)));
    found
}

fn read(id: CanId, data: &[u8]) -> Vec<(Channel, Result<f64, Fault>)> {
    readings(&map(), 0, &Frame::classic(id, data).unwrap())
}

const PACK: CanId = CanId::Standard(256);
const CELLS: CanId = CanId::Standard(257);

#[test]
fn readings_are_ordered_current_temperature_voltage() {
    let found = read(PACK, &[0xDF, 0x0D, 65, 0x00, 0x64, 0]);
    assert_eq!(found, [(Channel::Current, Ok(-10.0)), (sensor(0), Ok(25.0)), (Channel::PackVoltage, Ok(355.1))]);
    let found = read(CELLS, &[0, 0x10, 0x0E, 0x11, 0x0E, 0xC4, 0x09]);
    assert_eq!(found, [(sensor(1), Ok(25.0)), (cell(0), Ok(3.6)), (cell(1), Ok(3.601))]);
}

#[test]
fn interleaved_pages_keep_channel_order() {
    // The signals of a page are not consecutive.
    let found = InputMap::new(vec![
        bind("Cells.Cell1", cell(0)),
        bind("Cells.Cell3", cell(1)),
        bind("Cells.Cell2", cell(2)),
        bind("Cells.Air", sensor(0)),
    ]);
    let frame = |page| Frame::classic(CELLS, &[page, 0x10, 0x0E, 0x11, 0x0E, 0, 0]).unwrap();
    assert_eq!(readings(&found, 0, &frame(0)), [(sensor(0), Ok(0.0)), (cell(0), Ok(3.6)), (cell(2), Ok(3.601))]);
    assert_eq!(readings(&found, 0, &frame(1)), [(sensor(0), Ok(0.0)), (cell(1), Ok(3.6))]);
}

#[test]
fn only_present_page_is_decoded() {
    let found = read(CELLS, &[1, 0x10, 0x0E, 0xFF, 0xFF, 0, 0]);
    assert_eq!(found, [(sensor(1), Ok(0.0)), (cell(2), Ok(3.6))]);
    assert_eq!(read(CELLS, &[7, 0, 0, 0, 0, 0, 0]), [(sensor(1), Ok(0.0))]);
}

#[test]
fn nested_signal_needs_both_selectors_in_range() {
    let channels = |outer: u8, inner: u8| -> Vec<Channel> {
        let mut data = [0; 16];
        (data[0], data[1]) = (outer, inner);
        let frame = Frame::fd(CanId::Extended(257), true, false, &data).unwrap();
        readings(&nested(), 0, &frame).into_iter().map(|(channel, _)| channel).collect()
    };
    assert_eq!(channels(3, 7), [sensor(0), sensor(1), cell(0)]);
    assert_eq!(channels(3, 8), [sensor(0), sensor(1), cell(0)]);
    assert_eq!(channels(3, 6), [sensor(0), sensor(1)]);
    assert_eq!(channels(3, 9), [sensor(0), sensor(1)]);
    assert_eq!(channels(4, 7), [sensor(0), sensor(1), cell(1)], "page 4 has no inner selector");
    assert_eq!(channels(5, 0), [sensor(0), sensor(1), cell(1)]);
    assert_eq!(channels(6, 0), [sensor(0), cell(1)]);
    assert_eq!(channels(9, 0), [sensor(0), sensor(1)]);
    assert_eq!(channels(2, 7), [sensor(0)]);
    assert_eq!(channels(10, 7), [sensor(0)]);
}

#[test]
fn short_frame_affects_only_missing_signals() {
    let values = |data: &[u8]| -> Vec<_> { read(CELLS, data).into_iter().map(|(_, value)| value).collect() };
    let short = Err(Fault::ShortFrame);
    assert_eq!(values(&[0, 0x10, 0x0E]), [short, Ok(3.6), short]);
    assert_eq!(values(&[1, 0x10]), [short, short]);
    // Without the selector, the page is unknown, so all signals give a fault.
    assert_eq!(values(&[]), [short; 4]);
    assert_eq!(
        values(&[0, 0x10, 0x0E, 0x11, 0x0E, 0, 0, 0xFF]),
        [Ok(0.0), Ok(3.6), Ok(3.601)],
        "a longer frame is accepted"
    );
}

#[test]
fn bad_readings_have_their_fault() {
    let values = |data: &[u8]| -> Vec<_> { read(PACK, data).into_iter().map(|(_, value)| value).collect() };
    let out = Err(Fault::OutOfRange);
    assert_eq!(values(&[0x88, 0x13, 255, 0x7F, 0xFF, 0]), [out, Err(Fault::NotAvailable), Ok(500.0)]);
    assert_eq!(values(&[0x89, 0x13, 250, 0x75, 0x30, 0]), [Ok(-3000.0), Ok(210.0), out]);
    assert_eq!(values(&[0, 0, 251, 0x75, 0x31, 0]), [out, out, Ok(0.0)]);
    let mut nan = [4; 16];
    nan[12..].copy_from_slice(&f32::NAN.to_le_bytes());
    let nan = Frame::fd(CanId::Extended(257), false, false, &nan).unwrap();
    assert!(readings(&nested(), 0, &nan).contains(&(cell(1), Err(Fault::NotFinite))));
}

#[test]
fn range_applies_after_scale_with_ends_included() {
    let binding = Binding { scale: 0.5, offset: 1.0, range: (2.0, 3.0), ..bind("Cells.Cell3", cell(2)) };
    let value = |millivolts: u16| {
        let [low, high] = millivolts.to_le_bytes();
        readings(&InputMap::new(vec![binding.clone()]), 0, &Frame::classic(CELLS, &[1, low, high]).unwrap())[0].1
    };
    assert_eq!((value(2000), value(3000), value(4000)), (Ok(2.0), Ok(2.5), Ok(3.0)));
    assert_eq!((value(1998), value(4002)), (Err(Fault::OutOfRange), Err(Fault::OutOfRange)));
}

#[test]
fn not_available_code_applies_besides_range() {
    let binding = Binding { not_available: vec![0, 0xFFFE], ..bind("Cells.Cell3", cell(2)) };
    let map = InputMap::new(vec![binding]);
    let value = |low, high| readings(&map, 0, &Frame::classic(CELLS, &[1, low, high]).unwrap())[0].1;
    assert_eq!((value(0, 0), value(0xFE, 0xFF)), (Err(Fault::NotAvailable), Err(Fault::NotAvailable)));
    assert_eq!(value(1, 0), Ok(0.001));
}

#[test]
fn not_available_codes_work_anywhere_in_range() {
    let value = |not_available: Vec<u64>, code: i8| {
        let layout = SignalLayout { length_bits: 8, value_type: ValueType::Signed, ..SELECTOR };
        let binding = Binding { not_available, plan: layout.plan().unwrap(), ..bind("Pack.Temperature", sensor(0)) };
        readings(&InputMap::new(vec![binding]), 0, &Frame::classic(PACK, &code.to_le_bytes()).unwrap())[0].1
    };
    let several = [vec![0x81, 0x80, 0x7F], vec![0x7E, 0x180], vec![0xFF, 0, 0x20, 0xFF], vec![5, 3, 4, 0xF0]];
    for missing in [vec![], vec![0x80], vec![0x7F], vec![0xFF]].into_iter().chain(several) {
        for code in i8::MIN..=i8::MAX {
            let expected = if missing.contains(&u64::from(code.cast_unsigned())) {
                Err(Fault::NotAvailable)
            } else {
                Ok(f64::from(code))
            };
            assert_eq!(value(missing.clone(), code), expected, "{missing:X?}");
        }
    }
    assert_eq!(value((0..256).collect(), 0), Err(Fault::NotAvailable));
}

#[test]
fn direction_is_minus_one_for_values_of_charge() {
    let binding = Binding { charge: vec![1.0, 3.0], ..bind("Pack.Temperature", Channel::CurrentDirection) };
    let map = InputMap::new(vec![Binding { offset: 40.0, ..binding }]);
    let value = |code| readings(&map, 0, &Frame::classic(PACK, &[0, 0, code, 0, 0, 0]).unwrap())[0].1;
    assert_eq!([0, 1, 2, 3].map(value), [Ok(1.0), Ok(-1.0), Ok(1.0), Ok(-1.0)]);
    assert_eq!((value(255), value(251)), (Err(Fault::NotAvailable), Err(Fault::OutOfRange)));
}

#[test]
fn other_bus_other_id_kind_and_remote_frames_are_ignored() {
    let frame = Frame::classic(PACK, &[0; 6]).unwrap();
    assert_eq!(readings(&map(), 0, &frame).len(), 3);
    assert_eq!(readings(&map(), 1, &frame), []);
    assert_eq!(read(CanId::Extended(256), &[0; 6]), []);
    assert_eq!(read(CanId::Standard(258), &[0; 6]), []);
    assert_eq!(readings(&map(), 0, &Frame::remote(PACK, 6).unwrap()), []);
    assert_eq!(readings(&InputMap::default(), 0, &frame), []);
}

#[test]
fn same_identifier_on_two_buses_is_two_messages() {
    let other = Binding { bus: BusIndex(2), ..bind("Pack.Temperature", sensor(5)) };
    let map = InputMap::new(vec![other, bind("Pack.Voltage", Channel::PackVoltage)]);
    let frame = Frame::classic(PACK, &[0; 6]).unwrap();
    assert_eq!(readings(&map, 0, &frame), [(Channel::PackVoltage, Ok(0.0))]);
    assert_eq!(readings(&map, 1, &frame), []);
    assert_eq!(readings(&map, 2, &frame), [(sensor(5), Ok(-40.0))]);
    assert_eq!((map.ids(BusIndex(0)), map.ids(BusIndex(1)), map.ids(BusIndex(2))), (vec![PACK], vec![], vec![PACK]));
}

#[test]
fn identifiers_and_channels_are_unique_and_sorted() {
    assert_eq!(map().ids(BusIndex(0)), [PACK, CELLS]);
    assert_eq!(map().ids(BusIndex(9)), []);
    let all = [Channel::Current, sensor(0), sensor(1), Channel::PackVoltage, cell(0), cell(1), cell(2)];
    assert_eq!(map().channels(), all);
}

/// Signals of every type and position. Some are multiplexed.
fn any_bindings() -> impl Strategy<Value = Vec<Binding>> {
    let order = prop::sample::select(vec![ByteOrder::LittleEndian, ByteOrder::BigEndian]);
    let kind = prop_oneof![
        8 => Just((ValueType::Unsigned, None)),
        8 => Just((ValueType::Signed, None)),
        1 => Just((ValueType::Float32, Some(32))),
        1 => Just((ValueType::Float64, Some(64))),
    ];
    let number = prop_oneof![Just(1.0), Just(0.0), Just(-0.1), Just(0.001), Just(1e300), -1e3..1e3f64];
    let layout =
        (0..128u16, 1..=64u16, order, kind, [number.clone(), number.clone()], [number.clone(), number.clone()]);
    let layout =
        layout.prop_map(|(start_bit, length_bits, byte_order, (value_type, length), [factor, offset], [a, b])| {
            let (minimum, maximum) = (a.min(b), a.max(b));
            let length_bits = length.unwrap_or(length_bits);
            SignalLayout { start_bit, length_bits, byte_order, value_type, factor, offset, minimum, maximum }
        });
    let plan = layout.prop_filter_map("a layout that can be read", |layout| layout.plan().ok());
    let limits = prop::sample::select(vec![(f64::NEG_INFINITY, f64::INFINITY), (f64::NAN, 5.0), (0.0, f64::NAN)]);
    let range = prop_oneof![2 => limits, 3 => (-1e3..0.0, 0.0..1e3)];
    // Codes near both ends of the range for many signal lengths, and random codes.
    let end = (0..64u32, 0..3u64).prop_map(|(down, below)| (u64::MAX >> down).saturating_sub(below));
    let codes = prop::collection::vec(prop_oneof![0..4u64, end, any::<u64>()], 0..4);
    let page = prop::collection::vec((prop::sample::select(vec![0u16, 4, 60]), 0..5u64, 0..3u64), 0..3);
    let binding = (0..2u8, 0..3u32, plan, [number.clone(), number], codes, range, page);
    let binding = binding.prop_map(|(bus, id, plan, [scale, offset], not_available, range, page)| {
        let selector = |start_bit| SignalLayout { start_bit, length_bits: 4, ..SELECTOR }.plan().unwrap();
        let test = |(start, low, more)| MuxTest { plan: selector(start), ranges: vec![(low, low + more), (9, 9)] };
        let id = if id == 2 { CanId::Extended(1) } else { CanId::Standard(id as u16) };
        let mux = page.into_iter().map(test).collect();
        let channel = cell(0);
        let (of_any_source, charge) = (false, Vec::new());
        Binding {
            bus: BusIndex(bus),
            id,
            of_any_source,
            len_bytes: 8,
            plan,
            mux,
            channel,
            scale,
            offset,
            not_available,
            range,
            charge,
        }
    });
    prop::collection::vec(binding, 0..12).prop_map(|mut bindings| {
        bindings.iter_mut().zip(0..).for_each(|(binding, n)| binding.channel = cell(n));
        bindings
    })
}

/// Reference decoder: decodes every binding separately.
fn decode_plainly(map: &InputMap, bus: BusIndex, frame: &Frame, mut each: impl FnMut(Reading)) {
    for binding in map.bindings().iter().filter(|binding| (binding.bus, binding.id) == (bus, frame.id())) {
        let value = match binding.holds(frame.data()) {
            Ok(false) => continue,
            Ok(true) => binding.value(frame.data()),
            Err(fault) => Err(fault),
        };
        each(Reading { channel: binding.channel, value });
    }
}

const SELECTOR: SignalLayout = SignalLayout {
    start_bit: 0,
    length_bits: 4,
    byte_order: ByteOrder::LittleEndian,
    value_type: ValueType::Unsigned,
    factor: 1.0,
    offset: 0.0,
    minimum: 0.0,
    maximum: 0.0,
};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn table_decodes_bit_identical_to_bindings(
        bindings in any_bindings(),
        frames in prop::collection::vec((0..2u8, 0..3u32, prop::collection::vec(prop_oneof![0..16u8, any::<u8>()], 0..17)), 1..20),
    ) {
        let map = InputMap::new(bindings);
        for (bus, id, data) in frames {
            let id = if id == 2 { CanId::Extended(1) } else { CanId::Standard(id as u16) };
            let len = data.len() - data.len() % if data.len() > 8 { 4 } else { 1 };
            let frame = Frame::fd(id, false, false, &data[..len]).unwrap();
            let (mut quick, mut plain) = (Vec::new(), Vec::new());
            let bits = |reading: Reading| (reading.channel, reading.value.map(f64::to_bits));
            map.decode(BusIndex(bus), &frame, |reading| quick.push(bits(reading)));
            decode_plainly(&map, BusIndex(bus), &frame, |reading| plain.push(bits(reading)));
            prop_assert_eq!(quick, plain);
        }
    }
}
