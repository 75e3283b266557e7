//! The report: one self-contained HTML file, from the history of a store or from a replay.
//!
//! [`Data`] is collected from either; [`page`] renders the page, [`write_plots`] writes its pictures as files. The same data
//! give the same bytes: nothing here reads a clock. A value that is not known is shown as unknown, with the reason.

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

pub use data::{Data, DataSource, Origin};
pub use html::page;
pub use reference::{Reference, read as read_reference};

use super::chart::{self, Format, PlotError};
use crate::config::Config;

/// Content of a page in addition to the data.
#[derive(Debug, Default)]
pub struct PageContext<'a> {
    /// Title of the page.
    pub title: String,
    /// Thresholds, rated capacity; `None` = not known.
    pub config: Option<&'a Config>,
    /// The configuration file's text, for the page's end.
    pub config_text: Option<String>,
    /// Measured or true values.
    pub reference: Reference,
    /// Lines of the provenance: name and value.
    pub provenance: Vec<(String, String)>,
}

/// Writes every picture of the report into a folder, as SVG and PNG; gives how many pictures.
///
/// # Errors
/// A file cannot be written, or there is no font for the words of a PNG.
pub fn write_plots(folder: &Path, data: &Data, context: &PageContext<'_>) -> Result<usize, PlotError> {
    let pictures = pictures::all(data, context);
    for (name, picture) in &pictures {
        chart::write(&folder.join(format!("{name}.svg")), picture, Format::Svg)?;
        chart::write(&folder.join(format!("{name}.png")), picture, Format::Png)?;
    }
    Ok(pictures.len())
}
