//! `packwatch simulate`: simulates a pack and encodes its measurements as frames of the configured DBC.
//!
//! Output: a candump log (`-o`, compressed if its name ends in `.gz`) or frames on an interface (`--to`), and the true
//! state as CSV (`--truth`). The same seed gives the same bytes on every machine. The frames of one sample are spaced
//! as on a 1 Mbit/s bus, or closer if they would otherwise delay the next sample.

mod output;
mod player;
mod settings;

use std::path::PathBuf;

use super::common::numbers::{integer, one_of};
use super::common::output::note;
use crate::can::encode::{InputEncoder, InputProtector};
use crate::can::{CanId, Frame};
use crate::config::{self, Config};
use crate::monitor::MonitorConfig;
use crate::quantity::{BusIndex, CellIndex, Channel, Timestamp};
use crate::sample::{SampleConfig, VoltageSource};
use crate::sim::{Moment, Scenario, Settings, Simulation, Wiring};
use output::{LogWriter, TruthColumns, TruthWriter};
use packwatch_host::failure::Failure;
use player::Player;

/// Time between the frames of one sample, ns: the duration of a classic frame of 8 bytes at 1 Mbit/s.
const FRAME_SPACING_NS: i64 = 130_000;

/// Arguments of `simulate`.
#[derive(Debug, clap::Args)]
#[command(override_usage = "packwatch simulate [OPTIONS] --config <FILE> --out <LOG> <SCENARIO>\n       \
    packwatch simulate [OPTIONS] --config <FILE> --to <INTERFACE> <SCENARIO>")]
pub(crate) struct Args {
    /// Load scenario
    #[arg(value_parser = one_of(&settings::SCENARIOS))]
    scenario: Scenario,
    /// Configuration file with the DBC, the cell model and the number of cells
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Candump log to write, compressed if the name ends in .gz; - writes standard output
    #[arg(short, long, value_name = "LOG", required_unless_present = "to", conflicts_with = "to")]
    out: Option<PathBuf>,
    /// Send the frames on this CAN interface instead of writing a log
    #[arg(long, value_name = "INTERFACE")]
    to: Option<String>,
    /// Play frames this many times faster than real time; 0 = as fast as the bus accepts them
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = settings::non_negative, requires = "to")]
    speed: f64,
    /// Write the true state to this CSV, compressed if the name ends in .gz
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Time between rows of the truth (s)
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0, value_parser = settings::positive)]
    truth_period: f64,
    /// Unix time of the first frame (s)
    #[arg(long, value_name = "SECONDS", default_value_t = 1_700_000_000, value_parser = integer::<u32>(0, u32::MAX))]
    start: u32,
    #[command(flatten)]
    changes: settings::Changes,
}

#[derive(Debug, Default)]
struct Totals {
    frames: u64,
    moments: u64,
    end_s: f64,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = config::load(&args.config)?;
    let settings = settings_for(args, &config)?;
    let monitor = &config.monitor;
    if !monitor.modules.is_empty() {
        return Err(Failure::new(
            "[[pack.module]] cannot be simulated, because all simulated cells are of one kind; remove it from the configuration",
        ));
    }
    let wiring = wiring(&monitor.sample);
    let sensors = u16::try_from(wiring.temperature_at.len()).unwrap_or(u16::MAX);
    let sim = Simulation::new(monitor.model.clone(), settings, wiring);
    let faults = &args.changes.faults;
    let mut sim =
        faults.apply(sim, settings.pack.cells, sensors, settings.pack.capacity_ah, config.monitor.balancing)?;
    let mut sink = Sink::open(args, &config)?;
    let mut truth = match &args.truth {
        Some(path) => {
            let columns = TruthColumns { branches: monitor.model.branches.len(), faults: faults.changes_truth() };
            Some(TruthWriter::create(path, columns, args.truth_period)?)
        }
        None => None,
    };
    let start = Timestamp::from_nanos(i64::from(args.start) * 1_000_000_000);
    let mut frames = FrameMaker::new(monitor, &settings, start);
    let mut totals = Totals::default();
    while let Some(moment) = sim.advance() {
        for (time, bus, frame) in frames.of(&sim, &moment) {
            sink.write(time, bus, frame)?;
            totals.frames += 1;
        }
        if let Some(truth) = &mut truth {
            truth.write(start, &moment, &sim)?;
        }
        totals.moments += 1;
        totals.end_s = moment.time.secs();
    }
    sink.finish()?;
    truth.map_or(Ok(()), TruthWriter::finish)?;
    note(summary(&sim, &totals));
    Ok(())
}

enum Sink {
    Log(LogWriter),
    Bus(Player),
}

