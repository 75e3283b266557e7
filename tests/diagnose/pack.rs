//! Simulates one pack (true cells, sensors, CAN frames) and runs the whole core (`Monitor`) on its frames.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use packwatch_core::can::encode::InputEncoder;
use packwatch_core::cell_faults::fault::{CHANNEL_V, OFFSET_PER_H};
use packwatch_core::cell_faults::{CellFault, CellFaultKind};
use packwatch_core::monitor::{Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS};
use packwatch_core::quantity::{CellIndex, Timestamp};
use packwatch_core::sim::{Balancing, Fault, Scenario, SensorQuality, Sensors, Settings, Simulation, Spread, Wiring};
use packwatch_host::config;
use packwatch_host::io::ticks::Ticks;

use crate::finding::kind_of;

/// If no frame arrives for longer than this (s), the vehicle counts as asleep.
const SLEEP_GAP_S: f64 = 30.0;
/// Interval between two checks of the findings while the buses are awake (s).
const LOOK_S: f64 = 300.0;
/// A discharge current above this value counts as driving (current divided by capacity, 1/h).
const DRIVE_PER_H: f64 = 0.05;
/// If the vehicle has not been driving for longer than this (s), the next driving current begins a new drive.
const PARKED_S: f64 = 1800.0;
/// Cells per temperature sensor.
pub(crate) const CELLS_PER_SENSOR: u16 = 4;
/// Capacity of the cells in the model file (Ah).
const MODEL_AH: f64 = 2.6;

/// Size of a pack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PackSize {
    pub(crate) cells: u16,
    pub(crate) capacity_ah: f64,
}

/// Whether the BMS balances, and whether it reports which cells it bleeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum PackBalancing {
    Off,
    On,
    Bits,
}

impl PackBalancing {
    pub(crate) const ALL: [Self; 3] = [Self::Off, Self::On, Self::Bits];

    /// Name in the table.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::On => "on",
            Self::Bits => "bits",
        }
    }
}

/// One pack to simulate.
#[derive(Debug, Clone)]
pub(crate) struct Case {
    pub(crate) size: PackSize,
    pub(crate) quality: SensorQuality,
    pub(crate) balancing: PackBalancing,
    /// Steps of the fault: none in a healthy pack, one if the fault appears at once, several if it grows.
    pub(crate) faults: Vec<Fault>,
    pub(crate) seed: u64,
    pub(crate) days: u32,
    pub(crate) period_ms: u32,
}

/// A finding at its first occurrence.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FirstFinding {
    /// Time since the start of the simulation (s).
    pub(crate) at_s: f64,
    /// Number of drives with the fault until this time (see `Drives`).
    pub(crate) drives: u32,
    pub(crate) found: CellFault,
}

/// Writes a pack's configuration to `folder` and loads it. The configuration contains the bits in which the BMS reports
/// the cells that it bleeds (discharges to balance the pack).
pub(crate) fn configuration(folder: &Path, size: PackSize) -> Result<MonitorConfig, String> {
    let sensors = size.cells.div_ceil(CELLS_PER_SENSOR);
    let write = |name: &str, text: String| std::fs::write(folder.join(name), text).map_err(|e| e.to_string());
    write("pack.dbc", dbc(size.cells, sensors))?;
    write("cell.toml", cell_model(size.capacity_ah)?)?;
    write("pack.toml", pack(size, sensors))?;
    let config = config::load(&folder.join("pack.toml")).map_err(|faults| faults.0.join("\n"))?;
    Ok(config.monitor)
}

fn dbc(cells: u16, sensors: u16) -> String {
    let mut text = String::from("VERSION \"\"\n\nNS_ :\n\nBS_:\n\nBU_: BMS\n\nBO_ 256 Pack: 8 BMS\n");
    text += " SG_ Current : 0|24@1- (0.001,0) [-8000|8000] \"A\" BMS\n\nBO_ 272 Cells: 8 BMS\n";
    text += " SG_ Page M : 0|8@1+ (1,0) [0|255] \"\" BMS\n";
    for i in 0..cells {
        let (page, bit) = (i / 3, 16 + 16 * (i % 3));
        let _ = writeln!(text, " SG_ Voltage{} m{page} : {bit}|16@1+ (0.0001,0) [0|6.5] \"V\" BMS", i + 1);
    }
    text += "\nBO_ 304 Balancing: 8 BMS\n";
    for i in 0..cells {
        let _ = writeln!(text, " SG_ Bleed{} : {i}|1@1+ (1,0) [0|1] \"\" BMS", i + 1);
    }
    text += "\nBO_ 288 Temperatures: 8 BMS\n";
    for i in 0..sensors {
        let _ = writeln!(text, " SG_ Temperature{} : {}|16@1- (0.1,0) [-100|200] \"degC\" BMS", i + 1, 16 * i);
    }
    text
}

