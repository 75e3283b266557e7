//! The status document that the status sockets send as JSON. This file is the reference of the document.
//!
//! * Version 1. New keys may be added within a version, so readers must ignore unknown keys. Removing a key or changing
//!   its meaning requires a new version.
//! * An unknown value is `null`, never 0 or 100 %.
//! * Units are in the names: `_v`, `_a` (positive = discharge), `_c` (degrees C), `_ah`, `_s`. SOC and SOH are
//!   fractions. `_std` is a standard deviation. Cells count from 0, as in events. Times are ns since 1970 on the
//!   daemon's clock, which never steps; `wall_time` is the computer's clock.

use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::counters::{ClientCounts, Latency, ServiceCounters};
use crate::alarm::{Alarm, Rule, Severity};
use crate::can::poll::PollSilence;
use crate::can::uds::ControllerCounts;
use crate::cell_faults::CellFault;
use crate::config::{ConfigFiles, VehicleIdentity};
use crate::control::protocol::UnknownAlarms;
use crate::io::socket::{LinkCounts, LinkState};
use crate::monitor::{BusStatistics, CellView, PackView, Statistics, Validity};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{CellIndex, Timestamp};
use crate::sample::ReadingCounts;

/// Version of [`StatusDocument`].
pub const VERSION: u32 = 1;

/// The status of the daemon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StatusDocument {
    /// [`VERSION`].
    pub version: u32,
    /// The program's version.
    pub program_version: String,
    /// The daemon's process.
    pub pid: u32,
    /// Time of the document, on the daemon's clock.
    pub time: Timestamp,
    /// The same time on the computer's clock.
    pub wall_time: Timestamp,
    /// Start of the daemon.
    pub started: Timestamp,
    /// Time since the start (s).
    pub uptime_s: f64,
    /// The configuration in use.
    pub config: Option<ConfigFile>,
    /// The vehicle.
    #[serde(default)]
    pub vehicle: VehicleIdentity,
    /// Validity of the estimates.
    pub state: Validity,
    /// The interfaces, in configuration order.
    pub interfaces: Vec<InterfaceStatus>,
    /// The pack.
    pub pack: PackView,
    /// The cells of the pack.
    pub cells: Vec<CellView>,
    /// Alarms that need attention.
    pub alarms: AlarmStatus,
    /// Counters of the core, the service loop and the clients.
    pub counters: StatusCounters,
    /// Protected input messages, and the authenticated command message.
    pub protection: Vec<MessageProtection>,
    /// Commands from the bus; `None` = commands are not executed.
    #[serde(default)]
    pub commands: Option<CommandStatus>,
    /// Controllers that answer diagnostic requests.
    #[serde(default)]
    pub controllers: Vec<ControllerStatus>,
    /// Time when the buses fell asleep; `None` = awake.
    #[serde(default)]
    pub asleep_since: Option<Timestamp>,
    /// Diagnostic requests of this program; `None` = polling is not configured.
    #[serde(default)]
    pub poll: Option<PollStatus>,
    /// Input messages whose frames were dropped because their rate was too high.
    pub floods: Vec<MessageFlood>,
    /// Unexpected senders on the buses.
    #[serde(default)]
    pub intruders: Vec<Intruder>,
    /// Whether the reading of the pack current is frozen while the voltages show a changing load.
    #[serde(default)]
    pub current_frozen: bool,
    /// Findings about cells and sensors, in the format of `--events`.
    #[serde(default)]
    pub findings: Vec<CellFault>,
    /// Latency from the kernel's receive time stamp of a frame to the estimate that uses the frame.
    pub latency: Latency,
    /// The store of state and history; `None` = disabled.
    pub store: Option<StoreStatus>,
    /// Number of events since `started`. The last event in `events` has this number, the event before it has this
    /// number minus one. 0 in documents of older versions.
    #[serde(default)]
    pub event_count: u64,
    /// The latest events, oldest first, in the format of `--events`. Events that occur once per cell and half-cycle are
    /// left out. The list has 32 events, or more if more than 32 occurred in the last 5 s (at most 1,024).
    pub events: Vec<serde_json::Value>,
}

