//! Measures how much a restart changes the estimates: compares a run that is killed, or loses power, with an
//! uninterrupted run.
//!
//! The input is days of the simulated electric car. The state is stored every second, as the daemon does. At random
//! times a second monitor starts from an older state and misses the frames of the downtime. Then it receives the same
//! frames as the first monitor.

use std::collections::VecDeque;
use std::path::Path;

use packwatch::can::Frame;
use packwatch::can::encode::InputEncoder;
use packwatch::config;
use packwatch::filter::ScalarGaussian;
use packwatch::monitor::{Downtime, EventKind, Monitor, MonitorConfig, Outputs, Record, Snapshot};
use packwatch::quantity::{BusIndex, CellIndex, Channel, Mode, SensorIndex, Timestamp};
use packwatch::sim::{Pack, Scenario, Settings, Simulation, Wiring};

/// Eight cells show the differences between cells and leave time for many cases.
const CELLS: u16 = 8;
/// Rest with the bus awake after each drive (s).
const REST_S: u32 = 900;
/// Half-width of the 95 % interval of a normal distribution.
const SIGMAS: f64 = 1.96;

fn configuration() -> MonitorConfig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example.toml");
    let mut config = config::load(&path).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n"))).monitor;
    config.sample.cells = CELLS;
    config.sample.sensor_of_cell.truncate(usize::from(CELLS));
    config
}

struct Draw(u64);

impl Draw {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }

    /// Approximately normal with unit standard deviation.
    fn noise(&mut self) -> f64 {
        (0..12).map(|_| self.next()).sum::<f64>() - 6.0
    }
}

struct Live {
    monitor: Monitor,
    out: Outputs,
}

impl Live {
    fn new(config: &MonitorConfig) -> Self {
        Self { monitor: Monitor::new(config.clone()), out: Outputs::default() }
    }

    fn restored(config: &MonitorConfig, snapshot: Snapshot) -> Self {
        let mut live = Self::new(config);
        live.monitor.restore(snapshot, Downtime::AsStamped).expect("fits");
        live
    }

    fn take(&mut self, time: Timestamp, frames: &[(BusIndex, Frame)]) {
        while let Some(due) = self.monitor.next_due().filter(|due| *due <= time) {
            self.give(Record::tick(due));
        }
        for (bus, frame) in frames {
            self.give(Record::frame(time, *bus, frame));
        }
    }

    fn give(&mut self, record: Record) {
        self.out.clear();
        self.monitor.handle(&record, &mut self.out);
    }

    /// Time, SOC and SOC standard deviation of a cell's last estimate.
    fn soc(&self, cell: usize) -> Option<(Timestamp, f64, f64)> {
        let latest = self.monitor.latest().nth(cell)??;
        Some((latest.time, latest.soc, latest.soc_std))
    }
}

type Moment = (Timestamp, Vec<(Channel, Option<f64>)>);

/// Readings of a day: ten currents and one round of cell voltages per second.
fn day(config: &MonitorConfig, seed: u64) -> Vec<Moment> {
    let mut settings = Settings {
        seed,
        current_period_ns: 100_000_000,
        cell_period_ns: 1_000_000_000,
        duration_s: Some(40_000.0),
        ..Settings::of(Scenario::EvDay, config.model.capacity_ah)
    };
    settings.pack.cells = CELLS;
    let strings = config.sample.strings;
    let mut sim = Simulation::new(config.model.clone(), settings, Wiring { strings, temperature_at: vec![None; 8] });
    let (mut moments, mut noise) = (Vec::<Moment>::new(), Draw(seed));
    let (mut before, mut shift_s) = (sim.pack().clone(), 0.0);
    while let Some(moment) = sim.advance() {
        let time = moment.time.plus_secs(shift_s);
        if let Some((last, _)) = moments.last()
            && time.since(*last) > 1.0
        {
            let last = *last;
            rest(&mut before, last, &mut noise, &mut moments);
            shift_s += f64::from(REST_S);
        }
        moments.push((moment.time.plus_secs(shift_s), sim.readings().to_vec()));
        if moment.cells_sampled {
            before = sim.pack().clone();
        }
    }
    moments
}

