//! Completes the user's settings for reading logs with settings from the configuration.

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

/// Minimum of the default sleep gap (s).
const LEAST_SLEEP_GAP_S: f64 = 30.0;

/// Default sleep gap (s). If a log contains no record for longer than this, the computer that recorded the log counts
/// as asleep. The sleep gap is at least the maximum age of a current and of a voltage, so the computer counts as awake
/// while one of these values is fresh.
pub fn sleep_gap_s(config: &MonitorConfig) -> f64 {
    LEAST_SLEEP_GAP_S.max(config.sample.current.max_age_s).max(config.sample.voltage.max_age_s)
}

/// Settings for reading logs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LogReading {
    /// Whether reading ends at the first malformed line.
    pub strict: bool,
    /// Maps a channel or interface, as written in the log, to an interface.
    pub channels: Vec<(String, String)>,
    /// For CSV logs: maps roles to columns, see [`CsvOptions::columns`].
    pub columns: Vec<(String, String)>,
    /// For CSV logs: whether a positive current is a charge; `None` = the file decides.
    pub charge_positive: Option<bool>,
    /// For CSV logs: table with the start of each section, see [`CsvOptions::start_times`].
    pub start_times: Option<PathBuf>,
}

impl LogReading {
    /// Returns the options for reading a table; `pack` are the options that follow from the pack.
    pub fn csv_options(&self, pack: CsvOptions) -> CsvOptions {
        CsvOptions {
            columns: self.columns.clone(),
            charge_positive: self.charge_positive,
            start_times: self.start_times.clone(),
            ..pack
        }
    }

    /// Returns the options for reading a log with this configuration.
    pub fn options(&self, config: &Config) -> LogOptions {
        LogOptions {
            interfaces: config.interface_names(),
            channels: self.channels.clone(),
            strict: self.strict,
            csv: self.csv_options(table_options(&config.monitor)),
            encode_row: {
                let mut row_frames = RowFrames::new(&config.monitor);
                Box::new(move |values, frames| row_frames.encode(values, frames))
            },
        }
    }
}

/// The options that follow from the pack: cells, sensors and capacity.
fn table_options(config: &MonitorConfig) -> CsvOptions {
    let sample = &config.sample;
    CsvOptions {
        cells: sample.cells,
        series: sample.series(),
        sensors: sample.sensors(),
        pack_total: matches!(sample.voltage_source, VoltageSource::PackTotal { .. }),
        reported_soc: sample.reported_soc.is_some(),
        capacity_ah: Some(config.model.rated_capacity_ah * f64::from(sample.strings)),
        ..CsvOptions::default()
    }
}

/// Encodes rows of values as frames in the same way as the senders of these frames, including protection.
#[derive(Debug)]
pub struct RowFrames {
    encoder: InputEncoder,
    protector: InputProtector,
}

impl RowFrames {
    /// Creates an encoder for the input signals of this configuration.
    pub fn new(config: &MonitorConfig) -> Self {
        Self {
            encoder: InputEncoder::new(&config.input).with_answers(&config.answers),
            protector: InputProtector::new(&config.guards),
        }
    }

    /// Appends the frames that carry `values` (`None` and NaN mean no value). Returns the number of values that no
    /// frame can carry.
    pub fn encode(&mut self, values: &[(Channel, Option<f64>)], frames: &mut Vec<(BusIndex, Frame)>) -> usize {
        let uncarried = self.encoder.encode(values, frames);
        self.protector.protect(frames);
        uncarried
    }
}
