//! What the view knows and where its user is. Pure: news and keys in, fields out.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use crate::quantity::Timestamp;
use crate::status::STALE;
use crate::status::document::Document;

/// Documents remembered for the plots: four minutes.
pub(super) const HISTORY: usize = 240;

/// What the stream says.
#[derive(Debug)]
pub(super) enum News {
    /// A document.
    Document(Box<Document>),
    /// The connection is lost, or cannot be made: why.
    Lost(String),
}

/// What a key means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Key {
    /// Leave.
    Quit,
    /// To the page on the right.
    NextPage,
    /// To the page on the left.
    PreviousPage,
    /// A row up.
    Up,
    /// A row down.
    Down,
    /// A cell to the left.
    Left,
    /// A cell to the right.
    Right,
    /// A screen up.
    PageUp,
    /// A screen down.
    PageDown,
    /// To the first.
    First,
    /// To the last.
    Last,
    /// Show the other quantity.
    Quantity,
}

/// The pages.
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

/// What the map of the cells shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quantity {
    Soc,
    Voltage,
}

/// A cell's values at one document.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    soc: Option<f32>,
    voltage_v: Option<f32>,
}

impl Point {
    pub(super) fn get(self, quantity: Quantity) -> Option<f64> {
        match quantity {
            Quantity::Soc => self.soc.map(f64::from),
            Quantity::Voltage => self.voltage_v.map(f64::from),
        }
    }
}

/// The view.
#[derive(Debug)]
pub(super) struct App {
    path: PathBuf,
    pub(super) has_colour: bool,
    /// The latest document, while it holds.
    pub(super) document: Option<Document>,
    /// Since when there is none that holds, and why.
    pub(super) lost: Option<(Option<Timestamp>, String)>,
    /// When the latest document came.
    heard: Option<Timestamp>,
    /// Per cell, oldest first.
    pub(super) history: Vec<VecDeque<Point>>,
    pub(super) page: Page,
    pub(super) quantity: Quantity,
    /// Of the cells.
    pub(super) selected: usize,
    /// First line shown of the other pages.
    pub(super) scroll: usize,
    /// Cells in a row of the map and lines of a page, as last drawn.
    pub(super) row_cells: usize,
    pub(super) page_lines: usize,
    now: Timestamp,
}

impl App {
    /// A view of the stream there.
    pub(super) fn new(path: PathBuf, has_colour: bool) -> Self {
        Self {
            path,
            has_colour,
            document: None,
            lost: None,
            heard: None,
            history: Vec::new(),
            page: Page::Cells,
            quantity: Quantity::Soc,
            selected: 0,
            scroll: 0,
            row_cells: 1,
            page_lines: 1,
            now: Timestamp::ZERO,
        }
    }

    /// The stream.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Time passed: old news is none.
    pub(super) fn poll(&mut self, now: Timestamp) {
        self.now = now;
        if self.document.is_some() && self.heard.is_some_and(|heard| now.since(heard) > STALE.as_secs_f64()) {
            self.lose("it does not tell anything".to_owned());
        }
    }

    /// Takes what the stream says.
    pub(super) fn handle_news(&mut self, news: News) {
        match news {
            News::Lost(why) => self.lose(why),
            News::Document(document) => {
                self.remember(&document);
                self.selected = self.selected.min(document.cells.len().saturating_sub(1));
                self.heard = Some(self.now.max(document.wall_time));
                self.lost = None;
                self.document = Some(*document);
            }
        }
    }

    fn lose(&mut self, why: String) {
        let since = self.lost.take().map_or(self.heard, |(since, _)| since);
        self.lost = Some((since, why));
        // What was true is not, as far as anybody knows.
        self.document = None;
    }

    fn remember(&mut self, document: &Document) {
        self.history.resize_with(document.cells.len(), VecDeque::new);
        for (points, cell) in self.history.iter_mut().zip(&document.cells) {
            if points.len() == HISTORY {
                points.pop_front();
            }
            // For plots of a few dots' height.
            points
                .push_back(Point { soc: cell.soc.map(|soc| soc as f32), voltage_v: cell.voltage_v.map(|v| v as f32) });
        }
    }

    /// Does what a key means.
    pub(super) fn handle_key(&mut self, key: Key) {
        match key {
            Key::Quit => {}
            Key::NextPage => self.turn_to(self.page.step(1)),
            Key::PreviousPage => self.turn_to(self.page.step(Page::ALL.len() - 1)),
            Key::Quantity => {
                self.quantity = match self.quantity {
                    Quantity::Soc => Quantity::Voltage,
                    Quantity::Voltage => Quantity::Soc,
                };
            }
            _ if self.page == Page::Cells => {
                let last = self.history.len().saturating_sub(1);
                self.selected = moved(self.selected, key, self.row_cells, self.page_lines * self.row_cells, last);
            }
            // The drawing knows how far down it goes.
            _ => self.scroll = moved(self.scroll, key, 1, self.page_lines, usize::MAX / 2),
        }
    }

    fn turn_to(&mut self, page: Page) {
        (self.page, self.scroll) = (page, 0);
    }
}

fn moved(at: usize, key: Key, row: usize, screen: usize, last: usize) -> usize {
    let to = match key {
        Key::Up => at.saturating_sub(row),
        Key::Down => at + row,
        Key::Left => at.saturating_sub(1),
        Key::Right => at + 1,
        Key::PageUp => at.saturating_sub(screen),
        Key::PageDown => at + screen,
        Key::First => 0,
        Key::Last => last,
        Key::Quit | Key::NextPage | Key::PreviousPage | Key::Quantity => at,
    };
    to.min(last)
}
