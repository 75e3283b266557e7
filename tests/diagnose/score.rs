//! Compares findings with the injected faults.

use packwatch_core::quantity::CellIndex;
use packwatch_core::sim::FaultKind;

use crate::finding::kind_of;
use crate::pack::{CELLS_PER_SENSOR, Case, FirstFinding};

const DAY_S: f64 = 86_400.0;
const MONTH_DAYS: f64 = 30.0;

/// Results of one row of the table.
#[derive(Debug, Default, Clone)]
pub(crate) struct Score {
    packs: u32,
    days: f64,
    /// Days from the start of the fault to the right finding, for each pack with a right finding.
    delays_days: Vec<f64>,
    /// Packs in which the fault was found before its second drive.
    in_one_drive: u32,
    /// Packs with a finding of the right kind, but only on wrong cells.
    wrong_cell: u32,
    /// Packs with a finding of another kind after the start of the fault.
    wrong_kind: u32,
    /// Packs with at least one finding after the start of the fault.
    any: u32,
    /// Findings before the start of the fault, and all findings in healthy packs.
    false_findings: u32,
    /// Simulated days without a fault.
    healthy_days: f64,
}

impl Score {
    pub(crate) fn add(&mut self, case: &Case, seen: &[FirstFinding]) {
        self.packs += 1;
        self.days += f64::from(case.days);
        let from_s = case.fault().map_or(f64::INFINITY, |fault| fault.from_s);
        self.healthy_days += f64::from(case.days).min(from_s / DAY_S);
        self.false_findings += seen.iter().filter(|seen| seen.at_s < from_s).count() as u32;
        let Some(fault) = case.fault() else { return };
        let after = || seen.iter().filter(|seen| seen.at_s >= from_s);
        let (kind, cells) = (kind_of(&fault.kind), places(&fault.kind));
        let is_right = |seen: &&FirstFinding| is_right_place(&cells, seen.found.cells);
        let right = after().filter(|seen| Some(seen.found.kind) == kind).find(is_right);
        self.delays_days.extend(right.map(|seen| (seen.at_s - from_s) / DAY_S));
        self.in_one_drive += u32::from(right.is_some_and(|seen| seen.drives <= 1));
        let elsewhere = after().any(|seen| Some(seen.found.kind) == kind && !is_right(&seen));
        self.wrong_cell += u32::from(right.is_none() && elsewhere);
        self.wrong_kind += u32::from(after().any(|seen| Some(seen.found.kind) != kind));
        self.any += u32::from(after().next().is_some());
    }

    /// The columns from "packs" to "false" of the row, in Markdown.
    pub(crate) fn row(&self) -> String {
        let share = |count: usize| format!("{:.0} %", 100.0 * count as f64 / f64::from(self.packs.max(1)));
        let rate = self.false_rate();
        format!(
            "{} | {} | {} | {} | {} | {} | {} | {} | {rate}",
            self.packs,
            share(self.delays_days.len()),
            share(self.in_one_drive as usize),
            self.delay(0.5),
            self.delay(0.9),
            share(self.wrong_cell as usize),
            share(self.wrong_kind as usize),
            share(self.any as usize),
        )
    }

    /// Delay (days) within which the fault was found in the fraction `quantile` of all packs. `-` if it was found in
    /// fewer packs.
    fn delay(&self, quantile: f64) -> String {
        let mut delays = self.delays_days.clone();
        delays.sort_by(f64::total_cmp);
        let at = (quantile * f64::from(self.packs)).ceil().max(1.0) as usize - 1;
        delays.get(at).map_or_else(|| "-".to_owned(), |days| format!("{days:.1}"))
    }

    /// False findings per pack-month, and the upper end of the one-sided 95 % interval of this rate.
    fn false_rate(&self) -> String {
        let months = self.healthy_days / MONTH_DAYS;
        if months <= 0.0 {
            return "-".to_owned();
        }
        let count = f64::from(self.false_findings);
        format!("{:.2} (< {:.2})", count / months, poisson_upper(count) / months)
    }
}

/// Mean of a Poisson distribution that gives `count` or fewer in 5 % of cases. Uses the approximation of Wilson and
/// Hilferty, which is 1 % too low if `count` is 0.
fn poisson_upper(count: f64) -> f64 {
    const NORMAL_95: f64 = 1.645;
    let n = count + 1.0;
    n * (1.0 - 1.0 / (9.0 * n) + NORMAL_95 / (3.0 * n.sqrt())).powi(3)
}

/// Ranges of cells (first, last) that a correct finding may name. Empty if the fault concerns the whole pack.
fn places(fault: &FaultKind) -> Vec<(CellIndex, CellIndex)> {
    let sensor = |i: u16| (CellIndex(i * CELLS_PER_SENSOR), CellIndex((i + 1) * CELLS_PER_SENSOR - 1));
    match *fault {
        FaultKind::Leak { cell, .. }
        | FaultKind::Contact { cell, .. }
        | FaultKind::Weak { cell, .. }
        | FaultKind::Resistance { cell, .. }
        | FaultKind::VoltageOffset { cell, .. }
        | FaultKind::VoltageStuck { cell } => vec![(cell, cell)],
        FaultKind::Module { first, last, .. } => vec![(first, last)],
        FaultKind::Swap(a, b) | FaultKind::Double { shown: a, hidden: b } => {
            vec![(a.min(b), a.max(b)), (a, a), (b, b)]
        }
        FaultKind::TemperatureStuck(at) | FaultKind::TemperatureOff(at) => vec![sensor(at.0)],
        FaultKind::CurrentOffset(_) | FaultKind::CurrentGain(_) | FaultKind::CurrentStuck => Vec::new(),
    }
}

fn is_right_place(places: &[(CellIndex, CellIndex)], found: Option<(CellIndex, CellIndex)>) -> bool {
    match found {
        None => places.is_empty(),
        // The last temperature sensor may have fewer cells than the others.
        Some((first, last)) => places.iter().any(|place| place.0 == first && last <= place.1 && last >= place.0),
    }
}
