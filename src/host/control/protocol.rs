//! Requests and answers of the control socket, a line of JSON each.
//!
//! | request | keys | answer |
//! | --- | --- | --- |
//! | `alarms` | `all` (false): includes those at rest | [`AlarmList`] |
//! | `acknowledge`, `clear` | `rule`, `severity`, `cell` (from 0); a missing key selects every | [`CommandOutcome`] |
//! | `pack_replaced` | | [`CommandOutcome`] |
//! | `test` | `rule`, `seconds` (0 ends a test) | [`CommandOutcome`] |
//!
//! Every line has `version`. Anything else gets an error with the value found and the values allowed.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::alarm::{Alarm, Rule, Selector, Severity};
use crate::monitor::{Command, MAX_TEST_S};
use crate::quantity::{CellIndex, MAX_CELLS, Timestamp};

/// Version of requests and answers.
pub const VERSION: u64 = 1;

/// Names of the requests.
const REQUESTS: [&str; 5] = ["alarms", "acknowledge", "clear", "pack_replaced", "test"];

/// A request of a client.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    /// Lists the present alarms.
    Alarms {
        /// Includes alarms at rest.
        all: bool,
    },
    /// A command, which changes something.
    Command(Command),
}

/// An answer of the daemon.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The answer to `alarms`.
    Alarms(AlarmList),
    /// The answer to a command.
    Outcome(CommandOutcome),
    /// The request failed: the value found, the values allowed.
    Error(String),
}

/// The present alarms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmList {
    /// Time, on the daemon's clock.
    pub time: Timestamp,
    /// Thresholds configured.
    pub thresholds: usize,
    /// Thresholds with alarms that cannot be evaluated.
    pub unknown: Vec<UnknownAlarms>,
    /// Alarms, in the order rule, severity, cell.
    pub alarms: Vec<Alarm>,
    /// Number of further alarms, for which there was no room.
    pub omitted: usize,
}

/// Alarms of one threshold that cannot be evaluated, because their value is not known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct UnknownAlarms {
    /// The rule.
    pub rule: Rule,
    /// The threshold.
    pub severity: Severity,
    /// Number of alarms.
    pub alarms: usize,
}

/// The outcome of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommandOutcome {
    /// Time, on the daemon's clock.
    pub time: Timestamp,
    /// Alarms changed.
    pub changed: u32,
    /// Number of refusals: alarms that are not healthy, a test without output.
    pub refused: u32,
    /// The refused alarms.
    pub refused_alarms: Vec<Alarm>,
}

/// The keys of every answer, with its contents.
#[derive(Serialize)]
struct Envelope<'a, T> {
    version: u64,
    ok: bool,
    #[serde(flatten)]
    contents: &'a T,
}

impl Request {
    /// Parses a line.
    ///
    /// # Errors
    /// The value found and the values allowed.
    pub fn parse(line: &[u8]) -> Result<Self, String> {
        let value: Value = serde_json::from_slice(line).map_err(|error| format!("no JSON document: {error}"))?;
        let Value::Object(keys) = value else { return Err(format!("found {value}, must be a JSON object")) };
        match keys.get("version") {
            Some(version) if version.as_u64() == Some(VERSION) => {}
            found => return Err(must_be("version", found, &VERSION.to_string())),
        }
        let name = keys.get("request").and_then(Value::as_str);
        let only = |allowed: &[&str]| only_keys(&keys, allowed);
        match name {
            Some("alarms") => only(&["all"]).and_then(|()| Ok(Self::Alarms { all: flag(&keys, "all")? })),
            Some("acknowledge") => selector(&keys).map(Command::Acknowledge).map(Self::Command),
            Some("clear") => selector(&keys).map(Command::Clear).map(Self::Command),
            Some("pack_replaced") => only(&[]).map(|()| Self::Command(Command::PackReplaced)),
            Some("test") => only(&["rule", "seconds"]).and_then(|()| test(&keys)),
            Some(_) | None => Err(must_be("request", keys.get("request"), &REQUESTS.join(", "))),
        }
    }

    /// Formats the line of the request.
    pub fn to_line(self) -> String {
        let mut keys = match self {
            Self::Alarms { all } => json!({ "request": "alarms", "all": all }),
            Self::Command(Command::Acknowledge(which)) => selector_json("acknowledge", &which),
            Self::Command(Command::Clear(which)) => selector_json("clear", &which),
            Self::Command(Command::PackReplaced) => json!({ "request": "pack_replaced" }),
            Self::Command(Command::Test { rule, seconds }) => {
                json!({ "request": "test", "rule": rule, "seconds": seconds })
            }
        };
        keys["version"] = json!(VERSION);
        format!("{keys}\n")
    }

