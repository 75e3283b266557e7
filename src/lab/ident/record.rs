//! Prepares measured rows for the fit: joins them into blocks, positions them in the tables, and weights them by time.
//!
//! A block collects raw rows until it is [`BLOCK_S`] long. Its voltage, current, temperature and SOC are those of its
//! last row, because the series resistance acts immediately. The RC branches use its mean current, so that no charge is
//! lost. A block ends early at a gap. It also ends before a current step that follows a steady current, so that both
//! sides of the step are kept. A gap hides charge if the currents at its ends do not explain the change of the SOC.
//! After such a gap, the branches start relaxed (at 0 V).

use super::MeasuredPart;
use super::grid::{Corners, Grid};
use crate::filter::ends;

/// Maximum length of a block (s). Time constants of the branches are several times longer, and the current of drives
/// changes about once a second.
const BLOCK_S: f64 = 1.0;
/// Current step that ends a block early after a steady current, as a share of the largest current.
const EDGE_SHARE: f64 = 0.1;
/// Time with steady current before an edge (s). Drives are rarely steady that long.
const STEADY_S: f64 = 3.0;
/// Maximum number of seconds that one row represents. Otherwise, rests logged once a minute would outweigh drives.
const MAX_WEIGHT_S: f64 = 20.0;
/// Shortest gap that may hide charge (s).
const GAP_S: f64 = 60.0;
/// If a gap hides more charge than this (as SOC), the state of the branches is unknown.
const HIDDEN_SOC: f64 = 0.002;
/// Time (s) for which rows do not count in the fit after a gap that hides charge and ends under load, because the
/// branches are still wrong.
const UNKNOWN_S: f64 = 600.0;
/// A cell rests below this current, as a share of the largest current.
const REST_SHARE: f64 = 0.02;

/// One row of the fit.
#[derive(Debug, Clone, Copy)]
pub struct FitRow {
    /// Seconds since the part started.
    pub time_s: f64,
    /// Seconds since the previous row.
    pub dt_s: f64,
    /// Whether the branches are relaxed at this row, regardless of earlier rows.
    pub relaxed: bool,
    /// Mean current since the previous row (A).
    pub mean_current_a: f64,
    /// Current at the time of the row (A).
    pub current_a: f64,
    /// Measured voltage (V).
    pub voltage_v: f64,
    /// Cell temperature (degrees C).
    pub temperature_c: f64,
    /// State of charge.
    pub soc: f64,
    /// Seconds that the row represents; 0 = it only advances the branches and does not count in the fit.
    pub weight_s: f64,
    /// Nodes of the table of open-circuit voltages around this row.
    pub ocv: Corners,
    /// Nodes of the tables of resistances around this row.
    pub resistance: Corners,
    /// Nodes of the tables of time constants around this row.
    pub tau: Corners,
}

/// Rows of one part of a file.
#[derive(Debug, Clone, Default)]
pub struct Record {
    /// Rows in the order of time.
    pub rows: Vec<FitRow>,
    /// Number of raw rows.
    pub raw_rows: usize,
    /// Number of rows that do not count because their voltage is not plausible for this cell (disconnected sensor).
    pub outliers: usize,
}

/// Plausibility limits of a record's rows.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Lowest credible voltage (V).
    pub voltage_low_v: f64,
    /// Highest credible voltage (V).
    pub voltage_high_v: f64,
    /// Capacity that converts charge to SOC (Ah).
    pub capacity_ah: f64,
}

impl Record {
    /// Prepares a part. If `judged[k]` is false, raw row k does not count in the fit; an empty `judged` excludes no
    /// row.
    pub fn prepare(raw: &MeasuredPart, judged: &[bool], grid: &Grid, limits: &Limits) -> Self {
        let largest_a = raw.current_a.iter().fold(0.0_f64, |most, i| most.max(i.abs()));
        let ends = block_ends(raw, largest_a);
        let mut record = Self { raw_rows: raw.time_s.len(), ..Self::default() };
        let mut unknown_until_s = f64::NEG_INFINITY;
        let mut before = 0;
        for &end in &ends {
            let mut row = block_row(raw, before, end, grid);
            if end > before && hides_charge(raw, before, end, limits.capacity_ah) {
                row.relaxed = true;
                if row.current_a.abs() > REST_SHARE * largest_a {
                    unknown_until_s = row.time_s + UNKNOWN_S;
                }
            }
            let credible = (limits.voltage_low_v..=limits.voltage_high_v).contains(&row.voltage_v);
            record.outliers += usize::from(!credible);
            if !credible || row.time_s < unknown_until_s || judged.get(end) == Some(&false) {
                row.weight_s = -1.0;
            }
            record.rows.push(row);
            before = end;
        }
        weigh(&mut record.rows);
        record
    }

