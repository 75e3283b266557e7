//! Simulates one life: an ageing cell, its usage, its sensors, a slightly wrong model, and a Monitor.
//!
//! With every sensor set, the same life (cell, usage, model errors) is simulated. Only the size of the sensor errors
//! differs.

use std::path::Path;

use packwatch::alarm::{Change, Severity};
use packwatch::can::encode::InputEncoder;
use packwatch::cell::CellModel;
use packwatch::config::{self, ConfigFiles};
use packwatch::monitor::{EventKind, Monitor, MonitorConfig, Outputs, Record};
use packwatch::quantity::catalogue::Quantity;
use packwatch::quantity::{CellIndex, Channel, SensorIndex, Timestamp};
use packwatch::sim::{Ageing, Hysteresis, Pack, PackSettings, Settings};

use super::dice::Dice;

pub(crate) const RATED_AH: f64 = 2.6;
/// The alarm threshold and the end of life, as fractions of the rated capacity.
pub(crate) const THRESHOLD: f64 = 0.80;
pub(crate) const END_OF_LIFE: f64 = 0.70;

/// Interval between two readings (s).
const SAMPLE_S: f64 = 10.0;
/// Time between the last reading under one load and the first reading under the next load (s). It is short, so that the
/// charge counted from a reading belongs to the load of that reading.
const SWITCH_S: f64 = 0.1;
/// Ticks per reading. After 5 s without a tick, the Monitor assumes that the computer was suspended.
const TICKS: u32 = 4;
/// Number of half-cycles simulated from the start of the cycle in which an ageing cell reaches its end of life.
const AFTERLIFE: u32 = 4;
/// A constant-voltage charge ends at this current (A).
const TAPER_END_A: f64 = RATED_AH / 10.0;
/// Average charge moved per cycle, relative to the rated capacity.
const MOVED_PER_CYCLE: f64 = 2.0 * 0.55 * 0.85;

const CELL: u64 = 0;
const USAGE: u64 = 1;
const SENSORS: u64 = 2;

/// Accuracy of a sensor set. Offsets and gains are standard deviations over the lives; they are constant within a life.
/// The noise is white.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SensorSet {
    pub(crate) name: &'static str,
    pub(crate) voltage_noise_v: f64,
    pub(crate) voltage_offset_v: f64,
    pub(crate) current_noise_a: f64,
    pub(crate) current_gain: f64,
    pub(crate) current_offset_a: f64,
    pub(crate) temperature_noise_c: f64,
    pub(crate) temperature_offset_c: f64,
    pub(crate) dead_band_a: f64,
}

pub(crate) const SENSOR_SETS: [SensorSet; 3] = [
    SensorSet {
        name: "good",
        voltage_noise_v: 0.001,
        voltage_offset_v: 0.0005,
        current_noise_a: 0.005,
        current_gain: 0.002,
        current_offset_a: 0.002,
        temperature_noise_c: 0.1,
        temperature_offset_c: 0.3,
        dead_band_a: 0.1,
    },
    SensorSet {
        name: "usual",
        voltage_noise_v: 0.005,
        voltage_offset_v: 0.002,
        current_noise_a: 0.020,
        current_gain: 0.005,
        current_offset_a: 0.010,
        temperature_noise_c: 0.3,
        temperature_offset_c: 1.0,
        dead_band_a: 0.1,
    },
    SensorSet {
        name: "poor",
        voltage_noise_v: 0.015,
        voltage_offset_v: 0.005,
        current_noise_a: 0.080,
        current_gain: 0.015,
        current_offset_a: 0.030,
        temperature_noise_c: 1.0,
        temperature_offset_c: 3.0,
        dead_band_a: 0.25,
    },
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Fades below the threshold and reaches the end of life.
    Ageing,
    /// Stays above the threshold.
    Healthy,
}

/// The Monitor's estimate and the true capacity after one half-cycle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Evaluation {
    pub(crate) time: Timestamp,
    /// Cycles since the start of the life (two half-cycles make a cycle).
    pub(crate) cycle: f64,
    /// Moved charge divided by twice the rated capacity.
    pub(crate) full_cycles: f64,
    pub(crate) true_ah: f64,
    pub(crate) mean_ah: f64,
    pub(crate) std_ah: f64,
    /// Whether the half-cycle gave a capacity measurement. If not, no rule is evaluated.
    pub(crate) is_measured: bool,
    /// Changes of the Monitor's own alarms of severity info, warning and severe.
    pub(crate) reported: [Option<Change>; 3],
}