    /// Whether it is a command.
    pub const fn changes_something(&self) -> bool {
        matches!(self, Self::Command(_))
    }
}

impl Answer {
    /// Formats the line of the answer.
    pub fn to_line(&self) -> Vec<u8> {
        let written = match self {
            Self::Alarms(list) => serde_json::to_vec(&Envelope { version: VERSION, ok: true, contents: list }),
            Self::Outcome(done) => serde_json::to_vec(&Envelope { version: VERSION, ok: true, contents: done }),
            Self::Error(error) => {
                let contents = &json!({ "error": error });
                serde_json::to_vec(&Envelope { version: VERSION, ok: false, contents })
            }
        };
        let mut line =
            written.unwrap_or_else(|error| format!("{{\"version\":1,\"ok\":false,\"error\":\"{error}\"}}").into());
        line.push(b'\n');
        line
    }
}

/// Parses the contents of an answer.
///
/// # Errors
/// The error in the answer, or its fault.
pub fn contents<T: for<'de> Deserialize<'de>>(line: &[u8]) -> Result<T, String> {
    let strange = |what: String| format!("the daemon's answer is not understood: {what}");
    let value: Value = serde_json::from_slice(line).map_err(|error| strange(error.to_string()))?;
    if value.get("version").and_then(Value::as_u64) != Some(VERSION) {
        return Err(strange(must_be("version", value.get("version"), &VERSION.to_string())));
    }
    if value.get("ok") != Some(&Value::Bool(true)) {
        let error = value.get("error").and_then(Value::as_str);
        return Err(error.map_or_else(|| strange("it has neither ok nor an error".to_owned()), str::to_owned));
    }
    serde_json::from_value(value).map_err(|error| strange(error.to_string()))
}

fn must_be(key: &str, found: Option<&Value>, allowed: &str) -> String {
    match found {
        None => format!("{key} is missing, must be {allowed}"),
        Some(found) => format!("{key} = {found}, must be {allowed}"),
    }
}

fn only_keys(keys: &Map<String, Value>, allowed: &[&str]) -> Result<(), String> {
    let known = |key: &str| matches!(key, "version" | "request") || allowed.contains(&key);
    match keys.keys().find(|key| !known(key)) {
        None => Ok(()),
        Some(key) if allowed.is_empty() => Err(format!("{key} is not a key of this request, it has none")),
        Some(key) => Err(format!("{key} is not a key of this request, must be {}", allowed.join(", "))),
    }
}

fn flag(keys: &Map<String, Value>, key: &str) -> Result<bool, String> {
    match keys.get(key) {
        None => Ok(false),
        Some(Value::Bool(flag)) => Ok(*flag),
        found => Err(must_be(key, found, "true or false")),
    }
}

fn rule(found: &Value) -> Result<Rule, String> {
    let named = |rule: &Rule| found.as_str() == Some(rule.name());
    let fault = || must_be("rule", Some(found), &Rule::ALL.map(Rule::name).join(", "));
    Rule::ALL.into_iter().find(named).ok_or_else(fault)
}

fn severity(found: &Value) -> Result<Severity, String> {
    let named = |severity: &Severity| found.as_str() == Some(severity.name());
    let fault = || must_be("severity", Some(found), &Severity::ALL.map(Severity::name).join(", "));
    Severity::ALL.into_iter().find(named).ok_or_else(fault)
}

fn cell(found: &Value) -> Result<CellIndex, String> {
    let number = found.as_u64().and_then(|number| u16::try_from(number).ok());
    let cell = number.filter(|number| usize::from(*number) < MAX_CELLS).map(CellIndex);
    cell.ok_or_else(|| must_be("cell", Some(found), &format!("0 to {}", MAX_CELLS - 1)))
}

fn selector(keys: &Map<String, Value>) -> Result<Selector, String> {
    only_keys(keys, &["rule", "severity", "cell"])?;
    let given = |key| keys.get(key).filter(|value| !value.is_null());
    Ok(Selector {
        rule: given("rule").map(rule).transpose()?,
        severity: given("severity").map(severity).transpose()?,
        cell: given("cell").map(cell).transpose()?,
    })
}

fn selector_json(request: &str, which: &Selector) -> Value {
    json!({ "request": request, "rule": which.rule, "severity": which.severity, "cell": which.cell })
}

