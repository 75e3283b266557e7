//! Tests normalised recharge periods through the whole core. The normalised period is the time that a charge over the
//! SOC window would take at the reference current.
//!
//! The fleet has simulated cells of 1.4 to 2.6 Ah. Each cell has its own charger (0.3 to 1.2 C, constant current, then
//! constant voltage), temperature (5 to 40 degrees C) and depth of discharge. Its current sensor has 20 mA noise, 10 mA
//! offset and 0.5 % gain error. Its voltage sensor has 5 mV noise. The normalised period must rank the cells by their
//! true capacity, and its interval must contain the truth. In one life the charger becomes weaker half-way.
//!
//! To print the tables: `cargo test --workspace --test integration recharge_fleet -- --nocapture`.

use std::path::Path;

use packwatch::alarm::{Comparison, Rule, RuleConfig, Severity};
use packwatch::can::CanId;
use packwatch::can::encode::InputEncoder;
use packwatch::config;
use packwatch::health::RechargeAlarm;
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{EventKind, Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS};
use packwatch::quantity::{CellIndex, Channel, SensorIndex, Timestamp};
use packwatch::sim::{Ageing, Pack, PackSettings, Settings, Spread};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const RATED_AH: f64 = 2.6;
const FLEET: usize = 40;
/// SOC ranges of the charges. Three extend beyond the window (30 to 90 %), one equals it, and one covers only a part of
/// it.
const DEPTHS: [(f64, f64); 5] = [(0.20, 0.95), (0.25, 0.92), (0.10, 0.98), (0.30, 0.90), (0.40, 0.85)];
/// Number of cycles of each cell. The last cycle is evaluated.
const CYCLES: u32 = 4;
const REST_S: u32 = 600;
/// Charging ends when the current at constant voltage has fallen to this value (A): C/20.
const TAPER_END_A: f64 = RATED_AH / 20.0;

/// `PACKWATCH_Health` and its page with the recharge periods, as in `config/packwatch.dbc`.
const HEALTH_ID: CanId = CanId::Standard(1713);
const RECHARGE_PAGE: u8 = 1;

struct Dice(ChaCha8Rng);

impl Dice {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform(0.0, 1.0)).ln()).sqrt() * (std::f64::consts::TAU * self.uniform(0.0, 1.0)).cos()
    }

    fn sign(&mut self) -> f64 {
        if self.uniform(-1.0, 1.0) < 0.0 { -1.0 } else { 1.0 }
    }
}

#[derive(Debug, Clone, Copy)]
struct Usage {
    capacity_ah: f64,
    resistance_growth: f64,
    fade_ah: f64,
    temperature_c: f64,
    depth: (f64, f64),
    charge_a: f64,
    discharge_a: f64,
}

/// The Monitor's report on one charge; `None` = not reported.
#[derive(Debug, Clone, Copy, Default)]
struct ChargeReport {
    raw_s: Option<f64>,
    normalised_s: Option<f64>,
    std_s: Option<f64>,
    /// Period calculated from this charge alone, for comparison (s): charge per SOC inside the window, times the
    /// window's width, divided by the reference current.
    own_charge_s: Option<f64>,
}

struct Rig {
    config: MonitorConfig,
    pack: Pack,
    dice: Dice,
    gain: f64,
    offset_a: f64,
    monitor: Monitor,
    encoder: InputEncoder,
    ticks: Ticks,
    out: Outputs,
    seconds: f64,
    reported: ChargeReport,
    alarms: u32,
    health: Option<[u8; 8]>,
    /// Counted charge (A s) and estimated SOC: when the present charge entered the window, and now.
    own: Option<[(f64, f64); 2]>,
    counted_as: f64,
}