fn rest(pack: &mut Pack, from: Timestamp, noise: &mut Draw, moments: &mut Vec<Moment>) {
    for second in 1..=REST_S {
        pack.step(0.0, 1.0);
        for tenth in 0..10 {
            let time = from.plus_secs(f64::from(second) + 0.1 * f64::from(tenth));
            let mut readings = vec![(Channel::Current, Some(0.02 * noise.noise()))];
            if tenth == 0 {
                readings.extend((0..8).map(|sensor| (Channel::Temperature(SensorIndex(sensor)), Some(25.0))));
                let voltages = pack.voltages_v(0.0).map(|voltage_v| voltage_v + 0.001 * noise.noise());
                readings.extend((0..).map(|cell| Channel::CellVoltage(CellIndex(cell))).zip(voltages.map(Some)));
            }
            moments.push((time, readings));
        }
    }
}

/// A state as the daemon stores it, and the learned capacities of the monitor.
#[derive(Clone)]
struct State {
    snapshot: Snapshot,
    learned: Vec<ScalarGaussian>,
}

fn learned(monitor: &Monitor) -> Vec<ScalarGaussian> {
    (0..CELLS).map(|cell| monitor.capacity(CellIndex(cell))).collect()
}

struct Case {
    live: Live,
    until: Timestamp,
    mode: Mode,
    /// Per cell, at the first estimate after the restart: SOC difference from the uninterrupted run, and the stated
    /// standard deviation. `largest` is the largest difference until the end.
    first: Vec<Option<(f64, f64)>>,
    largest: Vec<f64>,
    /// Whether every restored capacity was bit-identical to the stored one.
    kept_learned: bool,
}

/// How the restart times are chosen: mean interval, age of the restored state, and downtime (s).
struct Plan {
    every_s: f64,
    state_age_s: (f64, f64),
    away_s: (f64, f64),
}

fn run(config: &MonitorConfig, seed: u64, plan: &Plan) -> Vec<Case> {
    let encoder = InputEncoder::new(&config.input);
    let (mut whole, mut draw) = (Live::new(config), Draw(0x9E37_79B9 ^ seed));
    let (mut states, mut waiting): (VecDeque<State>, Vec<(Timestamp, Mode, State)>) = Default::default();
    let (mut active, mut done): (Vec<Case>, Vec<Case>) = Default::default();
    let (mut next_kill, mut frames) = (Timestamp::from_secs(600.0), Vec::new());
    for (time, readings) in day(config, seed) {
        frames.clear();
        encoder.encode(&readings, &mut frames);
        whole.take(time, &frames);
        start_waiting(config, time, &mut waiting, &mut active);
        for case in &mut active {
            case.live.take(time, &frames);
            case.compare(&whole);
        }
        let (over, still): (Vec<_>, Vec<_>) = active.into_iter().partition(|case| time >= case.until);
        (active, done) = (still, done.into_iter().chain(over).collect());
        if states.back().is_none_or(|last| time.since(last.snapshot.time) >= 1.0) {
            states.push_back(State { snapshot: whole.monitor.snapshot(), learned: learned(&whole.monitor) });
            if states.len() > 61 {
                states.pop_front();
            }
        }
        if time >= next_kill {
            next_kill = time.plus_secs(plan.every_s * draw.between(0.5, 1.5));
            let age_s = draw.between(plan.state_age_s.0, plan.state_age_s.1);
            let mode = whole.monitor.mode();
            let state = states.iter().rev().find(|state| time.since(state.snapshot.time) >= age_s - 1.0);
            if let Some(state) = state {
                let up = time.plus_secs(draw.between(plan.away_s.0, plan.away_s.1));
                waiting.push((up, mode, state.clone()));
            }
        }
    }
    done
}

fn start_waiting(
    config: &MonitorConfig,
    time: Timestamp,
    waiting: &mut Vec<(Timestamp, Mode, State)>,
    active: &mut Vec<Case>,
) {
    let (up, still): (Vec<_>, Vec<_>) = waiting.drain(..).partition(|(up, ..)| time >= *up);
    *waiting = still;
    for (up, mode, state) in up {
        // The next readings came more than 1 s after the restart, because the bus had fallen asleep. Another test
        // covers this case.
        if time.since(up) > 1.0 {
            continue;
        }
        let mut live = Live::restored(config, state.snapshot);
        live.give(Record::tick(time));
        active.push(Case {
            // If the downtime completes a half-cycle, the monitor learns a new capacity immediately, so that the
            // capacities may differ.
            kept_learned: learned(&live.monitor) == state.learned
                || live.out.events.iter().any(|event| matches!(event.kind, EventKind::Capacity { .. })),
            live,
            until: time.plus_secs(60.0),
            mode,
            first: vec![None; usize::from(CELLS)],
            largest: vec![0.0; usize::from(CELLS)],
        });
    }
}

