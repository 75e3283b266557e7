//! Computes the open-circuit voltage of a BPX cell over SOC, and the charge between its cut-offs.
//!
//! `u(soc, T) = u_p(y) - u_n(x) + (T - T_ref) (du_p/dT(y) - du_n/dT(x))` with the lithium contents `x` (negative) and
//! `y` (positive). The cyclable lithium follows from the full cell in the file: the negative electrode has its maximum
//! lithium content, the positive electrode its minimum. At the reference temperature, SOC 1 has the upper cut-off
//! voltage and SOC 0 the lower cut-off voltage. The method is that of PyBaMM's ElectrodeSOH (Mohtat et al., J. Power
//! Sources 427 (2019) 101, eqs. 5 to 8). Units: V, Ah, K.

use super::FARADAY_C_PER_MOL;
use super::document::{BpxCell, Electrode};
use crate::filter::bisect;

/// Smallest rise of the open-circuit voltage between breakpoints (V). Voltages that rise by less are raised.
const LEAST_RISE_V: f64 = 2e-5;

/// Number of points between two breakpoints at which the interpolation is checked.
const PROBES: usize = 15;

#[derive(Debug, Clone, Copy)]
pub(super) struct Curve<'a> {
    cell: &'a BpxCell,
    /// Lithium content of the negative electrode at SOC 0 and 1.
    pub(super) negative: [f64; 2],
    /// Lithium content of the positive electrode at SOC 0 and 1.
    pub(super) positive: [f64; 2],
    pub(super) capacity_ah: f64,
}

#[derive(Debug, Clone)]
pub(super) struct CurveTable {
    pub(super) soc: Vec<f64>,
    /// One row per temperature (V).
    pub(super) ocv_v: Vec<Vec<f64>>,
    /// Largest amount by which a voltage was raised to make its row rise (V).
    pub(super) raised_v: f64,
}

impl Electrode {
    pub(super) fn capacity_ah(&self, area_m2: f64) -> f64 {
        let volume_share = self.surface_per_m * self.radius_m / 3.0;
        FARADAY_C_PER_MOL * volume_share * self.thickness_m * area_m2 * self.concentration_max / 3600.0
    }
}

impl<'a> Curve<'a> {
    /// Finds the lithium contents at the cut-offs.
    ///
    /// # Errors
    /// The voltage does not reach a cut-off.
    pub(super) fn new(cell: &'a BpxCell) -> Result<Self, Vec<String>> {
        let (n, p) = (&cell.negative, &cell.positive);
        let [q_n, q_p] = [n, p].map(|electrode| electrode.capacity_ah(cell.area_m2));
        let lithium_ah = q_n * n.stoichiometry[1] + q_p * p.stoichiometry[0];
        let y_of = |x: f64| (lithium_ah - q_n * x) / q_p;
        let voltage_v = |x: f64| p.ocp_v.at(y_of(x)) - n.ocp_v.at(x);
        let ends = (((lithium_ah - q_p) / q_n).max(0.0) + 1e-9, (lithium_ah / q_n).min(1.0) - 1e-9);
        let mut faults = Vec::new();
        let mut content = |key: &str, cut_off_v: f64| {
            // Search outwards from the stated lithium content, because far from this content, the potential may not be
            // monotone.
            let [full, empty] = [n.stoichiometry[1], n.stoichiometry[0]].map(|x| x.clamp(ends.0, ends.1));
            let near = if key == "Upper" { full } else { empty };
            let (low, high) = bracket(near, ends, |x| voltage_v(x) < cut_off_v);
            // 50 steps give an accuracy of 1e-15.
            let x = bisect((low, high), 50, |x| voltage_v(x) < cut_off_v).1;
            let reached_v = voltage_v(x);
            let is_reached = (reached_v - cut_off_v).abs() < 1e-3;
            if !is_reached {
                faults.push(format!(
                    "Parameterisation.Cell.{key} voltage cut-off [V]: {cut_off_v}, must be reached by the open-circuit voltage, \
                     which is {reached_v:.3} V there"
                ));
            }
            x
        };
        let [full, empty] = [content("Upper", cell.voltage_max_v), content("Lower", cell.voltage_min_v)];
        if faults.is_empty() && full <= empty {
            faults
                .push("Parameterisation: the open-circuit voltage falls as the cell is charged, must rise".to_owned());
        }
        match faults.is_empty() {
            true => Ok(Self {
                cell,
                negative: [empty, full],
                positive: [y_of(empty), y_of(full)],
                capacity_ah: q_n * (full - empty),
            }),
            false => Err(faults),
        }
    }