impl Rig {
    fn new(config: &MonitorConfig, usage: &Usage, seed: u64) -> Self {
        let usual = Settings::of(packwatch::sim::Scenario::Paper, RATED_AH).pack;
        let settings = PackSettings {
            capacity_ah: usage.capacity_ah,
            initial_soc: usage.depth.1,
            spread: Spread::default(),
            ageing: Ageing {
                resistance_growth_per_cycle: usage.resistance_growth,
                capacity_loss_ah_per_cycle: usage.fade_ah,
                ..Ageing::default()
            },
            ambient_c: usage.temperature_c,
            ..usual
        };
        let mut pack = Pack::new(config.model.clone(), settings, seed);
        pack.complete_cycle(); // creates the resistance growth
        let mut dice = Dice::new(seed);
        let (gain, offset_a) = (0.005 * dice.sign(), 0.010 * dice.sign());
        Self {
            pack,
            dice,
            gain,
            offset_a,
            monitor: Monitor::new(config.clone()),
            encoder: InputEncoder::new(&config.input),
            ticks: Ticks::new(TICK_PERIOD_MS, 30.0),
            out: Outputs::default(),
            seconds: 0.0,
            reported: ChargeReport::default(),
            alarms: 0,
            health: None,
            own: None,
            counted_as: 0.0,
            config: config.clone(),
        }
    }

    /// Simulates one second at `current_a`: sends the sensors' frames, then advances the cell.
    fn second(&mut self, current_a: f64) {
        let measured_a = current_a * (1.0 + self.gain) + self.offset_a + 0.020 * self.dice.normal();
        let voltage_v = self.pack.lowest_v(current_a) + 0.005 * self.dice.normal();
        let temperature_c = self.pack.cells()[0].temperature_c + 0.1 * self.dice.normal();
        let readings = [
            (Channel::Current, Some(measured_a)),
            (Channel::Temperature(SensorIndex(0)), Some(temperature_c)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
        ];
        let (time, mut frames) = (Timestamp::from_secs(self.seconds), Vec::new());
        self.encoder.encode(&readings, &mut frames);
        self.ticks.advance(time);
        while let Some(time) = self.ticks.pop(self.monitor.next_due()) {
            self.monitor.handle(&Record::tick(time), &mut self.out);
        }
        for (bus, frame) in &frames {
            self.monitor.handle(&Record::frame(time, *bus, frame), &mut self.out);
        }
        self.listen();
        self.watch_own_charge(current_a, measured_a);
        self.pack.step(current_a, 1.0);
        self.seconds += 1.0;
    }

    fn listen(&mut self) {
        for event in self.out.events.drain(..) {
            if let EventKind::RechargePeriod { seconds, normalised_s, normalised_std_s } = event.kind {
                let own_charge_s = self.reported.own_charge_s;
                self.reported = ChargeReport { raw_s: seconds, normalised_s, std_s: normalised_std_s, own_charge_s };
            }
            let raised = matches!(event.kind, EventKind::Alarm { rule: Rule::RechargePeriodLow, active: true, .. });
            self.alarms += u32::from(raised);
        }
        for sent in &self.out.frames {
            let payload = <[u8; 8]>::try_from(sent.frame.data()).unwrap_or_default();
            if sent.frame.id() == HEALTH_ID && payload[2] & 0xF == RECHARGE_PAGE {
                self.health = Some(payload);
            }
        }
        self.out.clear();
    }

    fn watch_own_charge(&mut self, current_a: f64, measured_a: f64) {
        let window = &self.config.health.recharge;
        let soc = self.monitor.pack().map_or(f64::NAN, |pack| pack.soc);
        self.counted_as -= measured_a;
        if current_a >= 0.0 || soc < window.from_soc {
            self.own = None;
        } else if soc <= window.to_soc {
            let now = (self.counted_as, soc);
            let [start, end] = [self.own.map_or(now, |own| own[0]), now];
            self.own = Some([start, end]);
            let per_soc = (end.0 - start.0) / (end.1 - start.1);
            self.reported.own_charge_s = Some(per_soc * (window.to_soc - window.from_soc) / window.reference_current_a);
        }
    }

    fn soc(&self) -> f64 {
        self.pack.cells()[0].soc
    }

    fn cycle(&mut self, usage: &Usage) -> ChargeReport {
        self.reported = ChargeReport::default();
        let (low_v, high_v) = (self.config.model.voltage_min_v, self.config.model.voltage_max_v);
        while self.soc() > usage.depth.0 && self.pack.lowest_v(usage.discharge_a) > low_v {
            self.second(usage.discharge_a);
        }
        (0..REST_S).for_each(|_| self.second(0.0));
        while self.soc() < usage.depth.1 {
            let current_a = self.pack.current_at_highest_a(high_v).max(-usage.charge_a);
            if current_a > -TAPER_END_A {
                break;
            }
            self.second(current_a);
        }
        (0..REST_S).for_each(|_| self.second(0.0));
        self.reported
    }
}

fn configuration() -> MonitorConfig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml");
    let mut config = config::load(&path).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n"))).monitor;
    config.estimator.initial.capacity_ah = 2.0;
    config.estimator.initial.capacity_std_ah = 0.4;
    config.health.capacity.noise_ah_per_cycle = 0.004 * RATED_AH;
    (config.health.recharge.from_soc, config.health.recharge.to_soc) = (0.3, 0.9);
    config.health.recharge.reference_current_a = RATED_AH / 2.0;
    config.output = None;
    config
}

