//! Simulates an ECU that sends authenticated commands, as the manual describes, and the bus between this ECU and the
//! core.

use std::cell::RefCell;

use packwatch::can::secoc::{Authentication, Mac, Profile};
use packwatch::can::{CanId, Frame};
use packwatch::io::can_key::CanKey;
use packwatch::monitor::{
    Command, CommandCounts, Downtime, EventKind, Monitor, MonitorConfig, Outputs, Record, Snapshot,
};
use packwatch::quantity::{BusIndex, Timestamp};

use crate::support::config_texts;
use crate::support::rig::{DBC, PACK};

pub(crate) const COMMAND: u32 = 0x6B3;
pub(crate) const FRESHNESS: u32 = 0x6B6;
pub(crate) const REPLY: u32 = 0x6B5;
const COMMAND_ID: u16 = 0x0321;
const FRESHNESS_ID: u16 = 0x0322;
const BUS: BusIndex = BusIndex(0);
/// Wall-clock time at the start, in 2027.
const START_MS: i64 = 1_800_000_000_000;

pub(crate) fn key(byte: u8) -> CanKey {
    CanKey::parse(&[byte, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]).unwrap()
}

/// The test rig's configuration, with commands authenticated by `profile` instead of protected end to end.
pub(crate) fn config(profile: &str, more: &str) -> MonitorConfig {
    let secoc = format!("secoc = \"{profile}\"\n");
    let fd = if profile == "fd" { "fd = true\n" } else { "" };
    let pack =
        PACK.replace("name = \"can0\"\n", "name = \"can0\"\nfd = true\n").replace("e2e = \"1A\"\n", &(secoc + fd));
    let tables = "[output.freshness]\ndata_id = 0x0322\n[authentication]\nkey_file = \"can.key\"\n";
    config_texts::load(&format!("{pack}{tables}{more}"), DBC).monitor
}

/// The sender. It keeps no state across restarts.
pub(crate) struct Ecu {
    key: CanKey,
    pub(crate) authentication: Authentication,
    /// Freshness of the next command (a counter that makes every command unique). `None` until the daemon's
    /// announcement of the allowed values arrives.
    next: Option<u64>,
    announced: u64,
}

impl Ecu {
    pub(crate) fn new(profile: Profile, key: CanKey) -> Self {
        let authentication = Authentication { profile, data_id: COMMAND_ID };
        Self { key, authentication, next: None, announced: 0 }
    }

    /// Handles an announcement. Ignores an announcement with a wrong authenticator or an old freshness.
    pub(crate) fn handle_frame(&mut self, frame: &Frame) {
        if frame.id() != CanId::standard(FRESHNESS).unwrap() {
            return;
        }
        let announcement = Authentication { profile: Profile::Announcement, data_id: FRESHNESS_ID };
        let sent = announcement.sent_freshness(frame.data()).unwrap();
        let span = 1 << Profile::Announcement.freshness_bits();
        let high = self.announced / span * span;
        for freshness in [high + sent, high + span + sent] {
            let input = announcement.mac_input(frame.data(), freshness).unwrap();
            if freshness > self.announced && announcement.has_mac(frame.data(), self.key.mac(input.bytes())) {
                (self.announced, self.next) = (freshness, Some(freshness));
                return;
            }
        }
    }

    /// Creates a command. Returns `None` if all announced freshness values are used.
    pub(crate) fn command(&mut self, command: u8, cell: u16) -> Option<Frame> {
        let freshness = self.next.filter(|next| *next < self.announced + 16)?;
        self.next = Some(freshness + 1);
        Some(self.encode_command(command, cell, freshness))
    }

    pub(crate) fn encode_command(&self, command: u8, cell: u16, freshness: u64) -> Frame {
        let codes = u32::from(command) | 31 << 4 | u32::from(cell) << 11;
        let mut payload = codes.to_le_bytes().to_vec();
        payload.resize(4 + self.authentication.profile.trailer_bytes(), 0);
        self.authentication.write_freshness(&mut payload, freshness);
        let input = self.authentication.mac_input(&payload, freshness).unwrap();
        self.authentication.write_mac(&mut payload, self.key.mac(input.bytes()));
        frame_of(&payload)
    }
}

