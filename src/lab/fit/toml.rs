//! Writes the file of a cell model: tables, thermal parameters, provenance. The output contains no date, so the same
//! data give the same bytes.

use std::fmt::Write as _;

use super::range::ModelTables;
use super::{AGEING_SHIFT, FitOutcome, FitRequest, FittedElectrodes};
use crate::cell::Electrodes;

/// Returns the text of the whole file.
pub fn text(request: &FitRequest, outcome: &FitOutcome) -> String {
    let mut out = String::new();
    head(&mut out, request, outcome);
    provenance(&mut out, request, outcome);
    measured(&mut out, outcome);
    tables(&mut out, request, outcome);
    if let Some(found) = &outcome.electrodes {
        electrodes(&mut out, found);
    }
    if let Some(thermal) = &outcome.thermal {
        line(&mut out, "\n[thermal]");
        line(&mut out, &format!("heat_capacity_j_per_k = {:.2}", thermal.heat_capacity_j_per_k));
        line(&mut out, &format!("resistance_k_per_w = {:.3}", thermal.resistance_k_per_w));
    }
    out
}

fn line(out: &mut String, text: &str) {
    out.push_str(text);
    out.push('\n');
}

pub(crate) fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

fn head(out: &mut String, request: &FitRequest, outcome: &FitOutcome) {
    line(out, "# Written by `packwatch fit`; do not edit by hand.");
    line(out, "format = 1");
    line(out, &format!("name = {}", quoted(&request.name)));
    line(out, &format!("rated_capacity_ah = {:.4}", request.rated_ah.unwrap_or(outcome.capacity_ah)));
    line(out, &format!("capacity_ah = {:.4}", outcome.capacity_ah));
    let unknown = outcome.electrodes.is_none() && (request.first_cycles.is_some());
    if let Some(shift) = request.ageing_shift.or(unknown.then_some(AGEING_SHIFT)) {
        line(out, &format!("ocv_ageing_shift = {shift}"));
    }
    line(out, &format!("voltage_min_v = {}", outcome.voltage_v.0));
    line(out, &format!("voltage_max_v = {}", outcome.voltage_v.1));
}

fn electrodes(out: &mut String, found: &FittedElectrodes) {
    let Electrodes { positive_content, negative_content, .. } = found.electrodes;
    let (positive, negative) = found.electrodes.names();
    line(
        out,
        &format!(
            "\n# These electrodes reproduce the open-circuit curve within {:.1} mV. The two contents of an electrode: \
             in the empty and in the full cell.",
            1e3 * found.residual_v
        ),
    );
    line(out, "[electrodes]");
    line(out, &format!("positive = \"{positive}\"\nnegative = \"{negative}\""));
    for (key, [empty, full]) in [("positive_content", positive_content), ("negative_content", negative_content)] {
        line(out, &format!("{key} = [{empty:.4}, {full:.4}]"));
    }
}

fn provenance(out: &mut String, request: &FitRequest, outcome: &FitOutcome) {
    let fit = &outcome.fit;
    line(out, "\n[provenance]");
    line(out, &format!("program = \"packwatch {}\"", env!("CARGO_PKG_VERSION")));
    let method = "bounded nonlinear least squares in log parameters, exact sensitivities, smoothness priors";
    line(out, &format!("method = \"{method}\""));
    if !request.ocv.is_empty() {
        let names: Vec<String> = request.ocv.iter().map(|path| quoted(&file_name(path))).collect();
        line(out, &format!("ocv = [{}]", names.join(", ")));
    }
    if let Some(first) = request.first_cycles {
        line(out, &format!("first_cycles = {first}"));
    }
    line(out, &format!("passes = {}", fit.passes));
    line(out, &format!("residual_rmse_mv = {:.2}", 1e3 * fit.total.rmse_v));
    if let Some((discharge, charge)) = &outcome.by_kind {
        line(out, &format!("residual_discharge_rmse_mv = {:.2}", 1e3 * discharge.rmse_v));
        line(out, &format!("residual_charge_rmse_mv = {:.2}", 1e3 * charge.rmse_v));
    }
    for file in &outcome.files {
        let (name, r) = (quoted(&file_name(&file.path)), &file.residual);
        line(out, "[[provenance.files]]");
        line(out, &format!("name = {name}"));
        line(out, &format!("rows = {}", file.rows));
        line(out, &format!("rmse_mv = {:.2}", 1e3 * r.rmse_v));
        line(out, &format!("mean_mv = {:.2}", 1e3 * r.mean_v));
    }
}

