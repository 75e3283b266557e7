//! Writes a cell model as a file that [`load`](super::load) reads back with identical numbers. The file contains no
//! date.

use toml::{Table as TomlTable, Value};

use super::source::SourcedModel;
use crate::cell::{AgeingLaw, CellModel, Electrodes, ModelSpread, Table};

/// Returns the contents of the file. `head` becomes the comment in the first line and must not contain line breaks.
pub fn text(sourced: &SourcedModel, head: &str) -> String {
    let SourcedModel { model, source } = sourced;
    let mut out = format!("# {head}\nformat = 1\nname = {}\n", quoted(&model.name));
    source.chemistry.iter().for_each(|chemistry| out.push_str(&format!("chemistry = {}\n", quoted(chemistry))));
    if let AgeingLaw::Shift(shift) = model.aged_ocv.law() {
        out.push_str(&format!("ocv_ageing_shift = {}\n", number(shift)));
    }
    let numbers = [
        ("rated_capacity_ah", model.rated_capacity_ah),
        ("capacity_ah", model.capacity_ah),
        ("voltage_min_v", model.voltage_min_v),
        ("voltage_max_v", model.voltage_max_v),
    ];
    numbers.iter().for_each(|(key, value)| out.push_str(&format!("{key} = {}\n", number(*value))));
    if !source.provenance.is_empty() {
        let whole = TomlTable::from_iter([("provenance".to_owned(), Value::Table(source.provenance.clone()))]);
        out.push_str(&format!("\n{whole}"));
    }
    let measured = &source.measured;
    let ranges = [("temperature_c", measured.temperature_c), ("current_a", measured.current_a), ("soc", measured.soc)];
    if ranges.iter().any(|(_, range)| range.is_some()) {
        out.push_str("\n[measured]\n");
        let given = ranges.iter().filter_map(|(key, range)| Some((key, (*range)?)));
        given.for_each(|(key, range)| out.push_str(&format!("{key} = {}\n", list(&range))));
    }
    tables(&mut out, model);
    if let AgeingLaw::Electrodes(found) = model.aged_ocv.law() {
        electrodes(&mut out, &found);
    }
    if let Some(found) = &model.spread {
        spread(&mut out, found, model.aged_ocv.spread_v());
    }
    if let Some(thermal) = &model.thermal {
        let (heat, resistance) = (number(thermal.heat_capacity_j_per_k), number(thermal.resistance_k_per_w));
        out.push_str(&format!("\n[thermal]\nheat_capacity_j_per_k = {heat}\nresistance_k_per_w = {resistance}\n"));
    }
    out
}

fn tables(out: &mut String, model: &CellModel) {
    out.push_str("\n# Rows: temperature. Columns: SOC.\n[tables]\n");
    out.push_str(&format!("soc = {}\ntemperature_c = {}\n", list(&model.soc), list(&model.temperature_c)));
    table(out, "ocv_v", &model.ocv_v);
    table(out, "r0_ohm", &model.r0_ohm);
    if let Some(voltage_error_v) = &model.voltage_error_v {
        table(out, "voltage_error_v", voltage_error_v);
    }
    for branch in &model.branches {
        out.push_str("\n[[tables.branches]]\n");
        table(out, "r_ohm", &branch.r_ohm);
        table(out, "c_farad", &branch.c_farad);
    }
}

fn table(out: &mut String, key: &str, table: &Table) {
    out.push_str(&format!("{key} = [\n"));
    table.values.iter().for_each(|row| out.push_str(&format!("    {},\n", list(row))));
    out.push_str("]\n");
}

fn electrodes(out: &mut String, found: &Electrodes) {
    let (positive, negative) = found.names();
    out.push_str(&format!(
        "\n# Contents: empty and full cell.\n[electrodes]\npositive = \"{positive}\"\nnegative = \"{negative}\"\n\
         positive_content = {}\nnegative_content = {}\n",
        list(&found.positive_content),
        list(&found.negative_content),
    ));
}

fn spread(out: &mut String, spread: &ModelSpread, modes_v: &[Vec<f64>; 2]) {
    let ModelSpread { curve_v, log_resistance, slow_branch, capacity, drop_sqrt_s } = *spread;
    out.push_str("\n# Standard deviations of a cell from this model.\n[spread]\n");
    let numbers = [
        ("curve_v", curve_v),
        ("log_resistance", log_resistance),
        ("slow_branch", slow_branch),
        ("capacity", capacity),
        ("drop_sqrt_s", drop_sqrt_s),
    ];
    numbers.iter().for_each(|(key, value)| out.push_str(&format!("{key} = {}\n", number(*value))));
    out.push_str("curve_modes_v = [\n");
    modes_v.iter().for_each(|mode_v| out.push_str(&format!("    {},\n", list(mode_v))));
    out.push_str("]\n");
}

/// Formats a number in the shortest decimal notation that parses to the same number.
fn number(value: f64) -> String {
    format!("{value:?}")
}

fn list(values: &[f64]) -> String {
    format!("[{}]", values.iter().map(|value| number(*value)).collect::<Vec<_>>().join(", "))
}

fn quoted(text: &str) -> String {
    Value::String(text.to_owned()).to_string()
}
