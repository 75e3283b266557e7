//! Tests the search on synthetic logs that contain signals to find and signals to ignore.

#![allow(clippy::unwrap_used, reason = "in a test a panic is the message")]

use super::capture::Capture;
use super::*;
use crate::can::CanId;
use crate::can::isotp::segment;

const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 HV_Pack: 8 A
 SG_ Amps : 0|16@1- (0.1,0) [-1000|1000] "A" A
 SG_ Volts : 16|16@1+ (0.1,0) [0|1000] "V" A
 SG_ Page M : 32|4@1+ (1,0) [0|15] "" A
 SG_ ModuleTemp m0 : 40|8@1+ (1,-40) [-40|215] "degC" A
 SG_ SOC m1 : 40|8@1+ (0.5,0) [0|100] "%" A
BO_ 512 Motor: 8 A
 SG_ MotorCurrent : 0|16@1- (0.1,0) [-1000|1000] "A" A
 SG_ LinkVoltage : 16|16@1+ (0.1,0) [0|1000] "V" A
"#;

fn load_a(step: i32) -> f64 {
    let x = f64::from(step);
    (80.0 * (x * 0.7).sin() + 40.0 * (x * 0.23).cos()).round()
}

fn time(milliseconds: i64) -> Timestamp {
    Timestamp::from_nanos(1_700_000_000_000_000_000 + milliseconds * 1_000_000)
}

fn frame(id: u32, data: &[u8]) -> Frame {
    Frame::classic(CanId::standard(id).unwrap(), data).unwrap()
}

fn names(discovery: &Discovery, quantity: PackQuantity) -> Vec<&str> {
    let found = discovery.candidates.iter().filter(|candidate| candidate.quantity == quantity);
    found.map(|candidate| candidate.signal.as_str()).collect()
}

fn discover(discoverer: &Discoverer) -> Discovery {
    discoverer.finish(&["can0".to_owned()])
}

/// Creates a pack whose voltage falls by 0.1 V per A. `sign` is the sign of the current on the bus.
fn pack(sign: f64) -> Discoverer {
    let mut discoverer = Discoverer::default();
    discoverer.add_database(Database::parse(DBC).unwrap());
    for step in 0..200 {
        let load_a = load_a(step);
        let amps = ((sign * load_a * 10.0) as i16).to_le_bytes();
        let volts = ((400.0 - 0.1 * load_a) * 10.0).round() as u16;
        let [low, high] = volts.to_le_bytes();
        let page = (step % 2) as u8;
        let last = if page == 0 { 65 } else { 120 };
        let bus = BusIndex(0);
        let at = i64::from(step) * 100;
        discoverer.handle(time(at), bus, &frame(0x100, &[amps[0], amps[1], low, high, page, last, 0, 0]));
        let other = (step * 37 % 251) as u8;
        discoverer.handle(time(at + 10), bus, &frame(0x200, &[other, 1, other, 15, 0, 0, 0, 0]));
    }
    discoverer
}

#[test]
fn voltage_gives_the_sign_of_a_current() {
    for (sign, positive) in [(1.0, PositiveDirection::Discharge), (-1.0, PositiveDirection::Charge)] {
        let discovery = discover(&pack(sign));
        let best = &discovery.candidates[0];
        assert_eq!(
            (best.quantity, best.signal.as_str(), best.positive),
            (PackQuantity::Current, "HV_Pack.Amps", Some(positive))
        );
        assert!(best.reasons.iter().any(|reason| reason.contains("0.1000 V per A")), "{:?}", best.reasons);
        assert_eq!(names(&discovery, PackQuantity::PackVoltage)[0], "HV_Pack.Volts");
        assert_eq!(names(&discovery, PackQuantity::Temperature), ["HV_Pack.ModuleTemp"], "multiplexed");
        assert_eq!(names(&discovery, PackQuantity::Soc), ["HV_Pack.SOC"], "multiplexed");
    }
}

#[test]
fn configuration_needs_cell_count_and_has_all_inputs() {
    let mut discoverer = pack(1.0);
    let discovery = discover(&discoverer);
    let settings = PackSettings {
        databases: vec!["car.dbc".to_owned()],
        cell_model: Some("cell.toml".to_owned()),
        ..PackSettings::default()
    };
    let question = discoverer.configuration(&discovery, &settings).unwrap_err().to_string();
    assert!(question.contains("how many cells are in series") && question.contains("--label 96s"), "{question}");
    discoverer.set_label("96s".parse().unwrap());
    let pack = discoverer.configuration(&discovery, &settings).unwrap();
    let table: toml::Table = pack.text.parse().unwrap();
    assert_eq!(table["input"]["current"]["positive"].as_str(), Some("discharge"));
    assert_eq!(table["input"]["pack_voltage"]["signal"].as_str(), Some("HV_Pack.Volts"));
    assert!(pack.open.iter().any(|question| question.contains("cell_model")), "{:?}", pack.open);
}

