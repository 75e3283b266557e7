//! Plots the residuals (measured voltage minus the model's voltage) over time, with one panel per file.

use std::path::Path;

use super::FitOutcome;
use crate::chart::{self, Chart, Ink, Layer, Picture};
use crate::error::LabError;
use crate::ident::pass::residuals;

/// Writes the plot.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, outcome: &FitOutcome) -> Result<(), LabError> {
    // More than 40 panels are not readable.
    let panels: Vec<Picture> = (0..outcome.files.len()).take(40).map(|number| panel(outcome, number)).collect();
    Ok(chart::write_stack(path, &panels)?)
}

/// Draws the panel of one file. On the time axis, the parts of the file follow each other without gaps.
fn panel(outcome: &FitOutcome, number: usize) -> Picture {
    let file = &outcome.files[number];
    let mut points = Vec::new();
    let mut begin_s = 0.0;
    let own = outcome.records.iter().zip(&outcome.file_of_record).filter(|(_, file)| **file == number);
    for (record, _) in own {
        let mut time_s = begin_s;
        for (row, error) in record.rows.iter().zip(residuals(record, &outcome.fit.tables)) {
            time_s += row.dt_s;
            if row.weight_s > 0.0 {
                points.push((time_s / 3600.0, 1e3 * error));
            }
        }
        begin_s = time_s;
    }
    let name = file.path.file_name().unwrap_or_default().to_string_lossy();
    Picture::Chart(Chart::new(
        format!("{name}: RMSE {:.1} mV", 1e3 * file.residual.rmse_v),
        "time, h",
        "measured - model, mV",
        vec![Layer::line("", Ink::Blue, points)],
    ))
}
