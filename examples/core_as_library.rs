//! Uses the core as a library: passes the records of a log to the core, and receives events and frames. The core needs
//! no CAN interface and reads no clock.
//!
//! ```sh
//! cargo run --example core_as_library -- examples/pack/pack.toml examples/pack/drive.log
//! ```
//!
//! The program prints each event as a line of JSON, then the state of the pack at the end of the log.

use std::error::Error;
use std::io::{self, Write};
use std::path::Path;

use packwatch::config;
use packwatch::io::csv_log::CsvOptions;
use packwatch::io::event_log;
use packwatch::io::log::{LogOptions, LogSource};
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{Monitor, Outputs, Record, TICK_PERIOD_MS};

/// A gap in the log longer than this (s) means that the recorder was asleep.
const SLEEP_GAP_S: f64 = 5.0;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [config, log] = arguments.as_slice() else { return Err("usage: core_as_library CONFIG LOG".into()) };
    monitor_log(Path::new(config), Path::new(log), &mut io::stdout().lock())
}

/// Passes a log to the core and prints the events and the last state of the pack.
pub(crate) fn monitor_log(config: &Path, log: &Path, out: &mut impl Write) -> Result<(), Box<dyn Error>> {
    // Outside the core: read the files, check the settings and convert the lines of the log to records.
    let config = config::load(config)?;
    let options = LogOptions {
        interfaces: config.interface_names(),
        channels: Vec::new(),
        strict: true,
        csv: CsvOptions::default(),
        encode_row: Box::new(|_, _| 0),
    };
    let mut source = LogSource::new([log.to_owned()], options);

    // The core is a state machine. Pass it every record and every tick in time order.
    let mut monitor = Monitor::new(config.monitor);
    let (mut outputs, mut frames) = (Outputs::default(), 0);
    let mut handle = |monitor: &mut Monitor, record: &Record| -> io::Result<()> {
        outputs.clear();
        monitor.handle(record, &mut outputs);
        frames += outputs.frames.len();
        outputs.events.iter().try_for_each(|event| event_log::write_line(out, event))
    };
    let mut ticks = Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S);
    while let Some(record) = source.next_record()? {
        ticks.advance(record.time);
        while let Some(time) = ticks.pop(monitor.next_due()) {
            handle(&mut monitor, &Record::tick(time))?;
        }
        handle(&mut monitor, &record)?;
    }

    match monitor.pack() {
        Some(pack) => writeln!(out, "SOC {:.1} % ± {:.1} %", 100.0 * pack.soc, 100.0 * pack.soc_std)?,
        None => writeln!(out, "SOC unknown")?,
    }
    writeln!(out, "{frames} frames to send")?;
    Ok(())
}
