//! Prints the summary of `replay`.

use std::io::{self, Write};
use std::path::Path;

use crate::io::log::LogCounts;
use crate::monitor::{Event, EventKind};
use crate::quantity::catalogue::Quantity;
use crate::replay::{ProtectedSummary, ReplaySummary};

/// Maximum number of alarms in the table. The JSON summary lists more.
const MAX_SHOWN_ALARMS: usize = 20;
/// Maximum number of cells in the table. The JSON summary has all cells.
const MAX_SHOWN_CELLS: usize = 16;

/// Prints the summary as a line of JSON that begins with the log's name.
pub(super) fn json_line(out: &mut impl Write, log: &Path, summary: &ReplaySummary) -> io::Result<()> {
    #[derive(serde::Serialize)]
    struct Named<'a> {
        name: String,
        #[serde(flatten)]
        summary: &'a ReplaySummary,
    }
    serde_json::to_writer(&mut *out, &Named { name: log.display().to_string(), summary })?;
    writeln!(out)
}

pub(super) fn table(summary: &ReplaySummary, to_stderr: bool) -> io::Result<()> {
    let mut text = Vec::new();
    write_table(&mut text, summary)?;
    if to_stderr { io::stderr().write_all(&text) } else { io::stdout().write_all(&text) }
}

/// Prints the number of frames sent on an interface, and the counts of the log.
pub(super) fn played(sent: u64, interface: &str, counts: &LogCounts, as_json: bool) -> io::Result<()> {
    let mut out = io::stdout().lock();
    if as_json {
        let document = serde_json::json!({ "sent": sent, "to": interface, "log": counts });
        return writeln!(out, "{document}");
    }
    let mut rows = log_rows(counts);
    rows.insert(0, ("frames sent", format!("{sent} to {interface}")));
    write_rows(&mut out, &rows)
}

fn log_rows(log: &LogCounts) -> Vec<(&'static str, String)> {
    let mut rows: Vec<_> = log.inputs.iter().map(|input| ("input", input.clone())).collect();
    rows.extend([("lines", log.lines.to_string()), ("frames", log.frames.to_string())]);
    rows.push(("bad lines", log.bad_lines.to_string()));
    rows.extend(log.first_bad_line.clone().map(|line| ("first bad line", line)));
    if let Some(first) = &log.first_time_backwards {
        rows.push(("stamps backwards", log.time_backwards.to_string()));
        rows.push(("first backwards", first.clone()));
    }
    let counted = [
        ("ignored lines", log.ignored_lines),
        ("CAN XL frames", log.xl_frames),
        ("error frames", log.error_frames),
        ("frames the recorder lost", log.dropped_frames),
        ("unknown gaps", log.unknown_gaps),
        ("values no frame carries", log.uncarried_values),
        ("segments missing at the beginning", log.deleted_segments),
    ];
    rows.extend(counted.into_iter().filter(|&(_, count)| count > 0).map(|(name, count)| (name, count.to_string())));
    rows.extend(log.first_ignored_line.clone().map(|line| ("first ignored line", line)));
    if !log.foreign.is_empty() {
        let each: Vec<_> = log.foreign.iter().map(|(name, count)| format!("{name} {count}")).collect();
        rows.push(("other interfaces", each.join(", ")));
    }
    rows
}