/// Simulates a controller like that of a Nissan Leaf. Group 01 contains current and pack voltage, group 02 contains 96
/// cells in mV. Both are sent every second. If `is_asked` is set, the log also contains the requests.
fn answers(seconds: i32, is_asked: bool) -> Discoverer {
    let mut discoverer = Discoverer::default();
    for step in 0..seconds {
        let load_a = load_a(step);
        let mut first = vec![0x61, 0x01];
        first.extend(((-load_a * 1024.0) as i32).to_be_bytes());
        first.extend([2, 0xAF, 0xFF, 0xFF, 0xFF, 0xFF, 7, 7]);
        let cell_mv = |n: i32| (3700.0 + f64::from(n % 5) - 1.2 * load_a).round() as u16;
        let sum_v = (0..96).map(|n| f64::from(cell_mv(n))).sum::<f64>() / 1000.0;
        first.extend(((sum_v * 100.0).round() as u16).to_be_bytes());
        first.extend([0; 8]);
        let mut second = vec![0x61, 0x02];
        second.extend((0..96).flat_map(|n| cell_mv(n).to_be_bytes()));
        second.extend([0x9C, 0x40, 0x9C, 0x40]);
        for (offset, group, message) in [(0, 1, first), (100, 2, second)] {
            let at = i64::from(step) * 1000 + offset;
            if is_asked {
                discoverer.handle(time(at), BusIndex(0), &frame(0x79B, &[2, 0x21, group, 0, 0, 0, 0, 0]));
            }
            for (number, payload) in (1..).zip(segment(None, &message, 0xFF)) {
                discoverer.handle(time(at + number), BusIndex(0), &frame(0x7BB, &payload));
            }
        }
    }
    discoverer
}

#[test]
fn undefined_answers_reveal_cells_current_and_voltage() {
    let discoverer = answers(60, true);
    let discovery = discover(&discoverer);
    let cells = discovery.candidates.iter().find(|candidate| candidate.quantity == PackQuantity::CellVoltage).unwrap();
    assert_eq!((cells.signal.as_str(), cells.signals), ("Answer7BB.Cell{n}", 96));
    assert!(
        cells.reasons[0].contains("96 values") && cells.reasons[0].contains("move together"),
        "{:?}",
        cells.reasons
    );
    let voltages = names(&discovery, PackQuantity::PackVoltage);
    assert!(voltages.iter().take(3).any(|name| *name == "Answer7BB.D2101_Voltage_12"), "{voltages:?}");
    let current = &discovery.candidates[0];
    assert_eq!(
        (current.signal.as_str(), current.positive),
        ("Answer7BB.D2101_Current_0", Some(PositiveDirection::Charge))
    );
    let settings = PackSettings { cell_model: Some("cell.toml".to_owned()), ..PackSettings::default() };
    let text = discoverer.configuration(&discovery, &settings).unwrap().text;
    let line =
        "{ name = \"Cell{n}\", numbers = \"1-96\", step = 16, bit = 0, length = 16, factor = 0.001, unit = \"V\" }";
    assert!(text.contains(line) && text.contains("request = 0x79B"), "{text}");
    assert!(text.lines().count() <= 60, "{}", text.lines().count());
}

#[test]
fn unheard_request_is_reported_as_a_guess() {
    let discoverer = answers(60, false);
    let settings = PackSettings { cell_model: Some("cell.toml".to_owned()), ..PackSettings::default() };
    let pack = discoverer.configuration(&discover(&discoverer), &settings).unwrap();
    assert!(pack.open.iter().any(|question| question.contains("0x7B3 is a guess")), "{:?}", pack.open);
}

