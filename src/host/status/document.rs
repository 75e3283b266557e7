//! The status document: what the status sockets tell, as JSON. This file is its description.
//!
//! * Version 1. New keys may come within a version, so a reader ignores what it does not know; a key that changes its
//!   meaning or goes makes a new version.
//! * What is not known is `null`, never 0 or 100 %.
//! * Units are in the names: `_v`, `_a` (positive = discharge), `_c` (degrees C), `_ah`, `_s`; SOC and SOH are fractions.
//!   `_std` is a standard deviation. Cells count from 0, as in events. Times are ns since 1970 on the daemon's
//!   clock, which never steps; `wall_time` is the computer's clock.

use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::counters::Latency;
use crate::alarm::{Alarm, Severity};
use crate::control::protocol::UnknownAlarms;
use crate::io::socket::LinkState;
use crate::monitor::{Statistics, Validity};
use crate::quantity::{Mode, Timestamp};
use crate::sample::ReadingCounts;

/// Version of [`Document`].
pub const VERSION: u32 = 1;

/// Everything that is told.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Document {
    /// [`VERSION`].
    pub version: u32,
    /// The program's version.
    pub program_version: String,
    /// The daemon's process.
    pub pid: u32,
    /// When this was true, on the daemon's clock.
    pub time: Timestamp,
    /// The same on the computer's clock.
    pub wall_time: Timestamp,
    /// When the daemon started.
    pub started: Timestamp,
    /// Since then, s.
    pub uptime_s: f64,
    /// The configuration it runs with.
    pub config: Option<ConfigFile>,
    /// How far the estimates are to be trusted.
    pub state: Validity,
    /// The interfaces, in the order of the configuration.
    pub interfaces: Vec<Interface>,
    /// The pack.
    pub pack: Pack,
    /// Its cells.
    pub cells: Vec<Cell>,
    /// Alarms that need eyes.
    pub alarms: Alarms,
    /// Counts.
    pub counters: Counters,
    /// Protected input messages.
    pub protection: Vec<Protected>,
    /// Input messages of which frames were dropped, because more came than are taken in.
    pub floods: Vec<Flooded>,
    /// From the kernel's receive stamp of a frame to its estimate.
    pub latency: Latency,
    /// The store of what is learned; `None` = none is wanted.
    pub store: Option<Store>,
    /// The latest events but those of single cells' half-cycles, oldest first, as `--events` writes them.
    pub events: Vec<serde_json::Value>,
}

/// Where the configuration came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConfigFile {
    /// The file.
    pub path: String,
    /// SHA-256 of what was read from it, in hexadecimal digits (its own text, not that of the files it names).
    pub sha256: String,
}

/// One interface.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Interface {
    /// Kernel name.
    pub name: String,
    /// What is known of it.
    pub state: LinkState,
    /// Times it came up again.
    pub reconnects: u64,
    /// Frames taken in.
    pub frames: u64,
    /// Error frames.
    pub error_frames: u64,
    /// Those of them that say bus-off.
    pub bus_offs: u64,
    /// Frames the kernel had no room to keep.
    pub kernel_dropped: u64,
    /// Frames that found the daemon's own queue full.
    pub queue_dropped: u64,
    /// Things read that are no frame.
    pub malformed: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames not sent: the queue to the interface was full.
    pub send_queue_full: u64,
    /// Frames not sent: the kernel did not take them, or they had waited too long.
    pub send_failed: u64,
}

/// The pack, as its limiting cells make it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pack {
    /// Validity of the estimates.
    pub validity: Validity,
    /// Charge, rest or discharge.
    pub mode: Mode,
    /// State of charge.
    pub soc: Option<f64>,
    /// Its standard deviation.
    pub soc_std: Option<f64>,
    /// The interval that holds the truth with 95 %, lower end.
    pub soc_low: Option<f64>,
    /// Upper end.
    pub soc_high: Option<f64>,
    /// Which cell ends a discharge.
    pub limiting_cell: Option<u16>,
    /// Sum of the cells' voltages.
    pub voltage_v: Option<f64>,
    /// Current, positive = discharge.
    pub current_a: Option<f64>,
    /// Highest temperature, while all sensors are fresh.
    pub temperature_max_c: Option<f64>,
    /// The cell with the least capacity, once every cell was learned.
    pub weakest_cell: Option<u16>,
    /// Its capacity.
    pub capacity_ah: Option<f64>,
    /// Standard deviation of that.
    pub capacity_std_ah: Option<f64>,
    /// Capacity relative to rated.
    pub soh: Option<f64>,
    /// The cell whose life ends first, once every cell's is known.
    #[serde(default)]
    pub shortest_lived_cell: Option<u16>,
    /// Equivalent full cycles until its end of life, median.
    #[serde(default)]
    pub remaining_cycles: Option<f64>,
    /// 5 % quantile of that.
    #[serde(default)]
    pub remaining_cycles_low: Option<f64>,
    /// 95 % quantile.
    #[serde(default)]
    pub remaining_cycles_high: Option<f64>,
    /// Days until then, if it goes on being used as of late, median.
    #[serde(default)]
    pub remaining_days: Option<f64>,
    /// Least usable capacity at the configured load.
    pub usable_capacity_ah: Option<f64>,
    /// Its standard deviation.
    pub usable_capacity_std_ah: Option<f64>,
    /// Last recorded recharge period.
    pub recharge_period_s: Option<f64>,
    /// What the reference charger would need.
    pub normalised_recharge_period_s: Option<f64>,
    /// Its standard deviation.
    pub normalised_recharge_period_std_s: Option<f64>,
    /// SOC as the pack itself reports it.
    pub reported_soc: Option<f64>,
    /// SOH as the pack itself reports it.
    pub reported_soh: Option<f64>,
}

