//! The report: one HTML file that stands alone, from the history of a store or from a replay.
//!
//! [`Data`] is gathered from either; [`page`] makes the page of it, [`write_plots`] its pictures as files. The same data
//! give the same bytes: nothing here looks at a clock. What is not known is said to be unknown, with the reason.

mod bins;
mod data;
mod forecast;
mod html;
mod pictures;
mod reference;
mod series;
mod summary;
mod trace;

use std::path::Path;

pub use data::{Data, Origin, Source};
pub use html::page;
pub use reference::{Reference, read as read_reference};

use super::chart::{self, Format, PlotError};
use crate::config::Config;

/// What a page is made of besides the data.
#[derive(Debug, Default)]
pub struct Setting<'a> {
    /// Above everything.
    pub title: String,
    /// Thresholds, rated capacity; `None` = not known.
    pub config: Option<&'a Config>,
    /// The configuration file's text, for the page's end.
    pub config_text: Option<String>,
    /// What was measured, or is known to be true.
    pub reference: Reference,
    /// Lines of the provenance: what, and which.
    pub provenance: Vec<(String, String)>,
}

/// Writes every picture of the report into a folder, as SVG and PNG; gives how many pictures.
///
/// # Errors
/// A file cannot be written, or there is no font for the words of a PNG.
pub fn write_plots(folder: &Path, data: &Data, setting: &Setting<'_>) -> Result<usize, PlotError> {
    let pictures = pictures::all(data, setting);
    for (name, picture) in &pictures {
        chart::write(&folder.join(format!("{name}.svg")), picture, Format::Svg)?;
        chart::write(&folder.join(format!("{name}.png")), picture, Format::Png)?;
    }
    Ok(pictures.len())
}
