//! Defines the requests and answers of the control socket. Each is one line of JSON.
//!
//! | request | keys | answer |
//! | --- | --- | --- |
//! | `alarms` | `all` (default false): also lists alarms that need no attention | [`AlarmList`] |
//! | `acknowledge`, `clear` | `rule`, `severity`, `cell` (from 0); a missing key selects all | [`CommandOutcome`] |
//! | `pack_replaced` | | [`CommandOutcome`] |
//! | `poll` | `standby`: true stops sending diagnostic requests, false resumes it | [`CommandOutcome`] |
//! | `test` | `rule`, `seconds` (0 ends a test) | [`CommandOutcome`] |
//!
//! Every line has the key `version`. The answer to an invalid line is an error with the value found and the values
//! allowed.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::alarm::{Alarm, Rule, Selector, Severity};
use crate::monitor::{Command, MAX_TEST_S};
use crate::quantity::{MAX_CELLS, Timestamp};

/// Version of requests and answers.
pub const VERSION: u64 = 1;

/// Requests and the keys they may have.
const REQUESTS: [(&str, &[&str]); 6] = [
    ("alarms", &["all"]),
    ("acknowledge", &["rule", "severity", "cell"]),
    ("clear", &["rule", "severity", "cell"]),
    ("pack_replaced", &[]),
    ("poll", &["standby"]),
    ("test", &["rule", "seconds"]),
];

/// A client's request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    /// Lists the current alarms.
    Alarms {
        /// Whether to include alarms that need no attention.
        all: bool,
    },
    /// A command, which changes something.
    Command(Command),
}

/// The daemon's answer.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The answer to `alarms`.
    Alarms(AlarmList),
    /// The answer to a command.
    Outcome(CommandOutcome),
    /// The request failed. The text states the value found and the values allowed.
    Error(String),
}

/// The current alarms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmList {
    /// Time, on the daemon's clock.
    pub time: Timestamp,
    /// Number of configured thresholds.
    pub thresholds: usize,
    /// Thresholds with alarms that cannot be evaluated because their value is unknown.
    pub unknown: Vec<UnknownAlarms>,
    /// Alarms, ordered by rule, severity and cell. If alarms are omitted, the raised alarms come first.
    pub alarms: Vec<Alarm>,
    /// Number of further alarms that did not fit into the answer.
    pub omitted: usize,
}

/// The alarms of one threshold that cannot be evaluated because their value is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct UnknownAlarms {
    /// The rule.
    pub rule: Rule,
    /// Severity of the threshold.
    pub severity: Severity,
    /// Number of alarms.
    pub alarms: usize,
}

/// The outcome of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommandOutcome {
    /// Time, on the daemon's clock.
    pub time: Timestamp,
    /// Number of alarms that were changed.
    pub changed: u32,
    /// Number of refused changes. Clearing a raised alarm is refused until its value has been healthy for long enough.
    /// A test is refused if no output is configured.
    pub refused: u32,
    /// The refused alarms.
    pub refused_alarms: Vec<Alarm>,
    /// Whether the changes of the command are on disk, so that a power cut does not undo them. `None` = the command
    /// changed nothing that is stored, or no state is kept.
    #[serde(default)]
    pub is_stored: Option<bool>,
}

