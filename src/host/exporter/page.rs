//! The live page: one file without external resources, see `page.html`.

use std::hash::{BuildHasher as _, RandomState};

use serde_json::{Value, json};

use super::live::KEPT;
use crate::alarm::Rule;
use crate::cell_faults::{CellFault, CellFaultKind};
use crate::filter::ScalarGaussian;
use crate::quantity::Timestamp;
use crate::quantity::catalogue::{CellValues, PackValues, Presentation, QuantityRow};

const PAGE: &str = include_str!("page.html");
/// Text in [`PAGE`] that the nonce of an answer replaces.
const NONCE: &str = "NONCE";
/// Text in [`PAGE`] that the names and units replace.
const CATALOGUE: &str = "CATALOGUE";

/// Returns the page with the names and units of all quantities, alarms and findings. If `has_report` is true, the page
/// has a link to the report.
pub(super) fn template(has_report: bool) -> String {
    PAGE.replacen(CATALOGUE, &catalogue(has_report).to_string(), 1)
}

/// Returns the page of one answer and its content security policy. Only the script and the style with the nonce of this
/// answer run.
pub(super) fn answer(template: &str) -> (String, String) {
    // The keys of the hash are random, so the hash cannot be guessed.
    let nonce = format!("{:016x}", RandomState::new().hash_one(template.len()));
    let policy = format!(
        "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; img-src data:; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    );
    (template.replace(NONCE, &nonce), policy)
}

/// The names and units that the page shows. For each rule and each kind of finding, the catalogue has a sample text (a
/// value of 1, or a finding of the size 1 ± 1). The page takes the scale, the decimals and the unit from this text.
fn catalogue(has_report: bool) -> Value {
    let row = |(row, shown): (&'static QuantityRow, &'static Presentation)| {
        json!([row.key, row.std_key, row.unit.symbol(), shown.mqtt_name, shown.about])
    };
    let rules = Rule::ALL.into_iter().filter(|rule| *rule != Rule::ThermalEvent);
    let rules = rules.map(|rule| (rule.name().to_owned(), json!(rule.with_unit(1.0))));
    let thermal_event = [0.0, 1.0, 2.0, 3.0].map(|value| Rule::ThermalEvent.with_unit(value));
    let findings = CellFaultKind::ALL.map(|kind| {
        let size = ScalarGaussian { mean: 1.0, variance: 1.0 };
        let (since, reported) = (Timestamp::ZERO, Timestamp::ZERO);
        let fault = CellFault { kind, cells: None, since, reported, probability: 1.0, size };
        (kind.name().to_owned(), json!([fault.to_string(), kind.is_of_pair(), kind.advice()]))
    });
    json!({
        "pack": PackValues::rows().map(row).collect::<Vec<_>>(),
        "cell": CellValues::rows().map(row).collect::<Vec<_>>(),
        "report": has_report,
        "kept": KEPT.map(|quantity| quantity.row().key),
        "rules": Value::Object(rules.collect()),
        "thermal_event": thermal_event,
        "findings": Value::Object(findings.into_iter().collect()),
    })
}
