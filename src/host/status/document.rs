//! The status document that the status sockets send as JSON. This file is its reference.
//!
//! * Version 1. New keys may be added within a version, so a reader ignores unknown keys; changing the meaning of a key or
//!   removing it makes a new version.
//! * An unknown value is `null`, never 0 or 100 %.
//! * Units are in the names: `_v`, `_a` (positive = discharge), `_c` (degrees C), `_ah`, `_s`; SOC and SOH are fractions.
//!   `_std` is a standard deviation. Cells count from 0, as in events. Times are ns since 1970 on the daemon's
//!   clock, which never steps; `wall_time` is the computer's clock.

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
    /// The same on the computer's clock.
    pub wall_time: Timestamp,
    /// Start of the daemon.
    pub started: Timestamp,
    /// Time since the start, s.
    pub uptime_s: f64,
    /// The configuration in use.
    pub config: Option<ConfigFile>,
    /// The vehicle.
    #[serde(default)]
    pub vehicle: VehicleIdentity,
    /// Validity of the estimates.
    pub state: Validity,
    /// The interfaces, in the order of the configuration.
    pub interfaces: Vec<InterfaceStatus>,
    /// The pack.
    pub pack: PackView,
    /// Its cells.
    pub cells: Vec<CellView>,
    /// Alarms that need attention.
    pub alarms: AlarmStatus,
    /// Counts.
    pub counters: StatusCounters,
    /// Protected input messages, and the authenticated command message.
    pub protection: Vec<MessageProtection>,
    /// Commands from the bus; `None` = none are executed.
    #[serde(default)]
    pub commands: Option<CommandStatus>,
    /// Controllers that answer diagnostic requests.
    #[serde(default)]
    pub controllers: Vec<ControllerStatus>,
    /// Since when the buses sleep; `None` = they are awake.
    #[serde(default)]
    pub asleep_since: Option<Timestamp>,
    /// Diagnostic requests of this program; `None` = it sends none.
    #[serde(default)]
    pub poll: Option<PollStatus>,
    /// Input messages with frames dropped beyond the accepted rate.
    pub floods: Vec<MessageFlood>,
    /// Senders on the buses that should not be there.
    #[serde(default)]
    pub intruders: Vec<Intruder>,
    /// The current's reading is frozen: the voltages show another load.
    #[serde(default)]
    pub current_frozen: bool,
    /// What is found of single cells and of the sensors, as `--events` writes it.
    #[serde(default)]
    pub findings: Vec<CellFault>,
    /// Latency from the kernel's receive stamp of a frame to its estimate.
    pub latency: Latency,
    /// The store of state and history; `None` = it is off.
    pub store: Option<StoreStatus>,
    /// The latest events without those of half-cycles of single cells, oldest first, as `--events` writes them.
    pub events: Vec<serde_json::Value>,
}

impl StatusDocument {
    /// The first cell with the least value, and that; `None` while the value of a cell is unknown.
    pub fn least(&self, quantity: Quantity) -> Option<(CellIndex, f64)> {
        self.extreme(quantity, |candidate, best| candidate < best)
    }

    /// The first cell with the greatest value, likewise.
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
    /// Its drop-ins, in the order in which they are merged.
    #[serde(default)]
    pub drop_ins: Vec<String>,
    /// SHA-256 of the text of the file and then of its drop-ins, in hexadecimal digits, as `cat FILE FILE.d/*.toml |
    /// sha256sum` prints it (without the other files they name).
    pub sha256: String,
}

/// One interface.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InterfaceStatus {
    /// Kernel name.
    pub name: String,
    /// Its state.
    pub state: LinkState,
    /// Times it came up again.
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
    /// Thresholds configured.
    pub thresholds: usize,
    /// Rules with a threshold, each once; empty in documents of earlier programs.
    #[serde(default)]
    pub rules: Vec<Rule>,
    /// Alarms raised now.
    pub raised: usize,
    /// The highest severity among them.
    pub highest_severity: Option<Severity>,
    /// Thresholds with alarms that cannot be evaluated, because their value is not known.
    pub unknown: Vec<UnknownAlarms>,
    /// Alarms that are raised, about to be raised, or not yet acknowledged.
    pub list: Vec<Alarm>,
    /// Further alarms, for which there was no room.
    pub omitted: usize,
}

