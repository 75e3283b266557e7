//! Writes the cell model of a BPX file. The output contains no date, so that the same file gives the same bytes.

use super::circuit::Resistances;
use super::curve::Curve;
use super::document::BpxCell;
use super::{BpxSettings, ERROR_OF_DROP, Model};
use crate::fit::{quoted, toml_list as list, toml_table as table};

pub(super) fn text(
    settings: &BpxSettings,
    cell: &BpxCell,
    curve: &Curve<'_>,
    model: &Model,
    notes: &[String],
) -> String {
    let mut out = head(settings, cell, curve);
    out.push_str(&provenance(settings, cell, curve, notes));
    tables(&mut out, model);
    if let (Some(heat), Some(resistance)) = (cell.heat_capacity_j_per_k, cell.thermal_k_per_w) {
        out.push_str(&format!(
            "\n[thermal]\nheat_capacity_j_per_k = {heat:.3}\nresistance_k_per_w = {resistance:.4}\n"
        ));
    }
    out
}

fn head(settings: &BpxSettings, cell: &BpxCell, curve: &Curve<'_>) -> String {
    let name = settings.name.as_ref().or(cell.title.as_ref()).unwrap_or(&settings.source);
    format!(
        "# Written by `packwatch import bpx`: derived from parameters, not measured. Fit a model to measured data to do better.\n\
         format = 1\nname = {}\nrated_capacity_ah = {}\ncapacity_ah = {:.5}\nvoltage_min_v = {}\nvoltage_max_v = {}\n",
        quoted(name),
        cell.nominal_ah,
        curve.capacity_ah,
        cell.voltage_min_v,
        cell.voltage_max_v
    )
}

fn provenance(settings: &BpxSettings, cell: &BpxCell, curve: &Curve<'_>, notes: &[String]) -> String {
    let mut out = "\n[provenance]\n".to_owned();
    let mut entry = |key: &str, value: &str| out.push_str(&format!("{key} = {}\n", quoted(value)));
    entry("program", &format!("packwatch {}", env!("CARGO_PKG_VERSION")));
    entry("method", "import bpx: closed forms of the parameters for small currents; nothing was fitted");
    let source = settings.source.rsplit('/').next().unwrap_or_default();
    entry("source", &format!("{source} (BPX {}, {})", cell.version, cell.model));
    if let Some(references) = &cell.references {
        entry("references", references);
    }
    entry(
        "soc",
        "1 at the upper, 0 at the lower voltage cut-off of the open-circuit voltage at the reference temperature",
    );
    entry("ocv", "OCP of the positive less that of the negative electrode; over temperature by the entropic changes");
    let conduction = if cell.transport.is_some() { ", conduction in electrolyte and solid" } else { "" };
    entry("r0", &format!("charge transfer from the reaction rate constants{conduction}"));
    let electrolyte = if cell.transport.is_some() { "electrolyte concentration; " } else { "" };
    entry("branches", &format!("{electrolyte}diffusion in negative particles; in positive particles"));
    entry("temperature", "Arrhenius' law of each property's activation energy");
    let share = 100.0 * ERROR_OF_DROP;
    entry("voltage_error", &format!("assumed: 10 mV and 0.3 mV/K, and {share:.0} % of the settled drop at 1C"));
    let ends = |[empty, full]: [f64; 2]| format!("[{empty:.6}, {full:.6}]");
    out.push_str(&format!(
        "negative_content = {}\npositive_content = {}\n",
        ends(curve.negative),
        ends(curve.positive)
    ));
    let notes: Vec<String> = notes.iter().map(|note| quoted(note)).collect();
    out.push_str(&format!("notes = [{}]\n", notes.join(", ")));
    out
}

fn tables(out: &mut String, model: &Model) {
    out.push_str(&format!("\n# Rows: temperature. Columns: SOC.\n[tables]\nsoc = [{}]\n", list(&model.curve.soc)));
    out.push_str(&format!("temperature_c = [{}]\n", list(&model.temperature_c)));
    let of = |value: &dyn Fn(&Resistances) -> f64| -> Vec<Vec<f64>> {
        model.resistances.iter().map(|row| row.iter().map(value).collect()).collect()
    };
    table(out, "ocv_v", &model.curve.ocv_v, 6);
    table(out, "r0_ohm", &of(&|node| node.r0_ohm), 6);
    out.push_str("# Standard deviation of the model's error averaged over 100 s: assumed, see [provenance].\n");
    table(out, "voltage_error_v", &model.voltage_error_v, 4);
    for branch in 0..model.branch_count() {
        out.push_str("\n[[tables.branches]]\n");
        table(out, "r_ohm", &of(&|node| node.branches[branch].0), 6);
        table(out, "c_farad", &of(&|node| node.branches[branch].1 / node.branches[branch].0), 2);
    }
}
