//! Writes the report: one self-contained HTML file from the history of a store or from a replay.
//!
//! [`Data`] is collected from the store or the replay. [`page`] renders the page, and [`write_plots`] writes the
//! pictures as separate files. An unknown value is shown as unknown, with the reason.

mod bins;
mod context;
mod data;
#[cfg(test)]
mod examples;
mod forecast;
mod format;
mod html;
mod known;
mod limits;
mod model;
mod pictures;
mod problems;
mod raised;
mod reference;
mod series;
mod summary;
mod text;
mod trace;
mod usage;

pub use context::PageContext;
pub use data::{Data, DataSource, Origin};
pub use html::page;
pub use pictures::write_plots;
pub use reference::{Reference, read as read_reference};
pub use text::Verdict;