/// The repository's example cell model, scaled to a capacity.
fn cell_model(capacity_ah: f64) -> Result<String, String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/cells/example_nmc_2600.toml");
    let text = std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    let mut model: toml::Table = text.parse().map_err(|e| format!("{}: {e}", path.display()))?;
    let k = capacity_ah / MODEL_AH;
    for key in ["rated_capacity_ah", "capacity_ah"] {
        model.insert(key.to_owned(), toml::Value::Float(capacity_ah));
    }
    scale(&mut model, k);
    let thermal = [("heat_capacity_j_per_k", 45.0 * k), ("resistance_k_per_w", 8.0 / k)];
    let thermal = thermal.into_iter().map(|(key, value)| (key.to_owned(), toml::Value::Float(value))).collect();
    model.insert("thermal".to_owned(), toml::Value::Table(thermal));
    toml::to_string(&model).map_err(|e| e.to_string())
}

/// Divides resistances by k and multiplies capacitances by k, in all tables.
fn scale(table: &mut toml::Table, k: f64) {
    for (key, value) in table.iter_mut() {
        match (key.as_str(), value) {
            ("r0_ohm" | "r_ohm", value) => multiply(value, 1.0 / k),
            ("c_farad", value) => multiply(value, k),
            (_, toml::Value::Table(inner)) => scale(inner, k),
            (_, toml::Value::Array(items)) => {
                items.iter_mut().filter_map(toml::Value::as_table_mut).for_each(|inner| scale(inner, k));
            }
            _ => {}
        }
    }
}

fn multiply(value: &mut toml::Value, factor: f64) {
    match value {
        toml::Value::Array(items) => items.iter_mut().for_each(|item| multiply(item, factor)),
        toml::Value::Float(x) => *x *= factor,
        toml::Value::Integer(n) => *value = toml::Value::Float(*n as f64 * factor),
        _ => {}
    }
}

fn pack(size: PackSize, sensors: u16) -> String {
    let PackSize { cells, capacity_ah } = size;
    let (discharge_a, dead_band_a) = (5.0 * capacity_ah, 0.02 * capacity_ah);
    let Balancing { bleed_a, .. } = Balancing::usual(capacity_ah);
    let mut text = format!(
        "[pack]\ncells = {cells}\ncell_model = \"cell.toml\"\nambient_c = 25.0\n\n[[interface]]\nname = \"can0\"\n\n\
         [input]\ndbc = [\"pack.dbc\"]\n\n[input.current]\nsignal = \"Pack.Current\"\npositive = \"discharge\"\n\n\
         [input.cell_voltage]\nsignal = \"Cells.Voltage{{n}}\"\n\n\
         [input.balancing]\nsignal = \"Balancing.Bleed{{n}}\"\nbleed_a = {bleed_a:?}\nmax_age_s = 90.0\n\
         only_while_sent = true\n\n"
    );
    for i in 0..sensors {
        let (first, last) = (i * CELLS_PER_SENSOR + 1, ((i + 1) * CELLS_PER_SENSOR).min(cells));
        let name = i + 1;
        let _ = writeln!(
            text,
            "[[input.temperature]]\nsignal = \"Temperatures.Temperature{name}\"\ncells = \"{first}-{last}\"\n"
        );
    }
    text + &format!(
        "[limits.current]\nmax_discharge_a = {discharge_a:?}\nmax_charge_a = {discharge_a:?}\nmax_age_s = 15.0\n\n\
         [limits.voltage]\nmax_age_s = 15.0\n\n[limits.temperature]\nmax_age_s = 15.0\n\n\
         [transition]\ndead_band_a = {dead_band_a:?}\nhysteresis_a = {:?}\nmin_duration_s = 30.0\n\n\
         [[alarm]]\nrule = \"cell_imbalance\"\nwarning = \"3 %\"\nwhen = {{ probability = 0.95 }}\ndebounce_s = 60.0\n\n\
         [[alarm]]\nrule = \"input_implausible\"\nwarning = \"20 %\"\ndebounce_s = 5.0\n\n\
         [[alarm]]\nrule = \"estimate_untrusted\"\nwarning = 4.0\ndebounce_s = 600.0\n",
        0.5 * dead_band_a
    )
}

impl Case {
    /// The first step of the fault; `None` in a healthy pack.
    pub(crate) fn fault(&self) -> Option<Fault> {
        self.faults.first().copied()
    }

