//! The surroundings of the daemon in a simulated life: its configuration, the sender of authenticated commands, and a
//! random number generator.

use std::fs;
use std::path::Path;

use crate::can::secoc::{Authentication, Profile};
use crate::can::{CanId, Frame};
use crate::config::{self, Config, ConfigFiles};
use crate::io::can_key::CanKey;

const CONFIG: &str = r#"
[pack]
cells = 3
cell_model = "cells/example_nmc_2600.toml"
[[interface]]
name = "can0"
fd = true
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature"
[[input.diagnostic]]
name = "Bms"
request = 0x79B
response = 0x7BB
service = 0x21
identifier = 0x01
parked_every_s = 3
drive_every_s = 2
charge_every_s = 2
signals = [{ name = "Soh", bit = 0, length = 16, factor = 0.01, unit = "%", minimum = 0, maximum = 100 }]
[input.reported_soh]
signal = "Bms.Soh"
[poll]
enabled = true
max_requests_per_s = 5
[transition]
min_duration_s = 5.0
[store]
checkpoint_s = 60
[output]
[output.status]
period_ms = 1000
fd = true
secoc = "fd"
data_id = 0x0323
[output.freshness]
data_id = 0x0322
[commands]
enabled = true
fd = true
secoc = "fd"
data_id = 0x0321
[authentication]
key_file = "can.key"
[[alarm]]
rule = "input_missing"
warning = 1
[[alarm]]
rule = "temperature_high"
warning = { set = 50, clear = 45 }
latched = true
[[alarm]]
rule = "soc_low"
warning = 0.3
[[alarm]]
rule = "capacity_low"
warning = 5.0
"#;

const DBC: &str = "VERSION \"\"\nBU_: A\nBO_ 256 Status: 8 A\n SG_ Current : 0|16@1- (0.01,0) [-300|300] \"A\" A\n \
                   SG_ Temperature : 16|8@1+ (1,-40) [-40|200] \"degC\" A\nBO_ 272 Cells: 8 A\n SG_ Voltage1 : \
                   0|16@1+ (0.0001,0) [0|5] \"V\" A\n SG_ Voltage2 : 16|16@1+ (0.0001,0) [0|5] \"V\" A\n SG_ Voltage3 : \
                   32|16@1+ (0.0001,0) [0|5] \"V\" A\n";

pub(super) fn key() -> CanKey {
    CanKey::parse(&[0xA0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]).unwrap()
}

pub(super) fn loaded() -> Config {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
    let read = |path: &Path| match path.to_str() {
        Some("pack.toml") => Ok(CONFIG.as_bytes().to_vec()),
        Some("pack.dbc") => Ok(DBC.as_bytes().to_vec()),
        _ => fs::read(shipped.join(path)),
    };
    let files = ConfigFiles::alone(Path::new("pack.toml"));
    config::load_with(&files, &read).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")))
}

/// Pseudo-random numbers (SplitMix64).
pub(super) struct Dice(pub u64);

impl Dice {
    pub(super) fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % limit
    }

    pub(super) fn one_in(&mut self, count: u64) -> bool {
        self.below(count) == 0
    }
}

/// A sender of authenticated commands. It uses the freshness (a counter against replayed commands) that the daemon
/// announces.
#[derive(Default)]
pub(super) struct Sender {
    announced: u64,
    next: Option<u64>,
}

impl Sender {
    const COMMAND: Authentication = Authentication { profile: Profile::Fd, data_id: 0x0321 };
    const ANNOUNCEMENT: Authentication = Authentication { profile: Profile::Announcement, data_id: 0x0322 };

    /// Handles an announcement. Returns the announced freshness.
    pub(super) fn hear(&mut self, frame: &Frame) -> Option<u64> {
        let sent = Self::ANNOUNCEMENT.sent_freshness(frame.data())?;
        let span = 1 << Profile::Announcement.freshness_bits();
        let high = self.announced / span * span;
        let found = [high + sent, high + span + sent].into_iter().find(|freshness| {
            let input = Self::ANNOUNCEMENT.mac_input(frame.data(), *freshness);
            input.is_some_and(|input| Self::ANNOUNCEMENT.has_mac(frame.data(), key().mac(input.bytes())))
        })?;
        if found > self.announced {
            (self.announced, self.next) = (found, Some(found));
        }
        Some(found)
    }

    /// Makes a command that acknowledges all alarms. `None` = no freshness was announced, or all announced values are
    /// used.
    pub(super) fn command(&mut self) -> Option<Frame> {
        let freshness = self.next.filter(|next| *next < self.announced + 16)?;
        self.next = Some(freshness + 1);
        let mut payload = (1_u32 | 31 << 4 | 0x7FF << 11).to_le_bytes().to_vec();
        payload.resize(4 + Self::COMMAND.profile.trailer_bytes(), 0);
        Self::COMMAND.write_freshness(&mut payload, freshness);
        let input = Self::COMMAND.mac_input(&payload, freshness)?;
        Self::COMMAND.write_mac(&mut payload, key().mac(input.bytes()));
        Frame::fd(CanId::standard(0x6B3)?, false, false, &payload)
    }
}