/// Time within a life.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) cycle: f64,
    pub(crate) full_cycles: f64,
}

#[derive(Debug, Clone)]
pub(crate) struct Life {
    pub(crate) evaluations: Vec<Evaluation>,
    pub(crate) crossing: Option<Place>,
    pub(crate) end: Option<Place>,
    pub(crate) resets: u32,
}

/// Ageing: the capacity (fraction of rated) falls from `start` by `loss * x^curvature`. Here x is the moved charge
/// divided by `span_ah`. The resistance grows by `growth * x`.
#[derive(Debug, Clone, Copy)]
struct Fade {
    start: f64,
    loss: f64,
    curvature: f64,
    span_ah: f64,
    growth: f64,
}

impl Fade {
    fn draw(kind: Kind, dice: &mut Dice) -> Self {
        let start = 1.0 + dice.normal(0.02).clamp(-0.05, 0.05);
        let floor = match kind {
            Kind::Ageing => END_OF_LIFE,
            Kind::Healthy => dice.uniform(THRESHOLD + 0.01, 0.95),
        };
        let cycles = dice.uniform(60.0, 150.0);
        Self {
            start,
            loss: (start - floor).max(0.0),
            curvature: dice.uniform(0.7, 1.8),
            span_ah: cycles * MOVED_PER_CYCLE * RATED_AH,
            growth: dice.uniform(0.2, 0.8),
        }
    }

    fn capacity_ah(&self, moved_ah: f64) -> f64 {
        RATED_AH * (self.start - self.loss * libm::pow(moved_ah / self.span_ah, self.curvature))
    }

    /// Average fade and resistance growth per Ah while the next `ah` of charge flows.
    fn ageing(&self, moved_ah: f64, ah: f64) -> Ageing {
        Ageing {
            capacity_loss_ah_per_ah: (self.capacity_ah(moved_ah) - self.capacity_ah(moved_ah + ah)) / ah,
            resistance_growth_per_ah: self.growth / self.span_ah,
            ..Ageing::default()
        }
    }
}

/// The Monitor's configuration, with values from the sensor set's data sheet.
pub(crate) fn configuration(set: &SensorSet) -> MonitorConfig {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let numbers = [
        ("@DEAD_BAND_A@", set.dead_band_a),
        ("@VOLTAGE_NOISE_V@", set.voltage_noise_v),
        ("@CURRENT_GAIN@", set.current_gain),
    ];
    let text = numbers
        .iter()
        .fold(include_str!("study.toml").to_owned(), |text, (name, number)| text.replace(name, &format!("{number:?}")));
    let path = folder.join("study.toml");
    let read = |asked: &Path| if asked == path { Ok(text.clone().into_bytes()) } else { std::fs::read(asked) };
    let config =
        config::load_with(&ConfigFiles::alone(&path), &read).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")));
    config.monitor
}

/// The true cell: the estimator's model changed by a few mV and a few percent.
fn true_model(model: &CellModel, dice: &mut Dice) -> CellModel {
    let mut truth = model.clone();
    let common_v = dice.normal(0.002);
    let offsets_v: Vec<f64> = truth.soc.iter().map(|_| common_v + dice.normal(0.003)).collect();
    for row in &mut truth.ocv_v.values {
        row.iter_mut().zip(&offsets_v).for_each(|(ocv_v, offset_v)| *ocv_v += offset_v);
    }
    let mut scale = |values: &mut Vec<Vec<f64>>, std: f64| {
        let factor = dice.factor(std);
        values.iter_mut().flatten().for_each(|value| *value *= factor);
    };
    scale(&mut truth.r0_ohm.values, 0.05);
    for branch in &mut truth.branches {
        scale(&mut branch.r_ohm.values, 0.10);
        scale(&mut branch.c_farad.values, 0.20);
    }
    truth
}

