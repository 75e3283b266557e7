//! A value that wanders round its threshold with noise for 24 hours, through the whole core from input frames to alarm
//! frames: one raise and one clear, in the events and on the wire. The same day without hysteresis and debounce must
//! flicker, or it would show nothing.

use std::path::Path;

use packwatch::alarm::{Change, Rule};
use packwatch::can::CanId;
use packwatch::can::encode::{InputEncoder, default_database};
use packwatch::can::signal::SignalPlan;
use packwatch::cell::circuit::{soc_after, terminal_v};
use packwatch::config::{self, ConfigFiles};
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{EventKind, Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS};
use packwatch::quantity::{CellIndex, Channel, SensorIndex, Timestamp};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const DAY_S: u32 = 86_400;
/// The value comes down to its threshold (or up to it) in the first hour and leaves it in the last.
const HOUR_S: f64 = 3600.0;
const SLEEP_GAP_S: f64 = 30.0;
/// States of an alarm on the wire, as `config/packwatch.dbc` has them.
const ACTIVE: u64 = 1;
const CLEARED: u64 = 2;

/// One cell as `config/paper.toml` has it, and the alarm under test.
fn configuration(alarm: &str) -> MonitorConfig {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let paper = std::fs::read_to_string(folder.join("paper.toml")).unwrap();
    let text = format!("{paper}\n[[alarm]]\n{alarm}");
    let read = |path: &Path| match path.file_name().and_then(|name| name.to_str()) {
        Some("noise.toml") => Ok(text.clone().into_bytes()),
        _ => std::fs::read(path),
    };
    config::load_with(&ConfigFiles::alone(&folder.join("noise.toml")), &read)
        .unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")))
        .monitor
}

/// What one second's frame says: current in A (positive = discharge), voltage in V, temperature in degrees C.
type Second = (f64, f64, f64);

/// The life of an alarm in a day.
#[derive(Debug, PartialEq)]
struct Day {
    raised: usize,
    cleared: usize,
    /// States of the rule's alarm frames, one of each run of equal ones.
    states: Vec<u64>,
    frames: usize,
}

/// The rule's number and the state of an alarm frame, read with the shipped DBC.
struct AlarmReader {
    id: CanId,
    rule: SignalPlan,
    state: SignalPlan,
}

impl AlarmReader {
    fn new() -> Self {
        let database = default_database().unwrap();
        let message = database.message("PACKWATCH_Alarm").unwrap();
        let plan = |name| message.signal(name).unwrap().layout.plan().unwrap();
        Self { id: message.id, rule: plan("Rule"), state: plan("State") }
    }
}

/// A day at a frame a second, with the driver's ticks between them.
fn day(config: MonitorConfig, rule: Rule, mut second: impl FnMut(&MonitorConfig, f64) -> Second) -> Day {
    let reader = AlarmReader::new();
    let encoder = InputEncoder::new(&config.input);
    let mut monitor = Monitor::new(config.clone());
    let (mut ticks, mut out, mut frames) = (Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S), Outputs::default(), Vec::new());
    let mut day = Day { raised: 0, cleared: 0, states: Vec::new(), frames: 0 };
    for t in (0..DAY_S).map(f64::from) {
        let (current_a, voltage_v, temperature_c) = second(&config, t);
        let values = [
            (Channel::Current, Some(current_a)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
            (Channel::Temperature(SensorIndex(0)), Some(temperature_c)),
        ];
        frames.clear();
        encoder.encode(&values, &mut frames);
        let time = Timestamp::from_secs(t);
        ticks.advance(time);
        while let Some(time) = ticks.pop(monitor.next_due()) {
            monitor.handle(&Record::tick(time), &mut out);
        }
        for (bus, frame) in &frames {
            monitor.handle(&Record::frame(time, *bus, frame), &mut out);
        }
        day.take(rule, &reader, &out);
        out.clear();
    }
    day
}

impl Day {
    fn take(&mut self, wanted: Rule, reader: &AlarmReader, out: &Outputs) {
        for event in &out.events {
            match event.kind {
                EventKind::Alarm { rule, change: Change::Raised, .. } if rule == wanted => self.raised += 1,
                EventKind::Alarm { rule, change: Change::Cleared, .. } if rule == wanted => self.cleared += 1,
                _ => {}
            }
        }
        let alarms = out.frames.iter().map(|sent| &sent.frame).filter(|frame| frame.id() == reader.id);
        for frame in alarms.filter(|frame| reader.rule.raw(frame.data()) == Ok(u64::from(wanted as u8))) {
            let state = reader.state.raw(frame.data()).unwrap();
            self.frames += 1;
            if self.states.last() != Some(&state) {
                self.states.push(state);
            }
        }
    }

