//! A listener as another ECU would implement it: built from the DBC and the contract page, without the encoder's code.

use std::collections::BTreeMap;

use packwatch::can::dbc::{Database, Message, Signal};
use packwatch::can::signal::SignalPlan;
use packwatch::can::{CanId, Frame};

/// Maps rule, severity and cell to state and acknowledgement. All values are codes as in the frames.
pub(crate) type AlarmTable = BTreeMap<(u64, u64, u64), (u64, bool)>;

/// Number of passes per cycle. In one pass each raised alarm is sent once. If the listener receives no frame of an
/// alarm for `TIMEOUT_PASSES` passes, it removes the alarm.
const CYCLE_PASSES: i64 = 4;
const TIMEOUT_PASSES: i64 = 7;

struct Reader {
    id: CanId,
    signals: BTreeMap<String, (SignalPlan, Signal)>,
}

impl Reader {
    fn new(database: &Database, name: &str) -> Self {
        let message: &Message = database.message(name).unwrap();
        let signal = |signal: &Signal| (signal.name.clone(), (signal.layout.plan().unwrap(), signal.clone()));
        Self { id: message.id, signals: message.signals.iter().map(signal).collect() }
    }

    fn raw(&self, frame: &Frame, name: &str) -> u64 {
        self.signals[name].0.raw(frame.data()).unwrap()
    }

    /// Whether the signal is on the frame's page.
    fn has(&self, frame: &Frame, name: &str) -> bool {
        let page = self.raw(frame, "Page");
        self.signals.get(name).is_some_and(|(_, signal)| {
            signal.conditions.iter().flat_map(|of| &of.ranges).any(|(low, high)| (*low..=*high).contains(&page))
        })
    }

    fn code(&self, name: &str, word: &str) -> u64 {
        let table = &self.signals[name].1.values;
        u64::try_from(table.iter().find(|(_, other)| other == word).unwrap().0).unwrap()
    }
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    state: u64,
    is_acknowledged: bool,
    received_ms: i64,
}

pub(crate) struct Listener {
    alarm: Reader,
    digest: Reader,
    /// State codes of a raised alarm.
    raised_states: [u64; 3],
    entries: BTreeMap<(u64, u64, u64), Entry>,
    pass_ms: i64,
    /// Number of raised alarms and checksum of the alarm table, from the last digest (a frame that summarises all
    /// alarms).
    wanted: Option<(u64, u64)>,
    rules: BTreeMap<u64, u64>,
}

impl Listener {
    pub(crate) fn new(database: &Database) -> Self {
        let (alarm, digest) = (Reader::new(database, "PACKWATCH_Alarm"), Reader::new(database, "PACKWATCH_Digest"));
        let raised_states = ["active", "latched", "suppressed"].map(|word| alarm.code("State", word));
        let (entries, rules) = (BTreeMap::new(), BTreeMap::new());
        Self { alarm, digest, raised_states, entries, pass_ms: 1000, wanted: None, rules }
    }

    pub(crate) fn handle(&mut self, now_ms: i64, frame: &Frame) {
        if frame.id() == self.alarm.id {
            self.handle_alarm(now_ms, frame);
        } else if frame.id() == self.digest.id {
            self.handle_digest(frame);
        }
    }

    fn handle_alarm(&mut self, now_ms: i64, frame: &Frame) {
        let raw = |name| self.alarm.raw(frame, name);
        if raw("Test") == 1 {
            return;
        }
        let key = (raw("Rule"), raw("Severity"), raw("Cell"));
        let entry = Entry { state: raw("State"), is_acknowledged: raw("Acknowledged") == 1, received_ms: now_ms };
        if self.raised_states.contains(&entry.state) {
            self.entries.insert(key, entry);
        } else {
            self.entries.remove(&key);
        }
    }

    fn handle_digest(&mut self, frame: &Frame) {
        let raw = |name: &str| self.digest.raw(frame, name);
        if raw("Page") == self.digest.code("Page", "alarms") {
            self.wanted = Some((raw("Raised"), raw("TableChecksum")));
            self.pass_ms = i64::try_from(raw("PassTime")).unwrap() * 100;
        } else if ["rules", "rules_2"].map(|page| self.digest.code("Page", page)).contains(&raw("Page")) {
            for (code, name) in &self.alarm.signals["Rule"].1.values {
                if self.digest.has(frame, &format!("Rule_{name}")) {
                    self.rules.insert(u64::try_from(*code).unwrap(), raw(&format!("Rule_{name}")));
                }
            }
            let rules = &self.rules;
            self.entries.retain(|(rule, _, _), _| rules.get(rule).is_none_or(|state| matches!(state, 1..=3)));
        }
    }

    pub(crate) fn cycle_ms(&self) -> i64 {
        CYCLE_PASSES * self.pass_ms
    }

    pub(crate) fn rules(&self) -> &BTreeMap<u64, u64> {
        &self.rules
    }

    /// The listener's alarm table.
    pub(crate) fn table(&mut self, now_ms: i64) -> AlarmTable {
        let timeout_ms = TIMEOUT_PASSES * self.pass_ms;
        self.entries.retain(|_, entry| now_ms - entry.received_ms <= timeout_ms);
        self.entries.iter().map(|(key, entry)| (*key, (entry.state, entry.is_acknowledged))).collect()
    }

    /// Whether the table agrees with the last digest.
    pub(crate) fn is_confirmed(&mut self, now_ms: i64) -> bool {
        let table = self.table(now_ms);
        let sum = table.iter().fold(0_u16, |sum, (key, entry)| sum.wrapping_add(crc(*key, *entry)));
        let count = u64::try_from(table.len()).unwrap();
        self.wanted == Some((count.min(4094), u64::from(sum.min(65534))))
    }
}

/// CRC-16 of an entry, bit by bit as the DBC comment specifies.
fn crc((rule, severity, cell): (u64, u64, u64), (state, is_acknowledged): (u64, bool)) -> u16 {
    let bytes = [rule, severity, cell & 0xFF, cell >> 8, state + 8 * u64::from(is_acknowledged)];
    bytes.into_iter().fold(0xFFFF_u16, |start, byte| {
        let mut crc = start ^ u16::try_from(byte).unwrap() << 8;
        for _ in 0..8 {
            crc = if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 };
        }
        crc
    })
}