    /// Returns the smallest and largest SOC of the rows that count in the fit.
    pub fn judged_ends(&self) -> (f64, f64) {
        ends(self.rows.iter().filter(|row| row.weight_s > 0.0).map(|row| row.soc))
    }

    /// Returns the seconds from the first row to the last.
    pub fn seconds(&self) -> f64 {
        self.rows.iter().map(|row| row.dt_s).sum()
    }
}

/// Weight of a whole discharge (s), about the length of a drive. Longer tests contain no more information.
const WHOLE_S: f64 = 8000.0;
/// Weight of slow tests and pulse tests relative to drives. It is below 1 because the model should follow drives.
const TEST_SHARE: f64 = 0.3;
/// Limits of a drive: smallest share of the time in which current flows, and smallest ratio of the current's standard
/// deviation to its mean.
const DRIVE: (f64, f64) = (0.5, 0.3);

/// Returns 1 for a drive. Returns [`TEST_SHARE`] for pulse tests with rests and for constant current.
pub fn share(record: &Record) -> f64 {
    let largest = record.rows.iter().fold(0.0_f64, |most, row| most.max(row.current_a.abs()));
    let (mut all, mut flowing, mut first, mut second) = (0.0, 0.0, 0.0, 0.0);
    for row in &record.rows {
        let size = row.mean_current_a.abs();
        all += row.dt_s;
        if size > REST_SHARE * largest {
            flowing += row.dt_s;
            first += size * row.dt_s;
            second += size * size * row.dt_s;
        }
    }
    let variation = (second * flowing / (first * first) - 1.0).max(0.0).sqrt();
    if flowing > DRIVE.0 * all && variation > DRIVE.1 { 1.0 } else { TEST_SHARE }
}

/// Returns the weight of each second. The weight of the whole record depends on its SOC range, not on its length.
pub fn weight(record: &Record) -> f64 {
    let (low, high) = record.judged_ends();
    let seconds: f64 = record.rows.iter().filter(|row| row.weight_s > 0.0).map(|row| row.weight_s).sum();
    if seconds > 0.0 { (high - low) * WHOLE_S / seconds } else { 0.0 }
}

fn block_ends(raw: &MeasuredPart, largest_a: f64) -> Vec<usize> {
    let (time_s, current_a) = (&raw.time_s, &raw.current_a);
    let (mut ends, mut last, mut last_step_s) = (vec![0], 0, f64::NEG_INFINITY);
    for k in 1..time_s.len() {
        let step = (current_a[k] - current_a[k - 1]).abs() > EDGE_SHARE * largest_a;
        let edge = step && time_s[k] - last_step_s >= STEADY_S;
        if k - 1 > last && (edge || time_s[k] - time_s[k - 1] > BLOCK_S) {
            ends.push(k - 1);
            last = k - 1;
        }
        if edge || time_s[k] - time_s[last] >= BLOCK_S - 1e-6 || k + 1 == time_s.len() {
            ends.push(k);
            last = k;
        }
        if step {
            last_step_s = time_s[k];
        }
    }
    ends
}

fn block_row(raw: &MeasuredPart, before: usize, end: usize, grid: &Grid) -> FitRow {
    let dt_s = raw.time_s[end] - raw.time_s[before];
    let charge_as: f64 = (before + 1..=end)
        .map(|k| 0.5 * (raw.current_a[k] + raw.current_a[k - 1]) * (raw.time_s[k] - raw.time_s[k - 1]))
        .sum();
    let place = grid.place(raw.soc[end], raw.temperature_c[end]);
    FitRow {
        time_s: raw.time_s[end],
        dt_s,
        relaxed: end == 0,
        mean_current_a: if dt_s > 0.0 { charge_as / dt_s } else { raw.current_a[end] },
        current_a: raw.current_a[end],
        voltage_v: raw.voltage_v[end],
        temperature_c: raw.temperature_c[end],
        soc: raw.soc[end],
        weight_s: 0.0,
        ocv: grid.ocv_corners(&place),
        resistance: grid.resistance_corners(&place),
        tau: grid.tau_corners(&place),
    }
}

