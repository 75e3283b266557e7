//! The stamp of a stored state contains the time of every clock. The age of the state is later computed from its stamp.
//!
//! The wall clock of a vehicle computer may show 1970 until it is set, and it may step. The boot clock never steps,
//! but starts again with every boot. Therefore the times of both clocks are stored, together with the identity of the
//! boot.
//!
//! Only the wall clock can measure the age of a state from an earlier boot. If the computer has no battery-backed
//! hardware clock, the wall clock continues after a boot from the value that systemd saved last. A week without power
//! then looks like seconds. The wall clock is therefore trusted only if a hardware clock agrees with it ([`WallClock`])
//! or a time server has set it.

use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::io::clock::Reading;
use crate::monitor::Downtime;
use crate::quantity::Timestamp;

/// A wall clock before this time (2024-01-01) has not been set.
pub(super) const SANE_WALL_NS: i64 = 1_704_067_200_000_000_000;

const NS_PER_YEAR: f64 = 365.25 * 86_400.0 * 1e9;

/// The kernel's list of hardware clocks. The program can read it even in a sandbox that forbids `adjtimex`.
const HARDWARE_CLOCKS: &str = "/sys/class/rtc";
/// systemd's time client creates this file when a time server has set the clock since the boot.
const SYNCHRONISED: &str = "/run/systemd/timesync/synchronized";
/// Maximum difference between the wall clock and a hardware clock that confirms it (s). A hardware clock counts whole
/// seconds and drifts by a few seconds a day. The wall clock may have been corrected since the boot.
const HARDWARE_TOLERANCE_S: i64 = 60;

/// One boot of one computer, as identified by the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct BootId(pub(super) [u8; 16]);

/// Environment variable with the boot's identity, for sandboxes that hide the kernel's file.
const BOOT_ID_VARIABLE: &str = "PACKWATCH_BOOT_ID";

impl BootId {
    /// The identity of a boot that the kernel does not report.
    const UNKNOWN: Self = Self([0; 16]);
    /// Used instead of a boot in the stamps of a replay. In these stamps, every clock shows the time on the bus.
    pub const REPLAY: Self = Self(*b"packwatch replay");

    /// The boot of the running system.
    pub fn current() -> Self {
        // In a sandbox without the kernel's file (`ProcSubset=pid`), the unit passes the identity.
        let text = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").ok();
        let kernel = text.and_then(|text| Self::parse(&text));
        let variable = || std::env::var(BOOT_ID_VARIABLE).ok().and_then(|text| Self::parse(&text));
        // An unknown boot never counts as equal to another unknown boot.
        kernel.or_else(variable).unwrap_or(Self::UNKNOWN)
    }

    /// Parses the notation of the kernel or of [`Display`](fmt::Display).
    pub(super) fn parse(text: &str) -> Option<Self> {
        let digits: String = text.chars().filter(|c| *c != '-' && !c.is_whitespace()).collect();
        u128::from_str_radix(&digits, 16).ok().filter(|_| digits.len() == 32).map(|id| Self(id.to_be_bytes()))
    }
}

impl From<BootId> for String {
    fn from(boot: BootId) -> Self {
        boot.to_string()
    }
}

impl TryFrom<String> for BootId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        Self::parse(&text).ok_or_else(|| format!("boot {text:?}, must be 32 hexadecimal digits"))
    }
}

impl fmt::Display for BootId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", u128::from_be_bytes(self.0))
    }
}

/// A time on every clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Stamp {
    /// Wall clock, ns since 1970; may be wrong.
    pub wall_ns: i64,
    /// Clock of the inputs.
    pub time: Timestamp,
    /// Time since this boot, including suspend, ns.
    pub boottime_ns: i64,
    pub boot: BootId,
}

/// Whether the wall clock can measure times across boots.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum WallClock {
    /// A hardware clock or a time server confirms the wall clock.
    Reliable,
    /// The wall clock may continue from a value that was saved before the computer was off.
    Unverified,
}

impl WallClock {
    /// Assesses the wall clock when the program starts. If a GPS receiver or a time server sets the clock later, this
    /// has no effect, because the age of the state is determined only once.
    pub(super) fn assess(now: &Stamp) -> Self {
        Self::judge(now, Path::new(HARDWARE_CLOCKS), Path::new(SYNCHRONISED))
    }

    fn judge(now: &Stamp, hardware_clocks: &Path, synchronised: &Path) -> Self {
        let wall_s = now.wall_ns / 1_000_000_000;
        // A hardware clock without a battery restarts from a fixed date when it gets power. A hardware clock therefore
        // confirms the wall clock only if their times agree.
        let agrees = |clock: &Path| {
            let text = std::fs::read_to_string(clock.join("since_epoch")).ok();
            let hardware_s = text.and_then(|text| text.trim().parse::<i64>().ok());
            hardware_s.is_some_and(|s| s.saturating_sub(wall_s).saturating_abs() <= HARDWARE_TOLERANCE_S)
        };
        let mut clocks = std::fs::read_dir(hardware_clocks).into_iter().flatten().flatten();
        if clocks.any(|clock| agrees(&clock.path())) || synchronised.exists() {
            Self::Reliable
        } else {
            Self::Unverified
        }
    }
}

impl Stamp {
    /// Returns the present time; the clock of the inputs shows `time`.
    pub(super) fn now(time: Timestamp, boot: BootId) -> Self {
        let Reading { realtime_ns, boottime_ns } = Reading::now();
        Self { wall_ns: realtime_ns, time, boottime_ns, boot }
    }

