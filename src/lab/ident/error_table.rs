//! Estimates the error of the fitted model over SOC and temperature: the root mean square of the voltage errors, each
//! averaged over a block of [`BLOCK_S`].
//!
//! Blocks are used because errors of a model are correlated over minutes. A block is weighted by the charge moved in
//! it, and is shared among the nodes around it. If little charge was moved near a node, its error follows the mean
//! error at its temperature.
//!
//! The residuals of a fit understate the error on a new drive. Therefore the variance is multiplied by 1 + 3 / n, where
//! n is the number of files with data near the node. A pulse test or slow test counts as 0.3 of a file, because it
//! differs from a drive. The life of an ageing cell counts as one file. A temperature without data gets the errors of
//! the nearest temperature with data, scaled by a power of the Arrhenius factor.

use std::collections::BTreeMap;

use super::fit::FittedTables;
use super::grid::{Grid, arrhenius};
use super::pass::{COLD_POWER, residuals};
use super::record::Record;

const BLOCK_S: f64 = 100.0;
/// Upper limit of the error of a block (V); also the error if no temperature has data.
const MOST_V: f64 = 0.1;
/// The error of each node includes the mean error at the node's temperature. The mean error counts like data that moved
/// this charge (in multiples of the capacity).
const LEAN_SOC: f64 = 1.0;
/// Growth of the variance on data outside the fit: 1 + this constant / number of files.
const UNSEEN: f64 = 3.0;
/// A file has data near a node if more than this charge (as a fraction of the capacity) was moved there.
const VISIT_SOC: f64 = 0.005;

struct NodeSums {
    square: Vec<f64>,
    weight: Vec<f64>,
    files: Vec<f64>,
}

/// A record with its file and weight.
#[derive(Debug, Clone, Copy)]
pub struct WeightedRecord<'a> {
    /// Rows of the record.
    pub record: &'a Record,
    /// Number of the file. All records of a file describe the same cell.
    pub file: usize,
    /// Weight of the record: 1 for a drive.
    pub share: f64,
}

