//! Judges whether a replay has read the battery at all.
//!
//! A log in a wrong format, with wrong units or of another vehicle still replays without an error, but its result says
//! nothing about the battery. Such a replay counts as failed.

use super::ReplaySummary;
use super::clock::RecordSpan;
use crate::sample::ReadingCounts;

/// Explains why a replay says nothing about the battery; `None` = the replay has used its log.
///
/// `steps` is the number of voltage readings that reached an estimator, `readings` counts all readings of the replay.
pub(super) fn failure(
    summary: &ReplaySummary,
    span: &RecordSpan,
    steps: u64,
    readings: &ReadingCounts,
    interfaces: &[String],
) -> Option<String> {
    no_frames(summary, interfaces)
        .or_else(|| no_estimates(summary, steps, readings))
        .or_else(|| mostly_refused(summary, readings))
        .or_else(|| mostly_asleep(span))
}

fn no_frames(summary: &ReplaySummary, interfaces: &[String]) -> Option<String> {
    let log = &summary.log;
    if log.frames > 0 {
        return None;
    }
    if !log.foreign.is_empty() {
        let names: Vec<_> = log.foreign.keys().map(String::as_str).collect();
        return Some(format!(
            "no frames used: the log has interface {}, configured is {}; --channel {}={} reads it",
            names.join(", "),
            interfaces.join(", "),
            names[0].trim_start_matches("channel "),
            interfaces.first().map_or("INTERFACE", String::as_str),
        ));
    }
    Some(match (&log.first_ignored_line, log.first_bad_line.is_some()) {
        _ if log.lines == 0 => "no frames: the log is empty".to_owned(),
        _ if summary.ticks > 0 => "no frames: the log contains only other records".to_owned(),
        (Some(line), _) => format!("no frames: {line} has no known format"),
        (None, true) => "no frames: every line is bad".to_owned(),
        (None, false) => "no frames: the log has only headers, comments and blank lines".to_owned(),
    })
}

fn no_estimates(summary: &ReplaySummary, steps: u64, readings: &ReadingCounts) -> Option<String> {
    let found = match (steps, readings.accepted + readings.refused()) {
        (1.., _) => return None,
        _ if summary.ticks == 0 && summary.skipped_records > 0 => {
            return Some("no frames used: --from and --until exclude all".to_owned());
        }
        (0, 0) => format!("none of {} frames carries a configured signal", summary.log.frames),
        (0, _) => format!(
            "no voltage was usable: {} readings accepted, {} refused",
            readings.accepted,
            readings.refused_in_words()
        ),
    };
    Some(format!("no estimates: {found}; `packwatch doctor` with this log finds the reason"))
}

fn mostly_refused(summary: &ReplaySummary, readings: &ReadingCounts) -> Option<String> {
    let refused = readings.refused() + summary.log.uncarried_values;
    (refused > readings.accepted).then(|| {
        format!(
            "most readings are refused: {} accepted, {}; `packwatch doctor` with this log finds the reason",
            readings.accepted,
            match summary.log.uncarried_values {
                0 => readings.refused_in_words(),
                values => format!("{values} values are outside the range of their signal"),
            }
        )
    })
}

/// During a gap longer than the sleep gap, the recorder counts as asleep, and nothing is computed.
fn mostly_asleep(span: &RecordSpan) -> Option<String> {
    let (gaps, steps) = span.gaps_and_steps();
    (2 * gaps > steps && steps > 1).then(|| {
        format!(
            "mostly asleep: {gaps} of {steps} steps between stamps are longer than the sleep gap, so nothing is \
             computed there; if the recorder was awake, set max_age_s in [limits.current] and [limits.voltage] to its \
             longest step, or give a longer --sleep-gap"
        )
    })
}