fn true_period_s(capacity_ah: f64) -> f64 {
    3600.0 * 0.6 * capacity_ah / (RATED_AH / 2.0)
}

/// Rank correlation over the pairs whose second value is known.
fn spearman(pairs: &[(f64, Option<f64>)]) -> f64 {
    let known: Vec<(f64, f64)> = pairs.iter().filter_map(|&(x, y)| Some((x, y?))).collect();
    let ranks = |values: Vec<f64>| -> Vec<f64> {
        values.iter().map(|v| values.iter().filter(|w| *w < v).count() as f64).collect()
    };
    let (x, y) = (ranks(known.iter().map(|p| p.0).collect()), ranks(known.iter().map(|p| p.1).collect()));
    let n = known.len() as f64;
    1.0 - 6.0 * x.iter().zip(&y).map(|(a, b)| (a - b) * (a - b)).sum::<f64>() / (n * (n * n - 1.0))
}

fn fleet() -> Vec<(Usage, ChargeReport)> {
    let config = configuration();
    let mut dice = Dice::new(40);
    let usages = (0..FLEET).map(|k| {
        let worn = k as f64 / (FLEET - 1) as f64;
        Usage {
            capacity_ah: 2.6 - 1.2 * worn,
            // The resistance of worn cells has grown by different amounts.
            resistance_growth: 0.5 * worn + dice.uniform(0.0, 0.2),
            fade_ah: 0.0,
            temperature_c: dice.uniform(5.0, 40.0),
            depth: DEPTHS[(dice.uniform(0.0, DEPTHS.len() as f64)) as usize],
            charge_a: RATED_AH * dice.uniform(0.3, 1.2),
            discharge_a: RATED_AH * dice.uniform(0.3, 1.0),
        }
    });
    let run = |(seed, usage): (u64, Usage)| {
        let mut rig = Rig::new(&config, &usage, seed);
        let reported = (0..CYCLES).map(|_| rig.cycle(&usage)).last().unwrap_or_default();
        (usage, reported)
    };
    (1..).zip(usages).map(run).collect()
}

