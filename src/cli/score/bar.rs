//! Progress of `score` on the terminal.

use indicatif::ProgressBar;

use crate::cli::common::progress::progress_bar;
use crate::lab::score::ScoreJob;

/// Progress by file size on standard error, if that is a terminal.
pub(super) struct Bar {
    bar: ProgressBar,
    bytes: Vec<f64>,
}

impl Bar {
    pub(super) fn new(jobs: &[ScoreJob]) -> Self {
        let bytes: Vec<f64> =
            jobs.iter().map(|job| std::fs::metadata(&job.path).map_or(0.0, |found| found.len() as f64)).collect();
        let bar = progress_bar(bytes.iter().sum::<f64>() as u64, "{bar:32} {percent} % of {msg}, eta {eta}");
        bar.set_message(if jobs.len() == 1 { "1 file".to_owned() } else { format!("{} files", jobs.len()) });
        Self { bar, bytes }
    }

    /// Adds a fraction of the work on file `index`.
    pub(super) fn advance(&self, index: usize, part: f64) {
        self.bar.inc((part * self.bytes.get(index).copied().unwrap_or(0.0)).round() as u64);
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}