impl Case {
    fn compare(&mut self, whole: &Live) {
        for cell in 0..usize::from(CELLS) {
            let (Some((time, soc, std)), Some((at, wanted, _))) = (self.live.soc(cell), whole.soc(cell)) else {
                continue;
            };
            if time != at {
                continue;
            }
            self.first[cell].get_or_insert((soc - wanted, std));
            self.largest[cell] = self.largest[cell].max((soc - wanted).abs());
        }
    }
}

struct Figures {
    restarts: usize,
    compared: usize,
    covered: f64,
    worst_first: f64,
    worst_later: f64,
}

impl Figures {
    fn of(name: &str, cases: &[&Case]) -> Self {
        let first: Vec<(f64, f64)> = cases.iter().flat_map(|case| case.first.iter().flatten().copied()).collect();
        let covered = first.iter().filter(|(error, std)| error.abs() <= SIGMAS * std).count();
        let worst =
            |errors: &mut dyn Iterator<Item = f64>| errors.fold(0.0, |worst: f64, error| worst.max(error.abs()));
        let figures = Self {
            restarts: cases.len(),
            compared: first.len(),
            covered: covered as f64 / first.len() as f64,
            worst_first: worst(&mut first.iter().map(|(error, _)| *error)),
            worst_later: worst(&mut cases.iter().flat_map(|case| case.largest.iter().copied())),
        };
        let rms = (first.iter().map(|(error, _)| error * error).sum::<f64>() / first.len() as f64).sqrt();
        let std = first.iter().map(|(_, std)| std).sum::<f64>() / first.len() as f64;
        println!(
            "{name}: {} restarts, {} first estimates: {:.1} % within 95 %, error {:.3} % RMS and {:.3} % at worst (later {:.3} %), \
             deviation {:.3} %",
            figures.restarts,
            figures.compared,
            100.0 * figures.covered,
            100.0 * rms,
            100.0 * figures.worst_first,
            100.0 * figures.worst_later,
            100.0 * std,
        );
        figures
    }
}

#[test]
fn kill_during_drive_costs_little_soc_accuracy() {
    let config = configuration();
    let plan = Plan { every_s: 60.0, state_age_s: (0.0, 1.0), away_s: (1.0, 3.0) };
    let cases: Vec<Case> = (1..=2).flat_map(|seed| run(&config, seed, &plan)).collect();
    let driving: Vec<&Case> = cases.iter().filter(|case| case.mode == Mode::Discharge).collect();
    let figures = Figures::of("killed in a drive", &driving);
    assert!(figures.restarts >= 150 && figures.compared == figures.restarts * usize::from(CELLS));
    assert!(figures.worst_first.max(figures.worst_later) <= 0.002, "SOC difference from the first estimate on");
    assert!(cases.iter().all(|case| case.kept_learned));
}

#[test]
fn interval_after_power_cut_covers_loss() {
    let config = configuration();
    let plan = Plan { every_s: 80.0, state_age_s: (0.0, 60.0), away_s: (60.0, 200.0) };
    let cases: Vec<Case> = (1..=2).flat_map(|seed| run(&config, seed, &plan)).collect();
    for mode in [Mode::Discharge, Mode::Charge, Mode::Rest] {
        let of_mode: Vec<&Case> = cases.iter().filter(|case| case.mode == mode).collect();
        let figures = Figures::of(&format!("power cut, {mode:?}"), &of_mode);
        assert!(figures.restarts >= 15 && figures.covered >= 0.93);
    }
    let figures = Figures::of("power cut, all", &cases.iter().collect::<Vec<_>>());
    assert!(figures.restarts >= 200 && figures.covered >= 0.95);
    assert!(cases.iter().all(|case| case.kept_learned));
}

