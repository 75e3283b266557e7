//! Output files of the simulator: a candump log, and the truth (true state of the cells) as CSV, plain or .gz.

use std::io::{self, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::can::Frame;
use crate::cli::common::output::failure;
use crate::io::candump::{self, StampDigits};
use crate::io::result_file::ResultFile;
use crate::quantity::{BusIndex, Timestamp};
use crate::sim::{Moment, Simulation};
use packwatch_host::failure::Failure;

/// An output file, compressed if its name ends in `.gz`.
enum Target {
    Plain(ResultFile),
    Gz(GzEncoder<ResultFile>),
}

impl Target {
    fn create(path: &Path) -> Result<Self, Failure> {
        let file = ResultFile::create(path).map_err(failure)?;
        let is_gz = path.extension().is_some_and(|extension| extension == "gz");
        Ok(if is_gz { Self::Gz(GzEncoder::new(file, Compression::fast())) } else { Self::Plain(file) })
    }

    fn write(&mut self, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), Failure> {
        let written = match self {
            Self::Plain(out) => write(out),
            Self::Gz(out) => write(out),
        };
        written.map_err(failure)
    }

    fn finish(self) -> Result<(), Failure> {
        let finished = match self {
            Self::Plain(out) => out.finish(),
            Self::Gz(out) => out.finish().and_then(ResultFile::finish),
        };
        finished.map_err(failure)
    }
}

/// Writes frames as candump lines with nanosecond stamps.
pub(super) struct LogWriter {
    target: Target,
    interfaces: Vec<String>,
}

impl LogWriter {
    pub(super) fn create(path: &Path, interfaces: Vec<String>) -> Result<Self, Failure> {
        Ok(Self { target: Target::create(path)?, interfaces })
    }

    pub(super) fn write(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) -> Result<(), Failure> {
        let interface = self.interfaces.get(bus.index()).map_or("can0", String::as_str);
        self.target.write(|mut out| candump::write_line(&mut out, time, StampDigits::Nanos, interface, frame))
    }

    pub(super) fn finish(self) -> Result<(), Failure> {
        self.target.finish()
    }
}

/// Optional columns of the truth.
#[derive(Debug, Clone, Copy)]
pub(super) struct TruthColumns {
    /// Number of RC branches of the cell model.
    pub(super) branches: usize,
    /// Whether the truth has the columns for leak, balancing and contact resistance.
    pub(super) faults: bool,
}

pub(super) struct TruthWriter {
    target: Target,
    columns: TruthColumns,
    period_ns: i64,
    next: Option<Timestamp>,
}

impl TruthWriter {
    pub(super) fn create(path: &Path, columns: TruthColumns, period_s: f64) -> Result<Self, Failure> {
        let mut target = Target::create(path)?;
        let branches: String = (1..=columns.branches).map(|i| format!("u{i}_v,")).collect();
        let faults = if columns.faults { ",leak_a,bleeding,contact_ohm" } else { "" };
        target.write(|out| {
            let rest = "capacity_ah,resistance_ratio,current_a,voltage_v,temperature_c";
            writeln!(out, "time_s,cell,soc,{branches}{rest}{faults}")
        })?;
        Ok(Self { target, columns, period_ns: Timestamp::from_secs(period_s).nanos(), next: None })
    }

    /// If rows are due and the cells were sampled, writes one row per cell.
    pub(super) fn write(&mut self, start: Timestamp, moment: &Moment, sim: &Simulation) -> Result<(), Failure> {
        if !moment.cells_sampled || self.next.is_some_and(|next| moment.time < next) {
            return Ok(());
        }
        self.next = Some(moment.time.plus_nanos(self.period_ns));
        let time_ns = start.plus_nanos(moment.time.nanos()).nanos();
        let (seconds, micros) = (time_ns / 1_000_000_000, time_ns % 1_000_000_000 / 1000);
        let (columns, current_a, pack) = (self.columns, moment.current_a, sim.pack());
        self.target.write(|out| {
            let cells = pack.cells().iter().zip(sim.voltages_v()).zip(pack.leaks_a());
            for (cell, ((truth, voltage_v), leak_a)) in cells.enumerate() {
                write!(out, "{seconds}.{micros:06},{cell},{:.9}", truth.soc)?;
                for u in &truth.branch_v[..columns.branches] {
                    write!(out, ",{u:.6}")?;
                }
                let (capacity, ratio, celsius) = (truth.capacity_ah, truth.resistance_ratio, truth.temperature_c);
                write!(out, ",{capacity:.6},{ratio:.6},{current_a:.6},{voltage_v:.6},{celsius:.3}")?;
                if columns.faults {
                    write!(out, ",{leak_a:.6},{},{:.6}", u8::from(truth.bleed_a > 0.0), truth.contact_ohm)?;
                }
                writeln!(out)?;
            }
            Ok(())
        })
    }

    pub(super) fn finish(self) -> Result<(), Failure> {
        self.target.finish()
    }
}