impl AlarmStatus {
    /// Whether there are thresholds and each of them is judged: without raised alarms all is well then, else it is not known.
    pub fn are_judged(&self) -> bool {
        self.thresholds > 0 && self.unknown.is_empty()
    }

    /// The highest severity of a raised alarm, or "none"; `None` = not known.
    pub fn level(&self) -> Option<&'static str> {
        let none = (self.raised == 0 && self.are_judged()).then_some("none");
        self.highest_severity.map(Severity::name).or(none)
    }
}

/// Counters. All start at 0 with the program, also those of interfaces, protected messages, controllers and floods, except `lifetime`: a
/// stored count may be a minute old after a power cut, and a falling counter is wrong for readers that sum differences.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StatusCounters {
    /// Counters of the core.
    pub core: Statistics,
    /// The same since the first start, as far as it was stored; without the interfaces.
    #[serde(default)]
    pub lifetime: Statistics,
    /// Readings by outcome.
    pub readings: ReadingCounts,
    /// Inputs with a time before that of an earlier input.
    pub time_backwards: u64,
    /// The loop.
    pub service: ServiceCounters,
    /// Clients of the status sockets.
    pub clients: ClientCounts,
}

/// Checks of one protected input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageProtection {
    /// Interface it comes on.
    pub interface: String,
    /// Its identifier: 3 hexadecimal digits, or 8 when it is extended.
    pub id: String,
    /// Number of checks per status.
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
    /// Interface they come on.
    pub interface: String,
    /// Their identifier, as in [`MessageProtection`].
    pub id: String,
    /// Profile of SecOC; `None` = they are unauthenticated.
    pub secoc: Option<String>,
}

impl CommandStatus {
    /// In words: `authenticated (SecOC 1)`, `unauthenticated`.
    pub fn words(&self) -> String {
        self.secoc
            .as_ref()
            .map_or_else(|| "unauthenticated".to_owned(), |profile| format!("authenticated (SecOC {profile})"))
    }
}

/// Diagnostic requests of this program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PollStatus {
    /// Why none is sent now; `None` = they are sent.
    pub silent: Option<PollSilence>,
    /// Requests that are not sent any more, because their controller refused them for good.
    pub refused: usize,
}

impl PollStatus {
    /// In words: `asking`, `silent: the bus sleeps`.
    pub fn words(&self) -> String {
        let state = self.silent.map_or_else(|| "asking".to_owned(), |reason| format!("silent: {}", reason.words()));
        if self.refused == 0 { state } else { format!("{state}; {} refused for good", self.refused) }
    }
}

/// A controller that answers diagnostic requests.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControllerStatus {
    /// Interface it is on.
    pub interface: String,
    /// Identifier of its answers, as in [`MessageProtection`].
    pub id: String,
    /// What came from it.
    #[serde(flatten)]
    pub counts: ControllerCounts,
}

impl ControllerStatus {
    /// The counts in words: `120 answers, 3 refused (latest code 31), 2 lost: wrong sequence 2`.
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
        add(counts.refused, &format!("refused (latest code {:02X})", counts.latest_refusal.unwrap_or_default()));
        for (fault, count) in counts.losses() {
            add(count, &format!("lost: {}", fault.words()));
        }
        words
    }
}

/// Frames dropped of one input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageFlood {
    /// Interface.
    pub interface: String,
    /// Identifier, as in [`MessageProtection`].
    pub id: String,
    /// Frames.
    pub dropped: u64,
}

/// What a sender that should not be there does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntruderKind {
    /// It sends an input message beside its own sender.
    SecondSender,
    /// It sends with an identifier of this program's frames.
    OwnIdentifier,
}

/// A sender that should not be there.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Intruder {
    /// Interface.
    pub interface: String,
    /// Identifier of its latest frames.
    pub id: String,
    /// What it does.
    pub kind: IntruderKind,
}

/// The store of state and history.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct StoreStatus {
    /// Its folder; empty when it could not be opened.
    pub path: String,
    /// Whether it can be written; `None` = not tried yet.
    pub works: Option<bool>,
    /// Commits done.
    pub commits: u64,
    /// Commits that failed.
    pub failures: u64,
    /// Announcements sent before they were stored, because the commit took too long.
    pub late: u64,
    /// Size of the database and its log, bytes, as of the last commit; `None` = none yet.
    pub file_bytes: Option<u64>,
}

impl ConfigFile {
    /// Reads the files' names and fingerprint; `None` = they cannot be read any more.
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
