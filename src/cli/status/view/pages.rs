//! Draws the pages of the live view (`packwatch status --watch`).

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Sparkline};
use serde_json::Value;

use super::app::{App, MAPPED, Page};
use super::plot::{ValueRange, bar, sparkline};
use super::theme::{Theme, clock};
use crate::cli::common::alarms::{AlarmGroup, grouped};
use crate::cli::status::table::alarm_line;
use crate::cli::status::{duration, mean, number, screen_unit, with_std, word};
use crate::quantity::Timestamp;
use crate::quantity::catalogue::Quantity;
use crate::status::document::StatusDocument;
use crate::status::event_words;

/// Width of the cell number at the start of a map row.
const LABEL: usize = 5;
/// Lines reserved below the map for the list of cells.
const LIST_LINES: usize = 4;
/// Smallest range of the SOC bars. It avoids magnifying small differences.
const LEAST_SOC_RANGE: f64 = 0.05;
/// Minimum height of the selected cell's plot, including its title.
const PLOT_LINES: usize = 5;

pub(super) fn page(frame: &mut Frame<'_>, app: &mut App, document: &StatusDocument, theme: Theme, area: Rect) {
    let lines = match app.page {
        Page::Cells => return cells(frame, app, document, theme, area),
        Page::Alarms => alarms(document, theme),
        Page::Interfaces => interfaces(document, theme),
        Page::Counts => counts(document),
        Page::Events => events(document),
    };
    app.page_lines = usize::from(area.height).max(1);
    app.scroll = app.scroll.min(lines.len().saturating_sub(app.page_lines));
    let shown: Vec<Line<'_>> = lines.into_iter().skip(app.scroll).take(app.page_lines).collect();
    frame.render_widget(Paragraph::new(shown), area);
}

fn cells(frame: &mut Frame<'_>, app: &mut App, document: &StatusDocument, theme: Theme, area: Rect) {
    let height = usize::from(area.height);
    let lines = height.saturating_sub(LIST_LINES + 1).max(1);
    let grid = Grid::new(document.cells.len(), usize::from(area.width), lines);
    let map_lines = grid.rows.min(lines) + 1;
    let left = height.saturating_sub(map_lines);
    // The plot also gets the lines that the list does not need.
    let spare = left.saturating_sub(document.cells.len() + 1);
    let plot_lines = if left >= PLOT_LINES + LIST_LINES { PLOT_LINES.max(spare) } else { 0 };
    let length = |lines: usize| Constraint::Length(u16::try_from(lines).unwrap_or(u16::MAX));
    let [map_area, list_area, plot_area] =
        Layout::vertical([length(map_lines), Constraint::Min(0), length(plot_lines)]).areas(area);
    (app.row_cells, app.page_lines) = (grid.per_row, map_lines - 1);
    frame.render_widget(Paragraph::new(map(app, document, theme, &grid, map_lines)), map_area);
    frame.render_widget(Paragraph::new(list(app, document, theme, list_area)), list_area);
    if plot_lines > 0 {
        plot(frame, app, theme, plot_area);
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Grid {
    /// Width of a cell in characters, including the space between cells.
    cell_width: usize,
    per_row: usize,
    rows: usize,
}

impl Grid {
    /// Chooses the largest cell width with which the grid has at most four rows, and at most `lines` rows. If no such
    /// width exists, a cell is one character wide. If the rows still do not fit, the map scrolls.
    fn new(cells: usize, width: usize, lines: usize) -> Self {
        let with = |cell_width: usize| {
            let fit = (width.saturating_sub(LABEL) / cell_width).max(1);
            // If the number of cells in a row is a multiple of 12, cells are easy to count.
            let per_row = if fit >= 12 { fit / 12 * 12 } else { fit };
            Self { cell_width, per_row, rows: cells.div_ceil(per_row) }
        };
        [4, 3, 2].into_iter().map(with).find(|grid| grid.rows <= lines.min(4)).unwrap_or_else(|| with(1))
    }
}

fn map(app: &App, document: &StatusDocument, theme: Theme, grid: &Grid, lines: usize) -> Vec<Line<'static>> {
    let cells = &document.cells;
    let (quantity, name) = MAPPED[app.mapped];
    let known = ValueRange::of(cells.iter().filter_map(|cell| cell.values.mean(quantity)));
    let (title, scale) = match (quantity, known) {
        (_, None) => (format!("{name} unknown"), None),
        (Quantity::Soc, Some(known)) => {
            let bars = known.at_least(LEAST_SOC_RANGE);
            let [least, greatest, from, to] =
                [known.least, known.greatest, bars.least, bars.greatest].map(|soc| 100.0 * soc);
            (format!("{name} {least:.1} to {greatest:.1} %, bars from {from:.1} to {to:.1} %"), Some(bars))
        }
        (_, Some(known)) => (format!("{name}, bars from {:.3} to {:.3} V", known.least, known.greatest), Some(known)),
    };
    let rows = lines.saturating_sub(1);
    let first = (app.selected / grid.per_row.max(1)).saturating_sub(rows.saturating_sub(1));
    let mut text = vec![Line::styled(title, Style::new().add_modifier(Modifier::DIM))];
    for row in first..grid.rows.min(first + rows) {
        let from = row * grid.per_row;
        let mut spans = vec![Span::raw(format!("{:>4} ", from + 1))];
        for (index, cell) in cells.iter().enumerate().skip(from).take(grid.per_row) {
            let share = cell.values.mean(quantity).and_then(|value| scale?.share(value));
            let bars = bar(share).to_string().repeat((grid.cell_width - 1).max(1));
            let mut style = match cell.trusted {
                Some(false) => theme.colour(Color::Red).add_modifier(Modifier::UNDERLINED),
                Some(true) => theme.colour(Color::Green),
                None => Style::new(),
            };
            if index == app.selected {
                style = style.add_modifier(Modifier::REVERSED);
            }
            spans.push(Span::styled(bars, style));
            if grid.cell_width > 1 {
                spans.push(Span::raw(" "));
            }
        }
        text.push(Line::from(spans));
    }
    text
}

/// Cells around the selected one, each with a small plot of the quantity.
fn list(app: &App, document: &StatusDocument, theme: Theme, area: Rect) -> Vec<Line<'static>> {
    let height = usize::from(area.height);
    let rows = height.saturating_sub(1);
    let cells = &document.cells;
    let first = app.selected.saturating_sub(rows / 2).min(cells.len().saturating_sub(rows));
    let (_, name) = MAPPED[app.mapped];
    let head = format!("cell   voltage   temp.            SOC         capacity  {name} so far");
    let mut text = vec![Line::styled(head, Style::new().add_modifier(Modifier::DIM))];
    for (index, cell) in cells.iter().enumerate().skip(first).take(rows) {
        let row = format!(
            "{:>4} {:>9} {:>7} {:>14} {:>16}  ",
            number(cell.cell),
            mean(&cell.values, Quantity::Voltage, 3),
            mean(&cell.values, Quantity::Temperature, 1),
            with_std(&cell.values, Quantity::Soc, 1),
            with_std(&cell.values, Quantity::Capacity, 2),
        );
        let width = usize::from(area.width).saturating_sub(row.chars().count());
        let points = app.history.get(index).map(|points| points.iter().map(|point| point[app.mapped].map(f64::from)));
        let plotted = points.map_or_else(String::new, |points| sparkline(points, width.min(super::app::HISTORY)));
        let style = if index == app.selected { Style::new().add_modifier(Modifier::BOLD) } else { Style::new() };
        text.push(Line::from(vec![Span::styled(row, style), Span::styled(plotted, theme.colour(Color::Cyan))]));
    }
    text
}

