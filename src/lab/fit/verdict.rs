//! Describes the accuracy of a fitted model in plain words.
//!
//! The SOC error at a breakpoint is the voltage error there (V, on data that the fit did not use) divided by the slope
//! of the open-circuit curve. The reported SOC error is the root mean square over the SOC range [`MIDDLE`]. It applies
//! if the SOC is determined from voltage alone. Counting charge between readings reduces the error; sensor errors
//! increase it.

use super::{FitOutcome, MeasuredRange};
use crate::ident::fit::{FittedTables, MIN_SLOPE_V, SUPPORTED_S};

/// SOC range over which errors are averaged. Lower SOC is left out: cells are rarely used there, and the steep curve
/// makes any model accurate.
const MIDDLE: std::ops::RangeInclusive<f64> = 0.1..=0.95;

pub(super) fn verdict(outcome: &FitOutcome) -> Vec<String> {
    let FitOutcome { fit, voltage_error_v, .. } = outcome;
    let columns = fit.grid.soc.len();
    let points = soc_points(fit, voltage_error_v);
    let measured = |t: usize| fit.visits_s[t * columns..(t + 1) * columns].iter().sum::<f64>() >= SUPPORTED_S;
    let rows: Vec<(f64, f64)> = (0..fit.grid.temperature_c.len())
        .filter(|&t| measured(t))
        .map(|t| (fit.grid.temperature_c[t], mean_points(&fit.grid.soc, &points[t * columns..(t + 1) * columns])))
        .collect();
    let mut said = accuracy(&rows);
    said.extend(flat(&fit.grid.soc, &points, columns));
    said.push(ranges(&outcome.measured));
    said
}

/// Returns the SOC error (percentage points) at every node if voltage alone determines the SOC.
fn soc_points(fit: &FittedTables, voltage_error_v: &[f64]) -> Vec<f64> {
    let (soc, columns) = (&fit.grid.soc, fit.grid.soc.len());
    let of_node = |node: usize| {
        let (first, s) = (node - node % columns, node % columns);
        let (low, high) = (s.saturating_sub(1), (s + 1).min(columns - 1));
        let rise_v = fit.tables.ocv_v[first + high] - fit.tables.ocv_v[first + low];
        100.0 * voltage_error_v[node] / (rise_v / (soc[high] - soc[low])).max(MIN_SLOPE_V)
    };
    (0..voltage_error_v.len()).map(of_node).collect()
}

fn mean_points(soc: &[f64], points: &[f64]) -> f64 {
    let middle: Vec<f64> =
        soc.iter().zip(points).filter(|(soc, _)| MIDDLE.contains(*soc)).map(|(_, p)| p * p).collect();
    (middle.iter().sum::<f64>() / middle.len().max(1) as f64).sqrt()
}

/// Rounds to half percentage points, at least half a point.
fn rounded(points: f64) -> String {
    let halves = ((2.0 * points).round() / 2.0).max(0.5);
    format!("{halves} {}", if halves == 1.0 { "point" } else { "points" })
}

fn accuracy(rows: &[(f64, f64)]) -> Vec<String> {
    // A temperature counts as good if the SOC error at this temperature is at most 2 percentage points.
    let (good, poor): (Vec<_>, Vec<_>) = rows.iter().partition(|(_, points)| *points <= 2.0);
    let mut said = Vec::new();
    if let (Some((low_c, _)), Some((high_c, _))) = (good.first(), good.last()) {
        let worst = good.iter().map(|(_, points)| *points).fold(0.0, f64::max);
        let place = if low_c == high_c { format!("at {low_c}") } else { format!("between {low_c} and {high_c}") };
        said.push(format!("SOC from voltage alone: accurate to about {} {place} degrees C", rounded(worst)));
    }
    if !poor.is_empty() {
        let each: Vec<String> = poor.iter().map(|(t, points)| format!("{} at {t}", rounded(*points))).collect();
        said.push(format!("SOC from voltage alone: not accurate, error about {} degrees C", each.join(", ")));
    }
    said
}

/// Lists the SOC breakpoints at which the curve is too flat to find the SOC from voltage, because the SOC error exceeds
/// 5 percentage points at every temperature.
fn flat(soc: &[f64], points: &[f64], columns: usize) -> Option<String> {
    let is_flat = |s: &usize| points.iter().skip(*s).step_by(columns).all(|points| *points > 5.0);
    let flat: Vec<String> = (0..columns).filter(is_flat).map(|s| soc[s].to_string()).collect();
    let list = flat.join(", ");
    (!flat.is_empty())
        .then(|| format!("near {list} the curve is too flat to find the SOC from voltage: charge is counted there"))
}

fn ranges(range: &MeasuredRange) -> String {
    let (cold_c, warm_c) = range.temperature_c;
    let (charge_a, discharge_a) = range.current_a;
    let (empty, full) = range.soc;
    let charges = if charge_a < 0.0 { format!("charges up to {:.1} A", -charge_a) } else { "no charge".to_owned() };
    // Adding 0 changes -0 to 0.
    format!(
        "measured: {:.0} to {:.0} degrees C, discharges up to {discharge_a:.1} A, {charges}, SOC {:.2} to {:.2}; outside this range the model \
         is extrapolated",
        cold_c.round() + 0.0,
        warm_c.round() + 0.0,
        empty + 0.0,
        full + 0.0,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_temperatures_are_joined_and_others_listed() {
        let rows = [(-20.0, 6.1), (-10.0, 2.9), (0.0, 1.6), (25.0, 0.6), (40.0, 0.3)];
        let expected = [
            "SOC from voltage alone: accurate to about 1.5 points between 0 and 40 degrees C",
            "SOC from voltage alone: not accurate, error about 6 points at -20, 3 points at -10 degrees C",
        ];
        assert_eq!(accuracy(&rows), expected);
        assert_eq!(accuracy(&rows[3..4]), ["SOC from voltage alone: accurate to about 0.5 points at 25 degrees C"]);
        assert!(accuracy(&[]).is_empty());
    }

    #[test]
    fn ranges_have_no_negative_zero() {
        let range =
            MeasuredRange { temperature_c: (-0.4, 42.1), current_a: (-2.0, 12.1), soc: (-0.001, 1.0), rms_a: 1.0 };
        let found = ranges(&range);
        assert!(
            found.starts_with("measured: 0 to 42 degrees C, discharges up to 12.1 A, charges up to 2.0 A"),
            "{found}"
        );
    }

    #[test]
    fn breakpoints_flat_at_every_temperature_are_listed() {
        let points = [1.0, 9.0, 7.0, 1.0, 6.0, 2.0];
        let found = flat(&[0.0, 0.5, 1.0], &points, 3).expect("one");
        assert!(found.starts_with("near 0.5 the curve is too flat"), "{found}");
        assert_eq!(flat(&[0.0, 1.0], &[1.0, 2.0], 2), None);
    }
}
