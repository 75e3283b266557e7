//! An example ECU in Rust that listens to packwatch: it shows the state of charge and maintains the table of alarms.
//!
//! ```sh
//! candump -L vcan0 | cargo run --example listen                # a live bus
//! cargo run --example listen -- config/packwatch.dbc <frames.log
//! ```
//!
//! The program reads candump lines from standard input and prints a line for every change. It follows rules 1 to 4 of
//! the contract (`docs/src/ecu/contract.md`). Rule 5, which confirms the table by its checksum, is left out. Time-outs
//! are checked when a frame arrives. A real ECU also checks them by its own clock.

use std::collections::BTreeMap;
use std::error::Error;
use std::io::{self, BufRead, Write};

use packwatch::can::dbc::{Database, Message, Signal};
use packwatch::can::{CanId, Frame};

/// If no status frame arrives for this time (s), all values are unknown.
const STATUS_TIMEOUT_S: f64 = 0.3;
/// An alarm ends if none of its frames arrives for this number of passes. In one pass, packwatch sends a frame of each
/// raised alarm.
const PASSES: f64 = 7.0;

fn main() -> Result<(), Box<dyn Error>> {
    let dbc = std::env::args().nth(1).unwrap_or_else(|| "config/packwatch.dbc".to_owned());
    listen(&std::fs::read_to_string(dbc)?, io::stdin().lock(), &mut io::stdout().lock())
}

pub(crate) fn listen(dbc: &str, log: impl BufRead, out: &mut impl Write) -> Result<(), Box<dyn Error>> {
    let mut listener = Listener::new(Database::parse(dbc)?);
    for line in log.lines() {
        if let Some((time_s, frame)) = parse(&line?) {
            listener.handle(time_s, &frame, out)?;
        }
    }
    Ok(())
}

/// Returns time (s) and frame of a candump line such as `(1700000000.000000) vcan0 6B0#0000FFFF0F1CF8BF`.
fn parse(line: &str) -> Option<(f64, Frame)> {
    let (stamp, rest) = line.strip_prefix('(')?.split_once(") ")?;
    let (id, digits) = rest.split_whitespace().nth(1)?.split_once('#')?;
    let byte = |at: usize| u8::from_str_radix(digits.get(at..at + 2)?, 16).ok();
    let data: Vec<u8> = (0..digits.len()).step_by(2).map(byte).collect::<Option<_>>()?;
    let id = CanId::standard(u32::from_str_radix(id, 16).ok()?)?;
    Some((stamp.parse().ok()?, Frame::classic(id, &data)?))
}

/// Rule, severity and cell of an alarm, as words.
type Key = (String, String, String);

/// The receiver. All times are frame times (s).
struct Listener {
    database: Database,
    alarms: BTreeMap<Key, f64>,
    /// Duration of a pass (s), from the latest digest frame that states it. Until then, it is the cycle time of the
    /// alarm frames.
    pass_time_s: f64,
    status_at_s: Option<f64>,
    validity: String,
}

impl Listener {
    fn new(database: Database) -> Self {
        let validity = "unavailable".to_owned();
        Self { database, alarms: BTreeMap::new(), pass_time_s: 1.0, status_at_s: None, validity }
    }

    /// Handles a frame. Ignores frames of other senders.
    fn handle(&mut self, now_s: f64, frame: &Frame, out: &mut impl Write) -> io::Result<()> {
        let message = self.database.messages.iter().find(|message| message.id == frame.id());
        let Some((name, signals)) = message.map(|message| (message.name.clone(), decode(message, frame.data()))) else {
            return Ok(());
        };
        match name.as_str() {
            "PACKWATCH_Status" => self.handle_status(now_s, &signals, out)?,
            "PACKWATCH_Alarm" => self.handle_alarm(now_s, &signals, out)?,
            "PACKWATCH_Digest" => self.handle_digest(now_s, &signals, out)?,
            _ => {}
        }
        self.check_time(now_s, out)
    }

    fn handle_status(&mut self, now_s: f64, signals: &Signals, out: &mut impl Write) -> io::Result<()> {
        self.status_at_s = Some(now_s);
        if signals["Validity"] != self.validity {
            self.validity.clone_from(&signals["Validity"]);
            let soc = signals["Soc"].parse::<f64>().map_or("unknown".to_owned(), |soc| format!("{soc:.1} %"));
            writeln!(out, "{now_s:.1} status {}, SOC {soc}", self.validity)?;
        }
        Ok(())
    }

