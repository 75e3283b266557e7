//! Runs `packwatch passport` as a user does. Checks the values against the numbers in the store, the handling of
//! unknown values, and the formats of both standards.
//!
//! Two independent programs ("peers") also check the formats. If a peer is missing, its test reports that it was
//! skipped:
//!
//! - IDTA's template, checked by `aas-submodel-validate`. `PACKWATCH_PYTHON` names a Python that has this package.
//! - the published JSON schemas. `PACKWATCH_SCHEMAS` names a folder with `ProductConditionBattery-schema.json` (1.0.1)
//!   and `BatteryPass-schema.json` (6.0.0).

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::Command;
use serde_json::{Value, json};

/// Number of parallel strings of the simulated pack. Each string carries half of the pack current.
const STRINGS: f64 = 2.0;
const RATED_AH: f64 = 2.0;

/// Values in Catena-X's part `performance.dynamic` that packwatch provides, with their units.
const MEASURED: [(&str, &str); 12] = [
    ("/stateOfCharge", "%"),
    ("/fullCycles", "1"),
    ("/capacity/fade", "%"),
    ("/capacity/throughput", "Ah"),
    ("/capacity/capacity", "Ah"),
    ("/resistance/increase/cell", "%"),
    ("/resistance/increase/pack", "%"),
    ("/resistance/remaining/cell", "ohm"),
    ("/resistance/remaining/pack", "ohm"),
    ("/energy/soce", "%"),
    ("/energy/remaining", "kWh"),
    ("/energy/throughput", "kWh"),
];

fn packwatch(args: &[&str]) -> Output {
    let mut command = Command::cargo_bin("packwatch").expect("Cargo builds the binary");
    command.env("RUNTIME_DIRECTORY", "/nonexistent").args(args).output().expect("it runs")
}