struct Rig {
    fade: Fade,
    pack: Pack,
    ambient_c: f64,
    usage: Dice,
    sensors: Sensors,
    monitor: Monitor,
    encoder: InputEncoder,
    out: Outputs,
    time: Timestamp,
    half_cycles: u32,
    life: Life,
}

struct Sensors {
    set: SensorSet,
    gain: f64,
    offset_a: f64,
    offset_v: f64,
    offset_c: f64,
    dice: Dice,
}

impl Sensors {
    fn new(set: &SensorSet, seed: u64) -> Self {
        let mut dice = Dice::new(seed, SENSORS);
        Self {
            set: *set,
            gain: dice.normal(set.current_gain),
            offset_a: dice.normal(set.current_offset_a),
            offset_v: dice.normal(set.voltage_offset_v),
            offset_c: dice.normal(set.temperature_offset_c),
            dice,
        }
    }

    fn read(&mut self, current_a: f64, voltage_v: f64, temperature_c: f64) -> [(Channel, Option<f64>); 3] {
        let (set, dice) = (&self.set, &mut self.dice);
        let current_a = current_a * (1.0 + self.gain) + self.offset_a + dice.normal(set.current_noise_a);
        let voltage_v = voltage_v + self.offset_v + dice.normal(set.voltage_noise_v);
        let temperature_c = temperature_c + self.offset_c + dice.normal(set.temperature_noise_c);
        [
            (Channel::Current, Some(current_a)),
            (Channel::Temperature(SensorIndex(0)), Some(temperature_c)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
        ]
    }
}

/// Simulates one life: an ageing cell past its end of life (`AFTERLIFE`), a healthy cell until the charge `span_ah` has
/// been moved.
pub(crate) fn live(config: &MonitorConfig, set: &SensorSet, kind: Kind, seed: u64) -> Life {
    let mut rig = Rig::new(config, set, kind, seed);
    let mut after = 0;
    while after < AFTERLIFE {
        rig.cycle();
        let is_over = match kind {
            Kind::Ageing => rig.life.end.is_some(),
            Kind::Healthy => rig.truth().throughput_ah >= rig.fade.span_ah,
        };
        after += match (is_over, kind) {
            (false, _) => 0,
            (true, Kind::Ageing) => 2,
            (true, Kind::Healthy) => AFTERLIFE,
        };
    }
    rig.life
}

impl Rig {
    fn new(config: &MonitorConfig, set: &SensorSet, kind: Kind, seed: u64) -> Self {
        let mut dice = Dice::new(seed, CELL);
        let fade = Fade::draw(kind, &mut dice);
        let model = true_model(&config.model, &mut dice);
        let ambient_c = dice.uniform(10.0, 35.0);
        let settings = PackSettings {
            capacity_ah: fade.start * RATED_AH,
            initial_soc: dice.uniform(0.4, 0.8),
            hysteresis: Hysteresis { magnitude_v: dice.uniform(0.0, 0.004), ..Hysteresis::default() },
            ambient_c,
            ageing: Ageing::default(),
            ..Settings::of(packwatch::sim::Scenario::Paper, RATED_AH).pack
        };
        Self {
            fade,
            pack: Pack::new(model, settings, seed),
            ambient_c,
            usage: Dice::new(seed, USAGE),
            sensors: Sensors::new(set, seed),
            monitor: Monitor::new(config.clone()),
            encoder: InputEncoder::new(&config.input),
            out: Outputs::default(),
            time: Timestamp::ZERO,
            half_cycles: 0,
            life: Life { evaluations: Vec::new(), crossing: None, end: None, resets: 0 },
        }
    }

    fn truth(&self) -> &packwatch::sim::TruthCell {
        &self.pack.cells()[0]
    }

    fn place(&self) -> Place {
        Place { cycle: f64::from(self.half_cycles) / 2.0, full_cycles: self.truth().throughput_ah / (2.0 * RATED_AH) }
    }

