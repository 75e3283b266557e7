//! Tests the record of use: how long and how often temperatures, voltages and currents were beyond their limits. The
//! monitor continues the record after restarts and gaps, and starts a new record when the pack is replaced. Report,
//! export and passport show the record.

use std::fs;
use std::path::Path;

use assert_cmd::Command as Program;
use packwatch::health::UseRecord;
use packwatch::monitor::{Command, Downtime, Record};
use packwatch::quantity::catalogue::Quantity;
use serde_json::Value;

use crate::support::rig::Rig;

const LIMITS: &str = "[outlook]\nmax_temperature_c = 45.0\nmax_charge_a = 2.0\n";

fn record(rig: &Rig) -> UseRecord {
    *rig.monitor.use_record()
}

fn near(found: f64, expected: f64, within: f64) {
    assert!((found - expected).abs() <= within, "{found}, not {expected}");
}

#[test]
fn use_survives_restart_and_ends_with_pack() {
    let mut rig = Rig::new(LIMITS);
    rig.seconds(30);
    assert_eq!(rig.monitor.pack_view().values.mean(Quantity::LimitEvents), Some(0.0));
    rig.temperatures_c[1] = Some(50.0);
    rig.seconds(20);
    rig.restart(Downtime::Seconds(3600.0));
    rig.seconds(10);
    rig.temperatures_c[1] = Some(25.0);
    rig.seconds(30);
    let before = record(&rig);
    near(before.temperature_c.above.beyond_s, 30.0, 0.5);
    near(before.temperature_c.above.known_s, 90.0, 1.5);
    assert_eq!((before.temperature_c.above.events, before.temperature_c.highest), (1, Some(50.0)));
    // If a limit is missing, nothing is counted for it.
    assert_eq!((before.temperature_c.below.known_s, before.current_a.above.known_s), (0.0, 0.0));
    // While the sensor is silent, the temperature is unknown.
    rig.temperatures_c = [None; 2];
    rig.seconds(60);
    let after = record(&rig);
    near(after.temperature_c.unknown_s - before.temperature_c.unknown_s, 58.0, 0.5);
    assert_eq!(rig.monitor.pack_view().values.mean(Quantity::LimitEvents), Some(1.0));
    rig.give(Record::command(rig.now(), Command::PackReplaced));
    assert_eq!(record(&rig), UseRecord::default());
    assert_eq!(rig.monitor.pack_view().values.get(Quantity::LimitEvents), None);
}

#[test]
fn parking_at_high_soc_counts_over_known_downtime_only() {
    let mut rig = Rig::new(LIMITS);
    rig.voltages_v = [Some(4.17); 2];
    rig.seconds(30);
    near(record(&rig).rest.above_90_s, 30.0, 1.0);
    rig.restart(Downtime::Seconds(36_000.0));
    rig.seconds(10);
    near(record(&rig).rest.above_90_s, 36_040.0, 2.0);
    rig.restart(Downtime::Unknown);
    rig.seconds(10);
    near(record(&rig).rest.above_90_s, 36_050.0, 3.0);
}

/// Temperature of the cell (degrees C): 25, except for some minutes at 50.
fn temperature_c(second: u32) -> f64 {
    25.0 + f64::from(second.saturating_sub(600).min(1200_u32.saturating_sub(second)).min(25))
}

/// Current of the cell, positive = discharge (A): 0.75 C, rest, 1.5 C, rest.
fn current_a(second: u32) -> f64 {
    match second {
        0..1800 => 1.5,
        2400..3300 => -3.0,
        _ => 0.0,
    }
}

fn packwatch(folder: &Path, args: &[&str]) {
    Program::cargo_bin("packwatch").unwrap().current_dir(folder).args(args).assert().success();
}