#[test]
fn signed_current_defined_as_unsigned_is_detected() {
    let text = r#"{"commands": [{"hdr": "7E4", "rax": "7EC", "cmd": {"22": "0101"}, "freq": 1, "signals": [
        {"id": "X_HVBAT_CURR", "name": "", "fmt": {"bix": 0, "len": 16, "max": 6553.5, "div": 10, "unit": "amps"}},
        {"id": "X_HVBAT_DC_VOLT", "name": "", "fmt": {"bix": 32, "len": 16, "max": 100, "min": 50, "unit": "volts"}},
        {"id": "X_HVBAT_VOLT", "name": "", "fmt": {"bix": 16, "len": 16, "max": 1000, "div": 10, "unit": "volts"}}]}]}"#;
    let mut discoverer = Discoverer::default();
    discoverer.add_obdb(text, &ObdbSettings::default()).unwrap();
    for step in 0..60 {
        let load_a = load_a(step);
        let mut message = vec![0x62, 0x01, 0x01];
        message.extend(((load_a * 10.0) as i16).to_be_bytes());
        message.extend((((380.0 - 0.08 * load_a) * 10.0).round() as u16).to_be_bytes());
        message.extend([0x0F, 0xA0]);
        let at = i64::from(step) * 1000;
        discoverer.handle(time(at), BusIndex(0), &frame(0x7E4, &[3, 0x22, 1, 1, 0, 0, 0, 0]));
        for (number, payload) in (1..).zip(segment(None, &message, 0)) {
            discoverer.handle(time(at + number), BusIndex(0), &frame(0x7EC, &payload));
        }
    }
    let discovery = discover(&discoverer);
    let current = &discovery.candidates[0];
    assert_eq!((current.signal.as_str(), current.positive), ("X.HVBAT_CURR", Some(PositiveDirection::Discharge)));
    assert!(current.low < -50.0 && current.reasons.iter().any(|reason| reason.contains("unsigned")), "{current:?}");
    assert_eq!(discovery.remarks.len(), 1);
    assert!(
        discovery.remarks[0].starts_with("X.HVBAT_DC_VOLT: all 60 readings are out of range"),
        "{:?}",
        discovery.remarks
    );
    let settings = PackSettings { cell_model: Some("cell.toml".to_owned()), ..PackSettings::default() };
    discoverer.set_label("98s".parse().unwrap());
    let text = discoverer.configuration(&discovery, &settings).unwrap().text;
    assert!(text.contains("name = \"HVBAT_CURR\", bit = 0, length = 16, signed = true"), "{text}");
}

#[test]
fn answers_with_extended_addresses_are_read() {
    let text = r#"{"commands": [{"hdr": "6F1", "rax": "607", "eax": "07", "cmd": {"22": "DDBC"}, "freq": 1, "signals": [
        {"id": "I3_HVBAT_SOC", "name": "", "fmt": {"len": 16, "max": 100, "div": 10, "unit": "percent"}}]}]}"#;
    let mut discoverer = Discoverer::default();
    discoverer.add_obdb(text, &ObdbSettings::default()).unwrap();
    for step in 0..20_u8 {
        let at = i64::from(step) * 1000;
        discoverer.handle(time(at), BusIndex(0), &frame(0x6F1, &[0x07, 0x03, 0x22, 0xDD, 0xBC, 0, 0, 0]));
        let message = [0x62, 0xDD, 0xBC, 0x02, step, 3, 0x8F, 0, 0x50];
        for (number, payload) in (1..).zip(segment(Some(0xF1), &message, 0xFF)) {
            discoverer.handle(time(at + number), BusIndex(0), &frame(0x607, &payload));
        }
    }
    let discovery = discover(&discoverer);
    assert_eq!((discovery.answers, names(&discovery, PackQuantity::Soc)), (1, vec!["I3.HVBAT_SOC"]));
    let soc = discovery.candidates.iter().find(|candidate| candidate.quantity == PackQuantity::Soc).unwrap();
    assert_eq!((soc.low, soc.high), (51.2, 53.1));
}

#[test]
fn memory_is_bounded_and_keeps_the_same_times() {
    let mut capture = Capture::default();
    let mut handle = |n: i64, id: u32| capture.handle(time(n * 10), BusIndex(0), &frame(id, &[1, 2, 3, 4, 5, 6, 7, 8]));
    for n in 0..1_200_000 {
        handle(n, 0x100);
        handle(n, 0x200);
    }
    for id in 0..8000 {
        let id = CanId::extended(0x10_0000 + id).unwrap();
        capture.handle(time(0), BusIndex(0), &Frame::classic(id, &[0; 8]).unwrap());
    }
    let kept: Vec<usize> = capture.messages.values().take(2).map(super::capture::Payloads::len).collect();
    assert_eq!(kept[0], kept[1]);
    assert!((300_000..2_400_000).contains(&(kept[0] + kept[1])), "{kept:?}");
    assert_eq!((capture.messages.len(), capture.ignored), (4096, 8000 + 2 - 4096));
}

proptest::proptest! {
    #[test]
    fn any_log_is_handled_without_panic(frames in proptest::collection::vec((0_i64..5000, 0_u32..4, proptest::collection::vec(proptest::num::u8::ANY, 0..9)), 0..200)) {
        let mut discoverer = pack(1.0);
        let ids = [0x100, 0x7BB, 0x79B, 0x6F1];
        for (at, id, mut data) in frames {
            // In ISO-TP, the upper four bits of the first byte are the frame type, from 0 to 3. The mask makes it more
            // likely that random frames form multi-frame messages.
            if let Some(first) = data.first_mut() {
                *first &= 0x3F;
            }
            discoverer.handle(time(at), BusIndex(0), &frame(ids[id as usize], &data));
        }
        let discovery = discover(&discoverer);
        let settings = PackSettings { cell_model: Some("cell.toml".to_owned()), ..PackSettings::default() };
        discoverer.set_label("96s".parse().unwrap());
        if let Ok(pack) = discoverer.configuration(&discovery, &settings) {
            proptest::prop_assert!(pack.text.parse::<toml::Table>().is_ok(), "{}", pack.text);
        }
    }
}
