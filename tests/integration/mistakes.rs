//! Puts common wiring mistakes into correct configurations, one at a time. `packwatch doctor` must name each mistake,
//! and must find nothing in the correct configurations.
//!
//! The packs are simulated: 4 LFP cells with one voltage per cell, and 96 NMC cells with only the pack voltage. If the
//! measured data are present, the logs of a boat (16 LFP cells) and of a Hyundai Kona (pack voltage) are also tested.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use assert_cmd::Command;

use crate::support::measured;

const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: BMS
BO_ 256 BmsStatus: 8 BMS
 SG_ Current : 0|16@1- (0.1,0) [-1000|1000] "A" X
 SG_ PackVoltage : 16|16@1+ (0.01,0) [0|655] "V" X
BO_ 257 BmsTemps: 8 BMS
 SG_ CellTemp : 0|16@1+ (0.1,0) [0|500] "K" X
 SG_ TempMos : 16|16@1+ (0.1,0) [0|500] "K" X
BO_ 258 BmsSummary: 8 BMS
 SG_ SOC : 0|16@1+ (0.1,0) [0|100] "%" X
 SG_ SOH : 16|8@1+ (1,0) [0|100] "%" X
 SG_ Cycles : 24|16@1+ (1,0) [0|65535] "" X
BO_ 272 BmsCells: 8 BMS
 SG_ Cell1 : 0|16@1+ (1,0) [0|5000] "mV" X
 SG_ Cell2 : 16|16@1+ (1,0) [0|5000] "mV" X
 SG_ Cell3 : 32|16@1+ (1,0) [0|5000] "mV" X
 SG_ Cell4 : 48|16@1+ (1,0) [0|5000] "mV" X
"#;

const CELLS: &str = r#"[pack]
cells = 4
chemistry = "lfp-graphite"
rated_capacity_ah = 100

[[interface]]
name = "can0"

[input]
dbc = ["pack.dbc"]

[input.current]
signal = "BmsStatus.Current"
positive = "charge"

[input.cell_voltage]
signal = "BmsCells.Cell{n}"
scale = 0.001

[[input.temperature]]
signal = "BmsTemps.CellTemp"
offset = -273.15

[input.reported_soc]
signal = "BmsSummary.SOC"

[input.reported_soh]
signal = "BmsSummary.SOH"

[limits.current]
max_age_s = 3.0

[limits.voltage]
max_age_s = 4.0
"#;

fn total() -> String {
    let edits = [
        ("lfp-graphite", "nmc-graphite"),
        ("cells = 4", "cells = 96"),
        ("[input.cell_voltage]", "[input.pack_voltage]"),
        ("BmsCells.Cell{n}", "BmsStatus.PackVoltage"),
        ("scale = 0.001\n", ""),
    ];
    edits.iter().fold(CELLS.to_owned(), |text, (from, to)| text.replace(from, to))
}

/// A pack: the files in its folder, its correct configuration and its log.
#[derive(Debug, Clone)]
struct Pack {
    files: BTreeMap<String, String>,
    config: String,
    log: PathBuf,
    arguments: &'static [&'static str],
}

impl Pack {
    fn doctor(&self, edits: &[(&str, &str)]) -> (i32, String) {
        let folder = tempfile::tempdir().unwrap();
        let (mut config, mut files) = (self.config.clone(), self.files.clone());
        for (from, to) in edits {
            let mut is_found = false;
            for text in files.values_mut().chain([&mut config]) {
                is_found |= text.contains(from);
                *text = text.replace(from, to);
            }
            assert!(is_found, "no text {from}");
        }
        for (name, text) in &files {
            std::fs::write(folder.path().join(name), text).unwrap();
        }
        std::fs::write(folder.path().join("pack.toml"), config).unwrap();
        let mut command = Command::cargo_bin("packwatch").unwrap();
        let command = command.arg("doctor").arg("-c").arg(folder.path().join("pack.toml"));
        let output = command.arg(&self.log).args(self.arguments).output().unwrap();
        let text = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        (output.status.code().unwrap(), text.split_whitespace().collect::<Vec<_>>().join(" "))
    }
}

