//! Sets up the program's log. If systemd has connected standard error to journald, lines are sent to journald with
//! fields. Otherwise, lines are written to standard error as text. `limit` limits the number of lines per second.
//!
//! The filter comes from `--log` or from `PACKWATCH_LOG`; a filter that cannot be parsed is an error.

mod journald;
mod limit;

use std::io::IsTerminal;
use std::os::linux::fs::MetadataExt;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::time::FormatTime;
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use journald::Journal;
use limit::RateLimit;

use crate::io::clock::Reading;
use crate::io::stamp::format_utc_micros;
use crate::quantity::Timestamp;

/// Environment variable with the filter, used if `--log` is not given.
pub const LOG_VARIABLE: &str = "PACKWATCH_LOG";

/// Number of lines that were not logged, because they exceeded the limit or journald did not accept them.
static LEFT_OUT: AtomicU64 = AtomicU64::new(0);

/// Crates of this program that log in addition to `packwatch` itself.
const MEMBER_CRATES: [&str; 4] = ["packwatch_core", "packwatch_host", "packwatch_lab", "packwatch_uplink"];

/// The MQTT library. It warns about every rejected message; the uplink logs each reason once.
const MQTT_LIBRARY: &str = "rumqttc";

fn note_left_out() {
    LEFT_OUT.fetch_add(1, Ordering::Relaxed);
}

/// Number of lines dropped from the log since the last call.
pub fn take_left_out() -> u64 {
    LEFT_OUT.swap(0, Ordering::Relaxed)
}

/// Starts logging. `filter` is a level (`info`) or a filter (`packwatch::io=debug,info`).
///
/// # Errors
/// Fails if the filter cannot be parsed.
pub fn start(filter: Option<&str>) -> Result<(), String> {
    let text = filter.map(str::to_owned).or_else(|| std::env::var(LOG_VARIABLE).ok()).unwrap_or_else(|| "info".into());
    let registry = tracing_subscriber::registry().with(targets(&text)?);
    // If logging has already been started (in tests), the first logger stays.
    let _ = match stderr_is_journal().then(Journal::new) {
        Some(Ok(journal)) => registry.with(journal.with_filter(RateLimit::default())).try_init(),
        // Colours are used only on a terminal. An empty NO_COLOR counts as not set.
        _ => {
            let wanted = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
            let ansi = wanted && std::io::stderr().is_terminal();
            let lines = fmt::layer().with_writer(std::io::stderr).with_ansi(ansi).with_timer(WallClock);
            registry.with(lines.with_filter(RateLimit::default())).try_init()
        }
    };
    Ok(())
}

/// Formats the time of a line in UTC, to the microsecond. The timer of `tracing` is not used because it calls
/// `SystemTime::now`, which panics after 2038 on 32-bit processors with musl.
struct WallClock;

impl FormatTime for WallClock {
    fn format_time(&self, line: &mut Writer<'_>) -> std::fmt::Result {
        line.write_str(&format_utc_micros(Timestamp::from_nanos(Reading::now().realtime_ns)))
    }
}

/// Parses a filter. `packwatch::MODULE` selects this module in every member crate.
fn targets(text: &str) -> Result<Targets, String> {
    let allowed = "must be error, warn, info, debug, trace or off, or a filter such as packwatch::io=debug,info";
    let filter: Targets = text.parse().map_err(|error| format!("log filter '{text}': {error}, {allowed}"))?;
    // A single word that is not a level would be taken for a module name, and nothing would be logged.
    let is_level = |word: &str| word.parse::<LevelFilter>().is_ok() || word.starts_with("packwatch");
    let mut words = text.split(',').map(str::trim).filter(|word| !word.is_empty() && !word.contains('='));
    if let Some(word) = words.find(|word| !is_level(word)) {
        return Err(format!("log filter '{text}': {word:?} is not a level, {allowed}"));
    }
    let modules = filter.iter().filter_map(|(target, level)| Some((target.strip_prefix("packwatch::")?, level)));
    let members =
        modules.flat_map(|(module, level)| MEMBER_CRATES.map(|member| (format!("{member}::{module}"), level)));
    let members: Vec<_> = members.collect();
    let is_quiet = !text.contains(MQTT_LIBRARY) && filter.default_level() <= Some(LevelFilter::INFO);
    let library = is_quiet.then_some((MQTT_LIBRARY.to_owned(), LevelFilter::ERROR));
    Ok(filter.with_targets(members).with_targets(library))
}

/// Whether standard error is connected to journald. systemd identifies this stream by device and inode.
fn stderr_is_journal() -> bool {
    let Ok(stream) = std::env::var("JOURNAL_STREAM") else { return false };
    std::fs::metadata("/proc/self/fd/2").is_ok_and(|file| stream == format!("{}:{}", file.st_dev(), file.st_ino()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing::Level;

    #[test]
    fn filter_module_matches_every_member_crate() {
        let filter = targets("warn,packwatch::io=debug,packwatch_host::store=trace").unwrap();
        for (target, level, expected) in [
            ("packwatch_host::io::socket", Level::DEBUG, true),
            ("packwatch_host::io", Level::TRACE, false),
            ("packwatch_host::store::writer", Level::TRACE, true),
            ("packwatch_host::service", Level::INFO, false),
            ("packwatch_host::service", Level::WARN, true),
        ] {
            assert_eq!(filter.would_enable(target, &level), expected, "{target} {level}");
        }
        let all = targets("packwatch=debug").unwrap();
        assert!(
            all.would_enable("packwatch_host::service", &Level::DEBUG) && !all.would_enable("hyper", &Level::ERROR)
        );
        for (filter, is_logged) in [("info", false), ("debug", true), ("info,rumqttc=warn", true)] {
            assert_eq!(targets(filter).unwrap().would_enable("rumqttc::state", &Level::WARN), is_logged, "{filter}");
        }
        assert!(targets("loud").unwrap_err().contains("\"loud\" is not a level, must be error, warn"));
        assert!(targets("packwatch::io=loud").unwrap_err().starts_with("log filter 'packwatch::io=loud': "));
    }
}
