//! Command line options that change a scenario's settings.

use crate::cell_faults::BalancingConfig;
use crate::cli::common::numbers::{NamedValue, between, finite, integer, one_of, share, within};
use crate::sim::{Balancing, Fault, Hysteresis, PackSettings, Scenario, SensorQuality, Sensors, Settings, Simulation};
use packwatch_host::failure::Failure;

pub(super) const SCENARIOS: [NamedValue<Scenario>; 4] = [
    ("paper", Scenario::Paper, "2.6 Ah, 0.05 Ah lost per cycle between SOC 30 and 90 %, until 0.25 Ah"),
    ("reference", Scenario::Reference, "30 Ah example: random discharge pulses, 1 Ah lost per cycle"),
    ("random-walk", Scenario::RandomWalk, "Random 5-minute loads with reference cycles in between"),
    ("ev-day", Scenario::EvDay, "A day of an electric car: drive, park asleep, fast charge"),
];

const QUALITIES: [NamedValue<SensorQuality>; 3] = [
    ("good", SensorQuality::Good, "Offset 1 mV in steps of 0.1 mV, current 0.1 % + 5 mA, 0.3 K"),
    ("usual", SensorQuality::Usual, "Offset 5 mV in steps of 1 mV, current 0.5 % + 50 mA, 1 K"),
    ("poor", SensorQuality::Poor, "Offset 15 mV in steps of 5 mV, current 2 % + 300 mA, 3 K"),
];

/// All changes; an absent option keeps the scenario's value. Currents and losses of a scenario are stated for its original cell and
/// scale with the capacity.
#[derive(Debug, clap::Args)]
pub(super) struct Changes {
    /// Seed of all random numbers
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = integer::<u64>(0, u64::MAX))]
    seed: u64,
    /// End after this many cycles (random-walk: blocks; ev-day: days) [default: reference 10, random-walk 1, ev-day 1]
    #[arg(long, value_parser = integer::<u32>(1, u32::MAX))]
    cycles: Option<u32>,
    /// End after this time (s) [default: ev-day 86400]
    #[arg(long, value_name = "SECONDS", value_parser = positive)]
    duration: Option<f64>,
    #[command(flatten)]
    pub(super) pack: PackChanges,
    #[command(flatten)]
    sensors: SensorChanges,
    #[command(flatten)]
    pub(super) faults: FaultArgs,
    /// Time between current samples, ms [default: ev-day 10, others 1000]
    #[arg(long, value_name = "MILLISECONDS", value_parser = integer::<u32>(1, 3_600_000))]
    period: Option<u32>,
    /// Time between samples of the cells, ms, a multiple of --period [default: ev-day 100, others --period]
    #[arg(long, value_name = "MILLISECONDS", value_parser = integer::<u32>(1, 3_600_000))]
    cell_period: Option<u32>,
    /// Only for random-walk: number of loads before each pair of reference cycles [default: 1500]
    #[arg(long, value_name = "N", value_parser = integer::<u32>(1, u32::MAX))]
    pub(super) walk_steps: Option<u32>,
}

/// Options of the pack.
#[derive(Debug, clap::Args)]
pub(super) struct PackChanges {
    /// Cells in series [default: from the configuration]
    #[arg(long, value_parser = integer::<u16>(1, 1024))]
    cells: Option<u16>,
    /// Capacity of a new cell (Ah) [default: from the cell model]
    #[arg(long, value_name = "AH", value_parser = positive)]
    pub(super) capacity_ah: Option<f64>,
    /// Initial SOC, fraction [default: paper 0.9, reference 1, random-walk 0.9, ev-day 0.85]
    #[arg(long, value_name = "SOC", value_parser = share)]
    initial_soc: Option<f64>,
    /// Ambient temperature (degrees C) [default: from the configuration]
    #[arg(long, value_name = "CELSIUS", allow_negative_numbers = true, value_parser = between(-60.0, 100.0, ""))]
    ambient: Option<f64>,
    /// Capacity lost per cycle (Ah)
    #[arg(long, value_name = "AH", value_parser = non_negative)]
    loss_per_cycle: Option<f64>,
    /// Resistance gained per cycle, as a fraction of a new cell's resistance
    #[arg(long, value_name = "FRACTION", value_parser = non_negative)]
    resistance_per_cycle: Option<f64>,
    /// Spread of capacity between cells, relative standard deviation [default: ev-day 0.01, others 0]
    #[arg(long, value_name = "FRACTION", value_parser = between(0.0, 0.3, ""))]
    spread_capacity: Option<f64>,
    /// Spread of resistance between cells, relative standard deviation [default: ev-day 0.03, others 0]
    #[arg(long, value_name = "FRACTION", value_parser = between(0.0, 0.3, ""))]
    spread_resistance: Option<f64>,
    /// Spread of the initial SOC between cells, standard deviation [default: ev-day 0.005, others 0]
    #[arg(long, value_name = "FRACTION", value_parser = between(0.0, 0.3, ""))]
    spread_soc: Option<f64>,
    /// Open-circuit hysteresis that the estimator does not model (V) in each direction
    #[arg(long, value_name = "VOLTS", value_parser = non_negative)]
    hysteresis: Option<f64>,
    /// Self-discharge current (A)
    #[arg(long, value_name = "AMPERES", value_parser = non_negative)]
    leakage: Option<f64>,
}