/// Whether the SOC change during a gap differs by more than [`HIDDEN_SOC`] from the charge that the currents at both
/// ends would move.
fn hides_charge(raw: &MeasuredPart, before: usize, end: usize, capacity_ah: f64) -> bool {
    (before + 1..=end).any(|k| {
        let dt_s = raw.time_s[k] - raw.time_s[k - 1];
        let shown = 0.5 * (raw.current_a[k] + raw.current_a[k - 1]) * dt_s / 3600.0 / capacity_ah;
        dt_s > GAP_S && (raw.soc[k - 1] - raw.soc[k] - shown).abs() > HIDDEN_SOC
    })
}

/// Weights each row by half of the time to both neighbours, at most [`MAX_WEIGHT_S`]. A negative weight becomes 0.
fn weigh(rows: &mut [FitRow]) {
    for k in 0..rows.len() {
        let after_s = rows.get(k + 1).map_or(0.0, |row| row.dt_s);
        let row = &mut rows[k];
        row.weight_s = if row.weight_s < 0.0 { 0.0 } else { (0.5 * (row.dt_s + after_s)).min(MAX_WEIGHT_S) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        Grid { soc: vec![0.0, 1.0], temperature_c: vec![25.0] }
    }

    const LIMITS: Limits = Limits { voltage_low_v: 2.0, voltage_high_v: 4.5, capacity_ah: 1.0 };

    fn prepare(time_s: &[f64], current_a: &[f64], voltage_v: &[f64], soc: &[f64]) -> Record {
        let temperature_c = vec![25.0; time_s.len()];
        let [time_s, current_a, voltage_v, soc] = [time_s, current_a, voltage_v, soc].map(<[f64]>::to_vec);
        let raw = MeasuredPart { time_s, current_a, voltage_v, temperature_c, soc, ..MeasuredPart::default() };
        Record::prepare(&raw, &[], &grid(), &LIMITS)
    }

    #[test]
    fn blocks_keep_charge_and_both_sides_of_an_edge() {
        let time_s: Vec<f64> = (0..200).map(|k| 0.1 * f64::from(k)).collect();
        let current_a: Vec<f64> = time_s.iter().map(|&t| if t >= 9.95 { 2.0 } else { 0.0 }).collect();
        let soc = vec![0.5; 200];
        let record = prepare(&time_s, &current_a, &[3.6; 200], &soc);
        assert!(record.rows.len() < 30, "{}", record.rows.len());
        let charge: f64 = record.rows.iter().map(|row| row.mean_current_a * row.dt_s).sum();
        let raw_charge = 3600.0 * super::super::charge_ah(&time_s, &current_a)[199];
        assert!((charge - raw_charge).abs() < 1e-9, "{charge} {raw_charge}");
        let edge = record.rows.windows(2).find(|pair| pair[1].current_a > 1.0).expect("an edge");
        assert!((edge[1].dt_s - 0.1).abs() < 1e-9 && edge[0].current_a == 0.0, "{edge:?}");
    }

    #[test]
    fn disconnected_sensor_is_counted_and_not_judged() {
        let record = prepare(&[0.0, 1.0, 2.0], &[0.1; 3], &[3.6, -0.0006, 3.6], &[0.5; 3]);
        assert_eq!(record.outliers, 1);
        assert_eq!(record.rows[1].weight_s, 0.0);
        assert!(record.rows[2].weight_s > 0.0);
    }

    #[test]
    fn gap_with_hidden_charge_relaxes_the_branches() {
        let hidden = prepare(&[0.0, 1.0, 7000.0], &[0.0; 3], &[3.6; 3], &[0.5, 0.5, 0.4]);
        assert!(hidden.rows[2].relaxed && hidden.rows[2].weight_s > 0.0);
        let rest = prepare(&[0.0, 1.0, 7000.0], &[0.0; 3], &[3.6; 3], &[0.5; 3]);
        assert!(!rest.rows[2].relaxed);
        let driving = prepare(&[0.0, 1.0, 500.0, 501.0], &[0.0, 0.0, 1.0, 1.0], &[3.6; 4], &[0.5, 0.5, 0.4, 0.4]);
        assert!(driving.rows[2].relaxed && driving.rows[3].weight_s == 0.0);
    }
}
