//! Simulates the daemon with random faults. The engine, its monitor and the real store run in simulated time, with
//! commands, authentication and polling. The store is in a temporary folder, in memory if possible.
//!
//! A simulated run is called a life. Its seed determines the whole life. Faults are lost, repeated and foreign frames,
//! silence, bus events, clock steps, pauses of up to two hours, clean ends, and kills at any step, even before a commit
//! reaches the disk. Bytes in the stored files are flipped, and files are deleted or replaced while the process runs.
//! Every step checks the estimates, the sent frames and the store. A failure prints the seed and the step;
//! `PACKWATCH_SEED` repeats the life.
//!
//! The folder is in a real file system, so this test never sees reordered or torn writes. The power-cut tests in
//! `tests/vcan` cause them on a simulated disk.

mod nodes;

use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};

use self::nodes::{Dice, Sender, key, loaded};
use super::engine::Engine;
use super::*;
use crate::can::encode::InputEncoder;
use crate::can::secoc::{Authentication, Profile};
use crate::can::{CanId, Frame};
use crate::monitor::{BusEvent, Command, EventKind, RecordKind, Source};
use crate::quantity::{CellIndex, Channel, SensorIndex, Timestamp};

/// Time of a step. A real daemon has a tick every 10 ms.
const STEP_NS: i64 = 100_000_000;
const BUS: BusIndex = BusIndex(0);
/// Identifiers that the daemon may send: its own frames and the diagnostic request.
const ALLOWED: [u16; 7] = [0x6B0, 0x6B1, 0x6B2, 0x6B4, 0x6B5, 0x6B6, 0x79B];
const ALARM: u16 = 0x6B2;
const CYCLIC: [u16; 4] = [0x6B0, 0x6B1, 0x6B4, 0x6B6];

#[derive(Debug, Default)]
struct Counts {
    steps: u64,
    faults: u64,
    starts: u64,
    commands: u64,
    /// Number of times that a recorded command was sent again.
    replays: u64,
    frames: u64,
    commits: u64,
}

struct World {
    dice: Dice,
    place: tempfile::TempDir,
    generation: u32,
    now_ns: i64,
    engine: Option<Engine>,
    next_frame: Box<dyn FnMut() -> Option<Frame>>,
    /// Sent frames that are not yet checked.
    unchecked: VecDeque<Frame>,
    encoder: InputEncoder,
    sender: Sender,
    /// Commands that the daemon must reject. They were executed before, or were held back across a start.
    recorded: VecDeque<Frame>,
    /// Commands since the last start that an attacker holds back.
    withheld: Vec<Frame>,
    /// Steps until the recorded commands are sent.
    replay_in: u32,
    /// Highest freshness (number against replayed frames, see SecOC) of all sent frames.
    freshness: u64,
    /// Number of history rows that the store has confirmed.
    rows: i64,
    /// Times of the alarm frames and of the requests in the last second, ns.
    alarms: VecDeque<i64>,
    requests: VecDeque<i64>,
    standby: bool,
    /// Whether the files were changed from outside since the start.
    tampered: bool,
    /// Steps since the last frame, start, stop or clock step.
    silent_steps: u32,
    silent_until: i64,
    soc: f64,
    current_a: f64,
    temperature_c: f64,
    counts: Counts,
}

