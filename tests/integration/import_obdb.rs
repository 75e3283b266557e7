//! `packwatch import obdb` on the signal sets of three cars: every expected value of their test cases, read from raw frames
//! through the written file.
//!
//! The reference decoder moves a value onto the limit of its range; here such a value is out of range. That is the only
//! difference allowed. Some cases were recorded with characters lost, their lines are no CAN frames: they have no answer here.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use toml::Value;

pub(crate) fn folder() -> Option<PathBuf> {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("PACKWATCH_DATA").map_or(shared, PathBuf::from);
    // Beside the folder of data, or in it.
    let places = [data.join("obd"), data.join("../more-data/obd")];
    let found = places.iter().find(|place| place.is_dir()).cloned();
    if found.is_none() {
        eprintln!("SKIPPED: {} is not there (set PACKWATCH_DATA)", places[0].display());
    }
    found
}

fn import(args: &[&str]) -> String {
    let output = assert_cmd::Command::cargo_bin("packwatch").unwrap().args(["import", "obdb"]).args(args).assert();
    String::from_utf8(output.success().get_output().stdout.clone()).unwrap()
}

/// Result of one signal.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Reading {
    Value(f64),
    /// With the limit nearest to the value.
    OutOfRange {
        limit: f64,
    },
    Absent,
}

/// Decodes by the written file alone: service, identifier and payload of an answer in; values by signal name out.
fn decode(tables: &toml::Table, response: i64, answer: &[u8]) -> BTreeMap<String, Reading> {
    let mut readings = BTreeMap::new();
    let number = |table: &toml::Table, key: &str| table.get(key).map_or(0, |value| value.as_integer().unwrap());
    for table in tables["input"]["diagnostic"].as_array().unwrap() {
        let table = table.as_table().unwrap();
        let service = number(table, "service");
        let digits = if service == 0x22 { 3 } else { 2 };
        let Some(echo) = answer.get(1..digits) else { continue };
        let identifier = echo.iter().fold(0, |all, byte| all << 8 | i64::from(*byte));
        let is_it = number(table, "response") == response
            && i64::from(answer[0]) == service + 0x40
            && number(table, "identifier") == identifier;
        if !is_it {
            continue;
        }
        for signal in table["signals"].as_array().unwrap() {
            let signal = signal.as_table().unwrap();
            let numbers = signal.get("numbers").map_or("0-0", |numbers| numbers.as_str().unwrap());
            let (first, last) = numbers.split_once('-').unwrap();
            for n in first.parse::<i64>().unwrap()..=last.parse().unwrap() {
                let bit = number(signal, "bit") + (n - first.parse::<i64>().unwrap()) * number(signal, "step");
                let name = signal["name"].as_str().unwrap().replace("{n}", &n.to_string());
                if let Some(reading) = read(signal, bit, &answer[digits..]) {
                    assert!(readings.insert(name, reading).is_none());
                }
            }
        }
    }
    readings
}

fn read(signal: &toml::Table, bit: i64, data: &[u8]) -> Option<Reading> {
    let length = signal["length"].as_integer().unwrap();
    let mut bytes = data.to_vec();
    if signal.get("byte_order").is_some_and(|order| order.as_str() == Some("little")) {
        bytes.get_mut((bit / 8) as usize..((bit + length) / 8) as usize)?.reverse();
    }
    let mut code = 0_u64;
    for at in bit..bit + length {
        code = code << 1 | u64::from(bytes.get((at / 8) as usize)? >> (7 - at % 8) & 1);
    }
    let float = |key: &str, default: f64| match signal.get(key) {
        Some(Value::Integer(number)) => *number as f64,
        Some(value) => value.as_float().unwrap(),
        None => default,
    };
    let absent = signal.get("not_available").map_or(&[][..], |codes| codes.as_array().unwrap());
    if absent.iter().any(|absent| absent.as_integer() == Some(code.cast_signed())) {
        return Some(Reading::Absent);
    }
    let is_negative = signal.contains_key("signed") && code >> (length - 1) & 1 == 1;
    let number = if is_negative { code as f64 - 2_f64.powi(length as i32) } else { code as f64 };
    let value = number * float("factor", 1.0) + float("offset", 0.0);
    let (low, high) = (float("minimum", f64::MIN), float("maximum", f64::MAX));
    Some(if (low - 1e-9..=high + 1e-9).contains(&value) {
        Reading::Value(value)
    } else {
        Reading::OutOfRange { limit: value.clamp(low, high) }
    })
}

/// One test case of a file: expected values by id, and the text with the frames.
#[derive(Debug, Default)]
pub(crate) struct Case {
    expected: Vec<(String, String)>,
    response: String,
}