impl Sink {
    fn open(args: &Args, config: &Config) -> Result<Self, Failure> {
        match (&args.to, &args.out) {
            (Some(interface), _) => {
                let fd = config.interfaces.iter().any(|interface| interface.fd);
                Ok(Self::Bus(Player::open(interface, fd, args.speed)?))
            }
            (None, Some(path)) => {
                let names = config.interface_names();
                Ok(Self::Log(LogWriter::create(path, names)?))
            }
            (None, None) => Err(Failure::new("give --out LOG or --to INTERFACE")),
        }
    }

    fn write(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) -> Result<(), Failure> {
        match self {
            Self::Log(log) => log.write(time, bus, frame),
            Self::Bus(player) => player.play(time, frame),
        }
    }

    fn finish(self) -> Result<(), Failure> {
        match self {
            Self::Log(log) => log.finish(),
            Self::Bus(_) => Ok(()),
        }
    }
}

/// Returns the settings of the scenario for the configured cell, with the changes from the command line.
fn settings_for(args: &Args, config: &Config) -> Result<Settings, Failure> {
    let capacity_ah = args.changes.pack.capacity_ah.unwrap_or(config.monitor.model.capacity_ah);
    if args.changes.walk_steps.is_some() && args.scenario != Scenario::RandomWalk {
        return Err(Failure::new(
            "--walk-steps changes only the scenario random-walk; choose this scenario or omit the option",
        ));
    }
    let mut settings = Settings::of(args.scenario, capacity_ah);
    let series = cells_in_series(&config.monitor.sample);
    settings.pack.cells = series;
    settings.pack.ambient_c = config.monitor.sample.ambient_c;
    args.changes.apply(&mut settings)?;
    if settings.pack.cells > series {
        let (found, file) = (settings.pack.cells, args.config.display());
        return Err(Failure::new(format!("--cells {found}, must be at most {series}, the number of cells in {file}")));
    }
    Ok(settings)
}

fn cells_in_series(sample: &SampleConfig) -> u16 {
    match sample.voltage_source {
        VoltageSource::Cells => sample.cells,
        VoltageSource::PackTotal { series } => series,
    }
}

/// Places each temperature sensor on the first cell it serves.
fn wiring(sample: &SampleConfig) -> Wiring {
    let cell_of = |sensor| {
        let cell = sample.sensor_of_cell.iter().position(|s| s.is_some_and(|s| s.0 == sensor))?;
        Some(CellIndex(u16::try_from(cell).ok()?))
    };
    Wiring { strings: sample.strings.max(1), temperature_at: (0..sample.sensors()).map(cell_of).collect() }
}

/// Encodes the frames of one sample. The frames with the current come first, because the voltages depend on this
/// current.
struct FrameMaker {
    encoder: InputEncoder,
    protector: InputProtector,
    with_current: Vec<(BusIndex, CanId)>,
    made: Vec<(BusIndex, Frame)>,
    start: Timestamp,
    period_ns: i64,
}

impl FrameMaker {
    fn new(monitor: &MonitorConfig, settings: &Settings, start: Timestamp) -> Self {
        let encoder = InputEncoder::new(&monitor.input).with_answers(&monitor.answers);
        let mut made = Vec::new();
        encoder.encode(&[(Channel::Current, Some(0.0))], &mut made);
        let with_current = made.iter().map(|(bus, frame)| (*bus, frame.id())).collect();
        let protector = InputProtector::new(&monitor.guards);
        Self { encoder, protector, with_current, made, start, period_ns: settings.current_period_ns }
    }

    fn of(&mut self, sim: &Simulation, moment: &Moment) -> impl Iterator<Item = (Timestamp, BusIndex, &Frame)> {
        self.made.clear();
        self.encoder.encode(sim.readings(), &mut self.made);
        self.made.sort_by_key(|(bus, frame)| !self.with_current.contains(&(*bus, frame.id())));
        self.protector.protect(&mut self.made);
        let count = i64::try_from(self.made.len()).unwrap_or(i64::MAX - 1);
        let spacing_ns = FRAME_SPACING_NS.min(self.period_ns / (count + 1));
        let first = self.start.plus_nanos(moment.time.nanos());
        (0..).zip(&self.made).map(move |(i, (bus, frame))| (first.plus_nanos(i * spacing_ns), *bus, frame))
    }
}

fn summary(sim: &Simulation, totals: &Totals) -> String {
    let pack = sim.pack();
    format!(
        "{:.0} s simulated, {} samples, {} frames, {} cycles completed; weakest cell {:.3} Ah, SOC {:.1} to {:.1} %",
        totals.end_s,
        totals.moments,
        totals.frames,
        pack.cycles(),
        pack.lowest_capacity_ah(),
        100.0 * pack.lowest_soc(),
        100.0 * pack.highest_soc(),
    )
}