    fn simulation(&self, config: &MonitorConfig) -> Simulation {
        let mut settings = Settings::of(Scenario::EvDay, self.size.capacity_ah);
        settings.seed = self.seed;
        settings.pack.cells = self.size.cells;
        settings.pack.spread = Spread { capacity: 0.01, resistance: 0.03, soc: 0.005 };
        settings.sensors = Sensors::of_quality(self.quality);
        settings.cycles = Some(self.days);
        settings.duration_s = Some(86_400.0 * f64::from(self.days));
        let period_ns = i64::from(self.period_ms) * 1_000_000;
        (settings.current_period_ns, settings.cell_period_ns) = (period_ns, period_ns);
        let sensors = self.size.cells.div_ceil(CELLS_PER_SENSOR);
        let temperature_at = (0..sensors).map(|i| Some(CellIndex(i * CELLS_PER_SENSOR))).collect();
        let sim = Simulation::new(config.model.clone(), settings, Wiring { strings: 1, temperature_at });
        let sim = sim.with_faults(&self.faults);
        let usual = Balancing::usual(self.size.capacity_ah);
        match self.balancing {
            PackBalancing::Off => sim,
            PackBalancing::On => sim.with_balancing(usual),
            PackBalancing::Bits => sim.with_balancing(usual).with_balancing_bits(),
        }
    }

    /// Returns the findings in the order of their first occurrence. The simulated sensors have errors of their own. A
    /// finding that correctly describes such an error is omitted, unless the simulated fault is of the same kind.
    pub(crate) fn run(&self, config: &MonitorConfig) -> Vec<FirstFinding> {
        let mut sim = self.simulation(config);
        let encoder = InputEncoder::new(&config.input);
        let is_balanced = self.balancing != PackBalancing::Off;
        let balancing = config.balancing.filter(|_| self.balancing == PackBalancing::Bits);
        let mut monitor = Monitor::new(MonitorConfig { is_balanced, balancing, ..config.clone() });
        let (mut ticks, mut out, mut frames) =
            (Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S), Outputs::default(), Vec::new());
        let (mut seen, mut next_look) = (FindingHistory::default(), Timestamp::ZERO);
        let from_s = self.fault().map_or(f64::INFINITY, |fault| fault.from_s);
        let least_a = DRIVE_PER_H * self.size.capacity_ah;
        let mut drives = Drives::default();
        while let Some(moment) = sim.advance() {
            frames.clear();
            encoder.encode(sim.readings(), &mut frames);
            frames.sort_by_key(|(_, frame)| frame.id().raw());
            ticks.advance(moment.time);
            while let Some(time) = ticks.pop(monitor.next_due()) {
                monitor.handle(&Record::tick(time), &mut out);
            }
            for (bus, frame) in &frames {
                monitor.handle(&Record::frame(moment.time, *bus, frame), &mut out);
            }
            out.clear();
            if moment.current_a > least_a {
                drives.note(moment.time.secs(), from_s);
            }
            if moment.time >= next_look {
                next_look = moment.time.plus_secs(LOOK_S);
                monitor.settle(&mut out);
                seen.note(moment.time.secs(), drives.begun, monitor.findings());
            }
        }
        let asked = self.fault().and_then(|fault| kind_of(&fault.kind));
        let (offset_a, offsets_v) = sim.sensor_offsets();
        let is_true = |found: &CellFault| match (found.kind, found.cells) {
            (CellFaultKind::CurrentOffset, _) => offset_a.abs() >= OFFSET_PER_H * self.size.capacity_ah,
            (CellFaultKind::VoltageChannel, Some((cell, _))) => {
                (offsets_v[cell.index()] - median(&offsets_v)).abs() >= CHANNEL_V
            }
            _ => false,
        };
        seen.first.retain(|seen| Some(seen.found.kind) == asked || !is_true(&seen.found));
        seen.first
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    0.5 * (sorted[(sorted.len() - 1) / 2] + sorted[sorted.len() / 2])
}

#[derive(Debug, Default)]
struct FindingHistory {
    first: Vec<FirstFinding>,
    known: BTreeMap<(u8, Option<(CellIndex, CellIndex)>), ()>,
}

impl FindingHistory {
    fn note(&mut self, at_s: f64, drives: u32, found: &[CellFault]) {
        for &found in found {
            if self.known.insert((code(found.kind), found.cells), ()).is_none() {
                self.first.push(FirstFinding { at_s, drives, found });
            }
        }
    }
}

/// Counts the drives with a fault. If the fault begins during a drive, this drive is number 1. Otherwise the next drive
/// is number 1.
#[derive(Debug, Default)]
struct Drives {
    begun: u32,
    last_s: Option<f64>,
}

impl Drives {
    fn note(&mut self, now_s: f64, from_s: f64) {
        let is_new = self.last_s.replace(now_s).is_none_or(|last_s| now_s - last_s > PARKED_S);
        if now_s >= from_s && (is_new || self.begun == 0) {
            self.begun += 1;
        }
    }
}

fn code(kind: CellFaultKind) -> u8 {
    kind as u8
}
