//! Runs the two loops of `packwatch doctor`: one for replayed logs, one for live input. Both pass their input to the
//! core's [`WiringObserver`] and, if the configuration is valid, also to a [`Monitor`].
//!
//! Listening is passive: nothing is sent. An [`Interrupt`] ends both loops early, and the report covers the input so
//! far.

mod survey;
mod trial;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::errno::Errno;

use crate::can::encode::{InputEncoder, InputProtector};
use crate::io::clock::{MappedClock, Reading};
use crate::io::csv_log::CsvOptions;
use crate::io::log::{LogCounts, LogError, LogOptions, LogSource};
use crate::io::reading::LogReading;
use crate::io::runtime::new_runtime;
use crate::io::socket::{PassiveSocket, explained};
use crate::io::stop::Stop;
use crate::monitor::{BusEvent, Monitor, Outputs, Record, RecordKind};
use crate::quantity::BusIndex;
use crate::wiring::{WiringObserver, WiringReport};

pub use survey::{Survey, survey};
pub use trial::try_changes;

/// Progress of a diagnosis.
#[derive(Debug, Clone, Copy)]
pub struct CheckProgress {
    /// Bytes of the logs read.
    pub bytes: u64,
    /// Frames handled.
    pub frames: u64,
    /// Seconds covered, of the log or of real time.
    pub seconds: f64,
}

/// Flag that ends the loops; the signals of [`Stop`] set the flag.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Starts catching the signals.
    ///
    /// # Errors
    /// Fails if the signals cannot be caught.
    pub fn watch() -> std::io::Result<Self> {
        let interrupt = Self::default();
        let flag = Arc::clone(&interrupt.0);
        let runtime = new_runtime()?;
        let mut stop = runtime.block_on(async { Stop::new(None) })?;
        std::thread::spawn(move || {
            runtime.block_on(stop.wait());
            flag.store(true, Ordering::Relaxed);
        });
        Ok(interrupt)
    }

    fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

struct Session {
    observer: WiringObserver,
    monitor: Option<Monitor>,
    out: Outputs,
    configured: usize,
}

impl Session {
    fn new(survey: &Survey) -> Self {
        Self {
            observer: WiringObserver::new(survey.plan.clone()),
            monitor: survey.config.as_ref().map(|config| Monitor::new(config.monitor.clone())),
            out: Outputs { want_estimates: true, ..Outputs::default() },
            configured: survey.plan.interfaces.len(),
        }
    }

    fn feed(&mut self, record: &Record) {
        let bus = match &record.kind {
            RecordKind::Frame { bus, frame } | RecordKind::SecuredFrame { bus, frame, .. } => {
                self.observer.handle_frame(record.time, *bus, frame);
                Some(*bus)
            }
            RecordKind::Bus { bus, event } => {
                self.observer.handle_bus(*bus, *event);
                Some(*bus)
            }
            RecordKind::UnknownGap => {
                self.observer.handle_gap();
                None
            }
            _ => None,
        };
        if bus.is_some_and(|bus| bus.index() >= self.configured) {
            return;
        }
        if let Some(monitor) = &mut self.monitor {
            monitor.handle(record, &mut self.out);
            self.forward_estimates();
        }
    }

    fn forward_estimates(&mut self) {
        self.out.estimates.iter().for_each(|estimate| self.observer.handle_estimate(estimate));
        self.out.clear();
    }

    /// Ends the input and returns the report.
    fn finish(mut self) -> WiringReport {
        if let Some(monitor) = &mut self.monitor {
            monitor.settle(&mut self.out);
            self.forward_estimates();
        }
        self.observer.finish()
    }
}

/// Replays logs, at most their first `limit_s` seconds.
///
/// # Errors
/// Fails if a log cannot be read, or if the logs have no records.
pub fn replay(
    survey: &Survey,
    logs: &[PathBuf],
    reading: &LogReading,
    limit_s: Option<f64>,
    interrupt: &Interrupt,
    each: &mut dyn FnMut(CheckProgress),
) -> Result<(WiringReport, LogCounts), LogError> {
    let pack = &survey.plan.pack;
    let (cells, is_total) = (pack.cells, pack.is_total);
    let encoder = InputEncoder::new(&survey.input).with_answers(&survey.answers);
    let mut protector = InputProtector::new(&survey.plan.guards);
    let mut source = LogSource::new(
        logs.to_vec(),
        LogOptions {
            interfaces: survey.plan.interfaces.iter().map(|interface| interface.name.clone()).collect(),
            channels: reading.channels.clone(),
            strict: reading.strict,
            csv: reading.csv_options(CsvOptions {
                cells: if is_total { 1 } else { cells },
                pack_total: is_total,
                series: cells,
                capacity_ah: Some(pack.capacity_ah * f64::from(pack.strings.max(1))),
                ..CsvOptions::default()
            }),
            encode_row: Box::new(move |values, frames| {
                let uncarried = encoder.encode(values, frames);
                protector.protect(frames);
                uncarried
            }),
        },
    );
    source.adopt_foreign();
    let mut session = Session::new(survey);
    let mut known = session.configured;
    let mut records = 0_u64;
    while let Some(record) = source.next_record()? {
        for name in source.interfaces().iter().skip(known) {
            session.observer.add_interface(name);
        }
        known = source.interfaces().len();
        session.feed(&record);
        records += 1;
        let is_over = limit_s.is_some_and(|limit_s| session.observer.seconds() >= limit_s) && !record.is_unknown_gap();
        if is_over || interrupt.is_set() {
            break;
        }
        if records.is_multiple_of(4096) {
            let bytes = source.read_bytes().load(Ordering::Relaxed);
            each(CheckProgress { bytes, frames: session.observer.frames(), seconds: session.observer.seconds() });
        }
    }
    let counts = source.counts().clone();
    if records == 0 {
        return Err(no_records(logs, &counts));
    }
    Ok((session.finish(), counts))
}