pub(super) fn write_table(out: &mut impl Write, summary: &ReplaySummary) -> io::Result<()> {
    let s = summary;
    let mut rows = log_rows(&s.log);
    rows.push(("record", format!("{:.1} s awake", s.awake_s)));
    rows.push(("wall time", format!("{:.2} s ({:.0} x real time)", s.wall_s, s.times_real_time)));
    rows.push(("rate", format!("{:.0} frames/s, {:.0} cell-steps/s", s.frames_per_s, s.cell_steps_per_s)));
    rows.extend(s.peak_memory_kib.map(|kib| ("peak memory", format!("{:.1} MiB", kib as f64 / 1024.0))));
    rows.push(("ticks", s.ticks.to_string()));
    rows.push(("frames to send", s.frames_out.to_string()));
    let events: Vec<_> = s.events.iter().map(|(name, count)| format!("{name} {count}")).collect();
    rows.push(("events", if events.is_empty() { "none".to_owned() } else { events.join(", ") }));
    rows.extend(s.protected.iter().map(|of| ("protected", statuses(of))));
    rows.extend(
        s.dropped.iter().map(|of| ("too many frames", format!("{} {}: {} dropped", of.interface, of.id, of.dropped))),
    );
    rows.extend(s.controllers.iter().map(|of| ("diagnostic", format!("{} {}: {}", of.interface, of.id, of.words()))));
    rows.extend(s.notes.iter().map(|note| ("note", note.clone())));
    write_rows(out, &rows)?;
    write_cells(out, summary)?;
    for event in s.alarms_raised.iter().take(MAX_SHOWN_ALARMS) {
        write_alarm(out, event)?;
    }
    let more = s.events.get("alarm_raised").copied().unwrap_or(0).saturating_sub(MAX_SHOWN_ALARMS as u64);
    if more > 0 {
        writeln!(out, "... and {more} more alarms")?;
    }
    Ok(())
}

/// Describes a protected message, and how often its end-to-end check gave each status.
fn statuses(of: &ProtectedSummary) -> String {
    let given = of.counts.iter().filter(|(_, count)| **count > 0);
    let given: Vec<_> = given.map(|(status, count)| format!("{status} {count}")).collect();
    let given = if given.is_empty() { "never received".to_owned() } else { given.join(", ") };
    format!("{} {}: {given}", of.interface, of.id)
}

fn write_rows(out: &mut impl Write, rows: &[(&str, String)]) -> io::Result<()> {
    let width = rows.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    rows.iter().try_for_each(|(name, value)| writeln!(out, "{name:width$}  {value}"))
}

fn write_cells(out: &mut impl Write, summary: &ReplaySummary) -> io::Result<()> {
    if summary.cells.is_empty() {
        return writeln!(out, "no estimates");
    }
    let with_std = |value: f64, std: f64, digits: usize| format!("{value:.digits$} +/- {std:.digits$}");
    writeln!(
        out,
        "{:>5}  {:>18}  {:>18}  {:>18}  {:>16}",
        "cell", "SOC %", "capacity Ah", "usable Ah", "resistance x"
    )?;
    for cell in summary.cells.iter().take(MAX_SHOWN_CELLS) {
        let learned = |quantity, digits| match cell.values.pair(quantity) {
            Some((value, std)) => with_std(value, std, digits),
            None => "unknown".to_owned(),
        };
        writeln!(
            out,
            "{:>5}  {:>18}  {:>18}  {:>18}  {:>16}",
            cell.cell + 1,
            with_std(100.0 * cell.soc, 100.0 * cell.soc_std, 2),
            learned(Quantity::Capacity, 3),
            learned(Quantity::UsableCapacity, 3),
            learned(Quantity::ResistanceRatio, 2),
        )?;
    }
    let more = summary.cells.len().saturating_sub(MAX_SHOWN_CELLS);
    if more > 0 { writeln!(out, "  ... and {more} more cells (--json has all)") } else { Ok(()) }
}

fn write_alarm(out: &mut impl Write, event: &Event) -> io::Result<()> {
    let EventKind::Alarm { rule, cell, severity, value, threshold, .. } = event.kind else { return Ok(()) };
    let place = cell.map_or_else(|| "pack".to_owned(), |cell| format!("cell {}", cell.0 + 1));
    let value = value.map_or_else(|| "unknown".to_owned(), |value| format!("{value:.4}"));
    let seconds = event.time.secs();
    writeln!(out, "alarm {} ({severity:?}) at {seconds:.3} s, {place}: {value}, threshold {threshold:.4}", rule.name())
}
