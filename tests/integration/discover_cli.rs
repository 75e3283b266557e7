//! Tests `packwatch discover` on logs of real cars, and on simulated traffic mixed with random messages. Pack voltage,
//! current, cells and temperature must be among the first three candidates.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use crate::import_obdb::{self, Case};
use crate::support::measured;

/// Fraction of the expected signals that must be among the first three candidates.
const BAR: f64 = 0.8;

fn config(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name)
}

fn packwatch(args: &[&str]) -> assert_cmd::assert::Assert {
    assert_cmd::Command::cargo_bin("packwatch").unwrap().args(args).assert()
}

fn found(document: &Value, quantity: &str) -> Vec<String> {
    let candidates = document["discovery"]["candidates"].as_array().unwrap().iter();
    let of_quantity = candidates.filter(|candidate| candidate["quantity"] == quantity);
    of_quantity.map(|candidate| candidate["signal"].as_str().unwrap().to_owned()).collect()
}

struct Trial<'a> {
    name: &'a str,
    log: PathBuf,
    options: Vec<String>,
    expected: &'a [(&'a str, &'a str)],
}

impl Trial<'_> {
    /// Returns how many expected signals are among the first three candidates, and how many are expected. Prints the
    /// rank of each expected signal.
    fn run(&self) -> (usize, usize) {
        let mut args = vec!["discover", self.log.to_str().unwrap(), "--json"];
        args.extend(self.options.iter().map(String::as_str));
        let document: Value = serde_json::from_slice(&packwatch(&args).success().get_output().stdout).unwrap();
        let is_hit = |(quantity, signal): &&(&str, &str)| {
            let found = found(&document, quantity);
            let rank = found.iter().position(|name| name == signal).map(|index| index + 1);
            eprintln!("{}: {quantity} {signal}: rank {rank:?}", self.name);
            rank.is_some_and(|rank| rank <= 3)
        };
        (self.expected.iter().filter(is_hit).count(), self.expected.len())
    }
}

/// Simulates a pack that sends the signals in `inputs`. Returns the log.
fn simulate(folder: &Path, name: &str, dbc: &Path, inputs: &str, cells: u32) -> PathBuf {
    let text = format!(
        "[pack]\ncells = {cells}\nstrings = 25\ncell_model = {:?}\n[[interface]]\nname = \"can0\"\n[input]\ndbc = [{:?}]\n{inputs}",
        config("cells/example_nmc_2600.toml"),
        dbc
    );
    let (file, log) = (folder.join(format!("{name}.toml")), folder.join(format!("{name}.log")));
    std::fs::write(&file, text).unwrap();
    let (file, log_text) = (file.to_str().unwrap(), log.to_str().unwrap());
    packwatch(&["simulate", "ev-day", "-c", file, "-o", log_text, "--duration", "300"]).success();
    log
}

/// Adds all other messages of the DBC, twice a second, with random bytes.
fn add_other_messages(log: &Path, dbc: &Path) {
    let text = std::fs::read_to_string(log).unwrap();
    let stamp = |line: &str| line[1..line.find(')').unwrap()].parse::<f64>().unwrap();
    let own: std::collections::BTreeSet<&str> =
        text.lines().map(|line| line.split([' ', '#']).nth(2).unwrap()).collect();
    let database = packwatch::can::dbc::Database::parse_bytes(&std::fs::read(dbc).unwrap()).unwrap();
    let others =
        database.messages.iter().map(|message| (message.id.to_string(), usize::from(message.len_bytes.min(8))));
    let mut others: Vec<(String, Vec<u8>)> =
        others.filter(|(id, len)| *len > 0 && !own.contains(id.as_str())).map(|(id, len)| (id, vec![0; len])).collect();
    let mut dice = ChaCha8Rng::seed_from_u64(16);
    others.iter_mut().for_each(|(_, data)| data.iter_mut().for_each(|byte| *byte = dice.random()));
    let start = stamp(text.lines().next().unwrap());
    let mut lines: Vec<(f64, String)> = text.lines().map(|line| (stamp(line), line.to_owned())).collect();
    for step in 0..600 {
        for (id, data) in &mut others {
            let place = dice.random_range(0..data.len());
            data[place] = dice.random();
            let payload: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
            let time_s = start + 0.5 * f64::from(step);
            lines.push((time_s, format!("({time_s:.6}) can0 {id}#{payload}")));
        }
    }
    lines.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: String = lines.into_iter().map(|(_, line)| line + "\n").collect();
    std::fs::write(log, all).unwrap();
}