fn test(keys: &Map<String, Value>) -> Result<Request, String> {
    let rule = keys.get("rule").map_or_else(|| Err(must_be("rule", None, "a rule's name")), rule)?;
    let seconds = keys.get("seconds").and_then(Value::as_f64).filter(|seconds| (0.0..=MAX_TEST_S).contains(seconds));
    let fault = || must_be("seconds", keys.get("seconds"), &format!("0 to {MAX_TEST_S}"));
    Ok(Request::Command(Command::Test { rule, seconds: seconds.ok_or_else(fault)? }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn requests() -> Vec<Request> {
        let which = Selector { rule: Some(Rule::SocLow), severity: Some(Severity::Severe), cell: Some(CellIndex(3)) };
        let commands = [
            Command::Acknowledge(which),
            Command::Acknowledge(Selector::default()),
            Command::Clear(which),
            Command::PackReplaced,
            Command::Test { rule: Rule::BusFault, seconds: 2.5 },
        ];
        let lists = [Request::Alarms { all: false }, Request::Alarms { all: true }];
        lists.into_iter().chain(commands.into_iter().map(Request::Command)).collect()
    }

    #[test]
    fn every_request_is_read_as_it_was_written() {
        for request in requests() {
            assert_eq!(Request::parse(request.to_line().as_bytes()), Ok(request));
        }
    }

    #[test]
    fn an_error_names_the_value_found_and_the_values_allowed() {
        let fault = |line: &str| Request::parse(line.as_bytes()).unwrap_err();
        assert!(fault("").starts_with("no JSON document"), "{}", fault(""));
        assert_eq!(fault("[1]"), "found [1], must be a JSON object");
        assert_eq!(fault("{}"), "version is missing, must be 1");
        assert_eq!(fault(r#"{"version":2,"request":"alarms"}"#), "version = 2, must be 1");
        assert_eq!(
            fault(r#"{"version":1,"request":"reboot"}"#),
            r#"request = "reboot", must be alarms, acknowledge, clear, pack_replaced, test"#
        );
        assert_eq!(fault(r#"{"version":1,"request":"alarms","all":1}"#), "all = 1, must be true or false");
        assert_eq!(
            fault(r#"{"version":1,"request":"clear","cells":1}"#),
            "cells is not a key of this request, must be rule, severity, cell"
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"pack_replaced","cell":1}"#),
            "cell is not a key of this request, it has none"
        );
        assert!(
            fault(r#"{"version":1,"request":"clear","rule":"soc"}"#)
                .starts_with(r#"rule = "soc", must be capacity_low, "#)
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"clear","severity":"bad"}"#),
            r#"severity = "bad", must be info, warning, severe"#
        );
        assert_eq!(fault(r#"{"version":1,"request":"clear","cell":1024}"#), "cell = 1024, must be 0 to 1023");
        assert_eq!(
            fault(r#"{"version":1,"request":"test","rule":"soc_low","seconds":-1}"#),
            "seconds = -1, must be 0 to 600"
        );
    }

    #[test]
    fn an_answer_is_its_contents_or_its_error() {
        let done =
            CommandOutcome { time: Timestamp::from_secs(1.5), changed: 2, refused: 1, refused_alarms: Vec::new() };
        assert_eq!(contents::<CommandOutcome>(&Answer::Outcome(done.clone()).to_line()), Ok(done.clone()));
        assert_eq!(
            contents::<CommandOutcome>(&Answer::Error("no \"way\"".to_owned()).to_line()),
            Err("no \"way\"".to_owned())
        );
        let unlike = contents::<AlarmList>(&Answer::Outcome(done).to_line()).unwrap_err();
        assert!(unlike.contains("missing field `thresholds`"), "{unlike}");
        assert!(
            contents::<CommandOutcome>(b"{\"version\":2,\"ok\":true}").unwrap_err().contains("version = 2, must be 1")
        );
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_request_or_a_fault(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let _ = Request::parse(&bytes);
            let _ = contents::<CommandOutcome>(&bytes);
        }

        #[test]
        fn any_keys_are_a_request_or_a_fault(
            request in prop::sample::select(REQUESTS.to_vec()),
            key in prop::sample::select(vec!["rule", "severity", "cell", "seconds", "all", "other"]),
            value in prop::sample::select(vec!["null", "1e400", "-1", "0.5", "\"soc_low\"", "\"severe\"", "[]", "true"]),
        ) {
            let _ = Request::parse(format!("{{\"version\":1,\"request\":\"{request}\",\"{key}\":{value}}}").as_bytes());
        }
    }
}
