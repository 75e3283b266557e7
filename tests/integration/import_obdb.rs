//! Tests `packwatch import obdb` on the OBDb signal sets of three cars. The test cases of a set contain raw frames and
//! expected values. With the imported file, the core must decode every expected value from the frames.
//!
//! Two differences from the reference decoder are allowed. The reference decoder clamps values that packwatch reports
//! as out of range. If a frame of a case was recorded with missing characters, packwatch reads no value from the case.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::support::measured;
use packwatch::can::CanId;
use packwatch::can::isotp::{Progress, Receiver};
use packwatch::can::uds::Answer;
use packwatch::quantity::{Channel, Fault, Timestamp};
use toml::Value;

/// The signal sets, in the measured data folder or in the folder `more-data` next to it.
pub(crate) fn folder() -> PathBuf {
    let inside = measured::path("obd");
    if inside.is_dir() { inside } else { measured::path("../more-data/obd") }
}

fn import(args: &[&str]) -> String {
    let output = assert_cmd::Command::cargo_bin("packwatch").unwrap().args(["import", "obdb"]).args(args).assert();
    String::from_utf8(output.success().get_output().stdout.clone()).unwrap()
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Reading {
    Value(f64),
    /// Limits of the signal's range.
    OutOfRange(f64, f64),
    Other(Fault),
}

/// A signal set of one model year as the core reads it. Every signal is an input.
struct ImportedCar {
    text: String,
    answers: Vec<Answer>,
    /// Name and range of each signal. Signal n is temperature sensor n.
    signals: Vec<(String, (f64, f64))>,
}

/// Inputs that every configuration needs, in a diagnostic answer of their own. The imported signals are configured as
/// temperatures, because a pack may have more temperature inputs than inputs of any other kind.
const OTHER_INPUTS: &str = "[[input.diagnostic]]\nname = \"Other\"\nrequest = 1\nresponse = 2\nservice = 0x22\nidentifier = 1\n\
    signals = [{ name = \"Cell{n}\", numbers = \"1-1024\", bit = 0, length = 8 }, { name = \"Current\", bit = 9000, length = 8 }]\n";

impl ImportedCar {
    fn new(signal_set: &Path, year: &str) -> Self {
        let text = import(&[signal_set.to_str().unwrap(), "--year", year]);
        let signals = signals_of(&text.parse().unwrap());
        let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/cells/example_nmc_2600.toml");
        let mut config = format!(
            "[pack]\ncells = 1024\ncell_model = {model:?}\n[[interface]]\nname = \"can0\"\n[input]\n[input.current]\n\
             signal = \"Other.Current\"\npositive = \"charge\"\n[input.cell_voltage]\nsignal = \"Other.Cell{{n}}\"\n"
        );
        for (number, (name, _)) in (1..).zip(&signals) {
            // With an explicit scale, packwatch accepts a signal of any unit.
            writeln!(config, "[[input.temperature]]\nsignal = \"{name}\"\nscale = 1.0\ncells = \"{number}\"").unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pack.toml");
        std::fs::write(&file, config + OTHER_INPUTS + &text).unwrap();
        let answers = packwatch::config::load(&file).unwrap().monitor.answers;
        Self { text, answers, signals }
    }

    fn decode(&self, response: CanId, answer: &[u8]) -> BTreeMap<&str, Reading> {
        let question = |found: &&Answer| {
            found.question.controller.response == response && answer.starts_with(&found.question.answer_head())
        };
        let found = self.answers.iter().find(question);
        let readings =
            found.into_iter().flat_map(|found| found.readings(&answer[found.question.answer_head().len()..]));
        let named = readings.map(|reading| {
            let Channel::Temperature(sensor) = reading.channel else { panic!("{:?}", reading.channel) };
            let (name, (low, high)) = &self.signals[usize::from(sensor.0)];
            let reading = match reading.value {
                Ok(value) => Reading::Value(value),
                Err(Fault::OutOfRange) => Reading::OutOfRange(*low, *high),
                Err(fault) => Reading::Other(fault),
            };
            (name.split_once('.').unwrap().1, reading)
        });
        named.collect()
    }
}

/// Every signal of a file with its range. A series gives several signals.
fn signals_of(tables: &toml::Table) -> Vec<(String, (f64, f64))> {
    let mut signals = Vec::new();
    for table in tables["input"]["diagnostic"].as_array().unwrap() {
        for signal in table["signals"].as_array().unwrap() {
            let limit = |key: &str, without: f64| match signal.get(key) {
                Some(Value::Integer(number)) => *number as f64,
                Some(value) => value.as_float().unwrap(),
                None => without,
            };
            let range = (limit("minimum", f64::MIN), limit("maximum", f64::MAX));
            let numbers = signal.get("numbers").map_or("0-0", |numbers| numbers.as_str().unwrap());
            let (first, last) = numbers.split_once('-').unwrap();
            for n in first.parse::<u32>().unwrap()..=last.parse().unwrap() {
                let name = signal["name"].as_str().unwrap().replace("{n}", &n.to_string());
                signals.push((format!("{}.{name}", table["name"].as_str().unwrap()), range));
            }
        }
    }
    signals
}

/// One test case of a file: expected values by id, and the text that contains the frames.
#[derive(Debug, Default)]
pub(crate) struct Case {
    expected: Vec<(String, String)>,
    response: String,
}

/// Reads a file of cases. Lines below `expected_values` have the form `ID: VALUE`. Frames follow below `response`,
/// either as the lines of a block (`|-`) or as a quoted text. In a quoted text, `\n` ends a frame and a line end is a
/// space.
pub(crate) fn cases(text: &str) -> Vec<Case> {
    let mut cases: Vec<Case> = Vec::new();
    for line in text.lines().map(str::trim_end) {
        if line.starts_with("- ") {
            cases.push(Case::default());
        }
        let Some(case) = cases.last_mut() else { continue };
        let line = line.trim_start_matches(['-', ' ']);
        match line.split_once(": ") {
            _ if line == "expected_values:" => {}
            Some(("response", "|-")) => case.response = "\\n".to_owned(),
            Some(("response", rest)) => case.response = rest.to_owned(),
            Some((id, value)) => case.expected.push((id.to_owned(), value.to_owned())),
            None => case.response += &format!("{}{line}", if case.response.starts_with('"') { " " } else { "\\n" }),
        }
    }
    cases
}

impl Case {
    pub(crate) fn frames(&self) -> Vec<String> {
        let lines = self.response.split("\\n");
        let digits = lines.map(|line| line.chars().filter(char::is_ascii_alphanumeric).collect::<String>());
        digits.filter(|digits| !digits.is_empty()).collect()
    }
}

/// Identifier and payload of every complete answer, reassembled by the core. Lines that are not classic frames are
/// skipped.
fn reassemble(frames: &[String]) -> Vec<(CanId, Vec<u8>)> {
    let mut receiver = Receiver::new(None);
    let mut answers = Vec::new();
    for (id, bytes) in frames.iter().filter_map(|frame| frame_of(frame)) {
        if receiver.handle(Timestamp::from_nanos(0), &bytes).progress == Progress::Complete {
            answers.push((id, receiver.message().to_vec()));
        }
    }
    answers
}

/// Identifier and data, or `None` if the text is not a classic frame with data.
fn frame_of(text: &str) -> Option<(CanId, Vec<u8>)> {
    let (id, data) = text.split_at_checked(3)?;
    let bytes = (0..data.len()).step_by(2).map(|at| u8::from_str_radix(data.get(at..at + 2)?, 16).ok());
    let bytes: Vec<u8> = bytes.collect::<Option<_>>()?;
    let id = CanId::standard(u32::from_str_radix(id, 16).ok()?)?;
    (1..=8).contains(&bytes.len()).then_some((id, bytes))
}

#[derive(Debug, Default, PartialEq)]
struct Comparison {
    equal: usize,
    clamped: usize,
    enumerations: usize,
    /// Cases without a complete answer because a line is not a CAN frame.
    damaged: usize,
    different: Vec<String>,
}

impl Comparison {
    fn compare(&mut self, place: &str, case: &Case, prefix: &str, car: &ImportedCar) {
        let answers = reassemble(&case.frames());
        if answers.is_empty() {
            assert!(case.frames().iter().any(|frame| frame_of(frame).is_none()), "{place}: {case:?}");
            self.damaged += 1;
            return;
        }
        let readings = answers.iter().flat_map(|(response, answer)| car.decode(*response, answer));
        let readings: BTreeMap<String, Reading> =
            readings.map(|(name, reading)| (without_zeros(name), reading)).collect();
        for (id, expected) in &case.expected {
            let name = id.strip_prefix(prefix).unwrap().strip_prefix('_').unwrap();
            let Ok(expected) = expected.parse::<f64>() else {
                assert!(car.text.contains(&format!("({id}): enumeration")), "{place}: {id}");
                self.enumerations += 1;
                continue;
            };
            match readings.get(&without_zeros(name)) {
                Some(Reading::Value(value)) if near(*value, expected) => self.equal += 1,
                Some(Reading::OutOfRange(low, high)) if near(*low, expected) || near(*high, expected) => {
                    self.clamped += 1
                }
                other => self.different.push(format!("{place}: {id}: expected {expected}, found {other:?}")),
            }
        }
    }
}

/// Whether the values agree. Expected values are rounded to five decimals, large values to seven digits.
fn near(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 6e-6 + 1e-6 * expected.abs()
}

/// The name with leading zeros removed from its numbers. Names in a series have no leading zeros.
fn without_zeros(name: &str) -> String {
    let mut short = String::new();
    let mut chars = name.chars().peekable();
    while let Some(c) = chars.next() {
        let is_leading = c == '0' && !short.ends_with(|c: char| c.is_ascii_digit());
        if !(is_leading && chars.peek().is_some_and(char::is_ascii_digit)) {
            short.push(c);
        }
    }
    short
}

fn compare_car(folder: &Path, car: &str, prefix: &str) -> Comparison {
    let signal_set = folder.join(car).join("signalset.json");
    let mut imported: BTreeMap<String, ImportedCar> = BTreeMap::new();
    let mut comparison = Comparison::default();
    for entry in std::fs::read_dir(folder.join(car).join("cases")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let (year, _) = name.split_once('.').unwrap();
        let of_year = imported.entry(year.to_owned()).or_insert_with(|| ImportedCar::new(&signal_set, year));
        for (number, case) in cases(&std::fs::read_to_string(&path).unwrap()).iter().enumerate() {
            comparison.compare(&format!("{car}/{name}[{number}]"), case, prefix, of_year);
        }
    }
    eprintln!(
        "{car}: {} equal, {} clamped, {} enumerations, {} damaged cases, {} different",
        comparison.equal,
        comparison.clamped,
        comparison.enumerations,
        comparison.damaged,
        comparison.different.len()
    );
    comparison
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn imported_signals_read_all_expected_values() {
    let folder = folder();
    for (car, prefix) in [("hyundai_kona", "KONAEV"), ("hyundai_ioniq5", "IONIQ5"), ("nissan_leaf", "LEAF")] {
        let comparison = compare_car(&folder, car, prefix);
        assert!(comparison.equal > 50, "{car}: {}", comparison.equal);
        assert!(
            comparison.different.is_empty(),
            "{} differences:\n{}",
            comparison.different.len(),
            comparison.different.join("\n")
        );
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn kona_cells_form_one_pattern() {
    let folder = folder();
    let text = import(&[folder.join("hyundai_kona/signalset.json").to_str().unwrap(), "--name", "Kona"]);
    assert!(text.contains("CC BY-SA 4.0") && text.contains("OBDb"));
    let cells: Vec<&str> = text.lines().filter(|line| line.contains("name = \"HVBAT_CMU{n}_VOLT\"")).collect();
    let numbers = ["\"1-32\"", "\"33-64\"", "\"65-96\"", "\"97-98\""];
    assert_eq!(cells.len(), numbers.len(), "{cells:?}");
    assert!(
        cells.iter().zip(numbers).all(|(line, numbers)| line.contains(&format!("numbers = {numbers}"))),
        "{cells:?}"
    );
}