impl Pack {
    /// Returns the pack with a changed log. `change` gets the time of each line (seconds since the start) and the line,
    /// and returns the new line, or `None` to remove the line.
    fn with_lines(&self, name: &str, change: impl Fn(f64, &str) -> Option<String>) -> Self {
        let text = std::fs::read_to_string(&self.log).unwrap();
        let time_s = |line: &str| line[1..18].parse::<f64>().unwrap() - 1.7e9;
        let lines = text.lines().filter_map(|line| Some(change(time_s(line), line)? + "\n"));
        let log = FOLDER.path().join(format!("{name}.log"));
        std::fs::write(&log, lines.collect::<String>()).unwrap();
        Self { log, ..self.clone() }
    }
}

static FOLDER: LazyLock<tempfile::TempDir> = LazyLock::new(|| tempfile::tempdir().unwrap());
static LFP: LazyLock<Pack> = LazyLock::new(|| simulated("cells", CELLS.to_owned()));
static NMC: LazyLock<Pack> = LazyLock::new(|| simulated("total", total()));

/// Simulates a pack and adds the values that its controller reports.
fn simulated(name: &str, config: String) -> Pack {
    let folder = FOLDER.path();
    std::fs::write(folder.join("pack.dbc"), DBC).unwrap();
    let [toml, log, truth] = ["toml", "raw", "csv"].map(|extension| folder.join(format!("{name}.{extension}")));
    std::fs::write(&toml, &config).unwrap();
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.args(["simulate", "reference", "--duration", "14000", "--truth-period", "10", "-c"]).arg(&toml);
    command.arg("-o").arg(&log).arg("--truth").arg(&truth).assert().success();
    let text = std::fs::read_to_string(&truth).unwrap();
    let number = |text: &str| text.parse::<f64>().unwrap();
    let row = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        (fields[1] == "0").then(|| (number(fields[0]), number(fields[2])))
    };
    let socs: Vec<(f64, f64)> = text.lines().skip(1).filter_map(row).collect();
    let mut lines = String::new();
    for line in std::fs::read_to_string(&log).unwrap().lines() {
        lines += &reported(line, &socs);
    }
    let log = folder.join(format!("{name}.log"));
    std::fs::write(&log, lines).unwrap();
    Pack { files: BTreeMap::from([("pack.dbc".to_owned(), DBC.to_owned())]), config, log, arguments: &[] }
}

/// Adds the values that the controller reports to a temperature line: the temperature of its transistors, and a summary
/// line with SOC, SOH and cycles. Returns any other line unchanged.
fn reported(line: &str, socs: &[(f64, f64)]) -> String {
    let (stamp, frame) = line.split_once(" can0 ").unwrap();
    let Some(data) = frame.strip_prefix("101#") else { return format!("{line}\n") };
    let time = stamp.trim_matches(['(', ')']).parse::<f64>().unwrap();
    let at = socs.partition_point(|(at, _)| *at <= time).max(1);
    let code = |value: f64| (value as u16).to_le_bytes().map(|byte| format!("{byte:02X}")).concat();
    let kelvin = u16::from_str_radix(&data[..2], 16).unwrap() + 256 * u16::from_str_radix(&data[2..4], 16).unwrap();
    let warm = code(f64::from(kelvin) + 140.0);
    let summary = format!("{}60{}000000", code((1000.0 * socs[at - 1].1).round()), code(131.0));
    format!("{stamp} can0 101#{}{warm}00000000\n{stamp} can0 102#{summary}\n", &data[..4])
}

/// A mistake: its number (or the name of its pack), the edits that make it, and words that must occur in the output.
type Mistake = (&'static str, &'static [(&'static str, &'static str)], &'static [&'static str]);