/// Returns the error table in node order (V).
pub fn table(fit: &FittedTables, records: &[WeightedRecord<'_>], capacity_ah: f64) -> Vec<f64> {
    let nodes = fit.grid.nodes();
    let mut sums = NodeSums { square: vec![0.0; nodes], weight: vec![0.0; nodes], files: vec![0.0; nodes] };
    let mut moved: BTreeMap<usize, (f64, Vec<f64>)> = BTreeMap::new();
    for judged in records {
        let before = sums.weight.clone();
        add_record(&mut sums, fit, judged.record, judged.share, capacity_ah);
        let (share, of_file) = moved.entry(judged.file).or_insert_with(|| (0.0, vec![0.0; nodes]));
        *share = judged.share.max(*share);
        for ((moved, now), before) in of_file.iter_mut().zip(&sums.weight).zip(&before) {
            *moved += (now - before) / judged.share;
        }
    }
    for (share, of_file) in moved.values() {
        for (files, moved) in sums.files.iter_mut().zip(of_file) {
            *files += if *moved > VISIT_SOC { *share } else { 0.0 };
        }
    }
    let columns = fit.grid.soc.len();
    let rows: Vec<Option<Vec<f64>>> = (0..fit.grid.temperature_c.len()).map(|t| row(&sums, t, columns)).collect();
    fill(&fit.grid, &rows)
}

fn add_record(sums: &mut NodeSums, fit: &FittedTables, record: &Record, share: f64, capacity_ah: f64) {
    let errors = residuals(record, &fit.tables);
    let mut block = ErrorBlock::default();
    for (row, error) in record.rows.iter().zip(errors) {
        if block.seconds + row.weight_s > BLOCK_S {
            block.close(sums, &fit.grid, share);
        }
        if row.weight_s > 0.0 {
            block.error += row.weight_s * error;
            block.soc += row.weight_s * row.soc;
            block.temperature += row.weight_s * row.temperature_c;
            block.seconds += row.weight_s;
            block.moved_soc += row.mean_current_a.abs() * row.dt_s / 3600.0 / capacity_ah;
        }
    }
    block.close(sums, &fit.grid, share);
}

#[derive(Default)]
struct ErrorBlock {
    error: f64,
    soc: f64,
    temperature: f64,
    seconds: f64,
    moved_soc: f64,
}

impl ErrorBlock {
    fn close(&mut self, sums: &mut NodeSums, grid: &Grid, share: f64) {
        let block = std::mem::take(self);
        if block.seconds <= 0.0 {
            return;
        }
        let error_v = (block.error / block.seconds).clamp(-MOST_V, MOST_V);
        let place = grid.place((block.soc / block.seconds).clamp(0.0, 1.0), block.temperature / block.seconds);
        for (node, corner) in grid.ocv_corners(&place).iter() {
            let weight = share * block.moved_soc * corner;
            sums.square[node] += weight * error_v * error_v;
            sums.weight[node] += weight;
        }
    }
}

fn row(sums: &NodeSums, t: usize, columns: usize) -> Option<Vec<f64>> {
    let range = t * columns..(t + 1) * columns;
    let weight: f64 = sums.weight[range.clone()].iter().sum();
    let most_files = sums.files[range.clone()].iter().fold(0.0_f64, |most, n| most.max(*n));
    if most_files == 0.0 {
        return None;
    }
    let mean = sums.square[range.clone()].iter().sum::<f64>() / weight;
    let of_node = |node: usize| {
        let files = if sums.files[node] > 0.0 { sums.files[node] } else { most_files };
        let variance = (sums.square[node] + LEAN_SOC * mean) / (sums.weight[node] + LEAN_SOC);
        // A model's error is assumed to be at least 1 mV.
        (variance * (1.0 + UNSEEN / files)).sqrt().max(0.001)
    };
    Some(range.map(of_node).collect())
}

fn fill(grid: &Grid, rows: &[Option<Vec<f64>>]) -> Vec<f64> {
    let temperatures = &grid.temperature_c;
    let known = || rows.iter().zip(temperatures).filter_map(|(row, &t)| row.as_ref().map(|row| (row, t)));
    let of_row = |&t: &f64| {
        let nearest = known().min_by(|a, b| (a.1 - t).abs().total_cmp(&(b.1 - t).abs()));
        let (row, from) = nearest.map_or((vec![MOST_V; grid.soc.len()], t), |(row, from)| (row.clone(), from));
        let colder = libm::pow(arrhenius(t) / arrhenius(from), COLD_POWER);
        row.into_iter().map(move |error| error * colder)
    };
    temperatures.iter().flat_map(of_row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ident::MeasuredPart;
    use crate::ident::fit::Residual;
    use crate::ident::parameters::ParameterTables;
    use crate::ident::record::Limits;

    #[test]
    fn temperature_without_data_takes_its_scaled_neighbour() {
        let grid = Grid { soc: vec![0.0, 1.0], temperature_c: vec![-20.0, 0.0, 25.0] };
        let found = fill(&grid, &[None, Some(vec![0.01, 0.02]), Some(vec![0.005; 2])]);
        assert!(found[0] > 1.5 * 0.01 && found[1] == 2.0 * found[0], "{found:?}");
        assert_eq!(found[2..], [0.01, 0.02, 0.005, 0.005]);
    }

    #[test]
    fn variance_depends_on_files_not_records() {
        let grid = Grid { soc: vec![0.0, 1.0], temperature_c: vec![25.0] };
        let tables = ParameterTables { ocv_v: vec![3.6; 2], r0_ohm: vec![0.0; 2], r_ohm: vec![], tau_s: vec![] };
        let time_s: Vec<f64> = (0..=3600).map(f64::from).collect();
        let soc: Vec<f64> = time_s.iter().map(|t| 1.0 - t / 3600.0).collect();
        let [current_a, voltage_v, temperature_c] = [2.0, 3.61, 25.0].map(|value| vec![value; 3601]);
        let raw = MeasuredPart { time_s, current_a, voltage_v, temperature_c, soc, ..MeasuredPart::default() };
        let limits = Limits { voltage_low_v: 2.0, voltage_high_v: 5.0, capacity_ah: 2.0 };
        let record = Record::prepare(&raw, &[], &grid, &limits);
        let fit =
            FittedTables { grid, tables, total: Residual::default(), visits_s: vec![], passes: 0, converged: true };
        let error_v = |files: [usize; 4], share: f64| {
            let judged = files.map(|file| WeightedRecord { record: &record, file, share });
            table(&fit, &judged, 2.0)
        };
        // The error is 10 mV everywhere. The variance is multiplied by 4 for one drive, by 1.75 for four drives, and by
        // 11 for one pulse test.
        let cases = [([7; 4], 1.0, 4.0_f64), ([0, 1, 2, 3], 1.0, 1.75), ([7; 4], 0.3, 11.0)];
        for (files, share, growth) in cases {
            let (found, expected_v) = (error_v(files, share), 0.01 * growth.sqrt());
            assert!(found.iter().all(|v| (v - expected_v).abs() < 1e-9), "{files:?}: {found:?}");
        }
    }

    #[test]
    fn rarely_visited_node_has_a_larger_error() {
        let sums = NodeSums { square: vec![4e-4, 0.0], weight: vec![4.0, 0.0], files: vec![4.0, 0.0] };
        let row = row(&sums, 0, 2).expect("data");
        assert!((row[0] - 0.01 * 1.75_f64.sqrt()).abs() < 1e-12, "{row:?}");
        assert_eq!(row[0], row[1]);
    }
}
