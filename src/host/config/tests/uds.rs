//! Tests `[[input.diagnostic]]`: the resulting settings, and the full text of every fault.

#![allow(clippy::panic, reason = "tests may panic")]

use super::*;
use crate::can::uds::{Answer, Service};

/// The cells are in two answers, the current is in a DBC file.
const ANSWERS: &str = r#"
[[input.diagnostic]]
name = "Car"
request = 0x7E4
response = 0x7EC
service = 0x22
identifier = 0x0102
signals = [
  { name = "Cell{n}", numbers = "1-3", bit = 32, length = 8, factor = 0.02, unit = "V", minimum = 1, maximum = 5 },
  { name = "Unused", bit = 0, length = 32 },
]
[[input.diagnostic]]
name = "Car"
request = 0x7E4
response = 0x7EC
service = 0x22
identifier = 0x0103
signals = [{ name = "Cell{n}", numbers = "4-4", bit = 12, length = 10, factor = 0.01, not_available = [0x3FF] }]
"#;

fn pack() -> String {
    pack_with("Cells.CellVoltage{n}", "Car.Cell{n}") + ANSWERS
}

fn readings(answer: &Answer, data: &[u8]) -> Vec<(Channel, Result<f64, Fault>)> {
    answer.readings(data).map(|reading| (reading.channel, reading.value)).collect()
}

#[test]
fn pattern_matches_cells_across_answers() {
    let config = good(&pack());
    let [first, second] = &config.monitor.answers[..] else { panic!("{:?}", config.monitor.answers) };
    assert_eq!((first.question.service, first.question.identifier), (Service::ByIdentifier, 0x102));
    let cell = |index| Channel::CellVoltage(CellIndex(index));
    let data = [0, 0, 0, 0, 180, 0, 255];
    let wanted = [(cell(0), Ok(3.6)), (cell(1), Err(Fault::OutOfRange)), (cell(2), Err(Fault::OutOfRange))];
    assert_eq!(readings(first, &data), wanted, "values are never clamped");
    // The lower four bits of the second byte and the upper six of the third: 0b0101_101000 = 360.
    assert_eq!(readings(second, &[0xFF, 0b1111_0101, 0b1010_0011]), [(cell(3), Ok(3.6))]);
    assert_eq!(readings(second, &[0, 0xFF, 0xFF]), [(cell(3), Err(Fault::NotAvailable))]);
    assert_eq!(readings(second, &[0, 0xFF]), [(cell(3), Err(Fault::ShortFrame))]);
    // Requests are received too: they show which answers were requested.
    let ids = [0x100, 0x7E4, 0x7EC].map(CanId::Standard);
    assert_eq!(config.monitor.wanted_ids(BusIndex(0)), ids);
}

#[test]
fn check_shows_position_in_answer() {
    let (_, description) = read_texts(&pack(), CELL, DBC).unwrap();
    let signal = description.signals.iter().find(|signal| signal.channel == "cell 4 voltage").unwrap();
    assert_eq!((signal.multiplex.as_str(), signal.start_bit), ("answer of 7EC to 22 01 03", 12));
    assert_eq!((signal.dbc.as_str(), signal.id.as_str()), ("input.diagnostic[2]", "7EC"));
}

#[test]
fn voltage_resolution_counts_as_noise() {
    let noise = |pack: &str| good(pack).monitor.estimator.voltage.noise_v;
    let (fine, coarse) = (noise(PACK), noise(&pack()));
    assert_eq!(fine, 0.005, "steps of 1 uV are within the noise");
    // Steps of 20 mV add 5.8 mV rms to the sensor's 5 mV.
    assert!((coarse - 0.005_f64.hypot(0.020 / 12.0_f64.sqrt())).abs() < 1e-12, "{coarse}");
    let (_, description) = read_texts(&pack(), CELL, DBC).unwrap();
    let words = "voltage resolution is 20 mV: rounding counts as noise of 5.8 mV";
    assert!(description.pack.contains(&words.to_owned()), "{:?}", description.pack);
}

