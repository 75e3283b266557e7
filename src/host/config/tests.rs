//! Tests valid and invalid configuration files. Users read the fault messages, so the tests compare these messages in
//! full.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use proptest::prelude::*;

mod alarms;
mod balancing;
mod cell_model;
mod definitions;
mod drop_ins;
mod faults;
mod j1939;
mod label;
mod modules;
mod plausible;
mod protect;
mod uds;

use super::*;
use crate::can::dbc::{Database, FrameFormat};
use crate::can::e2e::{Profile, Protection};
use crate::can::encode::OutputPlan;
use crate::can::{CanId, Frame};
use crate::health::{CapacityMethod, RechargeAlarm};
use crate::quantity::{BusIndex, CellIndex, Channel, Fault, SensorIndex};
use crate::sample::VoltageSource;

const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 0|16@1- (0.1,0) [-300|500] "A" A
 SG_ Total : 16|16@1+ (0.1,0) [0|100] "V" A
 SG_ Temperature : 32|8@1+ (1,-40) [-40|100] "degC" A
BO_ 272 Cells: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|1] "" A
 SG_ CellVoltage1 m0 : 8|16@1+ (0.001,0) [0|0] "mV" A
 SG_ CellVoltage2 m0 : 24|16@1+ (0.001,0) [0|0] "mV" A
 SG_ CellVoltage3 m1 : 8|16@1+ (0.001,0) [0|0] "mV" A
 SG_ CellVoltage4 m1 : 24|16@1+ (0.001,0) [0|0] "mV" A
BO_ 288 Long: 12 A
 SG_ Current : 0|16@1- (0.1,0) [0|0] "A" A
VAL_ 256 Current -32768 "not available" ;
"#;

const CELL: &str = r#"format = 1
name = "test"
rated_capacity_ah = 2.0
capacity_ah = 1.9
voltage_min_v = 2.5
voltage_max_v = 4.2
[provenance]
anything = ["goes", 1]
[tables]
soc = [0, 0.5, 1]
temperature_c = [10, 30]
ocv_v = [[3.0, 3.6, 4.1], [3.0, 3.6, 4.2]]
r0_ohm = [[0.1, 0.1, 0.1], [0.05, 0.05, 0.05]]
[[tables.branches]]
r_ohm = [[0.1, 0.1, 0.1], [0.05, 0.05, 0.05]]
c_farad = [[100, 100, 100], [100, 100, 100]]
"#;

/// A valid configuration; line 1 is `[pack]`.
const PACK: &str = r#"[pack]
cells = 4
cell_model = "cell.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "charge"
[input.cell_voltage]
signal = "Cells.CellVoltage{n}"
[[input.temperature]]
signal = "Status.Temperature"
"#;

fn read_texts(pack: &str, cell: &str, dbc: &str) -> Result<(Config, Description), Vec<String>> {
    read_merged(pack, cell, dbc, &[])
}

/// Reads the configuration with drop-ins named 1.toml, 2.toml and so on.
fn read_merged(pack: &str, cell: &str, dbc: &str, drop_ins: &[&str]) -> Result<(Config, Description), Vec<String>> {
    let names: Vec<String> = (1..=drop_ins.len()).map(|number| format!("{number}.toml")).collect();
    let own = include_str!("../../../config/packwatch.dbc");
    let files = [("pack.toml", pack), ("cell.toml", cell), ("pack.dbc", dbc), ("twin.dbc", DBC), ("own.dbc", own)];
    let mut files = HashMap::from(files);
    files.extend(names.iter().map(String::as_str).zip(drop_ins.iter().copied()));
    let read = |path: &Path| match path.to_str().and_then(|name| files.get(name)) {
        Some(text) => Ok(text.as_bytes().to_vec()),
        None => Err(std::io::ErrorKind::NotFound.into()),
    };
    let files = ConfigFiles { main: "pack.toml".into(), drop_ins: names.iter().map(PathBuf::from).collect() };
    describe_with(&files, &read).map_err(|faults| faults.0)
}

fn good(pack: &str) -> Config {
    read_texts(pack, CELL, DBC).unwrap().0
}

fn faults(pack: &str) -> Vec<String> {
    read_texts(pack, CELL, DBC).unwrap_err()
}

/// Returns `PACK` with the first `from` replaced by `to`. `PACK` must contain `from`.
fn pack_with(from: &str, to: &str) -> String {
    assert!(PACK.contains(from), "{from}");
    PACK.replacen(from, to, 1)
}