/// Reads a file of cases: below `expected_values` lines `ID: VALUE`, below `response` frames, as lines of a block (`|-`) or in
/// one text in quotes, in which `\n` ends a frame and the end of a line is a blank.
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

/// Identifier and payload of every complete answer in frames with 11-bit identifiers. A line that is no classic frame, or
/// breaks the sequence, ends its answer.
fn reassemble(frames: &[String]) -> Vec<(i64, Vec<u8>)> {
    let mut answers = Vec::new();
    let mut partial: Option<(usize, u8, Vec<u8>)> = None;
    for frame in frames {
        let Some((id, bytes)) = frame_of(frame) else { continue };
        match (bytes[0] >> 4, partial.take()) {
            (0, _) => answers.push((id, bytes[1..=usize::from(bytes[0])].to_vec())),
            (1, _) => {
                let length = usize::from(bytes[0] & 0xF) << 8 | usize::from(bytes[1]);
                partial = Some((length, 1, bytes[2..].to_vec()));
            }
            (2, Some((length, next, mut data))) if bytes[0] & 0xF == next => {
                data.extend(&bytes[1..]);
                if data.len() >= length {
                    data.truncate(length);
                    answers.push((id, data));
                } else {
                    partial = Some((length, (next + 1) & 0xF, data));
                }
            }
            _ => {}
        }
    }
    answers
}

/// Identifier and data; `None` when the text is no classic frame with data.
fn frame_of(text: &str) -> Option<(i64, Vec<u8>)> {
    let (id, data) = text.split_at_checked(3)?;
    let bytes = (0..data.len()).step_by(2).map(|at| u8::from_str_radix(data.get(at..at + 2)?, 16).ok());
    let bytes: Vec<u8> = bytes.collect::<Option<_>>()?;
    (1..=8).contains(&bytes.len()).then_some((i64::from_str_radix(id, 16).ok()?, bytes))
}

/// Counts of compared values.
#[derive(Debug, Default, PartialEq)]
struct Comparison {
    equal: usize,
    clamped: usize,
    enumerations: usize,
    /// Cases without a complete answer: a line is no CAN frame.
    damaged: usize,
    different: Vec<String>,
}

impl Comparison {
    fn compare(&mut self, place: &str, case: &Case, prefix: &str, tables: &toml::Table, left_out: &str) {
        let answers = reassemble(&case.frames());
        if answers.is_empty() {
            assert!(case.frames().iter().any(|frame| frame_of(frame).is_none()), "{place}: {case:?}");
            self.damaged += 1;
            return;
        }
        let readings: BTreeMap<String, Reading> =
            answers.iter().flat_map(|(response, answer)| decode(tables, *response, answer)).collect();
        for (id, expected) in &case.expected {
            let name = id.strip_prefix(prefix).unwrap().strip_prefix('_').unwrap();
            let found = readings.iter().find(|(found, _)| without_zeros(found) == without_zeros(name));
            let Ok(expected) = expected.parse::<f64>() else {
                assert!(left_out.contains(&format!("({id}): enumeration")), "{place}: {id}");
                self.enumerations += 1;
                continue;
            };
            match found.map(|found| *found.1) {
                Some(Reading::Value(value)) if near(value, expected) => self.equal += 1,
                Some(Reading::OutOfRange { limit }) if near(limit, expected) => self.clamped += 1,
                other => self.different.push(format!("{place}: {id}: expected {expected}, found {other:?}")),
            }
        }
    }
}

/// Expectations are rounded to five decimals, large ones to seven digits.
fn near(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 6e-6 + 1e-6 * expected.abs()
}

/// The name without the leading zeros of its numbers: a series drops them.
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
    let mut imported: BTreeMap<String, (toml::Table, String)> = BTreeMap::new();
    let mut comparison = Comparison::default();
    for entry in std::fs::read_dir(folder.join(car).join("cases")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        let (year, _) = name.split_once('.').unwrap();
        let (tables, text) = imported.entry(year.to_owned()).or_insert_with(|| {
            let text = import(&[signal_set.to_str().unwrap(), "--year", year]);
            (text.parse().unwrap(), text)
        });
        for (number, case) in cases(&std::fs::read_to_string(&path).unwrap()).iter().enumerate() {
            comparison.compare(&format!("{car}/{name}[{number}]"), case, prefix, tables, text);
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
fn every_expected_value_of_three_cars_is_read_through_the_imported_file() {
    let Some(folder) = folder() else { return };
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
fn the_cells_of_a_kona_are_one_pattern_over_five_answers() {
    let Some(folder) = folder() else { return };
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