#[test]
fn little_endian_and_extended_addresses_are_read() {
    let text = ANSWERS
        .replace("bit = 12, length = 10", "bit = 16, length = 16, byte_order = \"little\", signed = true")
        .replace("response = 0x7EC", "response = 0x18DAF1DB\nresponse_extension = 0xF1")
        .replace("not_available = [0x3FF]", "not_available = [0xFFFF]");
    let config = good(&(pack_with("Cells.CellVoltage{n}", "Car.Cell{n}") + &text));
    let answer = &config.monitor.answers[1];
    assert_eq!(answer.question.controller.response, CanId::Extended(0x18DA_F1DB));
    assert_eq!(answer.question.controller.response_extension, Some(0xF1));
    let value = |data: &[u8]| readings(answer, data)[0].1;
    assert_eq!(value(&[0, 0, 0x68, 0x01]), Ok(3.6));
    assert_eq!(value(&[0, 0, 0xFE, 0xFF]), Ok(-0.02));
    assert_eq!(value(&[0, 0, 0xFF, 0xFF]), Err(Fault::NotAvailable));
}

#[test]
fn answers_are_required_without_dbc() {
    let all = faults(&pack_with("dbc = [\"pack.dbc\"]\n", ""));
    let missing = "pack.toml:6: input.dbc is not set, must be a list of DBC files if there is no [[input.diagnostic]]";
    assert_eq!(all, [missing]);
    let alone = pack()
        .replace("dbc = [\"pack.dbc\"]\n", "")
        .replace("Status.Current", "Car.Unused")
        .replace("[[input.temperature]]\nsignal = \"Status.Temperature\"\n", "");
    assert_eq!(good(&alone).monitor.answers.len(), 2);
}

#[test]
fn answer_faults_are_reported() {
    let cases = [
        (
            "service = 0x22",
            "service = 0x2E",
            "pack.toml:20: input.diagnostic[1].service = 0x2E, must be 0x01, 0x21 or 0x22: services that only read",
        ),
        (
            "service = 0x22",
            "service = 0x21",
            "pack.toml:21: input.diagnostic[1].identifier = 0x0102, must be 0 to 0xFF with this service",
        ),
        (
            "response = 0x7EC",
            "response = 0x7E4",
            "pack.toml:19: input.diagnostic[1].response = 0x7E4, must not be the identifier of the requests",
        ),
        ("length = 8", "length = 65", "pack.toml:23: input.diagnostic[1].signals[1].length = 65, must be 1 to 64"),
        (
            "bit = 32",
            "bti = 32",
            "pack.toml:23: input.diagnostic[1].signals[1].bit is missing, must be a whole number, 0 to 524280 (bits): Position of the first (most significant) bit, counted from the most significant bit of the byte after the echoed service and identifier (like `bix` in OBDb)",
        ),
        (
            "numbers = \"1-3\", ",
            "",
            "pack.toml:23: input.diagnostic[1].signals[1].name = \"Cell{n}\", contains {n}, requires the key numbers",
        ),
        (
            "Cell{n}\", numbers = \"1-3\"",
            "Cell\", numbers = \"1-3\"",
            "pack.toml:23: input.diagnostic[1].signals[1].name = \"Cell\", must contain {n} for the number",
        ),
        (
            "numbers = \"1-3\"",
            "numbers = \"3-1\"",
            "pack.toml:23: input.diagnostic[1].signals[1].numbers = \"3-1\", must be an ascending range of numbers, like \"1-32\"",
        ),
        (
            "minimum = 1, maximum = 5",
            "minimum = 5, maximum = 1",
            "pack.toml:23: input.diagnostic[1].signals[1].maximum = 1, must be above minimum = 5",
        ),
        ("factor = 0.02", "factor = 0", "pack.toml:23: input.diagnostic[1].signals[1].factor = 0, must not be 0"),
        (
            "bit = 32",
            "bit = 33, byte_order = \"little\"",
            "pack.toml:23: input.diagnostic[1].signals[1].byte_order = \"little\", must be \"big\" for a signal that does not consist of whole bytes",
        ),
        (
            "\"Unused\"",
            "\"Cell1\"",
            "pack.toml:24: input.diagnostic[1].signals[2].name = \"Cell1\", must be unique in its answer, but Cell1 already exists",
        ),
        (
            "[0x3FF]",
            "[0x400]",
            "pack.toml:32: input.diagnostic[2].signals[1].not_available = [0x400], must be 0 to 0x3FF, the signal's codes",
        ),
        (
            "bit = 0, length = 32",
            "bit = 524280, length = 32",
            "pack.toml:24: input.diagnostic[1].signals[2].bit = 524280, must lie within an answer of 65535 bytes",
        ),
    ];
    let good = pack();
    for (from, to, fault) in cases {
        assert!(good.contains(from), "{from}");
        let found = faults(&good.replacen(from, to, 1));
        assert!(found.iter().any(|line| line == fault), "{from} -> {to}: {found:#?}");
    }
    let signals_of_no_table = good.replace("signals = [{ name", "signals = 3 # [{ name");
    let found = faults(&signals_of_no_table);
    assert_eq!(found, ["pack.toml:32: input.diagnostic[2].signals = 3, must be tables [[input.diagnostic.signals]]"]);
}