#[test]
fn valid_file_gives_settings_and_defaults() {
    let config = good(PACK);
    let monitor = &config.monitor;
    assert_eq!(config.interfaces, [InterfaceConfig { name: "can0".to_owned(), fd: false }]);
    assert_eq!((monitor.sample.cells, monitor.sample.voltage_source), (4, VoltageSource::Cells));
    assert_eq!(monitor.sample.sensor_of_cell, [Some(SensorIndex(0)); 4]);
    assert_eq!((monitor.estimator.initial.capacity_ah, monitor.estimator.initial.capacity_std_ah), (1.9, 0.19));
    let recharge = monitor.health.recharge;
    assert_eq!((recharge.from_soc, recharge.to_soc, recharge.reference_current_a), (0.3, 0.9, 1.0), "C/2 of 2 Ah");
    assert_eq!((recharge.min_coverage, recharge.alarm_on), (0.5, RechargeAlarm::Raw));
    assert_eq!(monitor.health.transition.dead_band_a, 0.04, "C/50 of the label's 2 Ah");
    assert_eq!(monitor.health.capacity.method, CapacityMethod::Swing);
    assert_eq!((monitor.health.usable, monitor.rules.len()), (None, 0));
}

#[test]
fn limits_are_derived_from_dbc_and_cell_model() {
    let sample = good(PACK).monitor.sample;
    assert_eq!((sample.current.min, sample.current.max), (-500.0, 300.0), "charge is positive on the bus");
    assert_eq!((sample.voltage.min, sample.voltage.max), (1.25, 4.7), "[0|0] in the DBC gives no range");
    assert_eq!((sample.temperature.min, sample.temperature.max), (-40.0, 100.0));
    let sample = good(&format!("{PACK}[limits.current]\nmax_charge_a = 20\n")).monitor.sample;
    assert_eq!((sample.current.min, sample.current.max), (-20.0, 300.0));
}

#[test]
fn contactor_open_values_are_read() {
    let table = "[input.contactor]\nsignal = \"Cells.Page\"\n";
    let contactor = good(&format!("{PACK}{table}open = [0, 2.5]\n")).monitor.sample.contactor.unwrap();
    assert_eq!((contactor.open, contactor.limits.max_age_s), (vec![0.0, 2.5], 5.0));
    assert_eq!(good(PACK).monitor.sample.contactor, None);
    let bad = [
        ("", "pack.toml:15: input.contactor.open is missing, must be a list of numbers that is not empty"),
        ("open = []\n", "pack.toml:17: input.contactor.open = [], must"),
        ("open = [nan]\n", "pack.toml:17: input.contactor.open"),
        ("open = [0]\nmax_age_s = 0\n", "pack.toml:18: input.contactor.max_age_s = 0, must be above 0"),
    ];
    for (keys, fault) in bad {
        let found = faults(&format!("{PACK}{table}{keys}"));
        assert!(found.len() == 1 && found[0].starts_with(fault), "{found:?}");
    }
}

#[test]
fn pack_voltage_is_divided_by_series_cells() {
    let pack = pack_with(
        "[input.cell_voltage]\nsignal = \"Cells.CellVoltage{n}\"",
        "[input.pack_voltage]\nsignal = \"Status.Total\"",
    );
    let sample = good(&pack).monitor.sample;
    assert_eq!((sample.cells, sample.voltage_source), (1, VoltageSource::PackTotal { series: 4 }));
    assert_eq!(sample.voltage.max, 4.7, "100 V divided by four cells exceeds the cell model's limit");
    assert_eq!(sample.sensor_of_cell, [Some(SensorIndex(0))]);
}

fn decoded(config: &Config, id: u16, payload: &[u8]) -> Vec<(Channel, Result<f64, Fault>)> {
    let frame = Frame::classic(CanId::Standard(id), payload).unwrap();
    let mut readings = Vec::new();
    config.monitor.input.decode(BusIndex(0), &frame, |reading| readings.push((reading.channel, reading.value)));
    readings
}

