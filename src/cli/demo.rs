//! `packwatch demo`: simulates a short battery life on a bus inside this process, until alarms are raised. It needs no
//! CAN interface, no root privileges and no files.
//!
//! A simulated cell loses 0.1 Ah per cycle. Its readings become frames of `config/measured.dbc`, which the core
//! processes like live frames. A consumer that has only `config/packwatch.dbc` decodes the frames that the core sends.
//! The exit code is 0 if a capacity alarm and a recharge-period alarm were raised and the DBC defines every sent frame,
//! else 1.

mod consumer;
mod table;

use std::io::{self, Write};
use std::path::Path;

use super::common::numbers::integer;
use super::common::output::word;
use crate::alarm::{Change, Rule};
use crate::can::Frame;
use crate::can::encode::InputEncoder;
use crate::config::{self, Config, ConfigFiles};
use crate::io::candump::{self, StampDigits};
use crate::io::ticks::Ticks;
use crate::monitor::{EventKind, Monitor, Outputs, Record, TICK_PERIOD_MS};
use crate::quantity::{BusIndex, CellIndex, Timestamp};
use crate::sim::{Moment, Scenario, Settings, Simulation, Wiring};
use consumer::Consumer;
use packwatch_host::failure::Failure;
use table::Table;

/// Files built into the binary, by the path used in the configuration.
const FILES: [(&str, &str); 3] = [
    ("demo.toml", include_str!("../../config/demo.toml")),
    ("measured.dbc", include_str!("../../config/measured.dbc")),
    ("cells/example_nmc_2600.toml", include_str!("../../config/cells/example_nmc_2600.toml")),
];
/// Loss of capacity per cycle (Ah). With this loss, the capacity alarm and the recharge-period alarm are raised within
/// about ten cycles.
const LOSS_AH_PER_CYCLE: f64 = 0.1;
/// SOC range of the cycles. It is wider than the recharge window, so that every charge covers the whole window.
const SOC_WINDOW: (f64, f64) = (0.2, 0.95);
/// Maximum number of cycles. After this number the cell has 1.2 Ah, far below the thresholds of the two alarms.
const MAX_CYCLES: u32 = 14;
/// Number of samples between two updates of the live row, which shows the current state on a terminal.
const LIVE_SAMPLES: u64 = 400;
/// Bus time at the start of the demo (Unix time, as in a log).
const START: Timestamp = Timestamp::from_nanos(1_700_000_000_000_000_000);
/// Longest gap between frames (s) that does not count as sleep. All gaps of the demo are shorter.
const SLEEP_GAP_S: f64 = 30.0;

/// Arguments of `demo`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Seed of the sensor noise
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = integer::<u64>(0, u64::MAX))]
    seed: u64,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = config::load_with(&ConfigFiles::alone(Path::new("demo.toml")), &read_built_in)?;
    let mut demo = Demo::new(config, args.seed)?;
    demo.run().map_err(|error| Failure::new(format!("standard output: {error}")))?;
    demo.conclude()
}

fn read_built_in(path: &Path) -> io::Result<Vec<u8>> {
    let found = FILES.iter().find(|(name, _)| Path::new(name) == path);
    found.map(|(_, text)| text.as_bytes().to_vec()).ok_or_else(|| io::ErrorKind::NotFound.into())
}

/// An alarm at the moment it was raised.
struct RaisedAlarm {
    rule: Rule,
    cycle: u32,
    true_capacity_ah: f64,
    time: Timestamp,
    bus: BusIndex,
    frame: Frame,
}

struct Demo {
    sim: Simulation,
    encoder: InputEncoder,
    monitor: Monitor,
    ticks: Ticks,
    consumer: Consumer,
    interfaces: Vec<String>,
    rated_ah: f64,
    /// True capacity in the present cycle. The simulation subtracts the loss when a cycle completes.
    true_capacity_ah: f64,
    out: Outputs,
    table: Table,
    raised: Vec<RaisedAlarm>,
    frames_in: u64,
    frames_out: u64,
}