#[test]
fn only_configured_requests_are_sent_and_listed() {
    let polled =
        pack().replacen("identifier = 0x0102", "identifier = 0x0102\ndrive_every_s = 2\ncharge_every_s = 10", 1);
    assert_eq!(good(&polled).monitor.poll, None, "off by default");
    let on = polled.clone() + "[poll]\nenabled = true\n";
    let (config, description) = read_texts(&on, CELL, DBC).unwrap();
    let poll = config.monitor.poll.clone().unwrap();
    let [request] = &poll.requests[..] else { panic!("{poll:?}") };
    assert_eq!((request.every_s, request.has_voltages), ([Some(2.0), Some(10.0), None], true));
    assert!(config.monitor.wants_all(BusIndex(0)), "all frames are needed to detect whether the bus sleeps");
    let words = [
        "can0: asks 7E4 for 22 01 02 every 2 s while driving, every 10 s while charging",
        "at most 10 requests a second, one at a time; nothing else can be sent to a controller",
        "silent for 60 s after another tester's request, while the bus sleeps, and on standby",
        "the vehicle's supply voltage is not monitored ([input.supply_voltage])",
    ];
    assert_eq!(description.polling, words);
    let supplied = on.clone() + "[input.supply_voltage]\nsignal = \"Status.Total\"\nminimum_v = 12\n";
    let (config, description) = read_texts(&supplied, CELL, DBC).unwrap();
    assert!(config.monitor.poll.unwrap().watches_supply);
    assert!(
        description.polling[2].contains("while the supply is below 12 V or not known"),
        "{:?}",
        description.polling
    );
}

#[test]
fn polling_faults_are_reported() {
    let none = pack() + "[poll]\nenabled = true\n";
    let fault = "pack.toml:34: poll.enabled = true, must be false, because nothing would be requested: no [[input.diagnostic]] whose \
                 signals are used has drive_every_s, charge_every_s or parked_every_s";
    assert_eq!(faults(&none), [fault]);
    let polled = pack().replace("Status.Current", "Car.Unused").replacen(
        "identifier = 0x0102",
        "identifier = 0x0102\ndrive_every_s = 2",
        1,
    );
    let fault = "pack.toml:35: poll.enabled = true, must be false, or input.diagnostic[1] must have parked_every_s: without the current it is unknown whether the car drives";
    assert_eq!(faults(&(polled + "[poll]\nenabled = true\n")), [fault]);
}