#[test]
fn readings_are_mapped_with_sign_scale_and_cell() {
    let pack = pack_with("\"charge\"", "\"charge\"\nscale = 0.5\nnot_available = [0x7FFF]")
        .replace("Status.Temperature\"", "Status.Temperature\"\noffset = -1");
    let config = good(&pack);
    let temperature = Channel::Temperature(SensorIndex(0));
    let status = decoded(&config, 0x100, &[100, 0, 0, 0, 65, 0, 0, 0]);
    assert_eq!(status, [(Channel::Current, Ok(-5.0)), (temperature, Ok(24.0))]);
    for code in [[0xFF, 0x7F], [0x00, 0x80]] {
        let status = decoded(&config, 0x100, &[code[0], code[1], 0, 0, 65, 0, 0, 0]);
        assert_eq!(
            status[0],
            (Channel::Current, Err(Fault::NotAvailable)),
            "this code is configured, or listed in the DBC's value table"
        );
    }
    let second_page = decoded(&config, 0x110, &[1, 0xE8, 0x03, 0xD0, 0x07, 0, 0, 0]);
    let (cell_3, cell_4) = (Channel::CellVoltage(CellIndex(2)), Channel::CellVoltage(CellIndex(3)));
    assert_eq!(second_page, [(cell_3, Ok(1.0)), (cell_4, Ok(2.0))]);
    assert!(decoded(&config, 0x120, &[0; 8]).is_empty(), "the message is not configured");
}

#[test]
fn nothing_is_sent_by_default() {
    assert!(good(PACK).monitor.output.is_none());
    assert!(good(&format!("{PACK}[output]\nenabled = false\n[output.status]\nid = 5\n")).monitor.output.is_none());
}

#[test]
fn identifiers_and_periods_are_configured_or_from_dbc() {
    let output = good(&format!("{PACK}[output]\n")).monitor.output.unwrap();
    assert_eq!(output.plan.ids(), [0x6B0, 0x6B1, 0x6B2, 0x6B4].map(CanId::Standard));
    assert_eq!((output.buses, output.status_period_s), (vec![BusIndex(0)], 0.1));
    let text = "[output.status]\nextended = true\nid = 0x18FF_0001\nperiod_ms = 200\n";
    let output = good(&format!("{PACK}{text}")).monitor.output.unwrap();
    assert_eq!(output.plan.ids()[..2], [CanId::Extended(0x18FF_0001), CanId::Standard(0x6B1)]);
    assert_eq!((output.status_period_s, output.alarm_period_s), (0.2, 1.0));
}

#[test]
fn layout_shows_frame_kind_and_protection() {
    let text = "[output.status]\nfd = true\nbrs = true\ne2e = \"5\"\ndata_id = 0x1234\n[output.alarm]\ne2e = \"1C\"\n\
                data_id = 7\n";
    let pack = pack_with("\"can0\"", "\"can0\"\nfd = true");
    let config = good(&format!("{pack}{text}"));
    let plan = config.monitor.output.unwrap().plan;
    let formats: Vec<_> = plan.messages().map(|sent| sent.format).collect();
    let classic = FrameFormat::Classic;
    assert_eq!(formats, [FrameFormat::Fd { brs: true }, classic, classic, classic]);
    let wanted = |profile, data_id| Some(Protection { profile, data_id });
    let protections: Vec<_> = plan.messages().map(|sent| sent.protection).collect();
    assert_eq!(protections, [wanted(Profile::P05, 0x1234), None, wanted(Profile::P01C, 7), None]);
    let layout = config.output_layout.unwrap();
    assert_eq!(layout.messages.len(), 4, "no command frame is configured");
    assert_eq!(OutputPlan::new(&Database::parse(&layout.to_dbc()).unwrap()).unwrap().without_outlook(), plan);
}

#[test]
fn longer_header_does_not_shift_custom_output_dbc() {
    let pack = pack_with("\"can0\"", "\"can0\"\nfd = true");
    let text = "[output]\ndbc = \"own.dbc\"\n[output.status]\nfd = true\ne2e = \"5\"\ndata_id = 1\n";
    let fault = "pack.toml:20: output.status.e2e = \"5\", signal PACKWATCH_Status.Soc begins at bit 16, must leave the 24 \
                 bits of the header of profile 5 free";
    assert_eq!(faults(&format!("{pack}{text}")), [fault]);
}

#[test]
fn ah_resolution_fits_configured_cell() {
    let cell = CELL.replace("rated_capacity_ah = 2.0", "rated_capacity_ah = 100.0");
    let (config, _) = read_texts(&format!("{PACK}[output]\n"), &cell, DBC).unwrap();
    let layout = config.output_layout.unwrap();
    assert_eq!(layout.signal("PACKWATCH_Alarm.Value_CapacityLow").unwrap().1.layout.factor, 0.05);
}

