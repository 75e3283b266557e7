//! How to read logs with a configuration: the reader's settings, completed from the configuration.

use std::path::PathBuf;

use crate::can::Frame;
use crate::can::decode::Channel;
use crate::can::encode::{InputEncoder, InputProtector};
use crate::config::Config;
use crate::io::csv_log::CsvOptions;
use crate::io::log::LogOptions;
use crate::monitor::MonitorConfig;
use crate::quantity::BusIndex;
use crate::sample::VoltageSource;

/// Default sleep gap: a longer hole in a log means that the recorder was asleep, s.
pub const SLEEP_GAP_S: f64 = 30.0;

/// How to read logs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogReading {
    /// Whether a malformed line ends the reading.
    pub strict: bool,
    /// CSV: maps roles to columns, see [`CsvOptions::columns`].
    pub columns: Vec<(String, String)>,
    /// CSV: whether positive current is charge.
    pub charge_positive: bool,
    /// CSV: table with the section column and `start`.
    pub start_times: Option<PathBuf>,
}

impl LogReading {
    /// The options for reading a log with this configuration.
    pub fn options(&self, config: &Config) -> LogOptions {
        let sample = &config.monitor.sample;
        LogOptions {
            interfaces: config.interface_names(),
            strict: self.strict,
            csv: CsvOptions {
                columns: self.columns.clone(),
                charge_positive: self.charge_positive,
                start_times: self.start_times.clone(),
                cells: sample.cells,
                pack_total: matches!(sample.voltage_source, VoltageSource::PackTotal { .. }),
            },
            encode_row: {
                let mut row_frames = RowFrames::new(&config.monitor);
                Box::new(move |values, frames| row_frames.encode(values, frames))
            },
        }
    }
}

/// Encodes rows of values as frames, as their senders would, including protection.
#[derive(Debug)]
pub struct RowFrames {
    encoder: InputEncoder,
    protector: InputProtector,
}

impl RowFrames {
    /// An encoder for the input signals of this configuration.
    pub fn new(config: &MonitorConfig) -> Self {
        Self {
            encoder: InputEncoder::new(&config.input).with_answers(&config.answers),
            protector: InputProtector::new(&config.guards),
        }
    }

    /// Appends the frames that carry `values` (`None` and NaN: no value); returns how many values no frame can carry.
    pub fn encode(&mut self, values: &[(Channel, Option<f64>)], frames: &mut Vec<(BusIndex, Frame)>) -> usize {
        let uncarried = self.encoder.encode(values, frames);
        self.protector.protect(frames);
        uncarried
    }
}