/// Fault injection and balancing.
#[derive(Debug, clap::Args)]
pub(super) struct FaultArgs {
    /// Inject a fault; repeat for several
    ///
    /// Cells and temperature sensors count from 1. @WHEN is the start of the fault after the start of the simulation: day3, 3d,
    /// 12h or 900s; without it the fault exists from the start.
    ///
    /// Cells: leak:CELL:20mA, leak:CELL:1kohm, weak:CELL:-10% (capacity), resistance:CELL:+20% (whole resistance of the cell),
    /// contact:CELL:0.4mohm, contact:CELL:+20% (of the cell's ohmic resistance), module:FIRST-LAST:+15% (replaced
    /// module).
    ///
    /// Sensors: current-offset:50mA, current-gain:+1%, current-stuck, voltage-offset:CELL:10mV, voltage-stuck:CELL,
    /// swap:CELL:CELL, double:CELL:CELL (the second channel shows the first cell), temperature-stuck:SENSOR, temperature-off:SENSOR.
    #[arg(long = "fault", value_name = "KIND:...[@WHEN]", value_parser = str::parse::<Fault>)]
    faults: Vec<Fault>,
    /// Balance the cells near the end of a charge and in the rest after it, with `input.balancing.bleed_a` or, if not configured, a
    /// thousandth of the capacity per hour
    #[arg(long)]
    balancing: bool,
}

impl FaultArgs {
    /// Whether the table of the true state needs additional columns.
    pub(super) fn changes_truth(&self) -> bool {
        self.balancing || !self.faults.is_empty()
    }

    /// Adds faults and balancing to `sim`. `balancing` is the configured `[input.balancing]`; its `bleed_a` replaces
    /// the default.
    pub(super) fn apply(
        &self,
        sim: Simulation,
        cells: u16,
        sensors: u16,
        capacity_ah: f64,
        balancing: Option<BalancingConfig>,
    ) -> Result<Simulation, Failure> {
        let check = |fault: &Fault| fault.kind.check(cells, sensors);
        self.faults.iter().try_for_each(check).map_err(|error| {
            Failure::new(format!("--fault: {error} (the pack has {cells} cells and {sensors} temperature sensors)"))
        })?;
        let sim = sim.with_faults(&self.faults);
        let sim = if balancing.is_some() { sim.with_balancing_bits() } else { sim };
        let usual = Balancing::usual(capacity_ah);
        let balancer = Balancing { bleed_a: balancing.map_or(usual.bleed_a, |it| it.bleed_a), ..usual };
        Ok(if self.balancing { sim.with_balancing(balancer) } else { sim })
    }
}