fn plot(frame: &mut Frame<'_>, app: &App, theme: Theme, area: Rect) {
    let Some(points) = app.history.get(app.selected) else { return };
    let width = usize::from(area.width.saturating_sub(2));
    let values: Vec<Option<f64>> =
        points.iter().skip(points.len().saturating_sub(width)).map(|point| point[app.mapped].map(f64::from)).collect();
    let Some(scale) = ValueRange::of(values.iter().copied().flatten()) else { return };
    let cell = app.selected + 1;
    let (quantity, name) = MAPPED[app.mapped];
    let (unit, factor) = screen_unit(quantity.row().unit);
    let (least, greatest) = (factor * scale.least, factor * scale.greatest);
    let digits = if quantity == Quantity::Soc { 2 } else { 3 };
    let seconds = values.len();
    let title = format!(" {name} of cell {cell}, {least:.digits$} to {greatest:.digits$}{unit} in {seconds} s ");
    // The height of a known value is at least one dot: heights are 1 to 1,001.
    let dots = values.into_iter().map(|value| value.and_then(|value| Some((1000.0 * scale.share(value)?) as u64 + 1)));
    let dots: Vec<Option<u64>> = dots.collect();
    let sparkline = Sparkline::default().data(dots).max(1001).style(theme.colour(Color::Cyan));
    frame.render_widget(sparkline.block(Block::bordered().title(title)), area);
}