#[test]
fn incomplete_output_dbc_is_rejected() {
    let all = faults(&format!("{PACK}[output]\ndbc = \"twin.dbc\"\n"));
    assert_eq!(all[0], "pack.toml:16: output.dbc = \"twin.dbc\", message PACKWATCH_Status is missing");
    assert_eq!(all.len(), 3);
}

#[test]
fn hex_and_underscores_are_accepted_in_numbers() {
    let output =
        "[output.status]\nid = 0x5_00\n[estimator]\nconsistency_window_s = 1_000\nvoltage_noise_v = 2_0.0e-0_1\n";
    let config = good(&format!("{PACK}{output}"));
    assert_eq!(config.monitor.estimator.consistency.window_s, 1000.0);
    assert_eq!(config.monitor.estimator.voltage.noise_v, 2.0);
}

#[test]
fn syntax_error_does_not_affect_other_faults() {
    let pack = pack_with("cells = 4", "cells = = 4").replace("\"charge\"", "\"in\"").replace("[input]", "[inp");
    let expected = [
        "pack.toml:2: invalid TOML: extra `=`, expected nothing",
        "pack.toml:6: invalid TOML: unclosed table, expected `]`",
        "pack.toml:10: input.current.positive = \"in\", must be charge or discharge",
    ];
    let all = faults(&pack);
    for fault in expected {
        assert!(all.contains(&fault.to_owned()), "{all:#?}");
    }
    assert!(!all.iter().any(|fault| fault.contains("missing")), "{all:#?}");
    let all = read_texts(PACK, DBC, DBC).unwrap_err();
    let expected = [
        (0, "cell.toml: has no [tables], must be a cell model file (format, name, [tables], ...)"),
        (11, "cell.toml:11: and 7 more syntax faults from here on; is this file really TOML?"),
        (
            12,
            "pack.toml:3: pack.cell_model = \"cell.toml\", must be a cell model file, relative to the folder of the configuration",
        ),
    ];
    assert_eq!(all.len(), 13);
    expected.iter().for_each(|&(index, fault)| assert_eq!(all[index], fault));
}

#[test]
fn signal_needs_interface_if_several_exist() {
    let all = faults(&format!("{PACK}[[interface]]\nname = \"can1\"\n"));
    let expected = [
        "pack.toml:8: input.current.interface is not set, must be can0 or can1",
        "pack.toml:11: input.cell_voltage.interface is not set, must be can0 or can1",
        "pack.toml:13: input.temperature[1].interface is not set, must be can0 or can1",
    ];
    assert_eq!(all, expected);
}

#[test]
fn signal_in_two_dbc_files_is_ambiguous() {
    let all = faults(&pack_with("[\"pack.dbc\"]", "[\"pack.dbc\", \"twin.dbc\"]"));
    assert_eq!(
        all[0],
        "pack.toml:9: input.current.signal = \"Status.Current\", must be unique, but is in pack.dbc and twin.dbc"
    );
    let cell = "pack.toml:12: input.cell_voltage.signal = \"Cells.CellVoltage{n}\", must match one signal per cell, but number 1 matches Cells.CellVoltage1 and Cells.CellVoltage1";
    assert!(all.contains(&cell.to_owned()), "{all:#?}");
}

#[test]
fn faults_of_all_files_are_sorted_by_line() {
    let pack =
        pack_with("cells = 4", "cells = 0\nx = 1").replace("\"charge\"", "\"in\"") + "[recharge]\nto_soc = 0.1\n";
    let cell = CELL.replace("capacity_ah = 1.9", "capacity_ah = 0").replace("[0, 0.5, 1]", "[0, 0.5, 0.5]");
    let all = read_texts(&pack, &cell, "VERSION \"\"\nBO_ 4000 Cells: 8 A\n").unwrap_err();
    let expected = [
        "pack.toml:2: pack.cells = 0, must be 1 to 1024",
        "pack.toml:3: pack.x is not a known key, must be one of cells, strings, cell_model, chemistry, prior, learn_model, balancing, \
         voltage_min_v, voltage_max_v, rated_capacity_ah, initial_capacity_ah, initial_capacity_std_ah, ambient_c, module",
        "pack.toml:11: input.current.positive = \"in\", must be charge or discharge",
        "pack.toml:17: recharge.to_soc = 0.1, must be above recharge.from_soc = 0.3",
        "cell.toml:4: capacity_ah = 0, must be 0.001 to 100000",
        "cell.toml:10: tables.soc = [0, 0.5, 0.5], must begin with 0 and end with 1",
        "cell.toml:10: tables.soc: 0.5 follows 0.5, must rise strictly",
        "pack.dbc: contains no message, must be a DBC file with at least one message (BO_)",
        "pack.dbc:2: message Cells is left out: identifier 4000, must be 0 to 2047, or 2147483648 (bit 31, extended) plus 0 to \
         536870911",
    ];
    assert_eq!(all, expected);
}