/// Simulates a drive, a downtime of `hours` that uses the fraction `used` of the capacity, and a rest. Returns SOC
/// error and stated standard deviation of each cell after each reading.
fn drive_after_downtime(config: &MonitorConfig, hours: f64, used: f64, seed: u64) -> Vec<(f64, f64)> {
    let encoder = InputEncoder::new(&config.input);
    let (mut live, mut noise, mut frames) = (Live::new(config), Draw(seed), Vec::new());
    let mut pack = Pack::new(
        config.model.clone(),
        Settings { seed, ..Settings::of(Scenario::EvDay, config.model.capacity_ah) }.pack,
        seed,
    );
    let mut second = |live: &mut Live, pack: &mut Pack, t: f64, current_a: f64| {
        pack.step(current_a, 1.0);
        for tenth in 0..10 {
            let mut readings =
                vec![(Channel::Current, Some(f64::from(config.sample.strings) * current_a + 0.005 * noise.noise()))];
            if tenth == 5 {
                readings.extend((0..8).map(|sensor| (Channel::Temperature(SensorIndex(sensor)), Some(25.0))));
                let voltages = pack.voltages_v(current_a).take(usize::from(CELLS)).map(|v| v + 0.001 * noise.noise());
                readings.extend((0..).map(|cell| Channel::CellVoltage(CellIndex(cell))).zip(voltages.map(Some)));
            }
            frames.clear();
            encoder.encode(&readings, &mut frames);
            live.take(Timestamp::from_secs(t + 0.1 * f64::from(tenth)), &frames);
        }
    };
    for t in 0..2400 {
        let current_a = if t < 1800 { 1.3 * (f64::from(t) * 0.1).sin().max(-0.3) } else { 0.0 };
        second(&mut live, &mut pack, f64::from(t), current_a);
    }
    let off_s = hours * 3600.0;
    let current_a = used * config.model.capacity_ah * 3600.0 / (0.5 * off_s);
    for part in 0..200 {
        pack.step(if part < 100 { current_a } else { 0.0 }, off_s / 200.0);
    }
    let mut live = Live::restored(config, live.monitor.snapshot());
    let mut seen = Vec::new();
    for t in 0..120 {
        second(&mut live, &mut pack, 2400.0 + off_s + f64::from(t), 0.0);
        for cell in 0..usize::from(CELLS) {
            let (_, soc, std) = live.soc(cell).expect("an estimate");
            seen.push((soc - pack.cells()[cell].soc, std));
        }
    }
    seen
}

#[test]
fn charge_used_during_downtime_is_found_at_rest() {
    let config = configuration();
    for (hours, used, bar) in [(8.0, 0.2, 0.02), (8.0, -0.1, 0.05), (1.0, 0.2, 0.03), (1000.0, 0.2, 0.02)] {
        for seed in [3, 4] {
            let seen = drive_after_downtime(&config, hours, used, seed);
            let covered = seen.iter().filter(|(error, std)| error.abs() <= SIGMAS * std).count();
            let worst = |reading: usize| {
                let cells = usize::from(CELLS);
                seen[cells * reading..cells * (reading + 1)].iter().fold(0.0, |worst: f64, (e, _)| worst.max(e.abs()))
            };
            println!(
                "{hours} h off, {:.0} % used: error {:.2} % after the first reading, {:.2} % after 10 and {:.2} % after 60; \
                 {:.1} % within 95 %",
                100.0 * used,
                100.0 * worst(0),
                100.0 * worst(9),
                100.0 * worst(59),
                100.0 * covered as f64 / seen.len() as f64,
            );
            assert!(worst(0) <= bar && worst(59) <= 0.01, "{hours} h, {used}");
            assert!(covered as f64 >= 0.95 * seen.len() as f64);
        }
    }
}

#[test]
fn longer_downtime_never_reduces_deviation() {
    let config = configuration();
    let mut before = 0.0;
    for hours in [0.01, 0.1, 1.0, 8.0, 100.0, 1000.0, 10_000.0] {
        let std = drive_after_downtime(&config, hours, 0.0, 5)[0].1;
        println!("{hours} h off, nothing used: deviation {:.2} % after the first reading", 100.0 * std);
        assert!(std >= before, "{hours} h: {std} after {before}");
        before = std;
    }
}
