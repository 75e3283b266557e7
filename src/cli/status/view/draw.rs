//! Draws the view: head, pack, the page chosen, keys.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph};

use super::app::{App, Page};
use super::{pages, plot};
use crate::alarm::Severity;
use crate::cli::status::{config, duration, number, percent, shown, store, with_std, word};
use crate::io::stamp;
use crate::monitor::Validity;
use crate::quantity::Timestamp;
use crate::status::document::Document;

/// Least size that shows anything sensible.
const LEAST: (u16, u16) = (40, 12);

/// Colours, where they are wanted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Theme {
    has_colour: bool,
}

impl Theme {
    pub(super) fn colour(self, colour: Color) -> Style {
        if self.has_colour { Style::new().fg(colour) } else { Style::new() }
    }

    pub(super) fn severity(self, severity: Severity) -> Style {
        match severity {
            Severity::Info => self.colour(Color::Cyan),
            Severity::Warning => self.colour(Color::Yellow).add_modifier(Modifier::BOLD),
            Severity::Severe => self.colour(Color::Red).add_modifier(Modifier::BOLD | Modifier::REVERSED),
        }
    }

    pub(super) fn validity(self, validity: Validity) -> Style {
        match validity {
            Validity::Valid => self.colour(Color::Green),
            Validity::Degraded => self.colour(Color::Yellow).add_modifier(Modifier::BOLD),
            Validity::Untrusted | Validity::Unavailable => self.colour(Color::Red).add_modifier(Modifier::BOLD),
        }
    }
}

/// Draws everything.
pub(super) fn draw(frame: &mut Frame<'_>, app: &mut App) {
    let area = frame.area();
    if area.width < LEAST.0 || area.height < LEAST.1 {
        let text = format!("{} x {} is too small, needs {} x {}", area.width, area.height, LEAST.0, LEAST.1);
        return frame.render_widget(Paragraph::new(text), area);
    }
    let theme = Theme { has_colour: app.has_colour };
    // Taken out, so that the pages may note in the app what they have drawn.
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

/// The time of day, UTC.
pub(super) fn clock(time: Timestamp) -> String {
    let stamp = stamp::format_utc(time);
    stamp.split_once('T').map_or(stamp.clone(), |(_, clock)| clock.to_owned())
}

fn lost(frame: &mut Frame<'_>, app: &App, area: Rect) {
    let text = match &app.lost {
        None => vec![Line::from(format!("waiting for {}", app.path().display()))],
        Some((since, why)) => {
            let since = since.map_or_else(|| "no daemon".to_owned(), |at| format!("no daemon since {}", clock(at)));
            let bold = Style::new().add_modifier(Modifier::BOLD);
            vec![Line::styled(since, bold), Line::from(""), Line::from(why.clone()), Line::from("looking for it ...")]
        }
    };
    let block = Block::bordered().title(" packwatch ").title_bottom(" q leave ");
    let paragraph = Paragraph::new(text).block(block).wrap(ratatui::widgets::Wrap { trim: false });
    frame.render_widget(paragraph, area);
}

fn head(document: &Document, theme: Theme) -> Line<'static> {
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

fn pack(frame: &mut Frame<'_>, document: &Document, theme: Theme, area: Rect) {
    let pack = &document.pack;
    let is_lost = document.store.as_ref().is_some_and(|store| store.works == Some(false));
    let style = if is_lost { theme.colour(Color::Red).add_modifier(Modifier::BOLD) } else { Style::new() };
    let stored = Span::styled(format!(" store {} ", store(document)), style);
    let block = Block::bordered().title(" pack ").title_bottom(stored);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let band = match (pack.soc_low, pack.soc_high) {
        (Some(low), Some(high)) => format!(" 95 %: {:.1} to {:.1} %", 100.0 * low, 100.0 * high),
        _ => " not known".to_owned(),
    };
    let label = format!("SOC {:>7} ", percent(pack.soc));
    let taken = label.chars().count() + band.chars().count();
    let width = usize::from(inner.width).saturating_sub(taken);
    let gauge = plot::gauge(pack.soc, pack.soc_low, pack.soc_high, width);
    let soc = Line::from(vec![
        Span::styled(label, Style::new().add_modifier(Modifier::BOLD)),
        Span::styled(gauge, theme.validity(document.state)),
        Span::raw(band),
    ]);
    let limiting = pack.limiting_cell.map_or_else(String::new, |cell| format!(", cell {} limits", number(cell)));
    let now = format!(
        "{}  {}  at most {}{limiting}",
        shown(pack.voltage_v, 2, " V"),
        shown(pack.current_a, 2, " A"),
        shown(pack.temperature_max_c, 1, " °C"),
    );
    let health = format!(
        "capacity {}  SOH {}  usable {}  recharge {}",
        with_std(pack.capacity_ah, pack.capacity_std_ah, 2, " Ah"),
        percent(pack.soh),
        with_std(pack.usable_capacity_ah, pack.usable_capacity_std_ah, 2, " Ah"),
        shown(pack.normalised_recharge_period_s, 0, " s"),
    );
    frame.render_widget(Paragraph::new(vec![soc, Line::from(now), Line::from(health)]), inner);
}

/// The alarm that matters most, and how many there are: on every page.
fn alarm_line(document: &Document, theme: Theme) -> Line<'static> {
    let alarms = &document.alarms;
    let raised = alarms.list.iter().filter(|alarm| alarm.state.is_raised());
    let Some(worst) = raised.max_by_key(|alarm| alarm.severity as u8) else {
        return Line::from(match (alarms.thresholds, alarms.unknown.len()) {
            (0, _) => "no threshold is configured".to_owned(),
            (_, 0) => "no alarm".to_owned(),
            (thresholds, unknown) => format!("no alarm; {unknown} of {thresholds} thresholds cannot be judged"),
        });
    };
    let count = if alarms.raised == 1 { "1 alarm: ".to_owned() } else { format!("{} alarms: ", alarms.raised) };
    let text = super::super::table::alarm_line(worst);
    Line::from(vec![Span::raw(count), Span::styled(text, theme.severity(worst.severity))])
}

fn tabs(document: &Document, chosen: Page) -> Line<'static> {
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
        Page::Cells => "q leave  tab page  arrows choose a cell  v SOC or voltage",
        Page::Alarms | Page::Interfaces | Page::Counts | Page::Events => "q leave  tab page  arrows scroll",
    };
    Line::styled(text, Style::new().add_modifier(Modifier::DIM))
}