impl Demo {
    fn new(config: Config, seed: u64) -> Result<Self, Failure> {
        let model = config.monitor.model.clone();
        let mut settings = Settings::of(Scenario::Paper, model.capacity_ah);
        settings.seed = seed;
        settings.soc_window = SOC_WINDOW;
        settings.pack.initial_soc = SOC_WINDOW.1;
        settings.pack.ageing.capacity_loss_ah_per_cycle = LOSS_AH_PER_CYCLE;
        settings.cycles = Some(MAX_CYCLES);
        Ok(Self {
            rated_ah: model.rated_capacity_ah,
            true_capacity_ah: model.capacity_ah,
            sim: Simulation::new(model, settings, Wiring::single()),
            encoder: InputEncoder::new(&config.monitor.input),
            interfaces: config.interfaces.into_iter().map(|i| i.name).collect(),
            monitor: Monitor::new(config.monitor),
            ticks: Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S),
            consumer: Consumer::new(include_str!("../../config/packwatch.dbc"))?,
            out: Outputs::default(),
            table: Table::new(),
            raised: Vec::new(),
            frames_in: 0,
            frames_out: 0,
        })
    }

    /// Runs the demo and prints everything except the last line, which [`Self::conclude`] prints.
    fn run(&mut self) -> io::Result<()> {
        let chain = "cell -> frames -> monitor -> frames -> consumer";
        writeln!(io::stdout(), "one 2.6 Ah cell loses {LOSS_AH_PER_CYCLE} Ah per cycle; {chain}")?;
        self.live()?;
        self.show_alarm_frames()
    }

    /// Simulates until one cycle after the later of the two alarms, at most [`MAX_CYCLES`] cycles.
    fn live(&mut self) -> io::Result<()> {
        let (mut samples, mut cycles) = (0_u64, 0);
        let mut frames = Vec::new();
        while let Some(moment) = self.sim.advance() {
            if self.sim.pack().cycles() != cycles {
                self.table.keep(&self.row(&moment, cycles))?;
                cycles = self.sim.pack().cycles();
                if self.is_complete() {
                    break;
                }
            }
            frames.clear();
            self.true_capacity_ah = self.sim.pack().lowest_capacity_ah();
            self.encoder.encode(self.sim.readings(), &mut frames);
            for (bus, frame) in &frames {
                self.feed(START.plus_nanos(moment.time.nanos()), *bus, frame);
            }
            samples += 1;
            if samples.is_multiple_of(LIVE_SAMPLES) {
                self.table.redraw(&self.row(&moment, cycles))?;
            }
        }
        self.table.close()
    }

    /// Handles one frame from the bus, after the ticks due before it.
    fn feed(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.ticks.advance(time);
        while let Some(tick) = self.ticks.pop(self.monitor.next_due()) {
            self.monitor.handle(&Record::tick(tick), &mut self.out);
        }
        self.monitor.handle(&Record::frame(time, bus, frame), &mut self.out);
        self.frames_in += 1;
        self.collect();
    }

    /// Passes every sent frame to the consumer and keeps the frames of newly raised alarms.
    fn collect(&mut self) {
        let (cycle, true_capacity_ah) = (self.sim.pack().cycles() + 1, self.true_capacity_ah);
        for sent in &self.out.frames {
            self.frames_out += 1;
            self.consumer.receive(&sent.frame);
        }
        for event in &self.out.events {
            let EventKind::Alarm { rule, change: Change::Raised, .. } = event.kind else { continue };
            let frame = self.out.frames.iter().find(|sent| self.consumer.is_alarm(&sent.frame, rule));
            if let Some(sent) = frame {
                let (time, bus, frame) = (sent.time, sent.bus, sent.frame);
                self.raised.push(RaisedAlarm { rule, cycle, true_capacity_ah, time, bus, frame });
            }
        }
        self.out.clear();
    }

    fn first(&self, rule: Rule) -> Option<&RaisedAlarm> {
        self.raised.iter().find(|raised| raised.rule == rule)
    }

    fn is_complete(&self) -> bool {
        let last = self.first(Rule::CapacityLow).zip(self.first(Rule::RechargePeriodLow));
        // The demo ends one cycle after the later alarm.
        last.is_some_and(|(a, b)| self.sim.pack().cycles() + 1 > a.cycle.max(b.cycle) + 1)
    }

    fn row(&self, moment: &Moment, cycles: u32) -> String {
        let soc = match self.monitor.latest().next().flatten() {
            Some(e) => format!("{:6.1} +-{:5.1}", 100.0 * e.soc, 100.0 * e.soc_std),
            None => format!("{:>6}{:8}", "-", ""),
        };
        let (cycle, hours, true_soc) =
            (cycles + 1, moment.time.secs() / 3600.0, 100.0 * self.sim.pack().cells()[0].soc);
        let capacity = self.monitor.capacity(CellIndex(0));
        let (ah, std_ah, true_ah, soh) =
            (capacity.mean, capacity.std(), self.true_capacity_ah, 100.0 * capacity.mean / self.rated_ah);
        let recharge = self.monitor.recharge_period_s().map_or("-".to_owned(), |s| format!("{s:.0}"));
        let mode = word(self.monitor.mode());
        let mut alarms: Vec<String> = self.raised.iter().map(|raised| raised.rule.name().replace('_', " ")).collect();
        alarms.dedup();
        format!(
            "{cycle:5} {hours:5.1} h | {soc} {true_soc:6.1} | {ah:8.3} +-{std_ah:6.3} {true_ah:6.3} | {soh:4.0} | {recharge:>8} | \
             {mode:10} {}",
            alarms.join(", ")
        )
    }

    /// Prints the alarm frames as an ECU receives them.
    fn show_alarm_frames(&self) -> io::Result<()> {
        let mut out = io::stdout();
        let (frames_in, frames_out, unknown) = (self.frames_in, self.frames_out, self.consumer.unknown_frames());
        writeln!(out, "\n{frames_in} frames in, {frames_out} out, {unknown} of them not in config/packwatch.dbc")?;
        writeln!(out, "alarm frames, decoded with that file:")?;
        for raised in &self.raised {
            let interface = self.interfaces.get(raised.bus.index()).map_or("?", String::as_str);
            candump::write_line(&mut out, raised.time, StampDigits::Micros, interface, &raised.frame)?;
            writeln!(out, "    {}", self.consumer.explain(&raised.frame))?;
        }
        Ok(())
    }

    /// Prints the result in one line. Fails if an alarm is missing, or if the DBC does not define a sent frame.
    fn conclude(&self) -> Result<(), Failure> {
        let unknown = self.consumer.unknown_frames();
        match (self.first(Rule::CapacityLow), self.first(Rule::RechargePeriodLow)) {
            (Some(capacity), Some(recharge)) if unknown == 0 => {
                let line = format!(
                    "capacity alarm raised in cycle {} (true capacity {:.2} Ah), recharge-period alarm in cycle {}",
                    capacity.cycle, capacity.true_capacity_ah, recharge.cycle
                );
                writeln!(io::stdout(), "\n{line}").map_err(|error| Failure::new(format!("standard output: {error}")))
            }
            (capacity, recharge) => {
                let word = |found: Option<&RaisedAlarm>| if found.is_some() { "raised" } else { "missing" };
                let (capacity, recharge) = (word(capacity), word(recharge));
                Err(Failure::new(format!(
                    "capacity alarm {capacity}, recharge-period alarm {recharge}, {unknown} frames not in config/packwatch.dbc"
                )))
            }
        }
    }
}