#[test]
fn normalised_period_ranks_fleet_by_capacity() {
    let fleet = fleet();
    println!("true Ah  true s | raw s  normalised s +-  std  error % | own charge % | charger A  temp C  depth");
    let words = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.0}"));
    for (usage, reported) in &fleet {
        let truth_s = true_period_s(usage.capacity_ah);
        let percent = |value: Option<f64>| value.map_or(f64::NAN, |v| 100.0 * (v / truth_s - 1.0));
        println!(
            "{:7.2}  {truth_s:6.0} | {:>5}  {:>12} +- {:>4}  {:+7.2} | {:+12.2} | {:9.2}  {:6.1}  {:.2} to {:.2}",
            usage.capacity_ah,
            words(reported.raw_s),
            words(reported.normalised_s),
            words(reported.std_s),
            percent(reported.normalised_s),
            percent(reported.own_charge_s),
            usage.charge_a,
            usage.temperature_c,
            usage.depth.0,
            usage.depth.1,
        );
    }
    let rank = |value: fn(&ChargeReport) -> Option<f64>| {
        spearman(&fleet.iter().map(|(usage, reported)| (usage.capacity_ah, value(reported))).collect::<Vec<_>>())
    };
    let (normalised, raw, own) = (rank(|t| t.normalised_s), rank(|t| t.raw_s), rank(|t| t.own_charge_s));
    println!("rank correlation with the true capacity: normalised {normalised:.4}, raw {raw:.3}, own charge {own:.4}");
    let rms = |value: fn(&ChargeReport) -> Option<f64>| {
        let errors = fleet.iter().filter_map(|(usage, t)| Some(value(t)? / true_period_s(usage.capacity_ah) - 1.0));
        let squares: Vec<f64> = errors.map(|error| error * error).collect();
        100.0 * (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    };
    println!("RMS error: normalised {:.2} %, own charge {:.2} %", rms(|t| t.normalised_s), rms(|t| t.own_charge_s));
    let inside = |(usage, reported): &&(Usage, ChargeReport)| {
        let error_s = reported.normalised_s.map(|s| (s - true_period_s(usage.capacity_ah)).abs());
        error_s.zip(reported.std_s).is_some_and(|(error_s, std_s)| error_s <= 1.96 * std_s)
    };
    let coverage = fleet.iter().filter(inside).count() as f64 / fleet.len() as f64;
    println!("95 % interval holds the truth: {:.0} % of the cells", 100.0 * coverage);
    assert!(
        fleet.iter().all(|(_, reported)| reported.normalised_s.is_some()),
        "every charge must give a normalised period"
    );
    assert!(fleet.iter().any(|(_, reported)| reported.raw_s.is_none()), "some charges must not cover the window");
    assert!(normalised >= 0.98, "rank correlation {normalised}");
    assert!(raw < 0.7, "the raw period alone already ranks the cells: {raw}");
    assert!((0.90..=1.0).contains(&coverage), "coverage {coverage}");
}

#[test]
fn weaker_charger_changes_only_raw_period() {
    const LIFE: usize = 24;
    const WEAKER_FROM: usize = 12;
    let config = configuration();
    let usage = |k: usize| Usage {
        capacity_ah: 2.5,
        resistance_growth: 0.01,
        fade_ah: 0.01,
        temperature_c: 25.0,
        depth: DEPTHS[0],
        charge_a: if k < WEAKER_FROM { RATED_AH } else { 0.5 * RATED_AH },
        discharge_a: 0.5 * RATED_AH,
    };
    let mut rig = Rig::new(&config, &usage(0), 7);
    println!("charge  charger A  true Ah  true s | raw s  normalised s +- std  error %");
    let mut life = Vec::new();
    for k in 0..LIFE {
        let reported = rig.cycle(&usage(k));
        let capacity_ah = rig.pack.cells()[0].capacity_ah;
        rig.pack.complete_cycle();
        let (Some(raw_s), Some(normalised_s), Some(std_s)) = (reported.raw_s, reported.normalised_s, reported.std_s)
        else {
            panic!("charge {k} was not reported: {reported:?}");
        };
        let truth_s = true_period_s(capacity_ah);
        println!(
            "{:6}  {:9.2}  {capacity_ah:7.3}  {truth_s:6.0} | {raw_s:5.0}  {normalised_s:12.0} +- {std_s:3.0}  {:+7.2}",
            k + 1,
            usage(k).charge_a,
            100.0 * (normalised_s / truth_s - 1.0),
        );
        life.push((raw_s, normalised_s, truth_s));
    }
    let mean = |from: usize, to: usize, value: fn(&(f64, f64, f64)) -> f64| {
        life[from..to].iter().map(value).sum::<f64>() / (to - from) as f64
    };
    // Compare three charges before the change of the charger with three charges after it. Correct for the cell's own
    // fade.
    let (before, after) = ((WEAKER_FROM - 3, WEAKER_FROM), (WEAKER_FROM, WEAKER_FROM + 3));
    let jump = |value: fn(&(f64, f64, f64)) -> f64| mean(after.0, after.1, value) / mean(before.0, before.1, value);
    let faded = jump(|l| l.2);
    let (raw, normalised) = (jump(|l| l.0) / faded - 1.0, jump(|l| l.1) / faded - 1.0);
    println!("when the charger gets weaker: raw {:+.1} %, normalised {:+.2} %", 100.0 * raw, 100.0 * normalised);
    assert!(raw > 0.9, "the raw period should have doubled: {raw}");
    assert!(normalised.abs() < 0.01, "the charger changed the normalised period by {normalised}");
    assert!(life[LIFE - 1].1 < life[2].1, "the normalised period must fall with the capacity");
    let worst = life[2..].iter().map(|l| (l.1 / l.2 - 1.0).abs()).fold(0.0, f64::max);
    assert!(worst < 0.03, "worst error {worst}");
}

