//! Formats the differences between the cells of a pack as lines with a name and a value: usable charge and energy, and
//! the charge and energy lost because the cells differ.
//!
//! Cells count from 1. The number after "±" is the standard deviation. Ah and kWh refer to one string.

use crate::cell::CellModel;
use crate::cell_faults::imbalance::{CellSpread, LeftOut, LimitingCell, mean_ocv_v};
use crate::cell_faults::{Imbalance, UnknownImbalance};
use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// Returns the lines. Without a `model`, the energies are missing.
pub fn lines(imbalance: &Result<Imbalance, UnknownImbalance>, model: Option<&CellModel>) -> Vec<(String, String)> {
    let pack = match imbalance {
        Ok(pack) => pack,
        Err(why) => return vec![("usable".to_owned(), format!("unknown: {why}"))],
    };
    let charge = |part| charge(pack, part, model);
    let mut lines = vec![
        ("usable", charge(pack.usable)),
        ("lost by imbalance", charge(pack.lost_by_imbalance)),
        ("lost by the weakest", format!("{}, cell {}", charge(pack.lost_by_weakest), number(pack.weakest))),
        ("ends a discharge", limit(&pack.discharge_limit)),
        ("ends a charge", limit(&pack.charge_limit)),
        ("spread of SOC", spread(&pack.soc, "points")),
        ("spread of capacity", spread(&pack.capacity, "%")),
        ("spread of resistance", spread(&pack.resistance, "%")),
    ];
    let without = [(LeftOut::FaultyChannel, "faulty channel"), (LeftOut::NotKnown, "not known yet")];
    lines.extend(without.iter().filter_map(|(reason, words)| {
        let cells: Vec<String> =
            pack.left_out.iter().filter(|it| it.1 == *reason).map(|it| number(it.0).to_string()).collect();
        match cells.len() {
            0 => None,
            // More than 12 cell numbers do not fit into a line.
            count if count > 12 => Some(("left out", format!("{words}: {count} cells"))),
            _ => Some(("left out", format!("{words}: cell {}", cells.join(", ")))),
        }
    }));
    lines.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// Returns the energy (kWh) that a string takes up or delivers if each of its cells moves `part` (a fraction) of the
/// mean cell's capacity.
pub fn energy_kwh(pack: &Imbalance, part: ScalarGaussian, model: &CellModel) -> ScalarGaussian {
    let string_v = mean_ocv_v(model, pack.mean_ah.mean) * (pack.cells + pack.left_out.len()) as f64;
    let ScalarGaussian { mean, variance } = pack.ah(part);
    ScalarGaussian { mean: 1e-3 * string_v * mean, variance: (1e-3 * string_v).powi(2) * variance }
}

fn number(cell: CellIndex) -> u16 {
    cell.0 + 1
}

fn charge(pack: &Imbalance, part: ScalarGaussian, model: Option<&CellModel>) -> String {
    let ah = pack.ah(part);
    let energy = model.map(|model| energy_kwh(pack, part, model));
    let energy = energy.map_or_else(String::new, |kwh| format!(", {:.3} ± {:.3} kWh", kwh.mean, kwh.std()));
    let percent = (100.0 * part.mean, 100.0 * part.std());
    format!("{:.1} ± {:.1} %, {:.3} ± {:.3} Ah{energy}", percent.0, percent.1, ah.mean, ah.std())
}

fn limit(limit: &LimitingCell) -> String {
    format!(
        "cell {}, {}: {:+.1} % by its charge, {:+.1} % by its capacity",
        number(limit.cell),
        limit.reason.words(),
        percent(-limit.by_charge),
        percent(-limit.by_capacity)
    )
}

fn spread(spread: &CellSpread, unit: &str) -> String {
    let end = |(cell, value): (CellIndex, f64)| format!("cell {} {:+.1}", number(cell), percent(value));
    format!(
        "{:.1} {unit} ({:.1} of error), {} to {}",
        percent(spread.std),
        percent(spread.error),
        end(spread.lowest),
        end(spread.highest)
    )
}

/// Converts a fraction to percent with one decimal. A zero is never negative.
fn percent(part: f64) -> f64 {
    (1000.0 * part).round() / 10.0 + 0.0
}
