//! When something was stored, on every clock there is, and how long ago that was.
//!
//! The wall clock of a vehicle computer may say 1970 until somebody tells it better, and may step; the boot clock never
//! steps but begins anew with every boot. So both are stored, with the boot they belong to.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::io::clock::Reading;
use crate::quantity::Timestamp;

/// A wall clock before this (2024-01-01) has not been set.
const SANE_WALL_NS: i64 = 1_704_067_200_000_000_000;

/// One boot of one computer, as the kernel names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub(crate) struct BootId(pub(super) [u8; 16]);

/// Tells which boot this is, where the kernel's own file cannot be seen.
const BOOT_ID_VARIABLE: &str = "PACKWATCH_BOOT_ID";

impl BootId {
    /// A kernel that does not say which boot this is.
    const UNKNOWN: Self = Self([0; 16]);
    /// No boot at all: bus time, from a record.
    pub(crate) const REPLAY: Self = Self(*b"packwatch replay");

    /// Of this boot.
    pub(crate) fn current() -> Self {
        let told = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").ok().and_then(|text| Self::parse(&text));
        // A sandbox without that file (`ProcSubset=pid`) has it from its unit.
        let told = told.or_else(|| std::env::var(BOOT_ID_VARIABLE).ok().and_then(|text| Self::parse(&text)));
        // Two unknown boots are never the same one.
        told.unwrap_or(Self::UNKNOWN)
    }

    /// From the kernel's form or ours.
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

/// A moment on every clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Stamp {
    /// The wall clock, ns since 1970; may be wrong.
    pub(crate) wall_ns: i64,
    /// The clock of the inputs.
    pub(crate) time: Timestamp,
    /// Since this boot, sleep included, ns.
    pub(crate) boottime_ns: i64,
    /// Which boot.
    pub(crate) boot: BootId,
}

/// How long ago something was stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Age {
    /// Seconds.
    Seconds(f64),
    /// The clocks do not say.
    Unknown,
}

impl Stamp {
    /// Now, with the inputs' clock at `time`.
    pub(crate) fn now(time: Timestamp, boot: BootId) -> Self {
        let Reading { realtime_ns, boottime_ns } = Reading::now();
        Self { wall_ns: realtime_ns, time, boottime_ns, boot }
    }

    /// Bus time of a record: the only clock there is.
    pub(crate) fn replayed(time: Timestamp) -> Self {
        Self { wall_ns: time.nanos(), time, boottime_ns: time.nanos(), boot: BootId::REPLAY }
    }

    /// Whether both belong to one boot that is known.
    pub(crate) fn same_boot(&self, other: &Self) -> bool {
        self.boot == other.boot && self.boot != BootId::UNKNOWN
    }

    /// How long before `now` this was.
    pub(crate) fn age(&self, now: &Self) -> Age {
        let seconds = |from: i64, to: i64| to.saturating_sub(from) as f64 / 1e9;
        if self.same_boot(now) {
            return Age::Seconds(seconds(self.boottime_ns, now.boottime_ns).max(0.0));
        }
        if now.wall_ns > self.wall_ns && self.wall_ns >= SANE_WALL_NS {
            // At least as long as this boot has lasted.
            return Age::Seconds(seconds(self.wall_ns, now.wall_ns));
        }
        Age::Unknown
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
    fn within_one_boot_the_wall_clock_does_not_count() {
        for wall_s in [0, 1_800_000_000, 4_000_000_000] {
            assert_eq!(stamp(1, 100, 1_800_000_000).age(&stamp(1, 130, wall_s)), Age::Seconds(30.0));
        }
    }

    #[test]
    fn over_a_boot_only_a_wall_clock_that_can_be_right_counts() {
        let stored = stamp(1, 100, 1_800_000_000);
        assert_eq!(stored.age(&stamp(2, 5, 1_800_000_600)), Age::Seconds(600.0));
        assert_eq!(stored.age(&stamp(2, 5, 1_799_999_999)), Age::Unknown, "before what was stored");
        assert_eq!(stored.age(&stamp(2, 5, 30)), Age::Unknown, "1970");
        assert_eq!(stamp(1, 100, 30).age(&stamp(2, 5, 1_800_000_000)), Age::Unknown, "stored in 1970");
        assert_eq!(stamp(0, 100, 30).age(&stamp(0, 130, 60)), Age::Unknown, "boots that are not known");
    }

    #[test]
    fn a_boot_is_read_as_the_kernel_writes_it() {
        let boot = BootId::parse("0f3c1c1e-7f7e-4c39-9a49-0123456789ab\n").unwrap();
        assert_eq!(boot.to_string(), "0f3c1c1e7f7e4c399a490123456789ab");
        assert_eq!(BootId::parse(&boot.to_string()), Some(boot));
        assert_eq!(BootId::parse("none"), None);
    }
}