/// Writes the raw frames of a car's test cases as a log, each request followed by its answer.
fn log_of_cases(folder: &Path, car: &str, year: &str, identifiers: &[&str], log: &Path) {
    let mut streams: Vec<Vec<Case>> = Vec::new();
    for identifier in identifiers {
        let name = format!("{year}.7E4.7EC.22{identifier}_fc=1.yaml");
        streams.push(import_obdb::cases(&std::fs::read_to_string(folder.join(car).join("cases").join(name)).unwrap()));
    }
    let (mut text, mut time_s) = (String::new(), 1_700_000_000.0);
    for number in 0..streams.iter().map(Vec::len).max().unwrap() {
        for (identifier, cases) in identifiers.iter().zip(&streams) {
            let Some(case) = cases.get(number) else { continue };
            writeln!(text, "({time_s:.6}) can0 7E4#0322{identifier}00000000").unwrap();
            for frame in case.frames().iter().filter(|frame| frame.len() == 19) {
                time_s += 0.005;
                writeln!(text, "({time_s:.6}) can0 {}#{}", &frame[..3], &frame[3..]).unwrap();
            }
            time_s += 0.1;
        }
        time_s += 0.5;
    }
    std::fs::write(log, text).unwrap();
}

const KONA_INPUTS: &str = "[input.current]\nsignal = \"Batt_HV_Status.IBatt\"\npositive = \"discharge\"\n\
    [input.pack_voltage]\nsignal = \"Batt_HV_Status.VBatt\"\n\
    [[input.temperature]]\nsignal = \"BatteryCharging.uwe596_7_TAkkuH\"\n";
const TESLA_CURRENT: &str = "[input.current]\nsignal = \"ID132HVBattAmpVolt.SmoothBattCurrent132\"\npositive = \"charge\"\n\
    [[input.temperature]]\nsignal = \"ID332BattCellMinMax.BattCellTempMax332\"\n";
const TESLA_PACK: &str = "[input.pack_voltage]\nsignal = \"ID132HVBattAmpVolt.BattVoltage132\"\n";
const TESLA_CELLS: &str = "[input.cell_voltage]\nsignal = \"ID401CellVoltages.Cell{n}\"\nfirst = 0\n";

const KONA: &[(&str, &str)] = &[
    ("current", "Batt_HV_Status.IBatt"),
    ("pack_voltage", "Batt_HV_Status.VBatt"),
    ("temperature", "BatteryCharging.uwe596_7_TAkkuH"),
];
const LEAF: &[(&str, &str)] = &[
    ("current", "Answer7BB.D2101_Current_0"),
    ("pack_voltage", "Answer7BB.D2101_Voltage_18"),
    ("temperature", "Answer7BB.D2104_Row2Sensor{n}"),
];
const TESLA_OF_PACK: &[(&str, &str)] = &[
    ("current", "ID132HVBattAmpVolt.SmoothBattCurrent132"),
    ("pack_voltage", "ID132HVBattAmpVolt.BattVoltage132"),
    ("temperature", "ID332BattCellMinMax.BattCellTempMax332"),
];
const TESLA_OF_CELLS: &[(&str, &str)] = &[
    ("current", "ID132HVBattAmpVolt.SmoothBattCurrent132"),
    ("cell_voltage", "ID401CellVoltages.Cell{n}"),
    ("temperature", "ID332BattCellMinMax.BattCellTempMax332"),
];
/// Without a DBC, the name of a message contains its number.
const KONA_FIELDS: &[(&str, &str)] = &[
    ("current", "Message1429.Current_16bits_at_32_little"),
    ("pack_voltage", "Message1429.Voltage_16bits_at_48_little"),
];
const TESLA_FIELDS: &[(&str, &str)] =
    &[("current", "Message306.Current_16bits_at_16_little"), ("cell_voltage", "Message1025.Cell{n}")];