#[test]
fn invalid_utf_8_is_reported_with_line() {
    let read = |_: &Path| Ok(b"[pack]\ncells = \xFF".to_vec());
    assert_eq!(
        load_with(&ConfigFiles::alone(Path::new("pack.toml")), &read).unwrap_err().0,
        ["pack.toml:2: is not UTF-8 text, must be a TOML file"]
    );
}

#[test]
fn vehicle_strings_are_optional_and_limited() {
    assert_eq!(good(PACK).vehicle, VehicleIdentity::default());
    let config = good(&format!("{PACK}[vehicle]\nid = \"WDB1\"\n"));
    assert_eq!(config.vehicle.to_string(), "WDB1");
    let all = faults(&format!("{PACK}[vehicle]\nname = \"\"\nid = \"a\\u0007b\"\npack = \"{}\"\n", "x".repeat(65)));
    assert!(all[0].ends_with("vehicle.name = \"\", must be a string that is not empty"), "{all:?}");
    let all = faults(&format!("{PACK}[vehicle]\nid = \"a\\u0007b\"\npack = \"{}\"\n", "x".repeat(65)));
    assert_eq!(all.len(), 2, "{all:?}");
    assert!(all.iter().all(|fault| fault.ends_with("must be at most 64 characters without control characters")));
}

#[test]
fn documented_defaults_are_the_real_ones() {
    use super::schema::{Presence, SECTIONS};
    for info in SECTIONS.iter().chain(super::cell_model::SECTIONS) {
        for key in info.keys.unwrap_or(&[]) {
            assert!(!key.about.trim().is_empty() && key.about.trim().ends_with('.'), "{}.{}", info.path, key.name);
            if let Presence::Optional(default) = key.presence {
                assert!(!default.is_empty(), "{}.{} states its default", info.path, key.name);
            }
        }
    }
    // Reading this file parses the defaults of the keys that it does not set.
    good(PACK);
}

#[test]
fn reference_page_matches_committed_file() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/src/reference/keys.md");
    let page = std::fs::read_to_string(path).unwrap();
    assert!(page == reference(), "regenerate it: packwatch check --reference > docs/src/reference/keys.md");
    for key in super::schema::SECTIONS.iter().chain(super::cell_model::SECTIONS).filter_map(|info| info.keys).flatten()
    {
        assert!(page.contains(&format!("| `{}` |", key.name)), "{}", key.name);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// After random deletions and insertions, the result is a configuration or a non-empty list of faults, never a
    /// panic.
    #[test]
    fn any_corrupted_file_gives_faults_or_configuration(
        edits in prop::collection::vec((0..3_usize, any::<prop::sample::Index>(), 0..24_usize, any::<prop::sample::Index>()), 1..6),
    ) {
        const SCRAPS: [&str; 14] = [
            "", "\n", "=", "[", "]", "\"", "{n}", "-1", "1e999", "[[alarm]]\n", "[input]\n", "nan", "0xFFFFFFFFFFFFFFFFFFF", "\u{e9}",
        ];
        let full = format!(
            "{PACK}[[alarm]]\nrule = \"capacity_low\"\nwarning = 1\n[output.status]\nid = 1\n{}",
            j1939::TABLE
        );
        let mut texts = [full.chars().collect::<Vec<_>>(), CELL.chars().collect(), DBC.chars().collect()];
        for (file, place, length, scrap) in edits {
            let text = &mut texts[file];
            let from = place.index(text.len() + 1);
            let to = (from + length).min(text.len());
            text.splice(from..to, SCRAPS[scrap.index(SCRAPS.len())].chars());
        }
        let texts = texts.map(|chars| chars.into_iter().collect::<String>());
        if let Err(faults) = read_texts(&texts[0], &texts[1], &texts[2]) {
            prop_assert!(!faults.is_empty());
            for fault in faults {
                prop_assert!(!fault.contains('\n') && !fault.contains("bug in packwatch"), "{fault}");
            }
        }
    }
}
