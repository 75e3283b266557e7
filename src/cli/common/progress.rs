//! Progress bars on standard error, if that is a terminal.

use std::path::PathBuf;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::replay::ReplayProgress;

#[derive(Debug)]
pub(crate) struct Bar(ProgressBar);

impl Bar {
    /// Creates a bar over the total size of the logs. If a size is unknown (standard input), the bar has no end.
    pub(crate) fn new(logs: &[PathBuf]) -> Self {
        Self(bar(logs))
    }

    pub(crate) fn show(&self, progress: ReplayProgress) {
        let seconds = self.0.elapsed().max(Duration::from_millis(1)).as_secs_f64();
        if self.0.is_hidden() {
            return;
        }
        let rate = progress.frames as f64 / seconds;
        self.0.set_message(format!("{rate:.0} frames/s, {:.0} x real time", progress.times_real_time));
        self.0.set_position(progress.bytes);
    }

    /// Seconds since the bar was created, above 0.
    pub(crate) fn seconds(&self) -> f64 {
        self.0.elapsed().max(Duration::from_millis(1)).as_secs_f64()
    }

    pub(crate) fn clear(&self) {
        self.0.finish_and_clear();
    }
}

/// Creates a bar over the sizes of logs, without an end if a size is unknown.
pub(crate) fn bar(logs: &[PathBuf]) -> ProgressBar {
    let size = |path: &PathBuf| std::fs::metadata(path).ok().filter(std::fs::Metadata::is_file).map(|m| m.len());
    let total: Option<u64> = logs.iter().map(size).sum();
    let template = match total {
        Some(_) => "{bar:32} {percent:>3} % {bytes}/{total_bytes} {bytes_per_sec} {msg} eta {eta}",
        None => "{spinner} {bytes} {bytes_per_sec} {msg}",
    };
    progress_bar(total, template)
}

/// Creates a progress bar over `total` units; `None` means unknown.
pub(crate) fn progress_bar(total: impl Into<Option<u64>>, template: &str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(total.into(), ProgressDrawTarget::stderr_with_hz(5));
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}
