//! Tests the contract with other ECUs. A listener loses frames and starts late, and the daemon is killed. Two cycles
//! later, the listener must have the daemon's alarm table. In one cycle the daemon sends each raised alarm four times.
//! The listener is built only from the written DBC and the manual's page `ecu/contract.md`.
//!
//! `PACKWATCH_CONTRACT_RUNS` sets the number of runs (default 200); the full test has 10,000.

mod listener;
mod replies;

use std::collections::BTreeMap;

use listener::{AlarmTable, Listener};
use packwatch::alarm::{Rule, Selector};
use packwatch::can::dbc::Database;
use packwatch::can::encode::InputEncoder;
use packwatch::can::{CanId, Frame};
use packwatch::config::Config;
use packwatch::monitor::{BusEvent, Command, Downtime, EventKind, Monitor, Outputs, Record, Snapshot};
use packwatch::quantity::{BusIndex, CellIndex, Channel, SensorIndex, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::support::config_texts;

/// Number of cells, and cells per page of their message.
const CELLS: u16 = 96;
const PAGE_CELLS: u16 = 3;
const PAGES: usize = (CELLS / PAGE_CELLS) as usize;
/// Fraction of the frames that the listener loses.
const LOSS: f64 = 0.1;
const RESTARTS: u32 = 10;
/// Interval between two comparisons of the alarm tables, ms.
const STEP_MS: i64 = 100;
/// Maximum wait for two cycles without an alarm change, ms. After the last action, the share of bad readings still
/// changes for up to a minute and may change an alarm.
const MAX_WAIT_MS: i64 = 600_000;
const BUS: BusIndex = BusIndex(0);

const PACK: &str = r#"
[pack]
cells = 96
cell_model = "cells/example_nmc_2600.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature"
[limits.temperature]
max_age_s = 2.0
[[alarm]]
rule = "input_missing"
warning = 1.2
[[alarm]]
rule = "input_implausible"
severe = "50 %"
[[alarm]]
rule = "temperature_high"
warning = 50.0
severe = 60.0
latched = true
[[alarm]]
rule = "bus_fault"
warning = 1.0
[[alarm]]
rule = "store_failed"
severe = 0.5
[output]
"#;

fn load() -> Config {
    let mut dbc = String::from("VERSION \"\"\nNS_ :\nBS_:\nBU_: A\nBO_ 256 Status: 8 A\n");
    dbc +=
        " SG_ Current : 0|16@1- (0.01,0) [-300|300] \"A\" A\n SG_ Temperature : 16|8@1+ (1,-40) [-40|200] \"degC\" A\n";
    dbc += "BO_ 272 Cells: 8 A\n SG_ Page M : 0|8@1+ (1,0) [0|255] \"\" A\n";
    for cell in 0..CELLS {
        let (page, bit) = (cell / PAGE_CELLS, 8 + 16 * (cell % PAGE_CELLS));
        dbc += &format!(" SG_ Voltage{} m{page} : {bit}|16@1+ (0.0001,0) [0|5] \"V\" A\n", cell + 1);
    }
    config_texts::load(PACK, &dbc)
}

/// If the listener receives no digest for this many digest periods, its table is not confirmed.
const DIGEST_TIMEOUT_PERIODS: i64 = 3;

/// A listener that applies the digest timeout (rule 5 of the contract).
struct TimedListener {
    listener: Listener,
    digest: CanId,
    timeout_ms: i64,
    digest_ms: Option<i64>,
}

impl TimedListener {
    fn new(database: &Database) -> Self {
        let digest = database.message("PACKWATCH_Digest").unwrap();
        let timeout_ms = DIGEST_TIMEOUT_PERIODS * i64::from(digest.cycle_time_ms.unwrap());
        Self { listener: Listener::new(database), digest: digest.id, timeout_ms, digest_ms: None }
    }

    fn handle(&mut self, now_ms: i64, frame: &Frame) {
        if frame.id() == self.digest {
            self.digest_ms = Some(now_ms);
        }
        self.listener.handle(now_ms, frame);
    }

    fn table(&mut self, now_ms: i64) -> AlarmTable {
        self.listener.table(now_ms)
    }

    fn is_confirmed(&mut self, now_ms: i64) -> bool {
        let is_recent = self.digest_ms.is_some_and(|digest_ms| now_ms - digest_ms < self.timeout_ms);
        is_recent && self.listener.is_confirmed(now_ms)
    }
}

struct Daemon<'a> {
    config: &'a Config,
    random: ChaCha8Rng,
    monitor: Monitor,
    /// State on disk. It is stored after every alarm change, as in the service, and after every command.
    stored: Snapshot,
    encoder: InputEncoder,
    out: Outputs,
    now_ms: i64,
    listener: Option<TimedListener>,
    is_digest_lost: bool,
    /// Per page of cells: 0 good, 1 missing, 2 out of range.
    pages: [u8; PAGES],
    temperature_c: Option<f64>,
}