/// An answer as sent: the keys that every answer has, and the contents.
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
    /// Returns an error that states the value found and the values allowed.
    pub fn parse(line: &[u8]) -> Result<Self, String> {
        let value: Value = serde_json::from_slice(line).map_err(|error| format!("not a JSON document: {error}"))?;
        let Value::Object(mut keys) = value else { return Err(format!("found {value}, must be a JSON object")) };
        match keys.remove("version") {
            Some(version) if version.as_u64() == Some(VERSION) => {}
            found => return Err(must_be("version", found.as_ref(), &VERSION.to_string())),
        }
        let request = keys.remove("request");
        let name = request.as_ref().and_then(Value::as_str).unwrap_or_default();
        let Some((_, allowed)) = REQUESTS.iter().find(|(known, _)| *known == name) else {
            return Err(must_be("request", request.as_ref(), &REQUESTS.map(|(name, _)| name).join(", ")));
        };
        only_keys(&keys, allowed)?;
        if name == "alarms" {
            let all = keys.get("all").map_or(Ok(false), bool::deserialize);
            return all.map(|all| Self::Alarms { all }).map_err(|error| format!("all: {error}"));
        }
        keys.insert("command".to_owned(), name.into());
        let command = Command::deserialize(Value::Object(keys.clone())).map_err(|error| error.to_string())?;
        match command {
            Command::Acknowledge(Selector { cell: Some(cell), .. })
            | Command::Clear(Selector { cell: Some(cell), .. })
                if cell.index() >= MAX_CELLS =>
            {
                Err(must_be("cell", keys.get("cell"), &format!("0 to {}", MAX_CELLS - 1)))
            }
            Command::Test { seconds, .. } if !(0.0..=MAX_TEST_S).contains(&seconds) => {
                Err(must_be("seconds", keys.get("seconds"), &format!("0 to {MAX_TEST_S}")))
            }
            command => Ok(Self::Command(command)),
        }
    }

    /// Formats the line of the request.
    pub fn to_line(self) -> String {
        let mut keys = match self {
            Self::Alarms { all } => json!({ "request": "alarms", "all": all }),
            Self::Command(command) => json!(command),
        };
        if let Some(name) = keys.as_object_mut().and_then(|keys| keys.remove("command")) {
            keys["request"] = name;
        }
        keys["version"] = json!(VERSION);
        format!("{keys}\n")
    }

    /// Whether the request is a command.
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
/// Returns the error in the answer, or the reason why the answer is not valid.
pub fn contents<T: for<'de> Deserialize<'de>>(line: &[u8]) -> Result<T, String> {
    let strange = |what: String| format!("unexpected answer of the daemon: {what}");
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
    match keys.keys().find(|key| !allowed.contains(&key.as_str())) {
        None => Ok(()),
        Some(key) if allowed.is_empty() => Err(format!("{key} is not a key of this request, which has no keys")),
        Some(key) => Err(format!("{key} is not a key of this request, must be {}", allowed.join(", "))),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::quantity::CellIndex;

    fn requests() -> Vec<Request> {
        let which = Selector { rule: Some(Rule::SocLow), severity: Some(Severity::Severe), cell: Some(CellIndex(3)) };
        let commands = [
            Command::Acknowledge(which),
            Command::Acknowledge(Selector::default()),
            Command::Clear(which),
            Command::PackReplaced,
            Command::Poll { standby: true },
            Command::Test { rule: Rule::BusFault, seconds: 2.5 },
        ];
        let lists = [Request::Alarms { all: false }, Request::Alarms { all: true }];
        lists.into_iter().chain(commands.into_iter().map(Request::Command)).collect()
    }

    #[test]
    fn every_request_round_trips() {
        for request in requests() {
            assert_eq!(Request::parse(request.to_line().as_bytes()), Ok(request));
        }
    }

    #[test]
    fn error_states_found_and_allowed_values() {
        let fault = |line: &str| Request::parse(line.as_bytes()).unwrap_err();
        assert!(fault("").starts_with("not a JSON document"), "{}", fault(""));
        assert_eq!(fault("[1]"), "found [1], must be a JSON object");
        assert_eq!(fault("{}"), "version is missing, must be 1");
        assert_eq!(fault(r#"{"version":2,"request":"alarms"}"#), "version = 2, must be 1");
        assert_eq!(
            fault(r#"{"version":1,"request":"reboot"}"#),
            r#"request = "reboot", must be alarms, acknowledge, clear, pack_replaced, poll, test"#
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"alarms","all":1}"#),
            "all: invalid type: integer `1`, expected a boolean"
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"clear","cells":1}"#),
            "cells is not a key of this request, must be rule, severity, cell"
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"pack_replaced","cell":1}"#),
            "cell is not a key of this request, which has no keys"
        );
        assert!(
            fault(r#"{"version":1,"request":"clear","rule":"soc"}"#)
                .starts_with("unknown variant `soc`, expected one of `capacity_low`, ")
        );
        assert_eq!(
            fault(r#"{"version":1,"request":"clear","severity":"bad"}"#),
            "unknown variant `bad`, expected one of `info`, `warning`, `severe`"
        );
        assert_eq!(fault(r#"{"version":1,"request":"clear","cell":1024}"#), "cell = 1024, must be 0 to 1023");
        assert_eq!(
            fault(r#"{"version":1,"request":"test","rule":"soc_low","seconds":-1}"#),
            "seconds = -1, must be 0 to 600"
        );
    }

    #[test]
    fn answer_gives_contents_or_error() {
        let done = CommandOutcome {
            time: Timestamp::from_secs(1.5),
            changed: 2,
            refused: 1,
            refused_alarms: Vec::new(),
            is_stored: Some(true),
        };
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
            request in prop::sample::select(REQUESTS.map(|(name, _)| name).to_vec()),
            key in prop::sample::select(vec!["rule", "severity", "cell", "seconds", "all", "other"]),
            value in prop::sample::select(vec!["null", "1e400", "-1", "0.5", "\"soc_low\"", "\"severe\"", "[]", "true"]),
        ) {
            let _ = Request::parse(format!("{{\"version\":1,\"request\":\"{request}\",\"{key}\":{value}}}").as_bytes());
        }
    }
}
