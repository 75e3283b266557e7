//! The residual plot: one panel per file, measured less model over time.

use std::path::Path;

use super::{FitFailure, Outcome};
use crate::ident::pass::residuals;
use crate::lab::plot::{self, Colour, Line, Panel};

/// Most panels; a page of more is not looked at.
const MAX_PANELS: usize = 40;

/// Writes the plot.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, outcome: &Outcome) -> Result<(), FitFailure> {
    let panels: Vec<Panel> = (0..outcome.files.len()).take(MAX_PANELS).map(|number| panel(outcome, number)).collect();
    plot::write(path, &panels).map_err(|error| FitFailure(error.to_string()))
}

/// One file; its stretches follow each other.
fn panel(outcome: &Outcome, number: usize) -> Panel {
    let file = &outcome.files[number];
    let mut line = Line { label: String::new(), colour: Colour::BLUE, points: vec![] };
    let mut begin_s = 0.0;
    let own = outcome.records.iter().zip(&outcome.file_of_record).filter(|(_, file)| **file == number);
    for (record, _) in own {
        let mut time_s = begin_s;
        for (row, error) in record.rows.iter().zip(residuals(record, &outcome.fit.tables)) {
            time_s += row.dt_s;
            if row.weight_s > 0.0 {
                line.points.push((time_s / 3600.0, 1e3 * error));
            }
        }
        begin_s = time_s;
    }
    let name = file.path.file_name().unwrap_or_default().to_string_lossy();
    Panel {
        title: format!("{name}: RMSE {:.1} mV", 1e3 * file.residual.rmse_v),
        x_label: "h".into(),
        y_label: "measured - model, mV".into(),
        lines: vec![line],
        ..Panel::default()
    }
}