impl StatusDocument {
    /// The cell with the lowest value (the first, if there are several), and this value. `None` if the value of any
    /// cell is unknown.
    pub fn least(&self, quantity: Quantity) -> Option<(CellIndex, f64)> {
        self.extreme(quantity, |candidate, best| candidate < best)
    }

    /// The cell with the highest value (the first, if there are several), and this value. `None` if the value of any
    /// cell is unknown.
    pub fn greatest(&self, quantity: Quantity) -> Option<(CellIndex, f64)> {
        self.extreme(quantity, |candidate, best| candidate > best)
    }

    fn extreme(&self, quantity: Quantity, beats: fn(f64, f64) -> bool) -> Option<(CellIndex, f64)> {
        let values = self.cells.iter().map(|cell| Some((cell.cell, cell.values.mean(quantity)?)));
        let values: Vec<_> = values.collect::<Option<_>>()?;
        values.into_iter().reduce(|best, candidate| if beats(candidate.1, best.1) { candidate } else { best })
    }
}

/// The configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConfigFile {
    /// The file.
    pub path: String,
    /// The drop-ins of the configuration file, in merge order.
    #[serde(default)]
    pub drop_ins: Vec<String>,
    /// SHA-256 of the file followed by its drop-ins, hexadecimal, as printed by `cat FILE FILE.d/*.toml | sha256sum`.
    /// The checksum does not cover other files that these files name.
    pub sha256: String,
}

/// One interface.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InterfaceStatus {
    /// Kernel name.
    pub name: String,
    /// State of the interface.
    pub state: LinkState,
    /// How often the interface came up again.
    pub reconnects: u64,
    /// Frames received.
    #[serde(flatten)]
    pub received: BusStatistics,
    /// Frames sent and lost.
    #[serde(flatten)]
    pub link: LinkCounts,
}

/// The alarms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmStatus {
    /// Number of configured thresholds.
    pub thresholds: usize,
    /// Rules with a threshold, each once; empty in documents of older versions.
    #[serde(default)]
    pub rules: Vec<Rule>,
    /// Number of raised alarms.
    pub raised: usize,
    /// Highest severity of the raised alarms.
    pub highest_severity: Option<Severity>,
    /// Thresholds whose alarms cannot be evaluated because a value is unknown.
    pub unknown: Vec<UnknownAlarms>,
    /// Alarms that are raised, about to be raised, or not yet acknowledged.
    pub list: Vec<Alarm>,
    /// Number of further alarms that did not fit into `list`.
    pub omitted: usize,
}

impl AlarmStatus {
    /// Whether there are thresholds and all of them can be evaluated. If so, and if no alarm is raised, the pack has no
    /// known problem.
    pub fn are_judged(&self) -> bool {
        self.thresholds > 0 && self.unknown.is_empty()
    }

    /// The highest severity of a raised alarm, or "none"; `None` = unknown.
    pub fn level(&self) -> Option<&'static str> {
        let none = (self.raised == 0 && self.are_judged()).then_some("none");
        self.highest_severity.map(Severity::name).or(none)
    }
}

/// Counters. Except for `lifetime`, all counters start at 0 when the program starts, including the counters of
/// interfaces, protected messages, controllers and floods. They do not continue from stored counts: after a power cut,
/// a stored count may be a minute old, so the counter would decrease. A program that sums the increases of a
/// counter can handle a restart from 0, but not such a decrease.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StatusCounters {
    /// Counters of the core.
    pub core: Statistics,
    /// Counters of the core since the first start; after a power cut, the counts since the last stored state are
    /// missing. The interfaces are not included.
    #[serde(default)]
    pub lifetime: Statistics,
    /// Readings by outcome.
    pub readings: ReadingCounts,
    /// Inputs with an earlier time than the input before them.
    pub time_backwards: u64,
    /// Counters of the loop.
    pub service: ServiceCounters,
    /// Counts of clients of the status sockets.
    pub clients: ClientCounts,
}

/// Checks of one protected input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageProtection {
    /// Interface of the message.
    pub interface: String,
    /// Identifier of the message: 3 hexadecimal digits, or 8 for an extended identifier.
    pub id: String,
    /// Number of checks with each status.
    pub checks: Vec<StatusCount>,
}