    /// One cycle: discharge, pause, charge, pause. The swing is 30 to 80 % SOC; currents and temperature are random.
    fn cycle(&mut self) {
        let usage = &mut self.usage;
        let (low, high) = (usage.uniform(0.12, 0.38), usage.uniform(0.68, 0.92));
        let (discharge_a, charge_a) = (RATED_AH * usage.uniform(0.3, 1.0), RATED_AH * usage.uniform(0.2, 0.7));
        let pauses_s = [usage.uniform(600.0, 2400.0), usage.uniform(600.0, 2400.0)];
        let ambient_c = (self.ambient_c + usage.normal(4.0)).clamp(5.0, 40.0);
        self.pack.set_ambient(ambient_c);
        self.age();
        let (low_v, high_v) = (self.pack.model().voltage_min_v, self.pack.model().voltage_max_v);
        while self.truth().soc > low && self.pack.lowest_v(discharge_a) > low_v {
            self.step(discharge_a, SAMPLE_S);
        }
        self.half_cycles += 1;
        self.pause(discharge_a, pauses_s[0]);
        self.age();
        let mut current_a = 0.0;
        while self.truth().soc < high {
            current_a = self.pack.current_at_highest_a(high_v).max(-charge_a);
            if current_a > -TAPER_END_A {
                break;
            }
            self.step(current_a, SAMPLE_S);
        }
        self.half_cycles += 1;
        self.pause(current_a, pauses_s[1]);
    }

    fn age(&mut self) {
        let moved_ah = self.truth().throughput_ah;
        self.pack.set_ageing(self.fade.ageing(moved_ah, 0.5 * MOVED_PER_CYCLE * RATED_AH));
    }

    fn pause(&mut self, last_a: f64, duration_s: f64) {
        self.step(last_a, SWITCH_S);
        for _ in 0..(duration_s / SAMPLE_S) as u32 {
            self.step(0.0, SAMPLE_S);
        }
        self.step(0.0, SWITCH_S);
    }

    /// Sends one reading at `current_a`, then lets this current flow for `dt_s`.
    fn step(&mut self, current_a: f64, dt_s: f64) {
        let (voltage_v, temperature_c) = (self.pack.lowest_v(current_a), self.truth().temperature_c);
        let readings = self.sensors.read(current_a, voltage_v, temperature_c);
        let mut frames = Vec::new();
        self.encoder.encode(&readings, &mut frames);
        let time = self.time;
        self.monitor.handle(&Record::tick(time), &mut self.out);
        for (bus, frame) in &frames {
            self.monitor.handle(&Record::frame(time, *bus, frame), &mut self.out);
        }
        for tick in 1..TICKS {
            let time = time.plus_secs(dt_s * f64::from(tick) / f64::from(TICKS));
            self.monitor.handle(&Record::tick(time), &mut self.out);
        }
        self.listen();
        self.pack.step(current_a, dt_s);
        self.time = time.plus_secs(dt_s);
        let (mut place, health) = (self.place(), self.truth().capacity_ah / RATED_AH);
        place.cycle += 0.5; // the crossing can be detected only at the end of the half-cycle
        let (life, beyond) = (&mut self.life, |limit: f64| (health < limit).then_some(place));
        life.crossing = life.crossing.or(beyond(THRESHOLD));
        life.end = life.end.or(beyond(END_OF_LIFE));
    }

    fn listen(&mut self) {
        for event in &self.out.events {
            match event.kind {
                EventKind::Capacity { measured_ah, values, .. } => {
                    let (capacity_ah, capacity_std_ah) = values.pair(Quantity::Capacity).expect("an event has it");
                    let (place, true_ah) = (self.place(), self.truth().capacity_ah);
                    self.life.evaluations.push(Evaluation {
                        time: event.time,
                        cycle: place.cycle,
                        full_cycles: place.full_cycles,
                        true_ah,
                        mean_ah: capacity_ah,
                        std_ah: capacity_std_ah,
                        is_measured: measured_ah.is_some(),
                        reported: [None; 3],
                    });
                }
                EventKind::Alarm { change, severity, .. } => {
                    let slot = match severity {
                        Severity::Info => 0,
                        Severity::Warning => 1,
                        Severity::Severe => 2,
                    };
                    let evaluation =
                        self.life.evaluations.last_mut().expect("an alarm about capacity follows a half-cycle");
                    evaluation.reported[slot] = Some(change);
                }
                EventKind::FilterReset { .. } => self.life.resets += 1,
                _ => {}
            }
        }
        self.out.clear();
    }
}
