//! Draws the live view (`packwatch status --watch`): head, pack, selected page, keys.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph};

use super::app::{App, Page};
use super::theme::{Theme, clock};
use super::{pages, plot};
use crate::cli::common::alarms::grouped;
use crate::cli::status::{config, duration, mean, number, soc_band, store, with_std, word};
use crate::quantity::catalogue::Quantity;
use crate::status::document::StatusDocument;

/// Smallest usable size of the terminal: columns and lines.
const LEAST: (u16, u16) = (40, 12);

pub(super) fn draw(frame: &mut Frame<'_>, app: &mut App) {
    let area = frame.area();
    if area.width < LEAST.0 || area.height < LEAST.1 {
        let text = format!("{} x {} is too small, needs {} x {}", area.width, area.height, LEAST.0, LEAST.1);
        return frame.render_widget(Paragraph::new(text), area);
    }
    let theme = Theme { has_colour: app.has_colour };
    // The document is taken out of `app`, so that the pages can change `app` while they draw.
    let Some(document) = app.document.take() else { return lost(frame, app, area) };
    let [head_area, pack_area, alarm_area, tab_area, page_area, keys_area] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(5),
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Min(1),
        Constraint::Length(1),
    ])
    .areas(area);
    frame.render_widget(head(&document, theme), head_area);
    pack(frame, &document, theme, pack_area);
    frame.render_widget(alarm_line(&document, theme), alarm_area);
    frame.render_widget(tabs(&document, app.page), tab_area);
    pages::page(frame, app, &document, theme, page_area);
    frame.render_widget(keys(app.page), keys_area);
    app.document = Some(document);
}

fn lost(frame: &mut Frame<'_>, app: &App, area: Rect) {
    let text = match &app.lost {
        None => vec![Line::from(format!("waiting for {}", app.path().display()))],
        Some((since, why)) => {
            let since = since.map_or_else(|| "no daemon".to_owned(), |at| format!("no daemon since {}", clock(at)));
            let bold = Style::new().add_modifier(Modifier::BOLD);
            vec![Line::styled(since, bold), Line::from(""), Line::from(why.clone()), Line::from("reconnecting ...")]
        }
    };
    let block = Block::bordered().title(" packwatch ").title_bottom(" q quit ");
    let paragraph = Paragraph::new(text).block(block).wrap(ratatui::widgets::Wrap { trim: false });
    frame.render_widget(paragraph, area);
}

fn head(document: &StatusDocument, theme: Theme) -> Line<'static> {
    let bold = Style::new().add_modifier(Modifier::BOLD);
    Line::from(vec![
        Span::styled(format!("packwatch {} ", document.program_version), bold),
        Span::styled(word(document.state), theme.validity(document.state)),
        Span::raw(format!(
            " {}  up {}  {}  {}",
            word(document.pack.mode),
            duration(document.uptime_s),
            clock(document.wall_time),
            config(document),
        )),
    ])
}

fn pack(frame: &mut Frame<'_>, document: &StatusDocument, theme: Theme, area: Rect) {
    let pack = &document.pack;
    let is_lost = document.store.as_ref().is_some_and(|store| store.works == Some(false));
    let style = if is_lost { theme.colour(Color::Red).add_modifier(Modifier::BOLD) } else { Style::new() };
    let stored = Span::styled(format!(" store {} ", store(document)), style);
    let title = if document.vehicle.is_stated() { format!(" {} ", document.vehicle) } else { " pack ".to_owned() };
    let block = Block::bordered().title(title).title_bottom(stored);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let band = soc_band(pack).map_or_else(|| " unknown".to_owned(), |band| format!(" {band}"));
    let label = format!("SOC {:>7} ", mean(&pack.values, Quantity::Soc, 1));
    let taken = label.chars().count() + band.chars().count();
    let width = usize::from(inner.width).saturating_sub(taken);
    let [soc, low, high] = [Quantity::Soc, Quantity::SocLow, Quantity::SocHigh].map(|it| pack.values.mean(it));
    let gauge = plot::gauge(soc, low, high, width);
    let soc = Line::from(vec![
        Span::styled(label, Style::new().add_modifier(Modifier::BOLD)),
        Span::styled(gauge, theme.validity(document.state)),
        Span::raw(band),
    ]);
    let limiting = pack.limiting_cell.map_or_else(String::new, |cell| format!(", cell {} limits", number(cell)));
    let now = format!(
        "{}  {}  at most {}{limiting}",
        mean(&pack.values, Quantity::Voltage, 2),
        mean(&pack.values, Quantity::Current, 2),
        mean(&pack.values, Quantity::TemperatureMax, 1),
    );
    let health = format!(
        "capacity {}  SOH {}  usable {}  recharge {}",
        with_std(&pack.values, Quantity::Capacity, 2),
        mean(&pack.values, Quantity::Soh, 1),
        with_std(&pack.values, Quantity::UsableCapacity, 2),
        mean(&pack.values, Quantity::NormalisedRechargePeriod, 0),
    );
    frame.render_widget(Paragraph::new(vec![soc, Line::from(now), Line::from(health)]), inner);
}

/// The most severe alarm and the number of alarms, shown on every page.
fn alarm_line(document: &StatusDocument, theme: Theme) -> Line<'static> {
    let alarms = &document.alarms;
    let groups = grouped(&alarms.list);
    let raised = groups.iter().filter(|group| group.alarm.state.is_raised());
    let Some(worst) = raised.max_by_key(|group| group.alarm.severity as u8) else {
        return Line::from(match (alarms.thresholds, alarms.unknown.len()) {
            (0, _) => "no threshold is configured".to_owned(),
            (_, 0) => "no alarm".to_owned(),
            (thresholds, unknown) => format!("no alarm; {unknown} of {thresholds} thresholds cannot be evaluated"),
        });
    };
    let count = if alarms.raised == 1 { "1 alarm: ".to_owned() } else { format!("{} alarms: ", alarms.raised) };
    let text = super::super::table::alarm_line(worst);
    Line::from(vec![Span::raw(count), Span::styled(text, theme.severity(worst.alarm.severity))])
}

fn tabs(document: &StatusDocument, chosen: Page) -> Line<'static> {
    let mut spans = Vec::new();
    for page in Page::ALL {
        let text = match page {
            Page::Cells => format!(" {} {} ", page.name(), document.cells.len()),
            Page::Alarms => format!(" {} {} ", page.name(), document.alarms.list.len() + document.alarms.omitted),
            Page::Interfaces | Page::Counts | Page::Events => format!(" {} ", page.name()),
        };
        let style = if page == chosen { Style::new().add_modifier(Modifier::REVERSED) } else { Style::new() };
        spans.extend([Span::styled(text, style), Span::raw(" ")]);
    }
    Line::from(spans)
}

fn keys(page: Page) -> Line<'static> {
    let text = match page {
        Page::Cells => "q quit  tab page  arrows choose a cell  v SOC or voltage",
        Page::Alarms | Page::Interfaces | Page::Counts | Page::Events => "q quit  tab page  arrows scroll",
    };
    Line::styled(text, Style::new().add_modifier(Modifier::DIM))
}
