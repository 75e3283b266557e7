//! Writes the result of a fit as a JSON document; the model itself is a separate file.

use super::{FileResidual, FitOutcome};

/// Returns the result as JSON. `seconds` is the duration of the fit.
pub fn document(outcome: &FitOutcome, seconds: f64) -> serde_json::Value {
    let of_file = |file: &FileResidual| {
        let r = &file.residual;
        serde_json::json!({
            "path": file.path, "rows": file.rows, "seconds": file.seconds, "outliers": file.outliers,
            "rmse_v": r.rmse_v, "mean_v": r.mean_v, "worst_v": r.worst_v,
        })
    };
    let cells = outcome.logs.iter().flat_map(|logs| &logs.cells).zip(1..).map(|(cell, number)| {
        serde_json::json!({
            "cell": number, "capacity_ah": outcome.capacity_ah * cell.capacity_ratio.0,
            "capacity_std_ah": outcome.capacity_ah * cell.capacity_ratio.1,
            "resistance_ratio": cell.resistance_ratio.0, "resistance_ratio_std": cell.resistance_ratio.1,
            "leakage_per_h": cell.leakage_per_h.0, "residual_v": cell.residual_v,
        })
    });
    serde_json::json!({
        "files": outcome.files.iter().map(of_file).collect::<Vec<_>>(),
        "rmse_v": outcome.fit.total.rmse_v,
        "capacity_ah": outcome.capacity_ah,
        "capacity_std_ah": outcome.logs.as_ref().map(|logs| logs.capacity_std_ah),
        "cells": cells.collect::<Vec<_>>(),
        "passes": outcome.fit.passes,
        "converged": outcome.fit.converged,
        "notes": outcome.notes,
        "verdict": outcome.verdict,
        "seconds": seconds,
    })
}