const KONA_ANSWERS: &[(&str, &str)] = &[
    ("current", "KONAEV.HVBAT_CURR"),
    ("pack_voltage", "KONAEV.HVBAT_VDC"),
    ("cell_voltage", "KONAEV.HVBAT_CMU{n}_VOLT"),
    ("temperature", "KONAEV.HVBAT_MOD{n}_T"),
    ("soc", "KONAEV.HVBAT_SOC"),
    ("soh", "KONAEV.HVBAT_SOH"),
];

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn car_signals_are_among_first_three_candidates() {
    let data = measured::path("can_ev");
    let folder = tempfile::tempdir().unwrap();
    let (kona, tesla) = (data.join("kona_pcan.dbc"), data.join("tesla_model3.dbc"));
    let simulated = |name: &str, dbc: &Path, inputs: &str, cells: u32| {
        let log = simulate(folder.path(), name, dbc, inputs, cells);
        add_other_messages(&log, dbc);
        log
    };
    let with = |dbc: &Path| vec!["--dbc".to_owned(), dbc.display().to_string()];
    let mut trials = vec![
        Trial {
            name: "Kona, log",
            log: data.join("kona2019_power_cycle_pcan_can0_ccan_can1.log.gz"),
            options: with(&kona),
            expected: KONA,
        },
        Trial { name: "Leaf, log", log: data.join("leaf2019_uds_poll.log.gz"), options: Vec::new(), expected: LEAF },
        Trial {
            name: "Kona, simulated",
            log: simulated("kona", &kona, KONA_INPUTS, 98),
            options: with(&kona),
            expected: KONA,
        },
        Trial {
            name: "Tesla, simulated pack",
            log: simulated("pack", &tesla, &format!("{TESLA_CURRENT}{TESLA_PACK}"), 96),
            options: with(&tesla),
            expected: TESLA_OF_PACK,
        },
        Trial {
            name: "Tesla, simulated cells",
            log: simulated("cells", &tesla, &format!("{TESLA_CURRENT}{TESLA_CELLS}"), 96),
            options: with(&tesla),
            expected: TESLA_OF_CELLS,
        },
    ];
    for (index, expected) in [(2, KONA_FIELDS), (4, TESLA_FIELDS)] {
        let log = trials[index].log.clone();
        trials.push(Trial { name: "the same log without a DBC", log, options: Vec::new(), expected });
    }
    {
        let obd = import_obdb::folder();
        let log = folder.path().join("answers.log");
        log_of_cases(&obd, "hyundai_kona", "2021", &["0101", "0102", "0103", "0104", "0105"], &log);
        let options = vec!["--obdb".to_owned(), obd.join("hyundai_kona/signalset.json").display().to_string()];
        trials.push(Trial { name: "Kona, answers", log, options, expected: KONA_ANSWERS });
    }
    let scores: Vec<(usize, usize)> = trials.iter().map(Trial::run).collect();
    let (hits, all) = scores.iter().fold((0, 0), |(hits, all), score| (hits + score.0, all + score.1));
    eprintln!("{hits} of {all} signals among the first three candidates");
    assert!(hits as f64 >= BAR * all as f64, "only {hits} of {all} signals");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn written_configuration_is_valid_and_estimates_log() {
    let data = measured::path("can_ev");
    let folder = tempfile::tempdir().unwrap();
    let tesla = data.join("tesla_model3.dbc");
    let log = simulate(folder.path(), "cells", &tesla, &format!("{TESLA_CURRENT}{TESLA_CELLS}"), 96);
    let (pack, model) = (folder.path().join("pack.toml"), config("cells/example_nmc_2600.toml"));
    let (log, pack, dbc, model) =
        (log.to_str().unwrap(), pack.to_str().unwrap(), tesla.to_str().unwrap(), model.to_str().unwrap());
    packwatch(&["discover", log, "--dbc", dbc, "--write", pack, "--model", model]).success();
    packwatch(&["check", pack]).success();
    let text = std::fs::read_to_string(pack).unwrap();
    assert!(text.contains("positive = \"charge\""), "the simulated bus reports charge as positive: {text}");
    let output = packwatch(&["replay", "-c", pack, log, "--json"]).success();
    let summary: Value = serde_json::from_slice(&output.get_output().stdout).unwrap();
    assert!(summary.to_string().contains("96"), "{summary}");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn discovered_fields_are_written_with_dbc() {
    let data = measured::path("can_ev");
    let folder = tempfile::tempdir().unwrap();
    let tesla = data.join("tesla_model3.dbc");
    let log = simulate(folder.path(), "cells", &tesla, &format!("{TESLA_CURRENT}{TESLA_CELLS}"), 96);
    let (pack, model) = (folder.path().join("pack.toml"), config("cells/example_nmc_2600.toml"));
    let (log, pack, model) = (log.to_str().unwrap(), pack.to_str().unwrap(), model.to_str().unwrap());
    let output = packwatch(&["discover", log, "--write", pack, "--model", model]).success();
    let open = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
    assert!(open.contains("scale of Message306.Current_16bits_at_16_little is a guess"), "{open}");
    packwatch(&["check", pack]).success();
    let text = std::fs::read_to_string(pack).unwrap();
    assert!(text.contains("cells = 96") && text.contains("dbc = [\"pack.dbc\"]"), "{text}");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn ambiguous_log_asks_and_writes_nothing() {
    let data = measured::path("can_ev");
    let folder = tempfile::tempdir().unwrap();
    let (pack, model) = (folder.path().join("pack.toml"), config("cells/example_nmc_2600.toml"));
    let (pack, model) = (pack.to_str().unwrap(), model.to_str().unwrap());
    let log = data.join("leaf2019_uds_poll.log.gz");
    let args = ["discover", log.to_str().unwrap(), "--write", pack, "--model", model];
    let output = packwatch(&args).code(1);
    let error = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
    assert!(error.contains("--positive") && error.contains("--label 96s"), "{error}");
    assert!(!Path::new(pack).exists());
    packwatch(&[&args[..], &["--positive", "discharge", "--label", "96s"]].concat()).success();
    packwatch(&["check", pack]).success();
}

#[test]
fn bad_input_error_names_file() {
    let folder = tempfile::tempdir().unwrap();
    let (log, other) = (folder.path().join("a.log"), folder.path().join("b.json"));
    std::fs::write(&log, "(1.000000) can0 100#00\n").unwrap();
    std::fs::write(&other, "{").unwrap();
    let (log, other) = (log.to_str().unwrap(), other.to_str().unwrap());
    for (args, part) in [
        (&["discover", "nothing.log"][..], "nothing.log"),
        (&["discover", log, "--obdb", other], "b.json:1:"),
        (&["discover", log, "--dbc", other], "b.json"),
        (&["import", "obdb", other], "b.json:1:"),
        (&["import", "obdb", "nothing.json"], "nothing.json"),
    ] {
        let output = packwatch(args).code(1);
        let error = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
        assert!(error.contains(part), "{args:?}: {error}");
    }
    let dbc = folder.path().join("c.dbc");
    std::fs::write(&dbc, "VERSION \"\"\nNS_ :\nBS_:\nBU_: A\nBO_ 1 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n")
        .unwrap();
    let output = packwatch(&["import", "dbc", dbc.to_str().unwrap()]).code(1);
    assert!(String::from_utf8_lossy(&output.get_output().stderr).contains("c.dbc: no signal"));
    let output = packwatch(&["discover", log]).success();
    assert!(String::from_utf8_lossy(&output.get_output().stdout).contains("no candidate"));
}