fn measured(out: &mut String, outcome: &FitOutcome) {
    let range = &outcome.measured;
    line(out, "\n[measured]");
    line(out, &format!("temperature_c = [{:.1}, {:.1}]", range.temperature_c.0, range.temperature_c.1));
    line(out, &format!("current_a = [{:.3}, {:.3}]", range.current_a.0, range.current_a.1));
    line(out, &format!("soc = [{:.3}, {:.3}]", range.soc.0, range.soc.1));
}

/// Returns the file name with the name of its folder. This identifies the file, but does not reveal the rest of the
/// path.
fn file_name(path: &std::path::Path) -> String {
    let parts: Vec<_> = path.components().map(|part| part.as_os_str().to_string_lossy().into_owned()).collect();
    parts[parts.len().saturating_sub(2)..].join("/")
}

fn tables(out: &mut String, request: &FitRequest, outcome: &FitOutcome) {
    // The tables of an ageing cell are not extended to other temperatures, because its cycles cannot separate the
    // effects of temperature and age.
    let is_ageing = request.first_cycles.is_some();
    let (fit, errors) = (&outcome.fit, &outcome.voltage_error_v);
    let ModelTables { grid, tables, voltage_error_v } = match is_ageing {
        true => ModelTables::fitted(fit, errors),
        false => ModelTables::beyond(fit, errors, &outcome.measured, outcome.logs.is_some()),
    };
    let (ocv_v, r0_ohm, branches) = tables.model(grid.soc.len());
    let beyond = if is_ageing { "" } else { "; the first and the last row are outside the measured range" };
    line(out, &format!("\n# Rows: temperature{beyond}. Columns: SOC.\n[tables]"));
    line(out, &format!("soc = [{}]", list(&grid.soc)));
    line(out, &format!("temperature_c = [{}]", list(&grid.temperature_c)));
    table(out, "ocv_v", &ocv_v.values, 5);
    table(out, "r0_ohm", &r0_ohm.values, 6);
    let errors: Vec<Vec<f64>> = voltage_error_v.chunks(grid.soc.len()).map(<[f64]>::to_vec).collect();
    line(out, "# Standard deviation of the model's error averaged over 100 s.");
    table(out, "voltage_error_v", &errors, 4);
    for branch in &branches {
        line(out, "\n[[tables.branches]]");
        table(out, "r_ohm", &branch.r_ohm.values, 6);
        table(out, "c_farad", &branch.c_farad.values, 2);
    }
}

pub(crate) fn list(values: &[f64]) -> String {
    values.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// Writes `key = [[..], [..]]`. Numbers have `digits` decimals, or more if needed for five significant digits.
pub(crate) fn table(out: &mut String, key: &str, rows: &[Vec<f64>], digits: usize) {
    line(out, &format!("{key} = ["));
    for row in rows {
        let mut text = String::new();
        for (k, value) in row.iter().enumerate() {
            let figures = 4.0 - value.abs().log10().floor();
            let decimals = if figures > digits as f64 { figures as usize } else { digits };
            let separator = if k == 0 { "" } else { ", " };
            let _ = write!(text, "{separator}{value:.decimals$}");
        }
        line(out, &format!("    [{text}],"));
    }
    line(out, "]");
}