/// Options of the sensors.
#[derive(Debug, clap::Args)]
struct SensorChanges {
    /// Quality of the sensors: constant errors per channel and noise of one step; other options override parts of it
    #[arg(long, value_name = "QUALITY", value_parser = one_of(&QUALITIES))]
    sensors: Option<SensorQuality>,
    /// White noise of cell voltages (V) [default: paper 0.005]
    #[arg(long, value_name = "VOLTS", value_parser = non_negative)]
    noise_voltage: Option<f64>,
    /// White noise of the current (A) [default: paper 0.02]
    #[arg(long, value_name = "AMPERES", value_parser = non_negative)]
    noise_current: Option<f64>,
    /// White noise of temperatures (K) [default: paper 0.1, ev-day 0.02]
    #[arg(long, value_name = "KELVIN", value_parser = non_negative)]
    noise_temperature: Option<f64>,
    /// Constant error of cell voltages (V)
    #[arg(long, value_name = "VOLTS", allow_negative_numbers = true, value_parser = finite)]
    offset_voltage: Option<f64>,
    /// Constant error of the current (A) [default: paper 0.01]
    #[arg(long, value_name = "AMPERES", allow_negative_numbers = true, value_parser = finite)]
    offset_current: Option<f64>,
    /// Relative error of the current [default: paper 0.005]
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true, value_parser = finite)]
    gain_current: Option<f64>,
    /// Step of the voltage converter (V), in addition to the DBC's resolution
    #[arg(long, value_name = "VOLTS", value_parser = non_negative)]
    resolution_voltage: Option<f64>,
    /// Probability that a reading is missing
    #[arg(long, value_name = "PROBABILITY", value_parser = share)]
    dropout: Option<f64>,
}

impl Changes {
    pub(super) fn apply(&self, settings: &mut Settings) -> Result<(), Failure> {
        settings.seed = self.seed;
        settings.cycles = self.cycles.or(settings.cycles);
        // Only ev-day has a default duration. It is the duration of one cycle, which is a day.
        let days = f64::from(self.cycles.unwrap_or(1));
        settings.duration_s = self.duration.or(settings.duration_s.map(|day_s| days * day_s));
        settings.walk_steps = self.walk_steps.unwrap_or(settings.walk_steps);
        self.pack.apply(&mut settings.pack);
        self.sensors.apply(&mut settings.sensors);
        self.apply_periods(settings)
    }

    fn apply_periods(&self, settings: &mut Settings) -> Result<(), Failure> {
        let ns = |ms: u32| i64::from(ms) * 1_000_000;
        if let Some(period) = self.period {
            settings.current_period_ns = ns(period);
            settings.cell_period_ns = ns(period);
        }
        settings.cell_period_ns = self.cell_period.map_or(settings.cell_period_ns, ns);
        if settings.cell_period_ns % settings.current_period_ns != 0 {
            let (cell, current) = (settings.cell_period_ns / 1_000_000, settings.current_period_ns / 1_000_000);
            return Err(Failure::new(format!("--cell-period {cell}, must be a multiple of --period {current} ms")));
        }
        Ok(())
    }
}

impl PackChanges {
    fn apply(&self, pack: &mut PackSettings) {
        pack.cells = self.cells.unwrap_or(pack.cells);
        set(&mut pack.initial_soc, self.initial_soc);
        set(&mut pack.ambient_c, self.ambient);
        set(&mut pack.leakage_a, self.leakage);
        set(&mut pack.ageing.capacity_loss_ah_per_cycle, self.loss_per_cycle);
        set(&mut pack.ageing.resistance_growth_per_cycle, self.resistance_per_cycle);
        set(&mut pack.spread.capacity, self.spread_capacity);
        set(&mut pack.spread.resistance, self.spread_resistance);
        set(&mut pack.spread.soc, self.spread_soc);
        if let Some(magnitude_v) = self.hysteresis {
            pack.hysteresis = Hysteresis { magnitude_v, ..Hysteresis::default() };
        }
    }
}

impl SensorChanges {
    fn apply(&self, sensors: &mut Sensors) {
        *sensors = self.sensors.map_or(*sensors, Sensors::of_quality);
        set(&mut sensors.voltage.noise_std, self.noise_voltage);
        set(&mut sensors.voltage.offset, self.offset_voltage);
        set(&mut sensors.voltage.resolution, self.resolution_voltage);
        set(&mut sensors.current.noise_std, self.noise_current);
        set(&mut sensors.current.offset, self.offset_current);
        set(&mut sensors.current.gain, self.gain_current);
        set(&mut sensors.temperature.noise_std, self.noise_temperature);
        for sensor in [&mut sensors.current, &mut sensors.voltage, &mut sensors.temperature] {
            set(&mut sensor.dropout, self.dropout);
        }
    }
}

fn set(value: &mut f64, change: Option<f64>) {
    *value = change.unwrap_or(*value);
}

/// Parses a number above 0.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    within(text, |x| x > 0.0, "above 0")
}

/// Parses a number of 0 or more.
pub(super) fn non_negative(text: &str) -> Result<f64, String> {
    within(text, |x| x >= 0.0, "0 or more")
}