const OF_CELLS: &[Mistake] = &[
    ("1", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted", "+ positive = \"charge\""]),
    ("2, fewer", &[("cells = 4", "cells = 3")], &["the pack has 4 cells, 3 are configured"]),
    ("2, more", &[("cells = 4", "cells = 5")], &["each of 5 cells", "none has number 5"]),
    ("5", &[("BmsStatus.Current", "BmsStatus.PackVoltage")], &["pack current is read from a voltage"]),
    ("6", &[("BmsStatus.Current", "BmsSummary.Cycles")], &["pack current: the value never changes"]),
    (
        "7",
        &[("BmsSummary.SOC", "X"), ("BmsSummary.SOH", "BmsSummary.SOC"), ("\"X\"", "\"BmsSummary.SOH\"")],
        &["reported SOC and reported SOH are exchanged", "+ signal = \"BmsSummary.SOC\""],
    ),
    (
        "8",
        &[("BmsTemps.CellTemp", "BmsTemps.TempMos")],
        &["not a temperature of the cells", "+ signal = \"BmsTemps.CellTemp\""],
    ),
    ("9, no scale", &[("scale = 0.001\n", "")], &["off by a factor of 1000"]),
    ("9, wrong scale", &[("scale = 0.001", "scale = 0.01")], &["off by a factor of 10"]),
    ("10, tenth", &[("\"charge\"", "\"charge\"\nscale = 0.1")], &["pack current: off by a factor of"]),
    ("10, half", &[("\"charge\"", "\"charge\"\nscale = 0.5")], &["pack current: off by a factor of 2"]),
    ("11", &[("16@1", "16@0")], &["wrong byte order"]),
    ("12, tenth", &[("ah = 100", "ah = 10")], &["10 Ah are configured", "+ rated_capacity_ah = "]),
    ("12, third", &[("ah = 100", "ah = 36")], &["36 Ah are configured", "+ rated_capacity_ah = "]),
    ("12, tenfold", &[("ah = 100", "ah = 1000")], &["1000 Ah are configured", "+ rated_capacity_ah = "]),
    (
        "13",
        &[("lfp-graphite", "nmc-graphite")],
        &["chemistry contradicts the reported SOC", "+ chemistry = \"lfp-graphite\""],
    ),
    ("15", &[("\"can0\"", "\"can1\"")], &["can0"]),
    ("16", &[("\"pack.dbc\"", "\"pak.dbc\"")], &["pack.toml:10: input.dbc", "did you mean pack.dbc"]),
    ("17", &[("cells = 4", "cells = 4\ncells = 6")], &["pack.toml:3", "the key cells is set twice, first in line 2"]),
    ("18", &[("offset = -273.15\n", "")], &["temperatures"]),
];

