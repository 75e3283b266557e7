//! Draws the results of a cell fault detector. For each estimated quantity, one picture shows how far each cell is from
//! the median of its pack.
//!
//! A bar is a 95 % interval. A cell is red if the detector has reported a finding that the picture shows. Only reported
//! cells are numbered. Without a reported cell, the lowest and the highest cell are numbered.

use crate::cell_faults::difference::{CAPACITY, CHANNEL, CONTACT, LEAK, RESISTANCE, SOC, STATES};
use crate::cell_faults::fault;
use crate::cell_faults::{CellFault, CellFaultDetector, CellFaultKind};
use crate::chart::{Axis, Chart, Ink, Layer, Picture, Point, Shape};
use crate::filter::ScalarGaussian;
use crate::quantity::CellIndex;

/// Half of the width of a bar; 1 is the distance between two cells on the axis.
const HALF_BAR: f64 = 0.3;

struct Shown {
    state: usize,
    name: &'static str,
    title: &'static str,
    label: &'static str,
    /// Factor from the unit of the state to the unit of `label`.
    scale: f64,
    /// Differences, in the unit of the state, at which a cell is reported.
    limits: &'static [f64],
    kinds: &'static [CellFaultKind],
}

/// The pictures in the order of a report. The SOC is first because it shows the most frequent difference.
const SHOWN: [Shown; STATES] = [
    Shown {
        state: SOC,
        name: "difference_soc",
        title: "Charge of the cells",
        label: "SOC relative to the pack's median, points",
        scale: 100.0,
        limits: &[fault::CHARGE, -fault::CHARGE],
        kinds: &[CellFaultKind::LowCharge, CellFaultKind::HighCharge],
    },
    Shown {
        state: LEAK,
        name: "difference_leak",
        title: "Loss of charge",
        label: "loss relative to the pack's median, % of the capacity per day",
        scale: 100.0,
        limits: &[fault::LEAK_PER_DAY],
        kinds: &[CellFaultKind::Leak],
    },
    Shown {
        state: CONTACT,
        name: "difference_contact",
        title: "Contact resistance",
        label: "relative to the pack's median, % of the series resistance",
        scale: 100.0,
        limits: &[fault::CONTACT],
        kinds: &[CellFaultKind::Contact],
    },
    Shown {
        state: CAPACITY,
        name: "difference_capacity",
        title: "Capacity of the cells",
        label: "relative to the pack's median, %",
        scale: 100.0,
        limits: &[fault::CAPACITY, -fault::CAPACITY],
        kinds: &[CellFaultKind::WeakCell, CellFaultKind::ForeignCell, CellFaultKind::Module],
    },
    Shown {
        state: RESISTANCE,
        name: "difference_resistance",
        title: "Resistance of the cells",
        label: "relative to the pack's median, %",
        scale: 100.0,
        limits: &[fault::RESISTANCE],
        kinds: &[CellFaultKind::HighResistance],
    },
    Shown {
        state: CHANNEL,
        name: "difference_channel",
        title: "Offset of the voltage channels",
        label: "relative to the pack's median, mV",
        scale: 1e3,
        limits: &[fault::CHANNEL_V, -fault::CHANNEL_V],
        kinds: &[
            CellFaultKind::VoltageChannel,
            CellFaultKind::VoltageFrozen,
            CellFaultKind::DoubledChannels,
            CellFaultKind::SwappedChannels,
        ],
    },
];

/// Names of the pictures, in the order of [`all`].
pub const NAMES: [&str; STATES] = {
    let mut names = [""; STATES];
    let mut i = 0;
    while i < STATES {
        names[i] = SHOWN[i].name;
        i += 1;
    }
    names
};

/// Returns all pictures with their file names.
pub fn all(diagnosis: &CellFaultDetector) -> Vec<(String, Picture)> {
    let cells: Vec<[Option<ScalarGaussian>; STATES]> =
        (0..).map(CellIndex).map_while(|cell| diagnosis.relative(cell)).collect();
    SHOWN.iter().map(|shown| (shown.name.to_owned(), picture(shown, &cells, diagnosis.findings()))).collect()
}

/// Returns name and title of the pictures that show no finding, except the picture of the SOC.
pub fn quiet(diagnosis: &CellFaultDetector) -> Vec<(&'static str, &'static str)> {
    let has_finding = |shown: &Shown| diagnosis.findings().iter().any(|found| shown.kinds.contains(&found.kind));
    let quiet = SHOWN.iter().filter(|shown| shown.state != SOC && !has_finding(shown));
    quiet.map(|shown| (shown.name, shown.title)).collect()
}

