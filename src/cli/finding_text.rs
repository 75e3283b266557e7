//! A finding in words: which cells, what, how large. Cells count from 1.

use crate::findings::{Finding, FindingKind};
use crate::quantity::CellIndex;

/// Place, kind and size, as `cell 7: loses charge by itself, 18.24 ± 0.43 % of its capacity a day`. The deviation is one standard
/// deviation.
pub(super) fn line(found: &Finding) -> String {
    let number = |cell: CellIndex| cell.0 + 1;
    let place = match found.cells.map(|(first, last)| (number(first), number(last))) {
        Some((first, last)) if first == last => format!("cell {first}"),
        Some((first, last)) if found.kind.is_of_pair() => format!("cells {first} and {last}"),
        Some((first, last)) => format!("cells {first} to {last}"),
        None => "pack".to_owned(),
    };
    format!("{place}: {}{}", found.kind.words(), size(found))
}

/// Size with its unit; empty for a kind that has none.
fn size(found: &Finding) -> String {
    let (mean, std) = (found.size.mean, found.size.std());
    let scaled = |scale: f64, digits: usize| {
        with_deviation(scale * mean, scale * std, digits).trim_start_matches('+').to_owned()
    };
    match found.kind {
        FindingKind::Leak => format!(", {} % of its capacity a day", scaled(100.0, 2)),
        FindingKind::Contact => format!(", {} % of its series resistance", scaled(100.0, 0)),
        FindingKind::VoltageChannel => format!(", {} mV", scaled(1e3, 0)),
        FindingKind::CurrentOffset => format!(", {} % of the rated capacity per hour", scaled(100.0, 2)),
        _ if std > 0.0 => format!(", {} %", scaled(100.0, 1)),
        _ => String::new(),
    }
}

/// With its sign and deviation; a zero is positive.
pub(super) fn with_deviation(mean: f64, std: f64, digits: usize) -> String {
    let scale = 10f64.powi(i32::try_from(digits).unwrap_or(0));
    format!("{:+.digits$} ± {std:.digits$}", (mean * scale).round() / scale + 0.0)
}