pub(crate) fn frame_of(payload: &[u8]) -> Frame {
    let id = CanId::standard(COMMAND).unwrap();
    if payload.len() <= 8 { Frame::classic(id, payload) } else { Frame::fd(id, false, false, payload) }.unwrap()
}

/// A journal entry: a tick (`None`), or a frame with its freshness (`None` if the authenticator is wrong).
pub(crate) type JournalLine = Option<(Frame, Option<u64>)>;

/// The daemon on a simulated bus, with manual time.
pub(crate) struct Daemon {
    pub(crate) config: MonitorConfig,
    pub(crate) monitor: Monitor,
    key: CanKey,
    out: Outputs,
    pub(crate) ms: i64,
    /// Frames that the daemon sent during the last `pass` or `receive`, with their authenticators.
    pub(crate) sent: Vec<Frame>,
    pub(crate) executed: u64,
    /// Recorded inputs, as a journal stores them; `None`: do not record.
    pub(crate) journal: Option<Vec<(i64, JournalLine)>>,
    pub(crate) macs: RefCell<u64>,
}

impl Daemon {
    pub(crate) fn new(config: MonitorConfig) -> Self {
        let mut daemon = Self {
            monitor: Monitor::new(config.clone()),
            config,
            key: key(0xA0),
            out: Outputs::default(),
            ms: START_MS,
            sent: Vec::new(),
            executed: 0,
            journal: None,
            macs: RefCell::new(0),
        };
        daemon.pass(20);
        daemon
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.ms * 1_000_000)
    }

    /// Advances the time, with a tick every 10 ms.
    pub(crate) fn pass(&mut self, ms: i64) {
        self.sent.clear();
        for _ in 0..ms / 10 {
            self.ms += 10;
            if let Some(journal) = &mut self.journal {
                journal.push((self.ms, None));
            }
            self.monitor.handle(&Record::tick(self.now()), &mut self.out);
            self.drain();
        }
    }

    /// Delivers a command frame. Returns whether it was executed.
    pub(crate) fn receive(&mut self, frame: &Frame) -> bool {
        self.sent.clear();
        let before = self.executed;
        let mac = |bytes: &[u8]| -> Mac {
            *self.macs.borrow_mut() += 1;
            self.key.mac(bytes)
        };
        let check = self.monitor.mac_check(BUS, frame).unwrap();
        let freshness = check.verify(frame.data(), mac);
        if let Some(journal) = &mut self.journal {
            journal.push((self.ms, Some((*frame, freshness))));
        }
        self.monitor.handle(&Record::secured_frame(self.now(), BUS, frame, freshness), &mut self.out);
        self.drain();
        self.executed > before
    }

    fn drain(&mut self) {
        let is_command = |kind: &EventKind| matches!(kind, EventKind::Command { command, .. } if is_of_bus(command));
        self.executed += self.out.events.iter().filter(|event| is_command(&event.kind)).count() as u64;
        let sealed = self.out.frames.iter().map(|sent| match sent.secured {
            Some(secured) => secured.seal(&sent.frame, |bytes| self.key.mac(bytes)),
            None => sent.frame,
        });
        self.sent.extend(sealed);
        self.out.clear();
    }

    pub(crate) fn counts(&self) -> CommandCounts {
        self.monitor.authenticated_commands().unwrap().2
    }

    /// Kills the daemon and restarts it from a stored state after `away_ms`.
    pub(crate) fn restart(&mut self, stored: Snapshot, downtime: Downtime, away_ms: i64) {
        self.ms += away_ms;
        self.monitor = Monitor::new(self.config.clone());
        self.monitor.restore(stored, downtime).unwrap();
        self.pass(20);
    }
}

fn is_of_bus(command: &Command) -> bool {
    matches!(command, Command::Acknowledge(_) | Command::Clear(_) | Command::PackReplaced)
}
