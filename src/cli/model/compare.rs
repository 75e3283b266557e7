//! `packwatch model compare`: shows how far the second model differs from the first, as tables or JSON.

use serde_json::{Value, json};

use crate::cell::ModelComparison;
use crate::cell::model_comparison::{AtTemperature, Difference};
use crate::cli::common::output;
use crate::config::cell_model::SourcedModel;

/// A model with its display name.
type Named<'a> = (&'a str, &'a SourcedModel);

pub(super) fn page(comparison: &ModelComparison, [first, second]: [Named<'_>; 2]) -> String {
    let name = |(source, sourced): Named<'_>| format!("{source}: {}", sourced.model.name);
    let mut page = format!("A  {}\nB  {}\n\nB less A\n", name(first), name(second));
    let rows = [
        ("open-circuit voltage at 25 \u{b0}C", difference(&comparison.curve, 1e3, "mV")),
        ("SOC that B reads at rest", difference(&comparison.rest_soc, 100.0, "points")),
        ("capacity", format!("{} %", signed(100.0 * comparison.capacity))),
    ];
    let rows = rows.into_iter().map(|(what, value)| vec![what.to_owned(), value]);
    page.push_str(&output::table::<&str>(&[], rows, 2));
    page.push_str("\nopen-circuit voltage at 25 \u{b0}C\n");
    // The table shows every tenth point of the curve, which has steps of 1 %.
    let points = comparison.curve_v.iter().step_by(10);
    let rows = points.map(|at| vec![format!("{:.0}", 100.0 * at.soc), signed(1e3 * at.value)]);
    page.push_str(&output::table(&["SOC, %", "mV"], rows, 0));
    if comparison.temperatures.is_empty() {
        page.push_str("\nresistances: the two models have no temperature in common\n");
        return page;
    }
    page.push_str("\nresistances per rated capacity, and the SOC that B reads under C/2\n");
    let heads = ["\u{b0}C", "series, % rms", "worst", "settled, % rms", "worst", "SOC, points rms", "worst"];
    let row = |at: &AtTemperature| {
        let pair = |found: &Difference| [format!("{:.1}", 100.0 * found.rms), signed(100.0 * found.worst.value)];
        let pairs = [&at.series, &at.settled, &at.load_soc].into_iter().flat_map(pair);
        [at.temperature_c.to_string()].into_iter().chain(pairs).collect()
    };
    page.push_str(&output::table(&heads, comparison.temperatures.iter().map(row), 0));
    page
}

fn difference(found: &Difference, factor: f64, unit: &str) -> String {
    let Difference { rms, worst } = found;
    let at_worst = signed(factor * worst.value);
    format!("{:.1} {unit} rms, at worst {at_worst} at {:.0} %", factor * rms, 100.0 * worst.soc)
}

/// Formats a number with its sign and one decimal. Zero gets a plus sign.
fn signed(value: f64) -> String {
    format!("{:+.1}", (10.0 * value).round() / 10.0 + 0.0)
}

pub(super) fn document(comparison: &ModelComparison, named: [Named<'_>; 2]) -> Value {
    let [first, second] = named.map(|(source, sourced)| json!({"source": source, "name": sourced.model.name}));
    let summary =
        |found: &Difference| json!({"rms": found.rms, "worst": found.worst.value, "worst_soc": found.worst.soc});
    let of_temperature = |at: &AtTemperature| {
        json!({
            "temperature_c": at.temperature_c, "series": summary(&at.series), "settled": summary(&at.settled),
            "load_soc": summary(&at.load_soc),
        })
    };
    let curve: Vec<Value> = comparison.curve_v.iter().map(|at| json!({"soc": at.soc, "ocv_v": at.value})).collect();
    json!({
        "version": 1, "first": first, "second": second,
        "curve": curve, "ocv_v": summary(&comparison.curve), "rest_soc": summary(&comparison.rest_soc),
        "capacity": comparison.capacity,
        "temperatures": comparison.temperatures.iter().map(of_temperature).collect::<Vec<_>>(),
    })
}
