//! Generates the manual's page of quantities from the catalogue. `PACKWATCH_WRITE_PAGES=1 cargo test quantities`
//! rewrites the page.

use std::fmt::Write as _;

use crate::quantity::catalogue::{CellValues, PackValues, Presentation, QuantityRow, VssPath};

const HEAD: &str = "# Quantities

The quantities that packwatch publishes for the pack and for each cell. This page is generated from `src/core/quantity/catalogue/table.rs`.

* If a quantity has two keys, the second key is its standard deviation. The metric and the MQTT key of a standard deviation end with
  `_std`, and its VSS signal ends with `StandardDeviation`.
* [Status document](status.md): the keys are in `pack` and in each of `cells[]`. An unknown value is `null`.
* [Metrics](metrics.md): the unit is in the name; days are seconds. An unknown value is omitted.
* [MQTT](../operations/mqtt.md) and [VSS](vss.md): fractions are sent as percent, and a positive current charges the battery. Values of cells are sent as arrays.
";

/// The table of the quantities of `owner`, which is the pack or a cell.
fn table(
    title: &str,
    owner: &str,
    rows: impl Iterator<Item = (&'static QuantityRow, &'static Presentation)>,
) -> String {
    let mut page = format!(
        "\n## {title}\n\n| status | unit | meaning | metric | MQTT | VSS |\n| --- | --- | --- | --- | --- | --- |\n"
    );
    for (row, it) in rows {
        let keys: Vec<String> = row.parts().map(|(_, key)| format!("`{key}`")).collect();
        let mqtt = it.mqtt_key.map_or_else(String::new, |key| format!("`{key}`"));
        let (VssPath::Standard(vss) | VssPath::Overlay(vss)) = it.vss;
        let (unit, about, metric) = (row.unit.symbol(), it.about, row.metric);
        let _ = writeln!(page, "| {} | {unit} | {about} | `{owner}_{metric}` | {mqtt} | `{vss}` |", keys.join(", "));
    }
    page
}

#[test]
fn manual_lists_every_quantity() {
    let wanted =
        HEAD.to_owned() + &table("Pack", "pack", PackValues::rows()) + &table("Cells", "cell", CellValues::rows());
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/src/reference/quantities.md");
    if std::env::var_os("PACKWATCH_WRITE_PAGES").is_some() {
        std::fs::write(path, &wanted).unwrap();
    }
    let found = std::fs::read_to_string(path).unwrap_or_default();
    assert!(found == wanted, "rewrite the page: PACKWATCH_WRITE_PAGES=1 cargo test quantities");
}
