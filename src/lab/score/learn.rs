//! Learns from measured files before a file is scored. The files run through the monitor one after the other.

use std::path::PathBuf;

use super::feed::{Feeder, Learned, UNKNOWN_GAP_NS};
use crate::error::LabError;
use crate::io::csv_log::CsvOptions;
use crate::measured::MeasuredFile;
use crate::monitor::MonitorConfig;
use crate::quantity::Timestamp;

/// Number of rows between two calls of `progress`. These rows take some milliseconds.
const PROGRESS_ROWS: usize = 4096;

/// Runs `files` through a monitor, with a gap of unknown length between parts and between files. `progress` is called
/// for every file and at least every [`PROGRESS_ROWS`] rows. It may unwind to abort.
///
/// # Errors
/// A file cannot be read.
pub fn learn(
    files: &[PathBuf],
    table: &CsvOptions,
    config: &MonitorConfig,
    sleep_gap_s: f64,
    progress: &dyn Fn(),
) -> Result<Learned, LabError> {
    let mut feeder = Feeder::new(config.clone(), sleep_gap_s, None);
    feeder.out().want_estimates = false;
    let mut latest = Timestamp::ZERO;
    for path in files {
        progress();
        for part in &MeasuredFile::read(path, table)?.parts {
            let Some(&first_s) = part.time_s.first() else { continue };
            let base = latest.plus_nanos(UNKNOWN_GAP_NS).plus_secs(-first_s);
            feeder.unknown_gap(base.plus_secs(first_s));
            for row in 0..part.len() {
                let time = base.plus_secs(part.time_s[row]);
                feeder.row(time, part.current_a[row], part.voltage_v[row], part.temperature_c[row]);
                feeder.out().clear();
                latest = latest.max(time);
                if row % PROGRESS_ROWS == PROGRESS_ROWS - 1 {
                    progress();
                }
            }
        }
    }
    feeder.unknown_gap(latest);
    Ok(feeder.learned())
}