    /// Returns the stamp of a replayed record: every clock shows the bus time, because a replay has no other clock.
    pub(super) fn replayed(time: Timestamp) -> Self {
        Self { wall_ns: time.nanos(), time, boottime_ns: time.nanos(), boot: BootId::REPLAY }
    }

    /// The wall-clock time `years` before this stamp, ns since 1970; `None` = the wall clock is not confirmed.
    pub(super) fn years_ago_ns(&self, years: f64) -> Option<i64> {
        let is_reliable = self.boot == BootId::REPLAY || WallClock::assess(self) == WallClock::Reliable;
        is_reliable.then(|| self.wall_ns.saturating_sub((years * NS_PER_YEAR) as i64))
    }

    /// Whether both times belong to the same known boot.
    pub(super) fn same_boot(&self, other: &Self) -> bool {
        self.boot == other.boot && self.boot != BootId::UNKNOWN
    }

    /// Time from this stamp to `now`.
    pub(super) fn age(&self, now: &Self, wall: WallClock) -> Downtime {
        let seconds = |from: i64, to: i64| to.saturating_sub(from) as f64 / 1e9;
        if self.same_boot(now) {
            return Downtime::Seconds(seconds(self.boottime_ns, now.boottime_ns).max(0.0));
        }
        let can_be = now.wall_ns > self.wall_ns && self.wall_ns >= SANE_WALL_NS;
        match wall {
            // The state was stored before this boot, so its age is at least the uptime.
            WallClock::Reliable if can_be => {
                Downtime::Seconds(seconds(self.wall_ns, now.wall_ns).max(seconds(0, now.boottime_ns)))
            }
            WallClock::Reliable | WallClock::Unverified => Downtime::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn stamp(boot: u8, boottime_s: i64, wall_s: i64) -> Stamp {
        let boot = BootId([boot; 16]);
        Stamp { wall_ns: wall_s * S, time: Timestamp::ZERO, boottime_ns: boottime_s * S, boot }
    }

    #[test]
    fn wall_clock_is_ignored_within_one_boot() {
        for wall_s in [0, 1_800_000_000, 4_000_000_000] {
            let now = stamp(1, 130, wall_s);
            assert_eq!(stamp(1, 100, 1_800_000_000).age(&now, WallClock::Unverified), Downtime::Seconds(30.0));
        }
    }

    #[test]
    fn only_plausible_wall_clock_counts_across_boots() {
        let stored = stamp(1, 100, 1_800_000_000);
        let age = |stored: Stamp, now: Stamp| stored.age(&now, WallClock::Reliable);
        assert_eq!(age(stored, stamp(2, 5, 1_800_000_600)), Downtime::Seconds(600.0));
        assert_eq!(
            age(stored, stamp(2, 5, 1_799_999_999)),
            Downtime::Unknown,
            "the wall clock is before the stored time"
        );
        assert_eq!(age(stored, stamp(2, 5, 30)), Downtime::Unknown, "1970");
        assert_eq!(age(stamp(1, 100, 30), stamp(2, 5, 1_800_000_000)), Downtime::Unknown, "stored in 1970");
        assert_eq!(age(stamp(0, 100, 30), stamp(0, 130, 60)), Downtime::Unknown, "both boots are unknown");
    }

    #[test]
    fn age_across_boots_is_at_least_uptime() {
        let stored = stamp(1, 100, 1_800_000_000);
        assert_eq!(stored.age(&stamp(2, 3_600, 1_800_000_020), WallClock::Reliable), Downtime::Seconds(3_600.0));
    }

    #[test]
    fn saved_clock_gives_unknown_age() {
        // Without a hardware clock, the wall clock continues from the last saved time, 20 s after the last checkpoint.
        let (stored, now) = (stamp(1, 100, 1_800_000_000), stamp(2, 5, 1_800_000_020));
        assert_eq!(stored.age(&now, WallClock::Unverified), Downtime::Unknown);
    }

    #[test]
    fn wall_clock_needs_hardware_or_time_server() {
        let folder = tempfile::tempdir().unwrap();
        let (clocks, synchronised) = (folder.path().join("rtc"), folder.path().join("synchronized"));
        let judge = || WallClock::judge(&stamp(2, 5, 1_800_000_020), &clocks, &synchronised);
        assert_eq!(judge(), WallClock::Unverified, "no hardware clock");
        let set_clock = |text: &str| {
            std::fs::create_dir_all(clocks.join("rtc0")).unwrap();
            std::fs::write(clocks.join("rtc0/since_epoch"), text).unwrap();
        };
        for (hardware, expected) in [
            ("1800000018\n", WallClock::Reliable),
            ("946684805\n", WallClock::Unverified), // 2000-01-01: no battery
            ("1800604800\n", WallClock::Unverified),
            ("\n", WallClock::Unverified),
        ] {
            set_clock(hardware);
            assert_eq!(judge(), expected, "{hardware:?}");
        }
        std::fs::write(&synchronised, "").unwrap();
        assert_eq!(judge(), WallClock::Reliable, "a time server");
    }

    #[test]
    fn boot_id_parses_kernel_notation() {
        let boot = BootId::parse("0f3c1c1e-7f7e-4c39-9a49-0123456789ab\n").unwrap();
        assert_eq!(boot.to_string(), "0f3c1c1e7f7e4c399a490123456789ab");
        assert_eq!(BootId::parse(&boot.to_string()), Some(boot));
        assert_eq!(BootId::parse("none"), None);
    }
}