fn good(args: &[&str]) -> String {
    let output = packwatch(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// Standard error of a rejected command. The command must not write anything.
fn refused(args: &[&str]) -> String {
    let output = packwatch(args);
    assert_eq!(output.status.code(), Some(1), "{args:?}: {}", String::from_utf8_lossy(&output.stdout));
    assert!(output.stdout.is_empty(), "{}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8(output.stderr).expect("text")
}

fn passport(args: &[&str]) -> Value {
    serde_json::from_str(&good(&[&["passport"], args].concat())).expect("JSON")
}

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// The document with the manufacturer's data for the measured cell.
fn cell_part() -> Value {
    let text = fs::read_to_string(shipped("tests/integration/passport_cli/manufacturer.json")).expect("a file");
    serde_json::from_str(&text).expect("JSON")
}

fn manufacturer() -> Value {
    let mut part = cell_part();
    part["performance"]["rated"]["capacity"]["value"] = json!(4.0);
    part["performance"]["rated"]["energy"]["value"] = json!(0.014);
    part
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-6 * b.abs().max(1.0)
}

/// The shipped configuration of a measured cell, with absolute paths and without outputs, which take half of the time.
fn measured_config() -> String {
    let mut text = fs::read_to_string(shipped("config/measured.toml")).expect("a file");
    for name in ["cells/nasa_b0005.toml", "measured.dbc"] {
        text = text.replace(&format!("\"{name}\""), &format!("{:?}", shipped("config").join(name)));
    }
    text.split_once("[output]").expect("outputs").0.to_owned()
}

struct Life(tempfile::TempDir);

impl Life {
    fn new() -> Self {
        let life = Self::configured("");
        life.simulate("life.log", "1700000000", &["--cycles", "3"]);
        life.replay(&["life.log"]);
        life
    }

    fn configured(more: &str) -> Self {
        let life = Self(tempfile::tempdir().expect("a folder"));
        let text = measured_config()
            .replace("cells = 1\n", "cells = 1\nstrings = 2\n")
            .replace("current_a = 2.0", "current_a = 1.0");
        fs::write(life.path("pack.toml"), text + more).expect("written");
        fs::write(life.path("accidents.json"), r#"{ "InformationOnAccidents": [] }"#).expect("written");
        life
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    fn simulate(&self, log: &str, start_s: &str, more: &[&str]) {
        let args = [
            "simulate",
            "paper",
            "-c",
            &self.path("pack.toml"),
            "-o",
            &self.path(log),
            "--start",
            start_s,
            "--capacity-ah",
            "1.9",
        ];
        good(&[&args, more].concat());
    }

    /// Appends two minutes at rest to a log because the simulation ends under load.
    fn rest(&self, log: &str) {
        let mut text = fs::read_to_string(self.path(log)).expect("a log");
        let last = text.lines().last().expect("a line").to_owned();
        let (end_s, data) = (&last[1..last.find('.').expect("a stamp")], &last[last.find('#').expect("a frame") + 1..]);
        let end_s: u64 = end_s.parse().expect("a number");
        // The voltage (bytes 0 to 2) is in 10 uV, the current (bytes 3 to 5) in 0.1 mA. At rest, the drop of the last
        // current across 0.1 ohm disappears, so it is added to the voltage.
        let number = |at: usize| {
            let byte = |k: usize| i32::from_str_radix(&data[2 * k..2 * k + 2], 16).expect("a byte");
            (byte(at + 2) << 24 | byte(at + 1) << 16 | byte(at) << 8) >> 8
        };
        let [low, middle, high, _] = (number(0) + number(3)).to_le_bytes();
        let temperature = &data[12..];
        (1..=120).for_each(|s| {
            text +=
                &format!("({}.000000000) vcan0 100#{low:02X}{middle:02X}{high:02X}000000{temperature}\n", end_s + s);
        });
        fs::write(self.path(log), text).expect("written");
    }

    fn replay(&self, logs: &[&str]) {
        let logs: Vec<String> = logs.iter().map(|log| self.path(log)).collect();
        let logs: Vec<&str> = logs.iter().map(String::as_str).collect();
        good(&[&["replay", "-c", &self.path("pack.toml"), "--state", &self.path("state")], &logs[..]].concat());
    }

    fn of_store(&self) -> Vec<String> {
        let args = ["-c", &self.path("pack.toml"), "--state", &self.path("state"), "--throughput-before-ah", "0"];
        args.map(str::to_owned).to_vec()
    }

    fn write(&self, name: &str, document: &Value) -> String {
        fs::write(self.path(name), document.to_string()).expect("written");
        self.path(name)
    }
}

fn with<'a>(args: &'a [String], more: &[&'a str]) -> Vec<&'a str> {
    args.iter().map(String::as_str).chain(more.iter().copied()).collect()
}

#[test]
fn passport_matches_store_and_is_reproducible() {
    let life = Life::new();
    let (args, accidents, details) = (life.of_store(), life.path("accidents.json"), life.path("details.json"));
    let args = with(&args, &["--static", &accidents, "--details", &details]);
    let condition = passport(&args);
    let details: Value = serde_json::from_str(&fs::read_to_string(&details).expect("a file")).expect("JSON");
    let rows: Value =
        serde_json::from_str(&good(&["history", "--state", &life.path("state"), "--json", "--limit", "0"]))
            .expect("JSON");
    let rows: Vec<&Value> = rows["rows"].as_array().expect("rows").iter().collect();
    let of = |kind: &str| rows.iter().filter(|row| row["kind"] == kind).copied().collect::<Vec<&Value>>();
    let moved_ah: f64 =
        STRINGS * of("half_cycle").iter().map(|row| row["charge_ah"].as_f64().expect("a number")).sum::<f64>();
    assert!(moved_ah > 5.0, "{moved_ah} Ah");
    assert!(close(condition["CapacityThroughput"]["CapacityThroughputValue"].as_f64().unwrap(), moved_ah));
    let cycles = moved_ah / (2.0 * STRINGS * RATED_AH);
    assert_eq!(condition["NumberOfFullCycles"]["NumberOfFullCyclesValue"], json!(cycles.floor() as u64));
    let detail = |name: &str| details["values"].as_array().unwrap().iter().find(|one| one["name"] == name).cloned();
    assert!(close(detail("full_cycles").unwrap()["value"].as_f64().unwrap(), cycles));
    let last = of("capacity").last().copied().cloned().expect("learned");
    let number = |name: &str| last[name].as_f64().expect("a number");
    let capacity = &condition["RemainingCapacity"]["RemainingCapacityValue"];
    assert!(close(capacity.as_f64().unwrap(), STRINGS * number("capacity_ah")));
    let known = detail("remaining_capacity").unwrap();
    assert!(close(known["std"].as_f64().unwrap(), STRINGS * number("capacity_std_ah")));
    assert_eq!(known["time"], condition["RemainingCapacity"]["LastUpdate"]);
    let increase = detail("cell_resistance_increase").unwrap();
    assert!(close(increase["value"].as_f64().unwrap(), 100.0 * (number("resistance_ratio") - 1.0)));
    assert_eq!(increase["path"], Value::Null, "IDTA has no member for the increase");
    let soc = condition["StateOfCharge"]["StateOfChargeValue"].as_f64().unwrap();
    assert!((0.0..=100.0).contains(&soc), "{soc}");
    assert!((10.0..40.0).contains(&condition["TemperatureInformation"]["MeasuredTemp"].as_f64().unwrap()));
    for absent in ["EnergyThroughput", "StateOfCertifiedEnergy", "CurrentSelfDischargingRate"] {
        assert!(condition.get(absent).is_none(), "{absent}: {condition}");
    }
    // The charges of this scenario end at 4.27 V; the limit of the cell model is 4.2 V.
    let event = condition["NegativeEvents"][0]["NegativeEventValue"].as_str().unwrap();
    assert!(event.starts_with("overcharge: cell voltage above its limit: "), "{event}");
    let why = |name: &str| {
        details["absent"].as_array().unwrap().iter().find(|one| one["name"] == name).unwrap()["reason"].to_string()
    };
    assert!(why("state_of_certified_energy").contains("--certified-energy-kwh"), "{details}");
    assert!(why("energy_throughput").contains("a store contains no voltages"), "{details}");
    assert_eq!(good(&[&["passport"], &args[..]].concat()), good(&[&["passport"], &args[..]].concat()));
}

#[test]
fn replay_passport_matches_store_plus_energy() {
    let life = Life::new();
    let (args, accidents, log) = (life.of_store(), life.path("accidents.json"), life.path("life.log"));
    let stored = passport(&with(&args, &["--static", &accidents]));
    let config = life.path("pack.toml");
    let replayed =
        |before: &str| passport(&["-c", &config, &log, "--static", &accidents, "--throughput-before-ah", before]);
    let mut whole = replayed("0");
    let energy = whole.as_object_mut().unwrap().remove("EnergyThroughput").expect("a replay has voltages");
    let energy_wh = 1e3 * energy["EnergyThroughputValue"].as_f64().unwrap();
    // The last charge of about 2.3 Ah is incomplete. Its energy has been counted, but not its charge.
    let moved_ah = stored["CapacityThroughput"]["CapacityThroughputValue"].as_f64().unwrap();
    assert!((3.5 * moved_ah..4.3 * (moved_ah + 2.3)).contains(&energy_wh), "{energy_wh} Wh, {moved_ah} Ah");
    for group in stored.as_object().unwrap().keys() {
        let pairs = stored[group].as_object().into_iter().flatten();
        for (name, value) in pairs.filter(|(name, _)| *name != "LastUpdate") {
            let (one, other) = (value.as_f64().unwrap(), whole[group][name].as_f64().unwrap());
            // The store keeps rows exactly but rounds its last state.
            assert!((one - other).abs() <= 1e-3 * one.abs().max(1.0), "{group}.{name}: {one} and {other}");
        }
    }
    let later = replayed("100");
    assert!(later.get("EnergyThroughput").is_none(), "not recorded since new");
    let moved = |document: &Value| document["CapacityThroughput"]["CapacityThroughputValue"].as_f64().unwrap();
    assert!(close(moved(&later), moved(&whole) + 100.0));
}

#[test]
fn unknown_required_value_is_rejected_with_reason() {
    let life = Life::new();
    let (config, state, accidents) = (life.path("pack.toml"), life.path("state"), life.path("accidents.json"));
    let base = ["passport", "-c", &config, "--state", &state];
    let printed = refused(&[&base[..], &["--static", &accidents]].concat());
    assert_eq!(printed.lines().count(), 1, "{printed}");
    assert!(
        printed.contains("NumberOfFullCycles: required, but unknown") && printed.contains("--throughput-before-ah, 0"),
        "{printed}"
    );
    let out = life.path("passport.json");
    let printed = refused(&[&base[..], &["--throughput-before-ah", "0", "-o", &out]].concat());
    assert_eq!(printed, "InformationOnAccidents: required, but no record contains it: state it with --static\n");
    assert!(!Path::new(&out).exists());
    let given = passport(&with(
        &["-c", &config, "--state", &state].map(str::to_owned),
        &["--static", &accidents, "--throughput-ah", "400"],
    ));
    assert_eq!(given["NumberOfFullCycles"]["NumberOfFullCyclesValue"], 50);
}

#[test]
fn soce_needs_certified_energy() {
    let life = Life::new();
    let (args, accidents) = (life.of_store(), life.path("accidents.json"));
    let condition = passport(&with(&args, &["--static", &accidents, "--certified-energy-kwh", "0.014"]));
    let energy_kwh = condition["RemainingEnergy"]["RemainingEnergyValue"].as_f64().unwrap();
    let soce = condition["StateOfCertifiedEnergy"]["StateOfCertifiedEnergyValue"].as_f64().unwrap();
    // Energy of 3.8 Ah at about 3.6 V.
    assert!((0.011..0.0150).contains(&energy_kwh), "{energy_kwh} kWh");
    assert!((soce - 100.0 * energy_kwh / 0.014).abs() < 0.01, "{soce} %");
    let path = life.write("manufacturer.json", &manufacturer());
    let printed =
        refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--form", "battery-pass", "--static", &path]));
    assert_eq!(
        printed,
        "performance.dynamic.energy.soce: required, but unknown: the certified energy is not given (--certified-energy-kwh)\n"
    );
}

#[test]
fn battery_pass_adds_measured_values_to_static_part() {
    let life = Life::new();
    let (log, config, details) = (life.path("life.log"), life.path("pack.toml"), life.path("details.json"));
    let path = life.write("manufacturer.json", &manufacturer());
    let args = [
        "-c",
        &config,
        &log,
        "--throughput-before-ah",
        "0",
        "--certified-energy-kwh",
        "0.014",
        "--form",
        "battery-pass",
    ];
    let mut pass = passport(&[&args[..], &["--static", &path, "--details", &details]].concat());
    let details: Value = serde_json::from_str(&fs::read_to_string(details).expect("a file")).expect("JSON");
    let absent = details["absent"].as_array().unwrap().iter().map(|one| one["name"].as_str().unwrap());
    assert!(absent.clone().count() == 4 && absent.clone().all(|name| name.starts_with("time_")), "{details}");
    for (pointer, unit) in MEASURED {
        let reading = pass.pointer(&format!("/performance/dynamic{pointer}")).unwrap_or_else(|| panic!("no {pointer}"));
        let path = format!("performance.dynamic{}.value", pointer.replace('/', "."));
        let detail = details["values"].as_array().unwrap().iter().find(|one| one["path"] == path).expect("a detail");
        assert_eq!(detail["unit"], unit, "{pointer}");
        assert_eq!(detail["time"], reading["time"], "{pointer}");
        assert!(detail["std"].as_f64().is_some_and(|std| std > 0.0), "{pointer}: {detail}");
        let (value, full) = (reading["value"].as_f64().unwrap(), detail["value"].as_f64().unwrap());
        assert!(if pointer == "/fullCycles" { value == full.floor() } else { value == full }, "{pointer}");
    }
    let dynamic = pass.pointer_mut("/performance/dynamic").and_then(Value::as_object_mut).unwrap();
    for measured in ["stateOfCharge", "fullCycles", "capacity", "resistance", "energy"] {
        dynamic.remove(measured);
    }
    assert_eq!(pass, manufacturer(), "no other value may be added or changed");
}

#[test]
fn static_template_is_accepted_once_filled_in() {
    let life = Life::new();
    let (log, config) = (life.path("life.log"), life.path("pack.toml"));
    let template = passport(&["--form", "battery-pass", "--static-template"]);
    // The template must have a place for everything that the manufacturer states, but not for measured values.
    let mut filled = template.clone();
    fill_in(&mut filled, &manufacturer());
    assert!(template.pointer("/performance/dynamic/fullCycles").is_none(), "{template}");
    let filled = life.write("filled.json", &filled);
    let args = ["-c", &config, &log, "--throughput-before-ah", "0", "--certified-energy-kwh", "0.014", "--form"];
    let args = [&args[..], &["battery-pass", "--static"]].concat();
    let plain = life.write("manufacturer.json", &manufacturer());
    assert_eq!(passport(&with_file(&args, &filled)), passport(&with_file(&args, &plain)));
    let empty = life.write("empty.json", &template);
    assert!(
        refused(&with_file(&[&["passport"], &args[..]].concat(), &empty))
            .contains("materials: required, but no record")
    );
}

fn with_file<'a>(args: &[&'a str], file: &'a str) -> Vec<&'a str> {
    args.iter().copied().chain([file]).collect()
}

/// Replaces the values of a template by those of `known`. The template must contain every member of `known`.
fn fill_in(template: &mut Value, known: &Value) {
    match (template, known) {
        (Value::Object(members), Value::Object(known)) => known.iter().for_each(|(name, value)| {
            fill_in(members.get_mut(name).unwrap_or_else(|| panic!("no {name}")), value);
        }),
        (template @ Value::Array(_), Value::Array(known)) => {
            let item = template[0].clone();
            let fill = |known: &Value| {
                let mut item = item.clone();
                fill_in(&mut item, known);
                item
            };
            *template = known.iter().map(fill).collect();
        }
        (template, known) => *template = known.clone(),
    }
}

/// JSON pointers to every member of all objects in a document.
fn members(document: &Value, at: &str, found: &mut Vec<String>) {
    match document {
        Value::Object(object) => object.iter().for_each(|(name, value)| {
            found.push(format!("{at}/{name}"));
            members(value, &format!("{at}/{name}"), found);
        }),
        Value::Array(list) => {
            list.iter().enumerate().for_each(|(i, value)| members(value, &format!("{at}/{i}"), found))
        }
        _ => {}
    }
}

fn removed(document: &mut Value, pointer: &str) -> String {
    let (parent, name) = pointer.rsplit_once('/').unwrap();
    document.pointer_mut(parent).unwrap().as_object_mut().unwrap().remove(name);
    let steps = pointer[1..].split('/').map(|step| if step == "0" { "[0]".to_owned() } else { format!(".{step}") });
    steps.collect::<String>().trim_start_matches('.').to_owned()
}

#[test]
fn missing_static_members_are_named() {
    let life = Life::new();
    let args = life.of_store();
    let optional = [
        "serial",
        "classificationDescription",
        "intoServiceDate",
        "manufacturingDate",
        "height",
        "width",
        "sustainabilityReport",
        "performanceClass",
        "other",
        "temperature",
        "performanceDocument",
        "testReport",
        "negativeEvents",
        "operatingEnvironment",
        "declarationOfConformityId",
        "document",
        "safeDischarging",
        "removalFromAppliance",
        "sources",
        "status",
        "registrationIdentifier",
        "lastModification",
        "placedOnMarket",
        "energy",
    ];
    let mut pointers = Vec::new();
    members(&manufacturer(), "", &mut pointers);
    // Skip the members of list items. Most belong to documents, whose names begin with `c` or `header`.
    let is_wanted = |pointer: &&String| !pointer.contains("/0/c") && !pointer.contains("/0/header");
    let mut document = manufacturer();
    let mut expected = Vec::new();
    // Remove members from the deepest level up, so that each member is missing alone.
    for pointer in pointers.iter().rev().filter(is_wanted) {
        let is_leaf = manufacturer().pointer(pointer).is_some_and(|value| !value.is_object() && !value.is_array());
        let (_, name) = pointer.rsplit_once('/').unwrap();
        let is_temperature = name == "temperature" && pointer.contains("cycleLifeTesting");
        let is_status = name == "status" && pointer.contains("sustainability");
        if is_leaf && (is_temperature || is_status || !optional.contains(&name)) {
            expected.push(removed(&mut document, pointer));
        }
    }
    assert!(expected.len() > 90, "{} members", expected.len());
    let path = life.write("manufacturer.json", &document);
    let more = ["--form", "battery-pass", "--certified-energy-kwh", "0.014", "--static", &path];
    let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &more));
    for path in &expected {
        let line = format!("{path}: required, but no record contains it: state it with --static");
        assert!(printed.lines().any(|one| one == line), "{path} in {printed}");
    }
    assert_eq!(printed.lines().count(), expected.len(), "only the removed members may be missing: {printed}");
}

#[test]
fn static_part_faults_are_named_by_path() {
    let life = Life::new();
    let args = life.of_store();
    let mut document = manufacturer();
    document["identification"]["category"] = json!("car");
    document["metadata"]["issued"] = json!("2026-01-31");
    document["performance"]["rated"]["voltage"]["min"] = json!("2.7");
    document["performance"]["dynamic"]["stateOfCharge"] = json!({ "value": 50.0 });
    let path = life.write("manufacturer.json", &document);
    let more = ["--form", "battery-pass", "--certified-energy-kwh", "0.014", "--static", &path];
    let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &more));
    for expected in [
        "identification.category: found \"car\", must be one of SLI, LMT, EV, industrial, portable, incorporated",
        "metadata.issued: not in the standard, which has version, status",
        "performance.rated.voltage.min: found \"2.7\", must be a number",
        "performance.dynamic.stateOfCharge.value: stated in the static part, but also measured",
    ] {
        assert!(printed.contains(expected), "{expected:?} in {printed}");
    }
    assert_eq!(printed.lines().count(), 4, "{printed}");
    fs::write(&path, "{").expect("written");
    let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--static", &path]));
    assert!(printed.contains("manufacturer.json: ") && printed.contains("line 1"), "{printed}");
}

#[test]
fn new_pack_or_undated_record_gives_no_passport() {
    let life = Life::configured("");
    life.simulate("life.log", "1700000000", &["--duration", "300"]);
    let (config, log, accidents) = (life.path("pack.toml"), life.path("life.log"), life.path("accidents.json"));
    let args = ["-c", &config, &log, "--static", &accidents, "--throughput-before-ah", "0"];
    let condition = passport(&args);
    assert_eq!(condition["NumberOfFullCycles"]["NumberOfFullCyclesValue"], 0);
    assert!(condition.get("RemainingCapacity").is_none() && condition.get("RemainingEnergy").is_none(), "{condition}");
    let printed = refused(&[&["passport"], &args[..], &["--form", "battery-pass"]].concat());
    assert!(
        printed.contains(
            "performance.dynamic.capacity.capacity: required, but unknown: nothing has been learned about cell 1 yet"
        ),
        "{printed}"
    );
    let rows = (0..400).map(|second| format!("{second},2.0,3.9,24.0\n")).collect::<String>();
    fs::write(life.path("cell.csv"), format!("time_s,current_a,voltage_v,temperature_c\n{rows}")).expect("written");
    let printed = refused(&[
        "passport",
        "-c",
        &config,
        &life.path("cell.csv"),
        "--static",
        &accidents,
        "--throughput-before-ah",
        "0",
    ]);
    assert!(printed.contains("the record has no dates"), "{printed}");
}

#[test]
fn deleted_half_cycles_count_in_sums() {
    let life = Life::configured("\n[store]\nkeep_years = 0.1\n");
    life.simulate("old.log", "1700000000", &["--cycles", "2"]);
    // Two months later, the old half-cycles exceed their maximum age.
    life.simulate("new.log", "1706000000", &["--cycles", "2"]);
    life.rest("old.log");
    life.replay(&["old.log", "new.log"]);
    let rows = good(&["history", "--state", &life.path("state"), "--kind", "half-cycle", "--json", "--limit", "0"]);
    let rows: Value = serde_json::from_str(&rows).expect("JSON");
    let charge_ah = |row: &Value| row["charge_ah"].as_f64().expect("a number");
    let kept_ah: f64 = STRINGS * rows["rows"].as_array().expect("rows").iter().map(charge_ah).sum::<f64>();
    let (args, accidents) = (life.of_store(), life.path("accidents.json"));
    let moved_ah = |document: &Value| document["CapacityThroughput"]["CapacityThroughputValue"].as_f64().unwrap();
    let stored_ah = moved_ah(&passport(&with(&args, &["--static", &accidents])));
    let (config, old, new) = (life.path("pack.toml"), life.path("old.log"), life.path("new.log"));
    let of_logs = ["-c", &config, &old, &new, "--static", &accidents, "--throughput-before-ah", "0"];
    let replayed_ah = moved_ah(&passport(&of_logs));
    // The state is stored with nine digits.
    assert!((stored_ah - replayed_ah).abs() < 1e-4 * replayed_ah, "{stored_ah} and {replayed_ah} Ah");
    assert!(kept_ah < 0.7 * stored_ah, "{kept_ah} of {stored_ah} Ah remain");
}

#[test]
fn tampered_history_gives_no_passport() {
    let life = Life::new();
    let (args, accidents) = (life.of_store(), life.path("accidents.json"));
    let database = rusqlite::Connection::open(Path::new(&life.path("state")).join("packwatch.db")).expect("a database");
    database
        .execute("DELETE FROM half_cycle WHERE moment = (SELECT min(moment) FROM half_cycle)", [])
        .expect("deleted");
    let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--static", &accidents]));
    assert!(
        printed.contains("the history was changed: rows 1 to ") && printed.contains("does not write a passport"),
        "{printed}"
    );
}

fn of_logs(life: &Life, logs: &[&str]) -> Vec<String> {
    let mut args = vec!["-c".to_owned(), life.path("pack.toml")];
    args.extend(logs.iter().map(|log| life.path(log)));
    args.extend(["--static".to_owned(), life.path("accidents.json")]);
    args
}

#[test]
fn record_without_current_has_no_sums() {
    let life = Life::configured("");
    let text = fs::read_to_string(life.path("pack.toml")).expect("a file");
    fs::write(life.path("pack.toml"), text.replace("max_age_s = 60.0", "max_age_s = 5.0")).expect("written");
    // Each current reading is valid for only half of the interval to the next reading.
    life.simulate("sparse.log", "1700000000", &["--cycles", "2", "--period", "10000"]);
    let args = of_logs(&life, &["sparse.log"]);
    let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--throughput-before-ah", "0"]));
    assert!(
        printed.contains("the current is missing from the record for") && printed.contains("--throughput-ah"),
        "{printed}"
    );
    let given = passport(&with(&args, &["--throughput-ah", "400"]));
    assert_eq!(given["NumberOfFullCycles"]["NumberOfFullCyclesValue"], 50);
    assert!(given.get("EnergyThroughput").is_none(), "{given}");
}

#[test]
fn record_with_gap_has_no_sums() {
    let life = Life::configured("");
    life.simulate("life.log", "1700000000", &["--cycles", "2"]);
    let text = fs::read_to_string(life.path("life.log")).expect("a log");
    let stamp = |line: &str| line.split(['(', ')']).nth(1).and_then(|stamp| stamp.parse::<f64>().ok()).unwrap_or(0.0);
    // Remove ten minutes of the first hour, during a discharge.
    let is_kept = |line: &&str| !(1_700_001_200.0..1_700_001_800.0).contains(&stamp(line));
    let cut: Vec<&str> = text.lines().filter(is_kept).collect();
    fs::write(life.path("cut.log"), cut.join("\n")).expect("written");
    fs::write(life.path("journal.000003.zst"), zstd::encode_all(text.as_bytes(), 1).expect("packed")).expect("written");
    let printed = |log: &str| {
        let args = of_logs(&life, &[log]);
        refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--throughput-before-ah", "0"]))
    };
    let gap = printed("cut.log");
    assert!(gap.contains("the record has a gap of ") && gap.contains(" s that started while current flowed"), "{gap}");
    let beginning = printed("journal");
    assert!(beginning.contains("the first 2 segments of the journal are missing"), "{beginning}");
    let whole = passport(&with(&of_logs(&life, &["life.log"]), &["--throughput-before-ah", "0"]));
    assert!(whole.get("EnergyThroughput").is_some(), "{whole}");
}

#[test]
fn sleep_between_trips_loses_no_charge() {
    let life = Life::configured("");
    life.simulate("first.log", "1700000000", &["--cycles", "1"]);
    life.rest("first.log");
    life.simulate("second.log", "1700040000", &["--cycles", "1"]);
    let text = fs::read_to_string(life.path("pack.toml")).expect("a file");
    // With the shorter maximum age, the monitor already counts the buses as asleep while the recorder still counts them
    // as awake.
    for age in ["max_age_s = 60.0", "max_age_s = 5.0"] {
        fs::write(life.path("pack.toml"), text.replace("max_age_s = 60.0", age)).expect("written");
        let args = of_logs(&life, &["first.log", "second.log"]);
        let whole = passport(&with(&args, &["--throughput-before-ah", "0"]));
        let charge_ah = whole["CapacityThroughput"]["CapacityThroughputValue"].as_f64().expect("known");
        let energy_kwh = whole["EnergyThroughput"]["EnergyThroughputValue"].as_f64().expect("known");
        assert!(charge_ah > 5.0 && energy_kwh > 0.015, "{age}: {charge_ah} Ah, {energy_kwh} kWh");
    }
}

#[test]
fn store_of_other_configuration_is_rejected() {
    let life = Life::new();
    let (args, accidents) = (life.of_store(), life.path("accidents.json"));
    let pack = fs::read_to_string(life.path("pack.toml")).expect("a file");
    let model = shipped("config/cells/nasa_b0005.toml");
    let cells = fs::read_to_string(&model).expect("a file");
    let printed = |text: String| {
        fs::write(life.path("pack.toml"), text).expect("written");
        refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--static", &accidents]))
    };
    let strings = printed(pack.replace("strings = 2", "strings = 4"));
    assert!(strings.contains("the record has 2 parallel strings, the configuration has 4"), "{strings}");
    let larger = cells.replace("rated_capacity_ah = 2.0", "rated_capacity_ah = 3.0");
    fs::write(life.path("larger.toml"), larger).expect("written");
    let capacity = printed(pack.replace(&format!("{model:?}"), "\"larger.toml\""));
    assert!(capacity.contains("cells of 2 Ah, the configuration has cells of 3 Ah"), "{capacity}");
    assert!(capacity.contains("state: "), "the state folder must be named: {capacity}");
}

#[test]
fn value_from_unset_clock_is_undated() {
    let life = Life::configured("");
    life.simulate("unset.log", "0", &["--cycles", "3"]);
    life.simulate("set.log", "1700000000", &["--duration", "300"]);
    life.rest("unset.log");
    life.replay(&["unset.log", "set.log"]);
    let (config, state) = (life.path("pack.toml"), life.path("state"));
    let stored = ["-c", &config, "--state", &state, "--static", &life.path("accidents.json")].map(str::to_owned);
    for args in [of_logs(&life, &["unset.log", "set.log"]), stored.to_vec()] {
        let printed = refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--throughput-before-ah", "0"]));
        assert!(printed.contains("NumberOfFullCycles: required, but unknown: its time is unknown"), "{printed}");
        let given = passport(&with(&args, &["--throughput-ah", "400"]));
        assert!(given.get("RemainingCapacity").is_none() && !given.to_string().contains("\"1970-"), "{given}");
    }
    let printed = |logs: &[&str]| {
        let args = of_logs(&life, logs);
        refused(&with(&[&["passport".to_owned()], &args[..]].concat(), &["--throughput-ah", "400"]))
    };
    assert!(printed(&["unset.log"]).contains("the record has no dates"));
    let moved = printed(&["set.log", "unset.log"]);
    assert!(moved.contains("a log begins before the end of the previous log"), "{moved}");
}

/// Output of a peer for a passport. If the peer is missing, prints a note and returns `None`.
#[expect(clippy::print_stdout, reason = "a skipped test prints the reason")]
fn peer(arguments: &[&str]) -> Option<String> {
    let Some(python) = std::env::var_os("PACKWATCH_PYTHON") else {
        println!("SKIPPED: PACKWATCH_PYTHON is not set, no peer was run");
        return None;
    };
    let mut command = std::process::Command::new(python);
    let output = command.arg(shipped("tests/tools/passport_peer.py")).args(arguments).output().expect("it runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).expect("text"))
}

#[expect(clippy::print_stdout, reason = "a skipped test prints the reason")]
fn schema(name: &str, document: &str) -> Option<String> {
    let Some(folder) = std::env::var_os("PACKWATCH_SCHEMAS") else {
        println!("SKIPPED: PACKWATCH_SCHEMAS is not set, {name} was not checked");
        return None;
    };
    peer(&["schema", &Path::new(&folder).join(name).display().to_string(), document])
}

fn both(life: &Life, args: &[&str], (part, certified_kwh): (&Value, &str)) -> (String, String) {
    let (condition, pass) = (life.path("condition.json"), life.path("battery_pass.json"));
    let (accidents, path) = (life.path("accidents.json"), life.write("manufacturer.json", part));
    let args = [args, &["--certified-energy-kwh", certified_kwh, "--throughput-before-ah", "0"]].concat();
    good(&[&["passport"], &args[..], &["--static", &accidents, "-o", &condition]].concat());
    good(&[&["passport"], &args[..], &["--static", &path, "--form", "battery-pass", "-o", &pass]].concat());
    (condition, pass)
}

fn assert_valid(condition: &str, pass: &str) {
    let faults = [
        peer(&["submodel", condition]),
        schema("ProductConditionBattery-schema.json", condition),
        schema("BatteryPass-schema.json", pass),
    ];
    for faults in faults.into_iter().flatten() {
        assert_eq!(faults, "");
    }
}

#[test]
fn peers_accept_valid_and_reject_broken_passport() {
    let life = Life::new();
    let (condition, pass) =
        both(&life, &["-c", &life.path("pack.toml"), &life.path("life.log")], (&manufacturer(), "0.014"));
    assert_valid(&condition, &pass);
    let mut broken: Value = serde_json::from_str(&fs::read_to_string(&condition).unwrap()).unwrap();
    broken["StateOfCharge"].as_object_mut().unwrap().remove("LastUpdate");
    broken.as_object_mut().unwrap().remove("NumberOfFullCycles");
    let broken = life.write("broken.json", &broken);
    let printed = [peer(&["submodel", &broken]), schema("ProductConditionBattery-schema.json", &broken)];
    assert!(printed.into_iter().flatten().all(|faults| faults.contains("LastUpdate") && faults.lines().count() == 2));
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn measured_life_gives_valid_passports() {
    let log = crate::support::measured::path("nasa_pcoe_aging/B0005.csv.gz");
    let life = Life::configured("");
    let (config, log) = (life.path("measured.toml"), log.display().to_string());
    fs::write(&config, measured_config()).expect("written");
    let starts = log.replace(".csv.gz", "_cycles.csv");
    let (accidents, condition) = (life.path("accidents.json"), life.path("of_replay.json"));
    let args = ["-c", &config, &log, "--start-times", &starts, "--static", &accidents, "--throughput-before-ah", "0"];
    good(&[&["passport"], &args[..], &["-o", &condition]].concat());
    let faults = [peer(&["submodel", &condition]), schema("ProductConditionBattery-schema.json", &condition)];
    assert!(faults.iter().flatten().all(String::is_empty), "{faults:?}");
    let of_replay: Value = serde_json::from_str(&fs::read_to_string(&condition).unwrap()).unwrap();
    // The record has 168 discharges with published capacities from 1.86 to 1.29 Ah, and as many charges.
    let moved_ah = of_replay["CapacityThroughput"]["CapacityThroughputValue"].as_f64().unwrap();
    assert!((480.0..560.0).contains(&moved_ah), "{moved_ah} Ah");
    assert_eq!(of_replay["NumberOfFullCycles"]["NumberOfFullCyclesValue"], json!((moved_ah / 4.0).floor() as u64));
    assert!(of_replay["RemainingCapacity"]["LastUpdate"].as_str().unwrap().starts_with("2008-05-"));
    let state = life.path("state");
    good(&["replay", "-c", &config, &log, "--start-times", &starts, "--state", &state]);
    let (condition, pass) = both(&life, &["-c", &config, "--state", &state], (&cell_part(), "0.0068"));
    assert_valid(&condition, &pass);
    let of_store: Value = serde_json::from_str(&fs::read_to_string(&condition).unwrap()).unwrap();
    assert_eq!(of_store["CapacityThroughput"], of_replay["CapacityThroughput"]);
    assert_eq!(of_store["RemainingCapacity"], of_replay["RemainingCapacity"]);
}