impl World {
    fn new(seed: u64) -> Self {
        let place = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let mut world = Self {
            dice: Dice(seed),
            place,
            generation: 0,
            now_ns: 1_800_000_000_000_000_000,
            engine: None,
            next_frame: Box::new(|| None),
            unchecked: VecDeque::new(),
            encoder: InputEncoder::new(&loaded().monitor.input),
            sender: Sender::default(),
            recorded: VecDeque::new(),
            withheld: Vec::new(),
            replay_in: 0,
            // On the first start, the freshness is computed from the clock.
            freshness: 1_800_000_000 * 256 - 1,
            rows: 0,
            alarms: VecDeque::new(),
            requests: VecDeque::new(),
            standby: false,
            tampered: false,
            silent_steps: 0,
            silent_until: 0,
            soc: 0.8,
            current_a: 0.0,
            temperature_c: 25.0,
            counts: Counts::default(),
        };
        world.start();
        world
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.now_ns)
    }

    fn state(&self) -> PathBuf {
        self.place.path().join(self.generation.to_string())
    }

    fn start(&mut self) {
        let mut service = Service {
            config: loaded(),
            record: None,
            record_limits: None,
            frames: None,
            events: None,
            restore: None,
            downtime: Downtime::AsStamped,
            snapshot: None,
            duration: None,
            ready_timeout: Duration::from_secs(3600),
            receive_buffer_bytes: 0,
            control: PlaceSetting::Off,
            state: PlaceSetting::At(self.state()),
            status: PlaceSetting::Off,
            config_file: None,
            key: Some(key()),
        };
        let mut engine = Engine::new(&mut service, MappedClock::new(Reading::now())).unwrap();
        // The first input sets the monitor's clock. The start is stored before the first frame.
        let tick = Record::tick(self.now());
        engine.handle(&tick);
        engine.store_start(self.now());
        let (link, next_frame) = LinkOutput::captured();
        engine.links = vec![link];
        let progress = engine.settle_store(self.now()).expect("a store");
        if !self.tampered {
            assert!(progress.rows >= self.rows, "{} rows were confirmed, {} are there", self.rows, progress.rows);
            assert!(progress.works, "the store works");
        }
        // If the stored state was damaged, the standby command may be lost.
        self.standby &= !self.tampered;
        (self.rows, self.tampered) = (progress.rows, false);
        (self.engine, self.next_frame) = (Some(engine), Box::new(next_frame));
        self.silent_steps = 0;
        self.recorded.extend(self.withheld.drain(..));
        self.replay_in = 20;
        self.counts.starts += 1;
    }

    /// Kills the process: copies the folder in its present state, and continues with the copy.
    fn kill(&mut self) {
        let before = self.state();
        self.generation += 1;
        copy(&before, &self.state());
        self.discard(&before);
    }

    /// Ends the process. Its last writes go to the old folder, which is then deleted.
    fn discard(&mut self, folder: &Path) {
        let now = self.now();
        if let Some(mut engine) = self.engine.take() {
            engine.close_store(now);
        }
        fs::remove_dir_all(folder).unwrap();
    }

    /// Passes a record to the daemon and checks the frames that it sends. If `is_cut` is true, the process is killed
    /// before the commit.
    fn give(&mut self, record: &Record, is_cut: bool) {
        let kept = is_cut.then(|| {
            let kept = self.place.path().join("kept");
            copy(&self.state(), &kept);
            kept
        });
        let (now, now_ns) = (self.now(), self.now_ns);
        let Some(engine) = &mut self.engine else { return };
        let was_asleep = engine.monitor.asleep_since().is_some();
        let ticket = engine.handle(record);
        // The daemon counts as asleep only after it has observed the silence itself. The silence begins with the last
        // frame, start, stop or clock step.
        if matches!(record.kind, RecordKind::Frame { .. }) {
            self.silent_steps = 0;
        }
        let asleep = self.silent_steps > 100 && was_asleep && engine.monitor.asleep_since().is_some();
        // A frame that announces a result must not be sent before the result is committed.
        let is_held = |sent: &&crate::monitor::Transmit| sent.announces && sent.secured.is_none();
        let held: Vec<Frame> = engine.outputs.frames.iter().filter(is_held).map(|sent| sent.frame).collect();
        self.unchecked.extend(std::iter::from_fn(&mut self.next_frame));
        if ticket.is_some() && !self.tampered {
            assert!(!held.iter().any(|frame| self.unchecked.contains(frame)), "announced before it was stored");
        }
        let executed = engine.outputs.events.iter().any(|event| {
            matches!(event.kind, EventKind::Command { source: Source::Bus(_), command: Command::Acknowledge(_), .. })
        });
        let was_standby = self.standby;
        for event in &engine.outputs.events {
            if let EventKind::Command { command: Command::Poll { standby }, .. } = event.kind {
                self.standby = standby;
            }
        }
        if let Some(kept) = kept {
            if ticket.is_some() {
                // The process was killed before the commit reached the disk. Frames that wait for the commit were not
                // sent.
                self.check_sent(now_ns, asleep, was_standby);
                self.discard(&self.state());
                self.generation += 1;
                fs::rename(kept, self.state()).unwrap();
                self.standby = was_standby;
                self.counts.faults += 1;
                self.start();
                return;
            }
            fs::remove_dir_all(kept).unwrap();
        }
        if let RecordKind::Frame { frame, .. } = &record.kind
            && frame.id() == CanId::Standard(0x6B3)
            && executed
        {
            assert!(!self.recorded.contains(frame), "a recorded command was executed again");
            self.recorded.push_back(*frame);
            self.recorded.drain(..self.recorded.len().saturating_sub(200));
            self.counts.commands += 1;
        }
        if ticket.is_some() {
            self.settle(now);
        }
        self.check_sent(now_ns, asleep, was_standby && self.standby);
    }

    fn settle(&mut self, now: Timestamp) {
        let Some(engine) = &mut self.engine else { return };
        let Some(progress) = engine.settle_store(now) else { return };
        if !self.tampered {
            assert!(progress.works, "the store works: {progress:?}");
        }
        self.rows = progress.rows;
        self.counts.commits = self.counts.commits.max(progress.commits);
    }

    fn check_sent(&mut self, now_ns: i64, is_asleep: bool, is_standby: bool) {
        while let Some(frame) = self.unchecked.pop_front().or_else(&mut self.next_frame) {
            self.counts.frames += 1;
            let CanId::Standard(id) = frame.id() else { panic!("{:?} was sent", frame.id()) };
            assert!(ALLOWED.contains(&id), "{id:#X} was sent");
            if let Some(freshness) = self.freshness_of(id, &frame) {
                assert!(freshness > self.freshness, "freshness {freshness} after {}", self.freshness);
                self.freshness = freshness;
            }
            assert!(
                !(is_asleep && CYCLIC.contains(&id)),
                "{id:#X} was sent on a sleeping bus, {} steps",
                self.silent_steps
            );
            assert!(!(is_standby && id == 0x79B), "a request was sent in standby");
            let times = if id == ALARM { &mut self.alarms } else { &mut self.requests };
            if id == ALARM || id == 0x79B {
                times.push_back(now_ns);
            }
        }
        for (times, limit) in [(&mut self.alarms, 121), (&mut self.requests, 11)] {
            while times.front().is_some_and(|first| *first <= now_ns - 1_000_000_000 || *first > now_ns) {
                times.pop_front();
            }
            assert!(times.len() <= limit, "{} frames in a second", times.len());
        }
    }

    /// Freshness of an authenticated frame that was sent.
    fn freshness_of(&mut self, id: u16, frame: &Frame) -> Option<u64> {
        match id {
            0x6B6 => {
                // An announcement contains the freshness of the next command. Two announcements may contain the same
                // value.
                self.sender.hear(frame);
                None
            }
            0x6B0 => {
                let authentication = Authentication { profile: Profile::Fd, data_id: 0x0323 };
                let sent = authentication.sent_freshness(frame.data())?;
                let span = 1 << Profile::Fd.freshness_bits();
                let base = self.freshness / span * span;
                let found = [base + sent, base + span + sent].into_iter().find(|freshness| {
                    let input = authentication.mac_input(frame.data(), *freshness);
                    input.is_some_and(|input| authentication.has_mac(frame.data(), key().mac(input.bytes())))
                });
                Some(found.expect("a status frame has a valid authenticator"))
            }
            _ => None,
        }
    }

    fn check(&self) {
        let Some(engine) = &self.engine else { return };
        for estimate in engine.monitor.latest().flatten() {
            assert!((0.0..=1.0).contains(&estimate.soc), "{estimate:?}");
            assert!(estimate.soc_std.is_finite() && estimate.soc_std > 0.0, "{estimate:?}");
            assert!(estimate.capacity_ah.is_finite() && estimate.capacity_ah > 0.0, "{estimate:?}");
            assert!(estimate.capacity_std_ah.is_finite() && estimate.capacity_std_ah > 0.0, "{estimate:?}");
        }
    }

    fn step(&mut self) {
        self.counts.steps += 1;
        self.silent_steps += 1;
        self.drive();
        let is_cut = self.dice.one_in(500);
        self.now_ns += STEP_NS;
        self.give(&Record::tick(self.now()), is_cut);
        let now = self.now();
        if let Some(engine) = &mut self.engine {
            engine.poll_store(now);
        }
        self.settle(now);
        self.check();
        self.replay_in = self.replay_in.saturating_sub(1);
        if self.replay_in == 1 {
            self.send_recorded();
        }
        if self.dice.one_in(100) {
            self.fault();
        }
    }

    /// Sends the frames of the vehicle. A frame may be lost or repeated.
    fn drive(&mut self) {
        if self.dice.one_in(200) {
            self.current_a = [0.0, 0.0, 2.6, -2.6, 5.0, -1.0][self.dice.below(6) as usize];
        }
        self.soc = (self.soc - self.current_a * 0.1 / 3600.0 * 20.0 / 2.6).clamp(0.02, 0.98);
        if self.now_ns < self.silent_until {
            return;
        }
        let voltage_v = 3.3 + 0.8 * self.soc - 0.03 * self.current_a;
        let mut values = vec![
            (Channel::Current, Some(self.current_a)),
            (Channel::Temperature(SensorIndex(0)), Some(self.temperature_c)),
        ];
        values.extend((0..3).map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(voltage_v))));
        let mut made = Vec::new();
        self.encoder.encode(&values, &mut made);
        for (_, frame) in made {
            let copies = match self.dice.below(50) {
                0 => 0,
                1 => 3,
                _ => 1,
            };
            for _ in 0..copies {
                let is_cut = self.dice.one_in(2000);
                self.give(&Record::frame(self.now(), BUS, &frame), is_cut);
            }
        }
    }

    /// Injects a fault, a command or another rare event.
    fn fault(&mut self) {
        self.counts.faults += 1;
        let time = self.now();
        match self.dice.below(16) {
            0 => self.silent_until = self.now_ns + [3, 30, 300][self.dice.below(3) as usize] * 1_000_000_000,
            1 => self.temperature_c = [10.0, 25.0, 55.0][self.dice.below(3) as usize],
            2 => {
                self.now_ns += [1, 60, 7200][self.dice.below(3) as usize] * 1_000_000_000;
                self.silent_steps = 0;
            }
            3 => {
                self.now_ns -= [300_000_000, 5_000_000_000][self.dice.below(2) as usize];
                self.silent_steps = 0;
            }
            4 => {
                let event = [BusEvent::Up, BusEvent::Down, BusEvent::SendFailed { frames: 2 }];
                let event = event.into_iter().nth(self.dice.below(3) as usize).expect("three");
                self.give(&Record::bus(time, BUS, event), false);
            }
            5 => self.flood(),
            6 | 7 => {
                if let Some(frame) = self.sender.command() {
                    if self.dice.one_in(3) {
                        self.withheld.push(frame);
                        return;
                    }
                    let is_cut = self.dice.one_in(4);
                    self.give(&Record::frame(time, BUS, &frame), is_cut);
                }
            }
            8 => {
                self.send_recorded();
            }
            9 => {
                let standby = self.dice.one_in(2);
                self.give(&Record::command(time, Command::Poll { standby }), false);
            }
            10 => {
                if let Some(mut engine) = self.engine.take() {
                    engine.close_store(time);
                }
                assert!(self.state().join("packwatch.db").exists() || self.tampered, "a clean end keeps the store");
                self.start();
            }
            11 | 12 => {
                self.kill();
                self.start();
            }
            13 => {
                self.kill();
                self.flip();
                self.start();
            }
            14 => self.lose_file(),
            _ => {
                let frame = Frame::classic(CanId::Standard(0x7DF), &[2, 1, 0, 0, 0, 0, 0, 0]).expect("short");
                self.give(&Record::frame(time, BUS, &frame), false);
            }
        }
    }

    /// Sends the newest commands that the daemon must reject.
    fn send_recorded(&mut self) {
        for frame in self.recorded.clone().iter().rev().take(20) {
            self.counts.replays += 1;
            self.give(&Record::frame(self.now(), BUS, frame), false);
        }
    }

    /// Sends first frames of multi-frame answers that are never completed, and answers without a request.
    fn flood(&mut self) {
        for n in 0..300_u16 {
            let data =
                if n % 2 == 0 { [0x10, 9, 0x61, 1, 0x20, 0x20, 0, 0] } else { [4, 0x61, 1, 0x20, 0x10, 0, 0, 0] };
            let frame = Frame::classic(CanId::Standard(0x7BB), &data).expect("short");
            self.give(&Record::frame(self.now(), BUS, &frame), false);
            self.now_ns += 1_000_000;
        }
    }

    fn flip(&mut self) {
        self.tampered = true;
        let mut files: Vec<_> = fs::read_dir(self.state()).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        let file = &files[self.dice.below(files.len() as u64) as usize];
        let mut bytes = fs::read(file).unwrap();
        if !bytes.is_empty() {
            let place = self.dice.below(bytes.len() as u64) as usize;
            bytes[place] ^= 1 << self.dice.below(8);
            fs::write(file, bytes).unwrap();
        }
    }

    /// Deletes or replaces the database while the process runs. The store must not report success for a file that no
    /// longer has this name.
    fn lose_file(&mut self) {
        self.tampered = true;
        let database = self.state().join("packwatch.db");
        let _ = fs::remove_file(&database);
        if self.dice.one_in(2) {
            fs::write(&database, "another file").unwrap();
        }
        let now = self.now();
        let Some(engine) = &mut self.engine else { return };
        let before = engine.settle_store(now).expect("a store").commits;
        engine.write_checkpoint(now);
        let progress = engine.settle_store(now).expect("a store");
        let status = engine.store_status().expect("a store");
        let is_database = fs::read(&database).is_ok_and(|bytes| bytes.starts_with(b"SQLite format 3"));
        let is_honest = progress.was_replaced || !progress.works || progress.commits > before;
        assert!(is_honest && (status.works != Some(true) || is_database), "{progress:?} {status:?}");
    }
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        // The process may delete one of its files during the copy.
        let _ = fs::copy(&path, to.join(path.file_name().unwrap()));
    }
}

