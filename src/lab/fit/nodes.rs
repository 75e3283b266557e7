//! Places SOC breakpoints where the open-circuit curve of the slow tests bends.
//!
//! Linear interpolation between breakpoints causes an SOC error. Breakpoints are added where the error is largest,
//! until it is below [`MOST_POINTS`] everywhere or there are [`MOST_NODES`] breakpoints.

use crate::ident::fit::{MIN_SLOPE_V, OcvCurve};
use crate::ident::grid::interpolate;

/// Maximum SOC error of the linear interpolation, fraction.
const MOST_POINTS: f64 = 0.005;
/// Width over which the slope of a curve is computed, SOC. A plateau has short steps. The width is larger than such a
/// step, so that a step does not count as a steep slope: an SOC estimate that changes crosses it soon.
const SLOPE_WIDTH: f64 = 0.04;
/// Smallest distance between breakpoints, and between the SOC values at which the error is computed.
const LEAST_DISTANCE: f64 = 0.01;
/// Maximum number of breakpoints. More would make a fit slow.
const MOST_NODES: usize = 31;

pub(super) fn by_curvature(first: &[f64], curves: &[OcvCurve]) -> Vec<f64> {
    let mut nodes = first.to_vec();
    while nodes.len() < MOST_NODES {
        let points = (1..100).map(|k| LEAST_DISTANCE * f64::from(k));
        let free = points.filter(|at| nodes.iter().all(|node| (node - at).abs() > 0.99 * LEAST_DISTANCE));
        let worst = free.map(|at| (at, misread(curves, &nodes, at))).max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((at, _)) = worst.filter(|(_, error)| *error > MOST_POINTS) else { break };
        let place = nodes.partition_point(|&node| node < at);
        nodes.insert(place, (at * 100.0).round() / 100.0);
    }
    nodes
}

/// Returns the SOC error (fraction) of linear interpolation between `nodes` at the SOC `at`: the largest over all
/// curves.
fn misread(curves: &[OcvCurve], nodes: &[f64], at: f64) -> f64 {
    let of_curve = |curve: &OcvCurve| {
        let voltage_v = |soc: f64| interpolate(&curve.soc, &curve.voltage_v, soc);
        let above = nodes.partition_point(|&node| node < at);
        let (low, high) = (nodes[above - 1], nodes[above]);
        // A cold test ends before the cell is empty, so its curve does not reach SOC 0.
        if low < curve.soc[0] {
            return 0.0;
        }
        let along = (at - low) / (high - low);
        let error_v = (voltage_v(low) + along * (voltage_v(high) - voltage_v(low)) - voltage_v(at)).abs();
        let (from, to) = ((at - 0.5 * SLOPE_WIDTH).max(0.0), (at + 0.5 * SLOPE_WIDTH).min(1.0));
        let slope_v = ((voltage_v(to) - voltage_v(from)) / (to - from)).max(MIN_SLOPE_V);
        // Errors up to 1 mV are ignored, because no model is more accurate.
        if error_v > 0.001 { error_v / slope_v } else { 0.0 }
    };
    curves.iter().map(of_curve).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates a straight curve with a step of 50 mV at SOC 0.63.
    fn stepped() -> OcvCurve {
        let soc: Vec<f64> = (0..=1000).map(|k| f64::from(k) / 1000.0).collect();
        let voltage_v = soc.iter().map(|z| 3.0 + z + 0.025 * ((z - 0.63) / 0.01).tanh()).collect();
        OcvCurve { temperature_c: 25.0, soc, voltage_v }
    }

    #[test]
    fn nodes_are_added_only_where_the_curve_bends() {
        let first = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];
        let nodes = by_curvature(&first, &[stepped()]);
        assert!(nodes.len() > first.len() && nodes.len() < MOST_NODES, "{nodes:?}");
        assert!(nodes.windows(2).all(|pair| pair[1] - pair[0] > 0.99 * LEAST_DISTANCE), "{nodes:?}");
        let added = || nodes.iter().filter(|node| !first.contains(node));
        assert!(added().all(|node| (0.55..0.75).contains(node)), "{nodes:?}");
        let worst =
            |nodes: &[f64]| (1..100).map(|k| misread(&[stepped()], nodes, f64::from(k) / 100.0)).fold(0.0, f64::max);
        assert!(worst(&first) > 0.01 && worst(&nodes) <= MOST_POINTS, "{} {}", worst(&first), worst(&nodes));
    }

    #[test]
    fn straight_curve_needs_no_more_nodes() {
        let curve = OcvCurve { temperature_c: 25.0, soc: vec![0.0, 1.0], voltage_v: vec![3.0, 4.2] };
        assert_eq!(by_curvature(&[0.0, 0.5, 1.0], &[curve]), [0.0, 0.5, 1.0]);
    }
}