    pub(super) fn contents(&self, soc: f64) -> (f64, f64) {
        let between = |[empty, full]: [f64; 2]| empty + soc * (full - empty);
        (between(self.negative), between(self.positive))
    }

    pub(super) fn voltage_v(&self, soc: f64, temperature_k: f64) -> f64 {
        let (x, y) = self.contents(soc);
        let BpxCell { negative: n, positive: p, reference_k, .. } = self.cell;
        let warmer_k = temperature_k - reference_k;
        p.ocp_v.at(y) - n.ocp_v.at(x) + warmer_k * (p.entropic.at(y) - n.entropic.at(x))
    }

    /// Returns the curve at suitable breakpoints.
    ///
    /// # Errors
    /// The open-circuit voltage at a breakpoint is not a finite number above 0.
    pub(super) fn table(&self, temperature_k: &[f64]) -> Result<CurveTable, Vec<String>> {
        let mut table = CurveTable { soc: self.nodes(), ocv_v: Vec::new(), raised_v: 0.0 };
        for &kelvin in temperature_k {
            let row: Vec<f64> = table.soc.iter().map(|&soc| self.voltage_v(soc, kelvin)).collect();
            if let Some(k) = row.iter().position(|voltage_v| !(*voltage_v > 0.0 && voltage_v.is_finite())) {
                let (x, y) = self.contents(table.soc[k]);
                return Err(vec![format!(
                    "Parameterisation: the open-circuit voltage is {} V at {kelvin} K and lithium contents {x:.4} (negative) and \
                     {y:.4} (positive), must be above 0",
                    row[k]
                )]);
            }
            table.ocv_v.push(rising(&row, &mut table.raised_v));
        }
        Ok(table)
    }

    /// Returns at most 80 SOC breakpoints, at least 1e-4 apart. The interval with the largest interpolation error is
    /// halved until no error exceeds 1 mV.
    fn nodes(&self) -> Vec<f64> {
        let mut nodes: Vec<f64> = (0..=10).map(|k| f64::from(k) / 10.0).collect();
        let mut errors: Vec<f64> = nodes.windows(2).map(|ends| self.line_error_v(ends[0], ends[1])).collect();
        while nodes.len() < 80 {
            let can_be_halved = |k: &usize| nodes[k + 1] - nodes[*k] >= 2.0 * 1e-4;
            let worst = (0..errors.len()).filter(can_be_halved).max_by(|a, b| errors[*a].total_cmp(&errors[*b]));
            let Some(worst) = worst.filter(|worst| errors[*worst] > 0.001) else { break };
            let middle = 0.5 * (nodes[worst] + nodes[worst + 1]);
            errors[worst] = self.line_error_v(nodes[worst], middle);
            errors.insert(worst + 1, self.line_error_v(middle, nodes[worst + 1]));
            nodes.insert(worst + 1, middle);
        }
        nodes
    }

    fn line_error_v(&self, from: f64, to: f64) -> f64 {
        let kelvin = self.cell.reference_k;
        let [a, b] = [from, to].map(|soc| self.voltage_v(soc, kelvin));
        let error_v = |k: usize| {
            let along = k as f64 / (PROBES + 1) as f64;
            (self.voltage_v(from + along * (to - from), kelvin) - (a + along * (b - a))).abs()
        };
        (1..=PROBES).map(error_v).fold(0.0, f64::max)
    }
}

/// Returns an interval around `near` in which the predicate changes from true to false. If there is none, returns
/// `ends`.
fn bracket(near: f64, ends: (f64, f64), is_below: impl Fn(f64) -> bool) -> (f64, f64) {
    let mut step = 1e-4;
    while step < 1.0 {
        let (low, high) = ((near - step).max(ends.0), (near + step).min(ends.1));
        if is_below(low) && !is_below(high) {
            return (low, high);
        }
        step *= 2.0;
    }
    ends
}

/// Raises each value, if necessary, to [`LEAST_RISE_V`] above the previous value.
fn rising(row: &[f64], raised_v: &mut f64) -> Vec<f64> {
    let mut least_v = f64::NEG_INFINITY;
    let mut raise = |voltage_v: f64| {
        let raised = voltage_v.max(least_v);
        *raised_v = raised_v.max(raised - voltage_v);
        least_v = raised + LEAST_RISE_V;
        raised
    };
    row.iter().map(|voltage_v| raise(*voltage_v)).collect()
}