const OF_TOTAL: &[Mistake] = &[
    ("1", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted"]),
    ("3", &[("cells = 96", "cells = 49")], &["49 cells cannot have this pack voltage"]),
    ("4, fewer", &[("cells = 96", "cells = 86")], &["number of cells", "contradicts the reported SOC"]),
    ("4, more", &[("cells = 96", "cells = 108")], &["number of cells", "contradicts the reported SOC"]),
    ("14", &[("nmc-graphite", "lfp-graphite")], &["100 to 145 cells", "pack.chemistry is wrong", "nmc-graphite"]),
];

/// Tries the mistakes on a pack. Returns a message for each mistake that the doctor does not name.
fn unnamed(name: &str, pack: &Pack, mistakes: &[Mistake]) -> Vec<String> {
    let (code, text) = pack.doctor(&[]);
    let mut failed = Vec::new();
    if code != 0 || !text.contains("No faults found") {
        failed.push(format!("{name}, right configuration: {text}"));
    }
    for (number, edits, words) in mistakes {
        let (code, text) = pack.doctor(edits);
        if code == 0 || !words.iter().all(|words| text.contains(words)) {
            failed.push(format!("{name}, mistake {number}: {text}"));
        }
    }
    failed
}

#[test]
fn simulated_mistakes_are_named_and_right_packs_silent() {
    let mut failed = unnamed("LFP, cells", &LFP, OF_CELLS);
    failed.extend(unnamed("NMC, total", &NMC, OF_TOTAL));
    assert!(failed.is_empty(), "{}", failed.join("\n\n"));
}

/// A correct pack of 100 Ah, as found in vehicles:
///
/// - name
/// - whether the chemistry is LFP
/// - SOC at the start
/// - duration (s)
/// - current (A, positive = discharge) as a function of time (s) and voltage (V per cell); NaN: the controller sleeps
///   and sends nothing
/// - reported SOC as a function of time (s) and true SOC
type RightPack = (&'static str, bool, f64, u32, fn(f64, f64) -> f64, fn(f64, f64) -> f64);

const RIGHT: &[RightPack] = &[
    ("constant current", false, 0.3, 9000, |_, _| -11.0, true_soc),
    ("constant power", false, 0.2, 4500, |_, v| -230.0 / v, true_soc),
    ("taper", false, 0.1, 1800, |_, v| -830.0 / v * (4.4 - v), true_soc),
    ("full", true, 0.9, 4000, |_, v| (-1000.0 * (3.6 - v)).clamp(-30.0, 0.0), true_soc),
    ("dashboard", false, 0.85, 6000, drive_a, |_, soc| 1.25 * (soc - 0.25) / 0.65),
    ("low dashboard", false, 0.45, 3000, drive_a, |_, soc| (soc - 0.25) / 0.65),
    ("recalibration", false, 0.9, 6000, drive_a, |t, soc| if t > 2600.0 { soc - 0.08 } else { soc }),
    ("asleep", false, 0.7, 9000, |t, v| if (2e3..8e3).contains(&t) { f64::NAN } else { drive_a(t, v) }, true_soc),
    ("storage", true, 0.6, 9000, |t, _| 25.0 * (t / 2000.0).sin(), true_soc),
    ("rest", true, 0.75, 3600, |_, _| 0.15, true_soc),
    ("a minute", false, 0.6, 60, drive_a, true_soc),
    ("coarse SOC", false, 0.9, 5000, drive_a, |_, soc| (200.0 * soc + 1.0).floor() / 200.0),
];

/// Mistakes in the packs of [`RIGHT`]. The first field is the name of the pack.
const WRONG: &[Mistake] = &[
    ("constant current", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted"]),
    ("constant power", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted"]),
    ("taper", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted"]),
    ("constant current", &[("BmsStatus.Current", "BmsSummary.Cycles")], &["pack current: the value never changes"]),
    ("full", &[("lfp-graphite", "nmc-graphite")], &["chemistry contradicts the reported SOC"]),
    ("low dashboard", &[("nmc-graphite", "lfp-graphite")], &["chemistry contradicts the reported SOC"]),
    ("dashboard", &[("cells = 96", "cells = 108")], &["number of cells contradicts the reported SOC"]),
    ("recalibration", &[("ah = 100", "ah = 36")], &["36 Ah are configured"]),
];

fn true_soc(_: f64, soc: f64) -> f64 {
    soc
}

/// Load current (A): changes every 7 s, with pauses and recuperation.
fn drive_a(time_s: f64, _: f64) -> f64 {
    let step = (time_s / 7.0).floor();
    if step % 5.0 == 0.0 { 0.0 } else { 20.0 + 60.0 * (1.7 * step).sin() }
}

/// Open-circuit voltage (V), from a table at 0, 10, ... 100 %. The curves are typical of the chemistry and independent
/// of packwatch's cell model.
fn ocv_v(is_lfp: bool, soc: f64) -> f64 {
    let curve = match is_lfp {
        true => [2.6, 3.2, 3.24, 3.275, 3.287, 3.29, 3.295, 3.318, 3.33, 3.332, 3.45],
        false => [3.0, 3.45, 3.555, 3.615, 3.655, 3.705, 3.79, 3.88, 3.97, 4.065, 4.185],
    };
    let at = (10.0 * soc).clamp(0.0, 9.999);
    let first = at as usize;
    curve[first] + (at - first as f64) * (curve[first + 1] - curve[first]) + 10.0 * (soc - 1.0).max(0.0)
}

fn right_pack(&(name, is_lfp, start, seconds, current_a, shown): &RightPack) -> Pack {
    let (config, cells) = if is_lfp { (CELLS.to_owned(), 4.0) } else { (total(), 96.0) };
    let (mut soc, mut slow_v, mut lines) = (start, 0.0, String::new());
    let mut voltage_v = ocv_v(is_lfp, soc);
    for second in 0..seconds {
        let (time_s, noise) = (f64::from(second), f64::from(second * 7919 % 13) - 6.0);
        let current = current_a(time_s, voltage_v);
        let flowing_a = if current.is_nan() { 0.0 } else { current };
        soc -= flowing_a / 360_000.0;
        slow_v += (3e-4 * flowing_a - slow_v) / 60.0;
        voltage_v = ocv_v(is_lfp, soc) - 6e-4 * flowing_a - slow_v + 5e-5 * noise;
        let code = |value: f64| (value.round() as i64 as u16).to_le_bytes().map(|byte| format!("{byte:02X}")).concat();
        let status = code(-10.0 * current) + &code(100.0 * cells * voltage_v);
        let temperatures = code(2981.0) + &code(3121.0);
        let summary = code(1000.0 * shown(time_s, soc)) + "60" + &code(131.0);
        let singles: String =
            (0..4).map(|n| code(1000.0 * voltage_v + f64::from(n) * (1.0 + 0.02 * flowing_a))).collect();
        let frames =
            [("100", status), ("101", temperatures), ("102", summary), ("110", singles), ("3F0", "00".to_owned())];
        let sent = frames.into_iter().filter(|(id, _)| !current.is_nan() || *id == "3F0");
        lines.extend(sent.map(|(id, data)| format!("({}.000000) can0 {id}#{data:0<16}\n", 1_700_000_000 + second)));
    }
    let log = FOLDER.path().join(format!("{name}.log"));
    std::fs::write(&log, lines).unwrap();
    Pack { files: BTreeMap::from([("pack.dbc".to_owned(), DBC.to_owned())]), config, log, arguments: &[] }
}

#[test]
fn right_packs_of_vehicles_are_silent_and_their_faults_named() {
    let mut failed = Vec::new();
    for right in RIGHT {
        let pack = right_pack(right);
        let wrong: Vec<Mistake> = WRONG.iter().filter(|mistake| mistake.0 == right.0).copied().collect();
        failed.extend(unnamed(right.0, &pack, &wrong));
        if right.0 == "dashboard" {
            let is_stopped = |time_s: f64, line: &str| (2000.0..4000.0).contains(&time_s) && line.contains(" 100#");
            let stopped = pack.with_lines("stopped", |time_s, line| match is_stopped(time_s, line) {
                true => Some(format!("{} can0 100#0000{}", &line[..19], &line[33..])),
                false => Some(line.to_owned()),
            });
            let (code, text) = stopped.doctor(&[]);
            assert!(code == 1 && text.contains("it stops while the pack is in use"), "{text}");
        }
    }
    assert!(failed.is_empty(), "{}", failed.join("\n\n"));
}

#[test]
fn hole_in_log_is_named_with_its_times() {
    // Two hours are missing, either in the whole log or only in the current.
    for (is_whole, words) in [(true, "a stretch of 2 h is missing in the log"), (false, "pack current: no reading for")]
    {
        let is_kept =
            |time_s: f64, line: &str| !(2000.0..9200.0).contains(&time_s) || !is_whole && !line.contains(" 100#");
        let pack = LFP.with_lines("hole", |time_s, line| is_kept(time_s, line).then(|| line.to_owned()));
        let (code, text) = pack.doctor(&[]);
        assert!(code == 1 && text.contains(words) && text.contains("to 2.556 h after the first frame"), "{text}");
    }
}

#[test]
fn current_without_sign_or_direction_is_named() {
    let pack = LFP.with_lines("magnitude", |_, line| {
        let Some((before, data)) = line.split_once("100#") else { return Some(line.to_owned()) };
        let low = u16::from_str_radix(&data[..2], 16).unwrap() + 256 * u16::from_str_radix(&data[2..4], 16).unwrap();
        let bytes = low.cast_signed().unsigned_abs().to_le_bytes();
        Some(format!("{before}100#{:02X}{:02X}{}", bytes[0], bytes[1], &data[4..]))
    });
    let (code, text) = pack.doctor(&[("\"charge\"", "\"discharge\"")]);
    assert!(code == 1 && text.contains("the current is never negative, but the"), "{text}");
    let sign = "\"discharge\"\nsign = { signal = \"BmsCharger.Charging\", charge = [1] }";
    let charger = "\nBO_ 259 BmsCharger: 8 BMS\n SG_ Charging : 0|1@1+ (1,0) [0|1] \"\" X\nBO_ 272 ";
    let (code, text) = pack.doctor(&[("\"charge\"", sign), ("\nBO_ 272 ", charger)]);
    for words in ["direction of the current: configured, never received", "never with the direction of the current"] {
        assert!(code == 1 && text.contains(words) && !text.contains("inverted"), "{text}");
    }
}

/// Path of a folder in `more-data`: optional data in a second place near the measured data.
fn more_data(name: &str) -> PathBuf {
    measured::path("can_ev").join("../../more-data").join(name)
}

const OF_BOAT: &[Mistake] = &[
    ("1", &[("\"charge\"", "\"discharge\"")], &["sign of the current is inverted"]),
    ("2, fewer", &[("cells = 16", "cells = 15")], &["the pack has 16 cells, 15 are configured"]),
    ("6", &[("BMS_Status.Current", "BMS_Status.Cycles")], &["pack current: the value never changes"]),
    (
        "7",
        &[("BMS_Status.SOC", "X"), ("BMS_MinMax.SOH", "BMS_Status.SOC"), ("\"X\"", "\"BMS_MinMax.SOH\"")],
        &["reported SOC and reported SOH are exchanged"],
    ),
    ("8", &[("BMS_Temps.Temp_1", "BMS_Temps.TempMos")], &["not a temperature of the cells"]),
    ("12, tenth", &[("ah = 280", "ah = 28")], &["28 Ah are configured", "+ rated_capacity_ah = "]),
    ("12, third", &[("ah = 280", "ah = 100")], &["100 Ah are configured", "+ rated_capacity_ah = "]),
    ("12, tenfold", &[("ah = 280", "ah = 2800")], &["2800 Ah are configured", "+ rated_capacity_ah = "]),
    (
        "13",
        &[("lfp-graphite", "nmc-graphite")],
        &["chemistry contradicts the reported SOC", "+ chemistry = \"lfp-graphite\""],
    ),
    ("16", &[("\"boat.dbc\"", "\"bot.dbc\"")], &["input.dbc", "did you mean boat.dbc"]),
];

const KONA: &str = r#"[pack]
cells = 98
chemistry = "nmc-graphite"
rated_capacity_ah = 180

[[interface]]
name = "can0"

[[interface]]
name = "can1"

[input]
dbc = ["kona.dbc"]

[input.current]
signal = "Batt_HV_Status.IBatt"
interface = "can0"
positive = "discharge"

[input.pack_voltage]
signal = "Batt_HV_Status.VBatt"
interface = "can0"

[[input.temperature]]
signal = "BatteryCharging.uwe596_7_TAkkuH"
interface = "can0"

[input.reported_soc]
signal = "BatteryLimits.SoC_Maybe"
interface = "can0"
"#;

const OF_KONA: &[Mistake] = &[
    ("3", &[("cells = 98", "cells = 49")], &["49 cells cannot have this pack voltage"]),
    ("4, fewer", &[("cells = 98", "cells = 90")], &["number of cells", "contradicts the reported SOC"]),
    ("4, more", &[("cells = 98", "cells = 108")], &["number of cells", "contradicts the reported SOC"]),
    ("14", &[("nmc-graphite", "lfp-graphite")], &["chemistry", "+ chemistry = \"nmc-graphite\""]),
    ("16", &[("\"kona.dbc\"", "\"dbc/kona.dbc\"")], &["input.dbc", "did you mean kona.dbc"]),
];

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

fn boat() -> Pack {
    let folder = more_data("field/boat");
    let files = ["boat.dbc", "boat_cell.toml", "eve.toml"].map(|name| (name.to_owned(), read(&folder.join(name))));
    let config = read(&folder.join("label.toml"));
    let converted = "signal = \"BMS_Temps.Temp_1\"\noffset = -273.15\n";
    let config = match config.contains("offset") {
        true => config,
        false => {
            config.replace("signal = \"BMS_Temps.Temp_1\"", converted) + "\n[limits.temperature]\nmax_age_s = 15\n"
        }
    };
    Pack { files: files.into(), config, log: folder.join("boat.log.gz"), arguments: &["--for", "30000"] }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn measured_mistakes_are_named_and_right_packs_silent() {
    if !more_data("field/boat").is_dir() {
        eprintln!("skipped: no folder more-data next to the measured data");
        return;
    }
    let boat = boat();
    let mut failed = unnamed("boat", &boat, OF_BOAT);
    let label = "chemistry = \"lfp-graphite\"\nrated_capacity_ah = 280";
    for model in ["boat_cell.toml", "eve.toml"] {
        let pack = Pack { config: boat.config.replace(label, &format!("cell_model = {model:?}")), ..boat.clone() };
        failed.extend(unnamed(model, &pack, &[]));
    }
    let can = measured::path("can_ev");
    let kona = Pack {
        files: BTreeMap::from([("kona.dbc".to_owned(), read(&can.join("kona_pcan.dbc")))]),
        config: KONA.to_owned(),
        log: can.join("kona2019_power_cycle_pcan_can0_ccan_can1.log.gz"),
        arguments: &[],
    };
    failed.extend(unnamed("Kona", &kona, OF_KONA));
    assert!(failed.is_empty(), "{}", failed.join("\n\n"));
}
