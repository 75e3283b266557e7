//! Where the log goes: journald with its fields when systemd connected standard error to it, else standard error.
//! Either way no more than a burst and a trickle of it ([`limit`]).

mod journald;
mod limit;

use std::io::IsTerminal;
use std::os::linux::fs::MetadataExt;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt;
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use journald::Journal;
use limit::Limit;

/// Environment variable with the filter, where `--log` is not given.
pub const LOG_VARIABLE: &str = "PACKWATCH_LOG";

/// Lines that are in no log: over the limit, or not taken by journald.
static LEFT_OUT: Count = Count(AtomicU64::new(0));

/// A number that only grows until it is taken.
#[derive(Debug)]
struct Count(AtomicU64);

impl Count {
    fn add(&self, lines: u64) {
        self.0.fetch_add(lines, Ordering::Relaxed);
    }
}

/// Lines left out of the log since the last call.
pub fn take_left_out() -> u64 {
    LEFT_OUT.0.swap(0, Ordering::Relaxed)
}

/// Starts logging; `filter` is a level (`info`) or a filter (`packwatch_host::io=debug,info`).
///
/// # Errors
/// When the filter cannot be read.
pub fn start(filter: Option<&str>) -> Result<(), String> {
    let text = filter.map(str::to_owned).or_else(|| std::env::var(LOG_VARIABLE).ok()).unwrap_or_else(|| "info".into());
    let filter: Targets = text.parse().map_err(|error| format!("log filter '{text}': {error}"))?;
    let registry = tracing_subscriber::registry().with(filter);
    // A second start (tests) keeps the first logger: nothing is lost by that.
    let _ = match stderr_is_journal().then(Journal::new) {
        Some(Ok(journal)) => registry.with(journal.with_filter(Limit::default())).try_init(),
        // Colours for a person at a terminal; in a file they are rubbish. An empty NO_COLOR counts as none.
        _ => {
            let wanted = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
            let ansi = wanted && std::io::stderr().is_terminal();
            let lines = fmt::layer().with_writer(std::io::stderr).with_ansi(ansi);
            registry.with(lines.with_filter(Limit::default())).try_init()
        }
    };
    Ok(())
}

/// systemd names the journal's stream by device and inode; a redirected standard error is another file.
fn stderr_is_journal() -> bool {
    let Ok(stream) = std::env::var("JOURNAL_STREAM") else { return false };
    std::fs::metadata("/proc/self/fd/2").is_ok_and(|file| stream == format!("{}:{}", file.st_dev(), file.st_ino()))
}