/// Number of checks with one status.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StatusCount {
    /// Name of the status.
    pub status: String,
    /// Number of checks.
    pub count: u64,
}

/// Commands from the bus.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandStatus {
    /// Interface of the commands.
    pub interface: String,
    /// Identifier of the command message, formatted as in [`MessageProtection`].
    pub id: String,
    /// SecOC profile; `None` = the commands are unauthenticated.
    pub secoc: Option<String>,
}

impl CommandStatus {
    /// The status in words: `authenticated (SecOC 1)`, `unauthenticated`.
    pub fn words(&self) -> String {
        self.secoc
            .as_ref()
            .map_or_else(|| "unauthenticated".to_owned(), |profile| format!("authenticated (SecOC {profile})"))
    }
}

/// Diagnostic requests of this program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PollStatus {
    /// Why no requests are sent at present; `None` = requests are sent.
    pub silent: Option<PollSilence>,
    /// Number of requests that are no longer sent because their controller rejected them permanently.
    pub refused: usize,
}

impl PollStatus {
    /// The status in words: `asking`, `silent: the bus sleeps`.
    pub fn words(&self) -> String {
        let state = self.silent.map_or_else(|| "asking".to_owned(), |reason| format!("silent: {}", reason.words()));
        if self.refused == 0 { state } else { format!("{state}; {} rejected permanently", self.refused) }
    }
}

/// A controller that answers diagnostic requests.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControllerStatus {
    /// Interface of the controller.
    pub interface: String,
    /// Identifier of the controller's answers, formatted as in [`MessageProtection`].
    pub id: String,
    /// Counts of the controller's answers.
    #[serde(flatten)]
    pub counts: ControllerCounts,
}

impl ControllerStatus {
    /// The counts in words: `120 answers, 3 rejections (latest code 31), 2 lost: wrong sequence`.
    pub fn words(&self) -> String {
        let counts = &self.counts;
        let mut words = format!("{} answers", counts.read);
        let mut add = |count: u64, what: &str| {
            if count > 0 {
                words.push_str(&format!(", {count} {what}"));
            }
        };
        add(counts.unasked, "of them unasked");
        add(counts.other, "not configured");
        add(counts.pending, "\"wait\"");
        add(counts.refused, &format!("rejections (latest code {:02X})", counts.latest_refusal.unwrap_or_default()));
        for (fault, count) in counts.losses() {
            add(count, &format!("lost: {}", fault.words()));
        }
        words
    }
}

/// Dropped frames of one input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageFlood {
    /// Interface.
    pub interface: String,
    /// Identifier, formatted as in [`MessageProtection`].
    pub id: String,
    /// Number of dropped frames.
    pub dropped: u64,
}

/// What an unexpected sender does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntruderKind {
    /// The sender sends an input message in addition to the message's own sender.
    SecondSender,
    /// The sender uses an identifier of this program's frames.
    OwnIdentifier,
}

/// An unexpected sender.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Intruder {
    /// Interface.
    pub interface: String,
    /// Identifier that the sender uses. If the sender uses several identifiers of this program on an interface, this is
    /// the latest one.
    pub id: String,
    /// What the sender does.
    pub kind: IntruderKind,
}

/// The store of state and history.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StoreStatus {
    /// Path of the store; empty if the store could not be opened.
    pub path: String,
    /// Whether the store can be written; `None` = not yet tried.
    pub works: Option<bool>,
    /// Number of successful commits.
    pub commits: u64,
    /// Number of failed commits.
    pub failures: u64,
    /// Number of results that were announced before they were stored, because the commit took too long.
    pub late: u64,
    /// Size of the database and its log at the last commit, bytes; `None` = no commit yet.
    pub file_bytes: Option<u64>,
}

impl ConfigFile {
    /// Reads the names of the files and computes their checksum; `None` = a file can no longer be read.
    pub fn of(path: &Path) -> Option<Self> {
        let files = ConfigFiles::find(path).ok()?;
        let mut digest = Sha256::new();
        for file in files.all() {
            digest.update(std::fs::read(file).ok()?);
        }
        let sha256 = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        let drop_ins = files.drop_ins.iter().map(|file| file.display().to_string()).collect();
        Some(Self { path: path.display().to_string(), drop_ins, sha256 })
    }
}