fn picture(shown: &Shown, cells: &[[Option<ScalarGaussian>; STATES]], findings: &[CellFault]) -> Picture {
    let is_found = |cell: usize| {
        findings.iter().any(|found| shown.kinds.contains(&found.kind) && found.is_of(CellIndex(cell as u16)))
    };
    // Each entry has the cell number, the value, and half the width of the interval.
    let shown_of = |wanted: bool| {
        let of_one = move |(cell, states): (usize, &[Option<ScalarGaussian>; STATES])| {
            let size = states[shown.state].filter(|_| is_found(cell) == wanted)?;
            Some((cell as f64 + 1.0, shown.scale * size.mean, crate::OF_95 * shown.scale * size.std()))
        };
        cells.iter().enumerate().filter_map(of_one).collect::<Vec<_>>()
    };
    let bars = |wanted: bool| {
        // Each bar ends with a gap, so that the next bar is not connected to it.
        let bar = |(x, y, half): (f64, f64, f64)| {
            [(x - HALF_BAR, y - half, y + half), (x + HALF_BAR, y - half, y + half), (x + HALF_BAR, f64::NAN, f64::NAN)]
        };
        shown_of(wanted).into_iter().flat_map(bar)
    };
    let points = |wanted: bool| {
        let point = |(x, y, half): (f64, f64, f64)| {
            let tip = format!("cell {x}: {y:.2} (95 %: {:.2} to {:.2})", y - half, y + half);
            Point { x, y, tip }
        };
        shown_of(wanted).into_iter().map(point).collect::<Vec<_>>()
    };
    let mut layers = vec![
        Layer::band("", Ink::Grey, bars(false)),
        Layer::new("cell, with its 95 % interval", Ink::Blue, Shape::Points(points(false))),
    ];
    if (0..cells.len()).any(is_found) {
        layers.push(Layer::band("", Ink::Red, bars(true)));
        layers.push(Layer::new("found", Ink::Red, Shape::Points(points(true))));
    }
    layers.push(Layer::new("", Ink::Plain, Shape::Labels(labels(&shown_of(false), &shown_of(true)))));
    let limit = |(i, limit): (usize, &f64)| {
        Layer::new(if i == 0 { "limit of a finding" } else { "" }, Ink::Amber, Shape::Level(shown.scale * limit))
    };
    layers.extend(shown.limits.iter().enumerate().map(limit));
    let description = format!(
        "{} of {} cells, each with its 95 % interval, relative to the median of the pack",
        shown.title,
        cells.len()
    );
    let axis = Axis::number("cell").within(0.0, cells.len() as f64 + 1.0);
    Picture::Chart(Chart { description, ..Chart::new(shown.title, axis, shown.label, layers) })
}

/// Labels the reported cells or, without them, the lowest and the highest cell, at the outer end of the bar.
fn labels(others: &[(f64, f64, f64)], found: &[(f64, f64, f64)]) -> Vec<Point> {
    let ends = || {
        let lowest = others.iter().min_by(|a, b| a.1.total_cmp(&b.1));
        let highest = others.iter().max_by(|a, b| a.1.total_cmp(&b.1)).filter(|highest| Some(*highest) != lowest);
        let mut ends: Vec<_> = lowest.into_iter().chain(highest).copied().collect();
        ends.sort_by(|a, b| a.0.total_cmp(&b.0));
        ends
    };
    let named = if found.is_empty() { ends() } else { found.to_vec() };
    let label = |(cell, y, half): (f64, f64, f64)| {
        let end = if y < 0.0 { y - half } else { y + half };
        Point { x: cell, y: end, tip: format!("cell {cell}: {y:+.1}").replace('-', "\u{2212}") }
    };
    named.into_iter().map(label).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn found_cells_are_numbered_else_both_ends() {
        let others = [(1.0, 0.2, 0.1), (2.0, -0.4, 0.1), (3.0, 0.9, 0.1)];
        let texts = |found: &[(f64, f64, f64)]| labels(&others, found).into_iter().map(|it| it.tip).collect::<Vec<_>>();
        assert_eq!(texts(&[]), ["cell 2: \u{2212}0.4", "cell 3: +0.9"]);
        assert_eq!(texts(&[(81.0, -2.9, 0.5)]), ["cell 81: \u{2212}2.9"]);
        assert_eq!(labels(&[], &[(81.0, -2.9, 0.5)])[0].y, -3.4);
    }
}
