//! The state of the live view (`packwatch status --watch`): the status document, the page, the selected cell. Updates,
//! keys and the time change the state. This module does no I/O.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use ratatui::crossterm::event::KeyCode;

use crate::quantity::Timestamp;
use crate::quantity::catalogue::Quantity;
use crate::status::STALE;
use crate::status::document::StatusDocument;

/// Number of documents that are kept for the plots. They cover four minutes.
pub(super) const HISTORY: usize = 240;

#[derive(Debug)]
pub(super) enum FeedUpdate {
    StatusDocument(Box<StatusDocument>),
    /// The connection failed, for this reason.
    Lost(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Page {
    Cells,
    Alarms,
    Interfaces,
    Counts,
    Events,
}

impl Page {
    pub(super) const ALL: [Self; 5] = [Self::Cells, Self::Alarms, Self::Interfaces, Self::Counts, Self::Events];

    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Cells => "cells",
            Self::Alarms => "alarms",
            Self::Interfaces => "interfaces",
            Self::Counts => "counts",
            Self::Events => "events",
        }
    }

    fn step(self, by: usize) -> Self {
        let at = Self::ALL.iter().position(|page| *page == self).unwrap_or(0);
        Self::ALL[(at + by) % Self::ALL.len()]
    }
}

/// Quantities that the cell map can show. The key `v` switches to the next one.
pub(super) const MAPPED: [(Quantity, &str); 2] = [(Quantity::Soc, "SOC"), (Quantity::Voltage, "voltage")];

/// A cell's values in one document, one per quantity in [`MAPPED`].
pub(super) type CellPoint = [Option<f32>; MAPPED.len()];

/// The state of the view.
#[derive(Debug)]
pub(super) struct App {
    path: PathBuf,
    pub(super) has_colour: bool,
    /// The latest document; `None` before the first document, after a loss of the connection, and if it is stale.
    pub(super) document: Option<StatusDocument>,
    /// Time of the last document, and the reason why no newer document arrives. Set from a loss of the connection until
    /// the next document.
    pub(super) lost: Option<(Option<Timestamp>, String)>,
    received_at: Option<Timestamp>,
    pub(super) history: Vec<VecDeque<CellPoint>>,
    pub(super) page: Page,
    /// Index in [`MAPPED`] of the quantity that the cell map shows.
    pub(super) mapped: usize,
    pub(super) selected: usize,
    /// First visible line of a page other than the cell map.
    pub(super) scroll: usize,
    /// Number of cells in a row of the map when it was last drawn.
    pub(super) row_cells: usize,
    /// Number of visible lines of the page when it was last drawn.
    pub(super) page_lines: usize,
    now: Timestamp,
}

impl App {
    /// Creates a view. `path` is the status socket; the stream socket is in the same folder.
    pub(super) fn new(path: PathBuf, has_colour: bool) -> Self {
        Self {
            path,
            has_colour,
            document: None,
            lost: None,
            received_at: None,
            history: Vec::new(),
            page: Page::Cells,
            mapped: 0,
            selected: 0,
            scroll: 0,
            row_cells: 1,
            page_lines: 1,
            now: Timestamp::ZERO,
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Advances the time; drops a stale document.
    pub(super) fn poll(&mut self, now: Timestamp) {
        self.now = now;
        if self.document.is_some()
            && self.received_at.is_some_and(|received_at| now.since(received_at) > STALE.as_secs_f64())
        {
            self.lose("it has stopped sending documents".to_owned());
        }
    }

    pub(super) fn handle_update(&mut self, updates: FeedUpdate) {
        match updates {
            FeedUpdate::Lost(why) => self.lose(why),
            FeedUpdate::StatusDocument(document) => {
                self.remember(&document);
                self.selected = self.selected.min(document.cells.len().saturating_sub(1));
                self.received_at = Some(self.now.max(document.wall_time));
                self.lost = None;
                self.document = Some(*document);
            }
        }
    }

    fn lose(&mut self, why: String) {
        let since = self.lost.take().map_or(self.received_at, |(since, _)| since);
        self.lost = Some((since, why));
        // Do not show a stale document.
        self.document = None;
    }

    fn remember(&mut self, document: &StatusDocument) {
        self.history.resize_with(document.cells.len(), VecDeque::new);
        for (points, cell) in self.history.iter_mut().zip(&document.cells) {
            if points.len() == HISTORY {
                points.pop_front();
            }
            // The plots are a few dots high, so single precision suffices.
            points.push_back(MAPPED.map(|(quantity, _)| Some(cell.values.mean(quantity)? as f32)));
        }
    }

    /// Performs the action of a key.
    pub(super) fn handle_key(&mut self, key: KeyCode) {
        match key {
            KeyCode::Tab => self.turn_to(self.page.step(1)),
            KeyCode::BackTab => self.turn_to(self.page.step(Page::ALL.len() - 1)),
            KeyCode::Char('v') => self.mapped = (self.mapped + 1) % MAPPED.len(),
            _ if self.page == Page::Cells => {
                let last = self.history.len().saturating_sub(1);
                self.selected = moved(self.selected, key, self.row_cells, self.page_lines * self.row_cells, last);
            }
            // The drawing code limits `scroll` to the number of lines.
            _ => self.scroll = moved(self.scroll, key, 1, self.page_lines, usize::MAX / 2),
        }
    }

    fn turn_to(&mut self, page: Page) {
        (self.page, self.scroll) = (page, 0);
    }
}

fn moved(at: usize, key: KeyCode, row: usize, screen: usize, last: usize) -> usize {
    let to = match key {
        KeyCode::Up => at.saturating_sub(row),
        KeyCode::Down => at + row,
        KeyCode::Left => at.saturating_sub(1),
        KeyCode::Right => at + 1,
        KeyCode::PageUp => at.saturating_sub(screen),
        KeyCode::PageDown => at + screen,
        KeyCode::Home => 0,
        KeyCode::End => last,
        _ => at,
    };
    to.min(last)
}