impl<'a> Daemon<'a> {
    fn with_listener(config: &'a Config, seed: u64) -> Self {
        let listener = TimedListener::new(config.output_layout.as_ref().unwrap());
        Self { listener: Some(listener), ..Self::new(config, seed) }
    }

    fn new(config: &'a Config, seed: u64) -> Self {
        let monitor = Monitor::new(config.monitor.clone());
        Self {
            config,
            random: ChaCha8Rng::seed_from_u64(seed),
            stored: monitor.snapshot(),
            monitor,
            encoder: InputEncoder::new(&config.monitor.input),
            out: Outputs::default(),
            now_ms: 1_000_000,
            listener: None,
            is_digest_lost: false,
            pages: [0; PAGES],
            temperature_c: Some(25.0),
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.now_ms * 1_000_000)
    }

    fn give(&mut self, record: Record) {
        self.monitor.handle(&record, &mut self.out);
        for sent in &self.out.frames {
            if let Some(listener) = &mut self.listener
                && !self.random.random_bool(LOSS)
                && !(self.is_digest_lost && sent.frame.id() == listener.digest)
            {
                listener.handle(self.now_ms, &sent.frame);
            }
        }
        let is_change = |kind: &EventKind| matches!(kind, EventKind::Alarm { .. } | EventKind::Command { .. });
        if self.out.events.iter().any(|event| is_change(&event.kind)) {
            self.stored = self.monitor.snapshot();
        }
        self.out.clear();
    }

    /// Advances the time. Sends input frames twice a second, and the ticks that are due.
    fn run_for(&mut self, duration_ms: i64) {
        let end_ms = self.now_ms + duration_ms;
        while self.now_ms < end_ms {
            self.now_ms += 10;
            if self.now_ms % 500 == 0 {
                self.give_inputs();
            }
            let time = self.now();
            if self.monitor.next_due().is_none_or(|due| due <= time) {
                self.give(Record::tick(time));
            }
        }
    }

    fn give_inputs(&mut self) {
        let mut values =
            vec![(Channel::Current, Some(0.0)), (Channel::Temperature(SensorIndex(0)), self.temperature_c)];
        for cell in 0..CELLS {
            let volts = [Some(3.7), None, Some(6.0)][usize::from(self.pages[usize::from(cell / PAGE_CELLS)])];
            values.push((Channel::CellVoltage(CellIndex(cell)), volts));
        }
        let mut made = Vec::new();
        self.encoder.encode(&values, &mut made);
        let time = self.now();
        for (bus, frame) in &made {
            self.give(Record::frame(time, *bus, frame));
        }
    }

