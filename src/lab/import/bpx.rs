//! Converts a BPX file (Battery Parameter eXchange, JSON) to a cell model.
//!
//! Input: the text of a BPX file of version 0.x or 1.x with the model SPM, SPMe or DFN. Output: the TOML of a cell
//! model. The open-circuit curve is the difference of the electrodes' potentials (`curve.rs`). The resistances follow
//! from the physical parameters (`circuit.rs`). `[provenance]` states each derivation. Every fault is reported with its
//! path in the JSON.
//!
//! Source: BPX standard, Faraday Institution (https://bpxstandard.com).

mod circuit;
mod curve;
mod document;
mod expression;
mod function;
#[cfg(test)]
mod tests;
mod toml;

use circuit::Resistances;
use curve::{Curve, CurveTable};
use document::BpxCell;

use crate::cell::MAX_BRANCHES;
use crate::error::LabError;
use crate::io::json::json_fault;

/// Faraday constant, C/mol (CODATA 2018).
const FARADAY_C_PER_MOL: f64 = 96_485.332_12;

/// Gas constant, J/(mol K) (CODATA 2018).
const GAS_J_PER_MOL_K: f64 = 8.314_462_618;

/// Temperatures of the tables relative to the file's reference temperature (K).
const TEMPERATURES_K: [f64; 6] = [-35.0, -25.0, -15.0, 0.0, 15.0, 30.0];

/// A real cell differs from its parameters. Standard deviation of the resulting voltage error, at rest and at the
/// reference temperature (V).
const ERROR_AT_REST_V: f64 = 0.010;

/// The formulas hold only for small currents. This fraction of the voltage drop at 1C is therefore added to the error
/// at rest (as the root of the sum of squares).
const ERROR_OF_DROP: f64 = 0.3;

/// Settings of a conversion.
#[derive(Debug, Clone, Default)]
pub struct BpxSettings {
    /// Name of the file, for messages and provenance.
    pub source: String,
    /// Name of the cell; `None` = the title of the file.
    pub name: Option<String>,
}

/// A converted file.
#[derive(Debug, Clone, PartialEq)]
pub struct BpxImport {
    /// The cell model, TOML.
    pub text: String,
    /// Assumptions, and parts of the file that are not used.
    pub notes: Vec<String>,
    /// Charge between the cut-offs at the reference temperature (Ah).
    pub capacity_ah: f64,
    /// Nominal charge (Ah).
    pub nominal_ah: f64,
}

#[derive(Debug)]
struct Model {
    temperature_c: Vec<f64>,
    curve: CurveTable,
    resistances: Vec<Vec<Resistances>>,
    voltage_error_v: Vec<Vec<f64>>,
}

/// Converts the text of a BPX file.
///
/// # Errors
/// The text is not valid JSON, or not a BPX file that can be converted. The error has one line per fault, with the
/// path, what was found and what is allowed.
pub fn import(text: &str, settings: &BpxSettings) -> Result<BpxImport, LabError> {
    let source = &settings.source;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let root: serde_json::Value = serde_json::from_str(text).map_err(|error| {
        let (line, column, fault) = (error.line(), error.column(), json_fault(&error));
        LabError::Data(format!("{source}:{line}:{column}: not valid JSON: {fault}"))
    })?;
    if root.is_object() && root.get("Header").is_none() && root.get("Parameterisation").is_none() {
        return Err(LabError::Data(format!("{source}: not a BPX file: it has neither Header nor Parameterisation")));
    }
    let failed = |faults: Vec<String>| {
        let lines: Vec<String> = faults.iter().map(|fault| format!("{source}: {fault}")).collect();
        LabError::Data(lines.join("\n"))
    };
    let cell = document::read(&root).map_err(failed)?;
    let curve = Curve::new(&cell).map_err(failed)?;
    let model = Model::new(&cell, &curve).map_err(failed)?;
    let notes = notes(&cell, &curve, &model);
    let toml = toml::text(settings, &cell, &curve, &model, &notes);
    Ok(BpxImport { text: toml, notes, capacity_ah: curve.capacity_ah, nominal_ah: cell.nominal_ah })
}

impl Model {
    fn new(cell: &BpxCell, curve: &Curve<'_>) -> Result<Self, Vec<String>> {
        let kelvin = TEMPERATURES_K.map(|from_reference| cell.reference_k + from_reference);
        let table = curve.table(&kelvin)?;
        let row = |&kelvin: &f64| table.soc.iter().map(|&soc| circuit::resistances(cell, curve, soc, kelvin)).collect();
        let resistances: Vec<Vec<Resistances>> = kelvin.iter().map(row).collect();
        let at = |t: usize, s: usize, of: &Resistances| {
            let (soc, kelvin) = (table.soc[s], kelvin[t]);
            of.fault().map(|fault| format!("Parameterisation: at SOC {soc} and {kelvin} K {fault}"))
        };
        let faults =
            resistances.iter().enumerate().flat_map(|(t, row)| row.iter().enumerate().map(move |(s, of)| (t, s, of)));
        if let Some(fault) = faults.filter_map(|(t, s, of)| at(t, s, of)).next() {
            return Err(vec![fault]);
        }
        let error_v = |from_reference: f64, of: &Resistances| {
            let at_rest_v = ERROR_AT_REST_V + 0.0003 * from_reference.abs();
            at_rest_v.hypot(ERROR_OF_DROP * of.settled_ohm() * cell.nominal_ah).min(0.5)
        };
        let errors = TEMPERATURES_K.iter().zip(&resistances);
        let voltage_error_v =
            errors.map(|(from, row)| row.iter().map(|of| error_v(*from, of)).collect::<Vec<f64>>()).collect();
        let temperature_c = kelvin.iter().map(|kelvin| (1e4 * (kelvin - 273.15)).round() / 1e4).collect();
        Ok(Self { temperature_c, curve: table, resistances, voltage_error_v })
    }

    fn branch_count(&self) -> usize {
        self.resistances.first().and_then(|row| row.first()).map_or(0, |of| of.branches.len().min(MAX_BRANCHES))
    }
}

fn notes(cell: &BpxCell, curve: &Curve<'_>, model: &Model) -> Vec<String> {
    let mut notes = cell.notes.clone();
    let electrodes = [&cell.negative, &cell.positive];
    let lacks_energy = electrodes.iter().any(|e| e.diffusivity_j_per_mol.is_none() || e.reaction_j_per_mol.is_none());
    let lacks_energy = lacks_energy
        || cell.transport.as_ref().is_some_and(|t| t.conductivity_j_per_mol.or(t.diffusivity_j_per_mol).is_none());
    if lacks_energy {
        notes.push("an activation energy is not stated: 25 kJ/mol assumed".to_owned());
    }
    if cell.transport.is_none() {
        notes.push("SPM: the file does not describe the electrolyte; its resistance is missing".to_owned());
    }
    if cell.heat_capacity_j_per_k.is_none() || cell.thermal_k_per_w.is_none() {
        notes.push("no [thermal]: heat capacity or heat transfer to the surroundings is not stated".to_owned());
    }
    if model.curve.raised_v > 0.0 {
        notes.push(format!(
            "open-circuit voltage raised by up to {:.2} mV to make it increase with SOC",
            1e3 * model.curve.raised_v
        ));
    }
    let ratio = curve.capacity_ah / cell.nominal_ah;
    if !(0.8..1.25).contains(&ratio) {
        notes.push(format!("charge between the cut-offs is {ratio:.2} times the nominal capacity"));
    }
    notes
}