/// Number of alarms in a few charges with a threshold of 3000 s, and the last health frame.
fn alarms(usage: &Usage, alarm_on: RechargeAlarm) -> (u32, Option<[u8; 8]>) {
    let output = config::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml")).ok();
    let mut config = configuration();
    config.output = output.and_then(|paper| paper.monitor.output);
    config.health.recharge.alarm_on = alarm_on;
    config.rules = vec![RuleConfig {
        rule: Rule::RechargePeriodLow,
        severity: Severity::Warning,
        threshold: 3000.0,
        clear: 3060.0,
        when: Comparison::Mean,
        debounce_s: 0.0,
        debounce_events: 1,
        is_latching: false,
    }];
    let mut rig = Rig::new(&config, usage, 3);
    for _ in 0..3 {
        rig.cycle(usage);
    }
    (rig.alarms, rig.health)
}

#[test]
fn normalised_period_alarm_ignores_charger() {
    let usual = Usage {
        capacity_ah: 2.5,
        resistance_growth: 0.0,
        fade_ah: 0.0,
        temperature_c: 25.0,
        depth: DEPTHS[0],
        charge_a: RATED_AH,
        discharge_a: 0.5 * RATED_AH,
    };
    // A cell of 2.5 Ah takes 4154 s at C/2 and 2060 s with this charger. A cell of 1.7 Ah takes 2825 s at C/2 and 4900
    // s with a weak charger.
    let worn = Usage { capacity_ah: 1.7, charge_a: 0.3 * RATED_AH, ..usual };
    let partly = Usage { depth: DEPTHS[4], ..worn };
    let raised = |usage: &Usage, alarm_on| alarms(usage, alarm_on).0;
    assert_eq!(raised(&usual, RechargeAlarm::Raw), 1);
    assert_eq!(raised(&usual, RechargeAlarm::Normalised), 0);
    assert_eq!(raised(&worn, RechargeAlarm::Raw), 0);
    assert_eq!(raised(&worn, RechargeAlarm::Normalised), 1);
    assert_eq!(raised(&partly, RechargeAlarm::Normalised), 1);
}

#[test]
fn partial_charge_sends_only_normalised_period() {
    let usage = Usage {
        capacity_ah: 2.0,
        resistance_growth: 0.0,
        fade_ah: 0.0,
        temperature_c: 25.0,
        depth: DEPTHS[4],
        charge_a: RATED_AH,
        discharge_a: 0.5 * RATED_AH,
    };
    let (_, health) = alarms(&usage, RechargeAlarm::Raw);
    let payload = u64::from_le_bytes(health.expect("a health frame must be sent"));
    let (raw, normalised) = ((payload >> 20) & 0xFFFF, (payload >> 36) & 0xFFFF);
    assert_eq!(raw, 0xFFFF, "not available");
    let error = normalised as f64 / true_period_s(usage.capacity_ah) - 1.0;
    assert!(error.abs() < 0.03, "{normalised} s in the frame");
}