    /// Applies a random change to the vehicle, or sends a command.
    fn act(&mut self) {
        let time = self.now();
        match self.random.random_range(0..10) {
            0..=3 => {
                let page = self.random.random_range(0..PAGES);
                self.pages[page] = self.random.random_range(0..3);
            }
            4 => self.pages = [self.random.random_range(0..3); PAGES],
            5 | 6 => self.temperature_c = [None, Some(25.0), Some(55.0), Some(65.0)][self.random.random_range(0..4)],
            7 => {
                let event = if self.random.random_bool(0.5) { BusEvent::Up } else { BusEvent::Down };
                self.give(Record::bus(time, BUS, event));
            }
            8 => {
                let works = self.random.random_bool(0.5);
                self.give(Record::store(time, works));
            }
            _ => {
                let rule = [None, Some(Rule::TemperatureHigh)][self.random.random_range(0..2)];
                let which = Selector { rule, ..Selector::default() };
                let is_clear = self.random.random_bool(0.5);
                let command = if is_clear { Command::Clear(which) } else { Command::Acknowledge(which) };
                self.give(Record::command(time, command));
            }
        }
    }

    fn restart(&mut self) {
        let away_ms = self.random.random_range(5..300) * 10;
        let age_ms = away_ms + self.now_ms - self.stored.time.nanos() / 1_000_000;
        self.now_ms += away_ms;
        self.monitor = Monitor::new(self.config.monitor.clone());
        self.monitor.restore(self.stored.clone(), Downtime::Seconds(age_ms as f64 / 1000.0)).unwrap();
    }

    /// The raised alarms, encoded as in their frames.
    fn table(&self) -> AlarmTable {
        let raised = self.monitor.alarms().raised();
        raised
            .map(|alarm| {
                let cell = alarm.cell.map_or(2047, |cell| u64::from(cell.0));
                let key = (alarm.rule as u64, alarm.severity as u64, cell);
                (key, (u64::from(alarm.state.wire_code()), alarm.is_acknowledged))
            })
            .collect()
    }

    fn rules(&self) -> BTreeMap<u64, u64> {
        let code = |rule: Rule| match self.monitor.alarms().rule_summary(rule) {
            None => 5,
            Some(summary) => summary.worst.map_or(if summary.is_known { 0 } else { 4 }, |severity| severity as u64),
        };
        Rule::ALL.into_iter().map(|rule| (rule as u64, code(rule))).collect()
    }
}

/// Performs one run. Returns the largest number of raised alarms and the length of two cycles, ms.
fn run(config: &Config, database: &Database, seed: u64) -> (usize, i64) {
    let mut daemon = Daemon::new(config, seed);
    let joins = daemon.random.random_range(0..=RESTARTS);
    let mut most = 0;
    for segment in 0..=RESTARTS {
        if segment == joins {
            daemon.listener = Some(TimedListener::new(database));
        }
        for _ in 0..daemon.random.random_range(1..5) {
            let wait_ms = daemon.random.random_range(1..100) * 10;
            daemon.run_for(wait_ms);
            daemon.act();
            most = most.max(daemon.table().len());
        }
        if segment < RESTARTS {
            daemon.restart();
        }
    }
    let (began_ms, mut state, mut since_ms) = (daemon.now_ms, (daemon.table(), daemon.rules()), daemon.now_ms);
    let mut two_cycles_ms = 2 * daemon.listener.as_ref().unwrap().listener.cycle_ms();
    while daemon.now_ms < since_ms + two_cycles_ms {
        daemon.run_for(STEP_MS);
        let now = (daemon.table(), daemon.rules());
        if now != state {
            (state, since_ms) = (now, daemon.now_ms);
        }
        // The listener learns the cycle time from digests, so the time may have changed since the last check.
        two_cycles_ms = 2 * daemon.listener.as_ref().unwrap().listener.cycle_ms();
        assert!(daemon.now_ms < began_ms + MAX_WAIT_MS, "seed {seed}: alarms never settle");
    }
    let (truth, rules) = (daemon.table(), daemon.rules());
    let now_ms = daemon.now_ms;
    let listener = daemon.listener.as_mut().unwrap();
    assert_eq!(listener.table(now_ms), truth, "seed {seed}");
    assert!(listener.is_confirmed(now_ms), "seed {seed}: the listener does not confirm a correct table");
    assert_eq!(listener.listener.rules(), &rules, "seed {seed}");
    (most.max(truth.len()), two_cycles_ms)
}