/// One cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Which, from 0.
    pub cell: u16,
    /// Voltage.
    pub voltage_v: Option<f64>,
    /// Current, positive = discharge.
    pub current_a: Option<f64>,
    /// Temperature of its sensor.
    pub temperature_c: Option<f64>,
    /// State of charge.
    pub soc: Option<f64>,
    /// Its standard deviation.
    pub soc_std: Option<f64>,
    /// Learned capacity.
    pub capacity_ah: Option<f64>,
    /// Its standard deviation.
    pub capacity_std_ah: Option<f64>,
    /// Usable capacity at the configured load.
    pub usable_capacity_ah: Option<f64>,
    /// Its standard deviation.
    pub usable_capacity_std_ah: Option<f64>,
    /// Equivalent full cycles until the end of life, median.
    #[serde(default)]
    pub remaining_cycles: Option<f64>,
    /// 5 % quantile of that.
    #[serde(default)]
    pub remaining_cycles_low: Option<f64>,
    /// 95 % quantile.
    #[serde(default)]
    pub remaining_cycles_high: Option<f64>,
    /// Days until then, if it goes on being used as of late, median.
    #[serde(default)]
    pub remaining_days: Option<f64>,
    /// Why that is not known.
    #[serde(default)]
    pub remaining_unknown: Option<String>,
    /// Resistance relative to new.
    pub resistance_ratio: Option<f64>,
    /// Its standard deviation.
    pub resistance_ratio_std: Option<f64>,
    /// Whether the filter agrees with itself; of a cell without SOC that is not known.
    pub trusted: Option<bool>,
}

/// The alarms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alarms {
    /// Thresholds configured.
    pub thresholds: usize,
    /// Alarms raised now.
    pub raised: usize,
    /// The highest severity among them.
    pub highest_severity: Option<Severity>,
    /// Thresholds with alarms that cannot be judged, because their value is not known.
    pub unknown: Vec<UnknownAlarms>,
    /// Alarms that are raised, about to be, or not yet acknowledged.
    pub list: Vec<Alarm>,
    /// Further ones, for which there was no room.
    pub omitted: usize,
}

/// Counts. All begin with the program, as those of interfaces, protected messages and floods do, but `lifetime`: what goes on
/// from a stored state may be a minute old after a power cut, and a counter that falls is a lie to those who add up differences.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Counters {
    /// What the core has done.
    pub core: Statistics,
    /// The same since the first start, as far as it was stored; without the interfaces.
    #[serde(default)]
    pub lifetime: Statistics,
    /// Readings by what became of them.
    pub readings: ReadingCounts,
    /// Inputs whose time was before that of an earlier one.
    pub time_backwards: u64,
    /// The loop.
    pub service: ServiceCounters,
    /// Clients of the status sockets.
    pub clients: Clients,
}

/// Counts of the loop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ServiceCounters {
    /// Ticks.
    pub ticks: u64,
    /// Ticks that came more than a period late.
    pub missed_deadlines: u64,
    /// The latest a tick ever came, s.
    pub worst_lateness_s: f64,
    /// Configurations taken up while running.
    pub reloads: u64,
    /// Configurations refused while running.
    pub reloads_refused: u64,
    /// Status documents that were not written down, because the one before was not yet.
    pub documents_skipped: u64,
}

/// Clients of the status sockets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Clients {
    /// Connected now.
    pub connected: u64,
    /// Served or being served.
    pub served: u64,
    /// Turned away: too many at once.
    pub refused: u64,
    /// Dropped: they did not take what they were sent.
    pub dropped: u64,
}

/// Checks of one protected input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Protected {
    /// Interface it comes on.
    pub interface: String,
    /// Its identifier: 3 hexadecimal digits, or 8 when it is extended.
    pub id: String,
    /// How often each status was given.
    pub checks: Vec<StatusCount>,
}

/// How often a check gave a status.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StatusCount {
    /// The status' name.
    pub status: String,
    /// How often.
    pub count: u64,
}

/// Frames dropped of one input message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flooded {
    /// Interface.
    pub interface: String,
    /// Identifier, as in [`Protected`].
    pub id: String,
    /// Frames.
    pub dropped: u64,
}

/// The store of what is learned.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Store {
    /// Its folder; empty when it could not be opened.
    pub path: String,
    /// Whether it can be written; `None` = not tried yet.
    pub works: Option<bool>,
    /// Commits done.
    pub commits: u64,
    /// Commits that failed.
    pub failures: u64,
    /// Events that went out before they were stored, because that took too long.
    pub late: u64,
    /// Size of the database and its log, bytes, as of the last commit; `None` = none yet.
    pub file_bytes: Option<u64>,
}

impl ConfigFile {
    /// The file's name and fingerprint; `None` when it has become unreadable since it was read.
    pub fn of(path: &Path) -> Option<Self> {
        let text = std::fs::read(path).ok()?;
        let sha256 = Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect();
        Some(Self { path: path.display().to_string(), sha256 })
    }
}