fn alarms(document: &StatusDocument, theme: Theme) -> Vec<Line<'static>> {
    let alarms = &document.alarms;
    let line = |group: &AlarmGroup| {
        let is_raised = group.alarm.state.is_raised();
        let style = if is_raised { theme.severity(group.alarm.severity) } else { Style::new() };
        Line::styled(alarm_line(group), style)
    };
    let mut text: Vec<Line<'_>> = grouped(&alarms.list).iter().map(line).collect();
    if alarms.list.is_empty() {
        text.push(Line::from("no alarm"));
    }
    if alarms.omitted > 0 {
        text.push(Line::from(format!("and {} more", alarms.omitted)));
    }
    text.extend(alarms.unknown.iter().map(|unknown| {
        let (rule, severity) = (unknown.rule.name(), unknown.severity.name());
        Line::from(format!("cannot be evaluated: {severity} {rule}, {} of its alarms", unknown.alarms))
    }));
    for found in &document.findings {
        text.push(Line::from(found.to_string()));
        text.push(Line::from(format!("    found, for {}", duration(document.time.since(found.since)))));
    }
    text
}

fn interfaces(document: &StatusDocument, theme: Theme) -> Vec<Line<'static>> {
    let mut text = Vec::new();
    for it in &document.interfaces {
        let style = match it.state {
            crate::io::socket::LinkState::Up => theme.colour(Color::Green),
            _ => theme.colour(Color::Red).add_modifier(Modifier::BOLD),
        };
        text.push(Line::from(vec![Span::raw(format!("{} ", it.name)), Span::styled(word(it.state), style)]));
        let rows = [
            ("frames in", it.received.frames),
            ("lost by the kernel", it.link.kernel_dropped),
            ("lost by our queue", it.link.queue_dropped),
            ("malformed", it.link.malformed),
            ("frames out", it.link.sent),
            ("not sent, queue full", it.link.send_queue_full),
            ("not sent, kernel", it.link.send_failed),
            ("error frames", it.received.error_frames),
            ("bus-off", it.received.bus_offs),
            ("reconnects", it.reconnects),
        ];
        text.extend(rows.map(|(name, count)| count_line(name, count)));
    }
    let protected = document.protection.iter().flat_map(|it| {
        let checks = it.checks.iter().filter(|check| check.count > 0);
        checks.map(|check| count_line(&format!("{} {} {}", it.interface, it.id, check.status), check.count))
    });
    text.extend(protected);
    let commands = document.commands.iter();
    text.extend(commands.map(|it| Line::from(format!("commands {} {}: {}", it.interface, it.id, it.words()))));
    text.extend(document.poll.iter().map(|poll| Line::from(format!("diagnostic requests: {}", poll.words()))));
    text.extend(document.controllers.iter().map(|it| Line::from(format!("{} {} {}", it.interface, it.id, it.words()))));
    text.extend(document.floods.iter().map(|it| count_line(&format!("{} {} flood", it.interface, it.id), it.dropped)));
    text
}

fn count_line(name: &str, count: u64) -> Line<'static> {
    Line::from(format!("  {name:<28}{count:>12}"))
}

fn counts(document: &StatusDocument) -> Vec<Line<'static>> {
    let counters = &document.counters;
    let mut text = Vec::new();
    // Every count, named as in the document.
    for part in [serde_json::to_value(counters.readings), serde_json::to_value(&counters.core)] {
        let Ok(Value::Object(keys)) = part else { continue };
        text.extend(keys.iter().filter_map(|(name, count)| Some(count_line(&name.replace('_', " "), count.as_u64()?))));
    }
    let (service, clients) = (&counters.service, &counters.clients);
    let rows = [
        ("time backwards", counters.time_backwards),
        ("ticks", service.ticks),
        ("ticks late", service.missed_deadlines),
        ("reloads", service.reloads),
        ("reloads refused", service.reloads_refused),
        ("status clients", clients.connected),
        ("status clients refused", clients.refused),
        ("status clients dropped", clients.dropped),
    ];
    text.extend(rows.map(|(name, count)| count_line(name, count)));
    let latency = &document.latency;
    text.push(Line::from("frame to estimate"));
    let most = latency.buckets.iter().map(|bucket| bucket.frames).max().unwrap_or(0).max(1);
    for bucket in latency.buckets.iter().filter(|bucket| bucket.frames > 0) {
        let name = bucket.le_s.map_or_else(|| "more".to_owned(), |seconds| format!("up to {} ms", 1e3 * seconds));
        // A bar has 1 to 20 characters.
        let bar = "█".repeat(((20.0 * bucket.frames as f64 / most as f64).ceil() as usize).clamp(1, 20));
        text.push(Line::from(format!("  {name:<28}{:>12} {bar}", bucket.frames)));
    }
    text
}

fn events(document: &StatusDocument) -> Vec<Line<'static>> {
    let mut text: Vec<Line<'_>> =
        document.events.iter().rev().map(|event| Line::from(event_line(event, document))).collect();
    if text.is_empty() {
        text.push(Line::from("no event yet"));
    }
    text
}

fn event_line(event: &Value, document: &StatusDocument) -> String {
    let time = event.get("time").and_then(Value::as_i64).map(Timestamp::from_nanos);
    format!("{} {}", time.map_or_else(|| "?".to_owned(), clock), event_words::words(event, document))
}