#[test]
fn lossy_listener_has_table_after_two_cycles() {
    let runs: u64 = std::env::var("PACKWATCH_CONTRACT_RUNS").map_or(200, |runs| runs.parse().unwrap());
    let config = load();
    let database = config.output_layout.clone().unwrap();
    let (mut most, mut longest_ms, mut sum) = (0, 0, 0);
    for seed in 0..runs {
        let (raised, two_cycles_ms) = run(&config, &database, seed);
        (most, longest_ms, sum) = (most.max(raised), longest_ms.max(two_cycles_ms), sum + raised);
    }
    let mean = sum as f64 / runs as f64;
    eprintln!(
        "{runs} runs, {mean:.1} alarms at once ({most} at most), two cycles of up to {longest_ms} ms: no differences"
    );
    assert!(most > 97 && sum > 3 * usize::try_from(runs).unwrap(), "too few alarms for this test");
}

#[test]
fn listener_needs_digest_to_remove_alarms() {
    let config = load();
    let mut daemon = Daemon::with_listener(&config, 1);
    daemon.temperature_c = Some(55.0);
    daemon.run_for(3_000);
    let raised = daemon.listener.as_mut().unwrap().table(daemon.now_ms);
    assert!(raised.contains_key(&(9, 2, 2047)), "{raised:?}");
    // Kill the daemon and discard its alarms. No frame announces the end of these alarms; only the digest shows it.
    daemon.monitor = Monitor::new(config.monitor.clone());
    daemon.temperature_c = Some(25.0);
    daemon.run_for(3_000);
    let now_ms = daemon.now_ms;
    let listener = daemon.listener.as_mut().unwrap();
    assert!(!listener.table(now_ms).contains_key(&(9, 2, 2047)));
    assert!(listener.is_confirmed(now_ms));
}

#[test]
fn digest_timeout_withdraws_table_confirmation() {
    let config = load();
    let mut daemon = Daemon::with_listener(&config, 2);
    let timeout_ms = daemon.listener.as_ref().unwrap().timeout_ms;
    let manual = include_str!("../../docs/src/ecu/contract.md");
    let row = manual.lines().find(|line| line.starts_with("| `PACKWATCH_Digest` |")).unwrap();
    assert!(row.ends_with(&format!("| {timeout_ms} ms |")), "the manual's timeout differs: {row}");
    daemon.temperature_c = Some(55.0);
    daemon.run_for(8_000);
    let confirmed = |daemon: &mut Daemon<'_>| {
        let (now_ms, truth) = (daemon.now_ms, daemon.table());
        let listener = daemon.listener.as_mut().unwrap();
        assert!(truth.contains_key(&(9, 2, 2047)), "{truth:?}");
        assert_eq!(listener.table(now_ms), truth, "alarm frames must keep the table correct");
        listener.is_confirmed(now_ms)
    };
    assert!(confirmed(&mut daemon));
    daemon.is_digest_lost = true;
    let last_ms = daemon.listener.as_ref().unwrap().digest_ms.unwrap();
    while daemon.now_ms < last_ms + timeout_ms - 10 {
        daemon.run_for(10);
        assert!(confirmed(&mut daemon), "not confirmed {} ms after the last digest", daemon.now_ms - last_ms);
    }
    for _ in 0..100 {
        daemon.run_for(100);
        assert!(!confirmed(&mut daemon), "still confirmed {} ms after the last digest", daemon.now_ms - last_ms);
    }
    daemon.is_digest_lost = false;
    daemon.run_for(2_000);
    assert!(confirmed(&mut daemon), "not confirmed after the digest is back");
}

#[test]
fn listener_without_digest_confirms_nothing() {
    let config = load();
    let mut daemon = Daemon::with_listener(&config, 3);
    daemon.is_digest_lost = true;
    daemon.run_for(8_000);
    let now_ms = daemon.now_ms;
    assert!(!daemon.listener.as_mut().unwrap().is_confirmed(now_ms));
}