#[test]
fn report_export_and_passport_show_use_of_a_replay() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("accidents.json"), r#"{ "InformationOnAccidents": [] }"#).unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let mut config = fs::read_to_string(shipped.join("measured.toml")).unwrap();
    for name in ["cells/nasa_b0005.toml", "measured.dbc"] {
        config = config.replace(&format!("\"{name}\""), &format!("{:?}", shipped.join(name)));
    }
    fs::write(folder.join("pack.toml"), config + LIMITS).unwrap();
    let model = packwatch::config::load(&folder.join("pack.toml")).unwrap_or_else(|faults| panic!("{faults:?}"));
    let model = model.monitor.model;
    let mut log = String::from("time_s,current_a,voltage_v,temperature_c\n");
    let mut soc = 0.9;
    for second in 0..3900 {
        let (current_a, temperature_c) = (current_a(second), temperature_c(second));
        soc -= current_a / 3600.0 / model.capacity_ah;
        let position = model.grid_position(soc, temperature_c);
        let voltage_v = model.ocv_v(&position) - current_a * model.settled_ohm(&position);
        log += &format!("{},{current_a},{voltage_v:.4},{temperature_c}\n", 1_700_000_000 + second);
    }
    fs::write(folder.join("cell.csv"), log).unwrap();
    packwatch(folder, &["replay", "-c", "pack.toml", "--state", "state", "cell.csv"]);
    packwatch(folder, &["report", "--state", "state", "-o", "report.html"]);
    packwatch(folder, &["export", "-c", "pack.toml", "--format", "csv", "-o", "out", "cell.csv"]);
    let passport = ["passport", "-c", "pack.toml", "--state", "state", "--throughput-before-ah", "0", "--static"];
    packwatch(folder, &[&passport[..], &["accidents.json", "--details", "d.json", "-o", "p.json"]].concat());

    let json = |name: &str| serde_json::from_slice::<Value>(&fs::read(folder.join(name)).unwrap()).unwrap();
    let hot_s = (0..3900).filter(|second| temperature_c(*second) > 45.0).count() as f64;
    let used = &json("d.json")["use_record"];
    let number = |path: &str| used.pointer(path).unwrap().as_f64().unwrap();
    near(number("/temperature_c/above/beyond_s"), hot_s, 2.0);
    near(number("/current_a/below/beyond_s"), 900.0, 2.0);
    near(number("/c_rate/discharge_s/1"), 1800.0, 2.0);
    near(number("/c_rate/charge_s/2"), 900.0, 2.0);
    assert_eq!((number("/half_cycles/charges"), number("/half_cycles/fast_charges")), (1.0, 1.0));
    assert_eq!(number("/half_cycles/discharges/3"), 1.0);

    let condition = json("p.json");
    near(condition["TemperatureInformation"]["TimeExtremeHighTemp"].as_f64().unwrap(), hot_s / 60.0, 0.05);
    assert_eq!(condition["TemperatureInformation"]["TimeExtremeHighTempCharging"], 0.0);
    assert!(condition["TemperatureInformation"].get("TimeExtremeLowTemp").is_none(), "no limit");
    let events = condition["NegativeEvents"].as_array().unwrap();
    let texts: Vec<&str> = events.iter().map(|event| event["NegativeEventValue"].as_str().unwrap()).collect();
    let whats: Vec<_> = texts.iter().filter_map(|text| text.split_once(": 1 x, ")).map(|(what, _)| what).collect();
    // The charge at 1.5 C raises the voltage above that of a full cell in the model.
    let expected =
        ["temperature above its limit", "overcharge: cell voltage above its limit", "charging current above its limit"];
    assert_eq!(whats, expected, "{texts:?}");

    let table = fs::read_to_string(folder.join("out/cell/use_record.csv")).unwrap();
    assert!(table.contains("cell,half_cycles.fast_charges,1") && table.contains("voltage_v.unknown_s"), "{table}");
    let page = fs::read_to_string(folder.join("report.html")).unwrap();
    for part in ["Temperature above its limit", "30 to 40 %: 1", "no limit, or unknown", ">50.0 °C<"] {
        assert!(page.contains(part), "no {part:?}");
    }
}