fn live(seed: u64, steps: u64) -> Counts {
    let mut world = World::new(seed);
    for step in 0..steps {
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| world.step()));
        if let Err(broken) = result {
            eprintln!("PACKWATCH_SEED={seed}: broken at step {step}, {:?}", world.counts);
            std::panic::resume_unwind(broken);
        }
    }
    std::mem::take(&mut world.counts)
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        let Self { steps, faults, starts, commands, replays, frames, commits } = other;
        self.steps += steps;
        self.faults += faults;
        self.starts += starts;
        self.commands += commands;
        self.replays += replays;
        self.frames += frames;
        self.commits += commits;
    }
}

/// Runs lives with consecutive seeds. Environment: `PACKWATCH_SIMULATE_S` is the duration in seconds (default 20),
/// `PACKWATCH_SIMULATE_JOBS` the number of threads (default 1), `PACKWATCH_SEED` the first seed (default 1).
#[test]
fn simulated_lives_keep_invariants() {
    let number = |name: &str, default: u64| std::env::var(name).map_or(default, |text| text.parse().expect("a number"));
    let (first, seconds) = (number("PACKWATCH_SEED", 1), number("PACKWATCH_SIMULATE_S", 20));
    let jobs = number("PACKWATCH_SIMULATE_JOBS", 1);
    let began = std::time::Instant::now();
    let lives = |job: u64| {
        let (mut total, mut seed) = (Counts::default(), first + job);
        loop {
            total += live(seed, 3000);
            if began.elapsed().as_secs() >= seconds {
                return (total, (seed - first - job) / jobs + 1);
            }
            seed += jobs;
        }
    };
    let (mut total, mut count) = (Counts::default(), 0);
    std::thread::scope(|scope| {
        let running: Vec<_> = (0..jobs).map(|job| scope.spawn(move || lives(job))).collect();
        for thread in running {
            let (of_thread, lives) = thread.join().unwrap_or_else(|broken| std::panic::resume_unwind(broken));
            total += of_thread;
            count += lives;
        }
    });
    let speed = total.steps as f64 * 0.1 / began.elapsed().as_secs_f64();
    eprintln!("{count} lives, {total:?}, {speed:.0} times real time");
    assert!(total.commands > 0 && total.commits > 0 && total.frames > 0, "{total:?}");
}
