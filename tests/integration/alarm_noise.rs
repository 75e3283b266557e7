//! Tests an alarm whose noisy value stays near the threshold for a day. The day's input frames run through the whole
//! core. The alarm must be raised and cleared exactly once. As a control, the same alarm without hysteresis and
//! debounce must flicker.

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
/// The value approaches its threshold in the first hour of the day and leaves it in the last hour (s).
const HOUR_S: f64 = 3600.0;
const SLEEP_GAP_S: f64 = 30.0;
/// Raw values of the alarm states, as `config/packwatch.dbc` defines them.
const ACTIVE: u64 = 1;
const CLEARED: u64 = 2;

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

/// Readings of one second: current in A (positive = discharge), voltage in V, temperature in degrees C.
type Second = (f64, f64, f64);

#[derive(Debug, PartialEq)]
struct Day {
    raised: usize,
    cleared: usize,
    /// Alarm states on the bus, without consecutive duplicates.
    states: Vec<u64>,
    frames: usize,
}

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

/// Simulates a day with one reading per second and the core's ticks between the readings.
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

    /// Expects one raise and one clear. A raised alarm is sent once per second, so the day has more than 70,000 alarm
    /// frames.
    fn assert_quiet(&self) {
        assert_eq!((self.raised, self.cleared), (1, 1));
        assert_eq!(self.states, [ACTIVE, CLEARED], "alarm states on the bus");
        assert!(self.frames > 70_000, "only {} alarm frames in more than 20 hours of a raised alarm", self.frames);
    }

    fn assert_flickers(&self) {
        assert!(self.raised > 200, "raised {} times: too little noise for this test", self.raised);
        assert!(self.raised - self.cleared <= 1);
        assert!(self.states.len() >= self.raised + self.cleared, "every change was sent");
    }
}

/// Approximately normal noise: the sum of twelve uniform numbers, minus 6.
struct Noise(ChaCha8Rng);

impl Noise {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn next(&mut self) -> f64 {
        (0..12).map(|_| f64::from(self.0.next_u32()) / f64::from(u32::MAX)).sum::<f64>() - 6.0
    }
}

/// Scaled distance of the value from its threshold: 1 at both ends of the day. It falls to 0 in the first hour and
/// rises to 1 in the last hour.
fn distance_from_threshold(t: f64) -> f64 {
    let to_end = (f64::from(DAY_S) - t).min(t);
    (1.0 - to_end / HOUR_S).max(0.0)
}

/// Slow variation between -1 and 1, with periods of 17 and 140 minutes.
fn wander(t: f64) -> f64 {
    (0.6 * (t / 160.0).sin() + 0.4 * (t / 1340.0).sin()).clamp(-1.0, 1.0)
}

/// A day with a noisy temperature sensor (standard deviation 0.7 C). The true temperature of the cell is about 40 C at
/// both ends of the day. From one hour after the start to one hour before the end, the true temperature stays within
/// 1 C of the threshold of 50 C.
fn temperature_day(alarm: &str) -> Day {
    let mut noise = Noise::new(1);
    day(configuration(alarm), Rule::TemperatureHigh, |_, t| {
        (0.0, 3.75, 50.0 - 10.0 * distance_from_threshold(t) + wander(t) + 0.7 * noise.next())
    })
}

/// A day with noisy sensors (50 mA, 10 mV). In the first hour, the cell is discharged to 10 % SOC. Its SOC then
/// oscillates around 10 % (amplitude 0.6 %, period four minutes). In the last hour, the cell is charged.
fn soc_day(alarm: &str) -> Day {
    let (mut noise, mut soc) = (Noise::new(2), 0.3);
    day(configuration(alarm), Rule::SocLow, |config, t| {
        let model = &config.model;
        let target = 0.1 + 0.2 * distance_from_threshold(t) + 0.006 * (t / 40.0).sin();
        let current_a = (soc - target) * model.capacity_ah * 3600.0;
        soc = soc_after(soc, current_a, model.capacity_ah);
        // The RC branches (together 0.025 ohm) have settled at this current.
        let place = model.grid_position(soc, 25.0);
        let voltage_v = terminal_v(model, &place, 1.0, 0.025 * current_a, current_a);
        (current_a + 0.05 * noise.next(), voltage_v + 0.01 * noise.next(), 25.0)
    })
}

#[test]
fn noisy_temperature_near_threshold_raises_once() {
    let alarm = "rule = \"temperature_high\"\nwarning = { set = 50.0, clear = 46.0 }\ndebounce_s = 10.0\n";
    temperature_day(alarm).assert_quiet();
}

#[test]
fn noisy_temperature_without_hysteresis_flickers() {
    temperature_day("rule = \"temperature_high\"\nwarning = 50.0\nhysteresis = 0.0\n").assert_flickers();
}

#[test]
fn noisy_soc_near_threshold_raises_once() {
    soc_day("rule = \"soc_low\"\nwarning = \"10 %\"\nhysteresis = 0.03\ndebounce_s = 10.0\n").assert_quiet();
}

#[test]
fn noisy_soc_without_hysteresis_flickers() {
    soc_day("rule = \"soc_low\"\nwarning = \"10 %\"\nhysteresis = 0.0\n").assert_flickers();
}