/// Explains that logs have no records, so that nothing can be said about the wiring.
fn no_records(logs: &[PathBuf], counts: &LogCounts) -> LogError {
    let names: Vec<_> = logs.iter().map(|log| log.display().to_string()).collect();
    let bad = counts.first_bad_line.as_ref().map_or_else(String::new, |first| {
        format!("; {} of {} lines cannot be read, first {first}", counts.bad_lines, counts.lines)
    });
    LogError::Data(format!("{}: no CAN frames; give a journal, a candump log or a CSV log{bad}", names.join(", ")))
}

struct BusListener {
    bus: BusIndex,
    name: String,
    tap: Option<PassiveSocket>,
    look_at: Instant,
}

/// Listens to the configured interfaces and all other CAN interfaces of this computer for `duration`.
///
/// # Errors
/// Fails if this kernel has no SocketCAN.
pub fn listen(
    survey: &Survey,
    duration: Duration,
    interrupt: &Interrupt,
    each: &mut dyn FnMut(CheckProgress),
) -> std::io::Result<WiringReport> {
    let clock = MappedClock::new(Reading::now());
    let mut session = Session::new(survey);
    let mut names: Vec<String> = survey.plan.interfaces.iter().map(|interface| interface.name.clone()).collect();
    for name in can_interfaces(clock) {
        if !names.contains(&name) && names.len() < usize::from(u8::MAX) {
            session.observer.add_interface(&name);
            names.push(name);
        }
    }
    let began = Instant::now();
    let listener = |(bus, name)| BusListener { bus: BusIndex(bus), name, tap: None, look_at: began };
    let mut listeners: Vec<BusListener> = (0_u8..).zip(names).map(listener).collect();
    let mut received = Vec::new();
    while began.elapsed() < duration && !interrupt.is_set() {
        for listener in &mut listeners {
            listener.look(clock, &mut session)?;
            listener.read(&mut received, &mut session);
        }
        received.sort_by_key(|record| record.time);
        received.drain(..).for_each(|record| session.feed(&record));
        each(CheckProgress { bytes: 0, frames: session.observer.frames(), seconds: began.elapsed().as_secs_f64() });
        // The kernel buffers thousands of frames, and a full bus delivers only 80 in 10 ms.
        std::thread::sleep(Duration::from_millis(10));
    }
    session.observer.handle_listened(began.elapsed().as_secs_f64());
    Ok(session.finish())
}

impl BusListener {
    fn look(&mut self, clock: MappedClock, session: &mut Session) -> std::io::Result<()> {
        if self.tap.is_some() || Instant::now() < self.look_at {
            return Ok(());
        }
        self.look_at = Instant::now() + Duration::from_millis(500);
        match PassiveSocket::open(&self.name, clock) {
            Ok((tap, is_up)) => {
                self.tap = Some(tap);
                session.observer.handle_bus(self.bus, if is_up { BusEvent::Up } else { BusEvent::Down });
            }
            Err(error) if error.raw_os_error() == Some(Errno::EAFNOSUPPORT as i32) => {
                let why = explained(&error);
                return Err(std::io::Error::other(format!("{}: {why}, or give a log to replay instead", self.name)));
            }
            Err(_) => session.observer.handle_bus(self.bus, BusEvent::Missing),
        }
        Ok(())
    }

    fn read(&mut self, received: &mut Vec<Record>, session: &mut Session) {
        let Some(tap) = &mut self.tap else { return };
        let before = received.len();
        loop {
            match tap.next(self.bus, received) {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) if error.raw_os_error() == Some(Errno::ENETDOWN as i32) => {
                    session.observer.handle_bus(self.bus, BusEvent::Down);
                }
                Err(_) => {
                    session.observer.handle_bus(self.bus, BusEvent::Missing);
                    self.tap = None;
                    break;
                }
            }
        }
        if received.len() > before {
            session.observer.handle_bus(self.bus, BusEvent::Up);
        }
    }
}

/// Names of the CAN interfaces of this computer, sorted. An interface counts as a CAN interface if a CAN socket can be
/// bound to it.
fn can_interfaces(clock: MappedClock) -> Vec<String> {
    let Ok(interfaces) = nix::net::if_::if_nameindex() else { return Vec::new() };
    let names = interfaces.iter().filter_map(|interface| interface.name().to_str().ok());
    let mut names: Vec<String> =
        names.filter(|name| PassiveSocket::open(name, clock).is_ok()).map(str::to_owned).collect();
    names.sort_unstable();
    names
}