    fn handle_alarm(&mut self, now_s: f64, signals: &Signals, out: &mut impl Write) -> io::Result<()> {
        if signals["Test"] == "test" {
            return Ok(());
        }
        let rule = &signals["Rule"];
        let cell = signals["Cell"].parse::<u16>().map_or("pack".to_owned(), |cell| format!("cell {}", cell + 1));
        let key = (rule.clone(), signals["Severity"].clone(), cell);
        let state = &signals["State"];
        if !matches!(state.as_str(), "active" | "latched" | "suppressed") {
            return self.remove(now_s, &key, state, out);
        }
        let (words, is_new) = (words(&key), self.alarms.insert(key, now_s).is_none());
        if is_new {
            let (value, threshold) = (&signals[&format!("Value_{rule}")], &signals[&format!("Threshold_{rule}")]);
            writeln!(out, "{now_s:.1} alarm {words} {state}: {value}, threshold {threshold}")?;
        }
        Ok(())
    }

    /// Removes the alarms whose rule the digest reports as not raised. The frame that announced the end of such an
    /// alarm was lost.
    fn handle_digest(&mut self, now_s: f64, signals: &Signals, out: &mut impl Write) -> io::Result<()> {
        if let Some(Ok(pass_time_s)) = signals.get("PassTime").map(|text| text.parse()) {
            self.pass_time_s = pass_time_s;
        }
        for key in self.alarms.keys().cloned().collect::<Vec<_>>() {
            let of_rule = signals.get(&format!("Rule_{}", key.0)).map(String::as_str);
            if matches!(of_rule, Some("none" | "unknown" | "not watched")) {
                self.remove(now_s, &key, "digest", out)?;
            }
        }
        Ok(())
    }

    /// Discards the status and each alarm whose frames have stopped.
    fn check_time(&mut self, now_s: f64, out: &mut impl Write) -> io::Result<()> {
        if self.status_at_s.is_some_and(|at_s| now_s - at_s > STATUS_TIMEOUT_S) {
            (self.status_at_s, self.validity) = (None, "unavailable".to_owned());
            writeln!(out, "{now_s:.1} status lost: all values unknown")?;
        }
        let limit_s = PASSES * self.pass_time_s;
        let is_late = |&(_, &latest_s): &(&Key, &f64)| now_s - latest_s > limit_s;
        for key in self.alarms.iter().filter(is_late).map(|(key, _)| key.clone()).collect::<Vec<_>>() {
            self.remove(now_s, &key, "not repeated", out)?;
        }
        Ok(())
    }

    fn remove(&mut self, now_s: f64, key: &Key, reason: &str, out: &mut impl Write) -> io::Result<()> {
        match self.alarms.remove(key) {
            Some(_) => writeln!(out, "{now_s:.1} alarm {} over: {reason}", words(key)),
            None => Ok(()),
        }
    }
}

fn words((rule, severity, cell): &Key) -> String {
    format!("{rule} {severity} {cell}")
}

type Signals = BTreeMap<String, String>;

fn decode(message: &Message, data: &[u8]) -> Signals {
    let is_present = |signal: &&Signal| {
        signal.conditions.iter().all(|condition| {
            let selector = &message.signals[condition.selector];
            let code = selector.layout.plan().ok().and_then(|plan| plan.raw(data).ok());
            code.is_some_and(|code| condition.ranges.iter().any(|&(low, high)| (low..=high).contains(&code)))
        })
    };
    let present = message.signals.iter().filter(is_present);
    present.filter_map(|signal| Some((signal.name.clone(), value(signal, data)?))).collect()
}

/// Returns the DBC's name for the value or, if it has no name, the number. Returns `None` if the frame is too short for
/// the signal.
fn value(signal: &Signal, data: &[u8]) -> Option<String> {
    let plan = signal.layout.plan().ok()?;
    let code = i64::try_from(plan.raw(data).ok()?).ok();
    let name = signal.values.iter().find(|(value, _)| Some(*value) == code).map(|(_, name)| name.clone());
    name.or_else(|| Some(format!("{}", (plan.decode(data).ok()? * 1e6).round() / 1e6)))
}
