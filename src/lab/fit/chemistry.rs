//! Tests whether another chemistry explains the logs better than the chemistry on the label.
//!
//! Input: the mean voltage of the cells in each stretch (a part of a log without gaps). All chemistries are compared on
//! the same rows, which are recorded and fitted as in the daemon.

use crate::cell::notebook::Row;
use crate::cell::own_model::fit;
use crate::cell::{CellModel, CellStep, Chemistry, Label, Notebook, NotebookConfig};
use crate::ident::MeasuredPart;

/// Difference of the log posterior densities above which another chemistry is reported.
const MARGIN: f64 = 12.0;

/// Returns the label from which a model was derived; `None` = the model comes from a file.
pub(super) fn label_of(model: &CellModel) -> Option<Label> {
    let of = |chemistry: Chemistry| Label {
        chemistry,
        rated_ah: model.rated_capacity_ah,
        voltage_min_v: model.voltage_min_v,
        voltage_max_v: model.voltage_max_v,
    };
    let labels = Chemistry::ALL.iter().map(|(chemistry, _)| of(*chemistry));
    model.spread.and(labels.into_iter().find(|label| label.model().as_ref() == Some(model)))
}

/// Returns the rows that the daemon would record for these stretches, without the offset of the current sensor. Each
/// stretch comes with its initial SOC.
fn rows<'a>(label: &Label, offset_a: f64, stretches: impl Iterator<Item = (&'a MeasuredPart, f64)>) -> Vec<Row> {
    let config = NotebookConfig::new(1, label.rated_ah);
    let mut notebook = Notebook::default();
    for (part, beginning) in stretches {
        let mut soc = beginning;
        for k in 0..part.len() {
            let before = k.saturating_sub(1);
            let measured_s = part.time_s[k] - part.time_s[before];
            let charge_as = (0.5 * (part.current_a[k] + part.current_a[before]) - offset_a) * measured_s;
            soc -= charge_as / 3600.0 / label.rated_ah;
            let step = CellStep {
                measured_s,
                charge_as,
                offset_s: measured_s,
                unmeasured_s: 0.0,
                current_a: Some(part.current_a[k] - offset_a),
                temperature_c: Some(part.temperature_c[k]).filter(|t| t.is_finite()),
                // Assumed for readings without temperature (degrees C).
                ambient_c: 25.0,
                voltage_v: part.voltage_v[k],
                is_voltage_frozen: false,
            };
            if notebook.add(&config, &step) {
                notebook.close_row(&config, soc);
            }
        }
        notebook.end_stretch(&config);
    }
    notebook.rows().to_vec()
}

/// Compares the chemistries, using the capacity (Ah) and the current offset (A) of a fit. Returns a sentence if another
/// chemistry is clearly better, or if there are too few rows. `error_ratio` is the circuit model's error at the coldest
/// temperature divided by its error when warm. The margin is multiplied by the square of this ratio, because log
/// likelihoods depend on squared errors.
pub(super) fn note<'a>(
    label: &Label,
    (capacity_ah, offset_a): (f64, f64),
    error_ratio: f64,
    stretches: impl Iterator<Item = (&'a MeasuredPart, f64)>,
) -> Option<String> {
    let rows = rows(label, offset_a, stretches);
    let cost = |chemistry: Chemistry| {
        let of = if chemistry == label.chemistry { *label } else { label.with_chemistry(chemistry) };
        Some((chemistry, fit::label_cost(&of.prior()?, &rows, &[capacity_ah])?))
    };
    let Some((_, own)) = cost(label.chemistry).filter(|_| rows.len() >= 12) else {
        return Some(format!("too little charge moved to compare {} with other chemistries", label.chemistry.name()));
    };
    let others = Chemistry::ALL.iter().map(|(chemistry, _)| *chemistry).filter(|other| *other != label.chemistry);
    let (best, least) = others.filter_map(cost).min_by(|a, b| a.1.total_cmp(&b.1))?;
    (least < own - MARGIN * error_ratio * error_ratio).then(|| {
        format!(
            "the voltages fit {} better than {}, the chemistry on the label (ln likelihood {:+.0}): fit again with it",
            best.name(),
            label.chemistry.name(),
            own - least
        )
    })
}