    /// Once, and in each period of 1 s in between a frame that says so.
    fn assert_quiet(&self) {
        assert_eq!((self.raised, self.cleared), (1, 1));
        assert_eq!(self.states, [ACTIVE, CLEARED], "on the wire");
        assert!(self.frames > 70_000, "{} frames in the 20 hours and more in which it was raised", self.frames);
    }

    fn assert_flickers(&self) {
        assert!(self.raised > 200, "raised {} times: the day is too quiet to show anything", self.raised);
        assert!(self.raised - self.cleared <= 1);
        assert!(self.states.len() >= self.raised + self.cleared, "each of them went out");
    }
}

/// Standard normal noise, near enough: the sum of twelve uniform numbers.
struct Noise(ChaCha8Rng);

impl Noise {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn next(&mut self) -> f64 {
        (0..12).map(|_| f64::from(self.0.next_u32()) / f64::from(u32::MAX)).sum::<f64>() - 6.0
    }
}

/// 0 in the middle of the day, 1 at its ends: how far the value is from its threshold.
fn away(t: f64) -> f64 {
    let to_end = (f64::from(DAY_S) - t).min(t);
    (1.0 - to_end / HOUR_S).max(0.0)
}

/// Slow wandering, -1 to 1, with periods of 17 and 140 minutes.
fn wander(t: f64) -> f64 {
    (0.6 * (t / 160.0).sin() + 0.4 * (t / 1340.0).sin()).clamp(-1.0, 1.0)
}

/// A sensor of 0.7 degrees of noise whose cell is at 50 C, 1 C more or less, for all the day, and at 40 C at its ends.
fn temperature_day(alarm: &str) -> Day {
    let mut noise = Noise::new(1);
    day(configuration(alarm), Rule::TemperatureHigh, |_, t| {
        (0.0, 3.75, 50.0 - 10.0 * away(t) + wander(t) + 0.7 * noise.next())
    })
}

/// A cell that is discharged to 10 % in the first hour, kept there, 0.6 % more or less every four minutes, and charged in
/// the last. Both sensors are noisy (50 mA, 10 mV); the estimate, which the filter makes smooth, is what the rule compares.
fn soc_day(alarm: &str) -> Day {
    let (mut noise, mut soc) = (Noise::new(2), 0.3);
    day(configuration(alarm), Rule::SocLow, |config, t| {
        let model = &config.model;
        let target = 0.1 + 0.2 * away(t) + 0.006 * (t / 40.0).sin();
        // The charge that leads there in this second.
        let current_a = (soc - target) * model.capacity_ah * 3600.0;
        soc = soc_after(soc, current_a, model.capacity_ah);
        // Branch in balance with the current.
        let place = model.grid_position(soc, 25.0);
        let voltage_v = terminal_v(model, &place, 1.0, 0.025 * current_a, current_a);
        (current_a + 0.05 * noise.next(), voltage_v + 0.01 * noise.next(), 25.0)
    })
}

#[test]
fn a_noisy_temperature_round_its_threshold_raises_and_clears_once_in_a_day() {
    let alarm = "rule = \"temperature_high\"\nwarning = { set = 50.0, clear = 46.0 }\ndebounce_s = 10.0\n";
    temperature_day(alarm).assert_quiet();
}

#[test]
fn the_same_temperature_flickers_without_hysteresis_and_debounce() {
    temperature_day("rule = \"temperature_high\"\nwarning = 50.0\nhysteresis = 0.0\n").assert_flickers();
}

#[test]
fn a_noisy_state_of_charge_round_its_threshold_raises_and_clears_once_in_a_day() {
    soc_day("rule = \"soc_low\"\nwarning = \"10 %\"\nhysteresis = 0.03\ndebounce_s = 10.0\n").assert_quiet();
}

#[test]
fn the_same_state_of_charge_flickers_without_hysteresis_and_debounce() {
    soc_day("rule = \"soc_low\"\nwarning = \"10 %\"\nhysteresis = 0.0\n").assert_flickers();
}
