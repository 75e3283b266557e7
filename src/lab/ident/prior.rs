//! Defines the prior of a fit: smooth tables, Arrhenius' law between temperatures, and an open-circuit voltage (OCV)
//! near the OCV of a slow test (a slow discharge, if one was measured).
//!
//! The parameters are the values of the tables at their nodes (points of SOC and temperature). Each term of the prior
//! is a linear combination of parameters with a target and a standard deviation. The curvature at a node is the change
//! of the slope times the mean distance to both neighbours.

use super::grid::{Grid, arrhenius};
use super::parameters::Layout;
use super::pass::NormalEquations;

/// Standard deviations of the prior's terms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PriorDeviations {
    /// Second difference over SOC, scaled to the node spacing (V). With a slow test, it is the second difference of the
    /// correction to the slow test, otherwise of the OCV.
    pub ocv_curvature_v: f64,
    /// Difference between neighbouring temperatures (V). With a slow test, it is the difference of the correction,
    /// otherwise of the OCV.
    pub ocv_by_temperature_v: f64,
    /// Deviation of the OCV from the slow test (V) per node; unused without a slow test.
    pub ocv_pull_v: f64,
    /// Second difference of ln R0 over SOC, scaled to the node spacing.
    pub r0_curvature: f64,
    /// Second difference of each ln R.
    pub r_curvature: f64,
    /// Second difference of each ln tau.
    pub tau_curvature: f64,
    /// Deviation of ln R from Arrhenius' law between neighbouring temperatures.
    pub r_by_temperature: f64,
    /// Difference of ln tau between neighbouring temperatures.
    pub tau_by_temperature: f64,
    /// Deviation of ln R from its starting value.
    pub r_level: f64,
    /// Deviation of ln tau from its starting value.
    pub tau_level: f64,
}

impl PriorDeviations {
    /// Prior without a slow test: the data alone determine the OCV.
    pub const FREE_OCV: Self = Self {
        ocv_curvature_v: 0.2,
        ocv_by_temperature_v: 0.01,
        ocv_pull_v: f64::INFINITY,
        r0_curvature: 0.3,
        r_curvature: 0.4,
        tau_curvature: 0.1,
        r_by_temperature: 0.5,
        tau_by_temperature: 0.3,
        r_level: 3.0,
        tau_level: 0.7,
    };

    /// Prior with a slow test: the OCV is the slow test plus a smooth correction, which fades where drives have no
    /// data. Tuned by leaving out one drive at a time, on two cells at five and six temperatures.
    pub const SLOW_TEST: Self = Self {
        ocv_curvature_v: 0.025,
        ocv_by_temperature_v: 0.02,
        ocv_pull_v: 0.03,
        r0_curvature: 0.15,
        r_curvature: 0.15,
        tau_curvature: 0.05,
        tau_level: 0.2,
        ..Self::FREE_OCV
    };

    /// Prior around the usual resistances of a chemistry (`cell::chemistry`), with the spread of five fitted cells.
    /// Most of a cell's deviation is common to all nodes of a table.
    pub const CHEMISTRY: Self = Self {
        ocv_by_temperature_v: 0.006,
        r0_curvature: 0.15,
        r_curvature: 0.15,
        tau_curvature: 0.05,
        r_by_temperature: 0.2,
        tau_by_temperature: 0.1,
        r_level: 2.0,
        tau_level: 1.0,
        ..Self::FREE_OCV
    };

    /// Prior for an ageing cell. Each discharge and charge has one current, so only the first rows separate R0 from the
    /// RC branch. R0 therefore hardly varies over SOC, and the time constant stays fixed. Near empty, OCV and branch
    /// resistance are both steep, and the data cannot separate them. The branch resistance may vary only as much as in
    /// [`PriorDeviations::SLOW_TEST`], so the fit attributes the steep fall of the voltage near empty to the OCV.
    pub const AGEING: Self = Self {
        ocv_curvature_v: 0.5,
        r0_curvature: 0.005,
        r_curvature: Self::SLOW_TEST.r_curvature,
        tau_curvature: 0.01,
        tau_level: 0.01,
        ..Self::FREE_OCV
    };
}

/// One term: the sum of factor x parameter equals the target, with standard deviation sigma.
#[derive(Debug, Clone, PartialEq)]
struct PriorDensity {
    terms: Vec<(usize, f64)>,
    target: f64,
    sigma: f64,
}

/// All prior terms of one fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Prior(Vec<PriorDensity>);

impl Prior {
    /// Creates the prior around the starting values `start`. If `slow_test` is set, the OCV in `start` comes from a
    /// slow test.
    pub fn new(grid: &Grid, layout: &Layout, start: &[f64], slow_test: bool, deviations: &PriorDeviations) -> Self {
        let mut prior = Self(Vec::new());
        let reference = if slow_test { &start[..layout.nodes] } else { &vec![0.0; layout.nodes] };
        prior.curvature(grid, 0, reference, deviations.ocv_curvature_v);
        prior.by_temperature(grid, 0, reference, deviations.ocv_by_temperature_v);
        if slow_test {
            prior.level(0, reference, deviations.ocv_pull_v);
        }
        let arrhenius_ln = per_node(grid, |t| libm::log(arrhenius(t)));
        let flat = vec![0.0; layout.nodes];
        let level = |first: usize| &start[first..first + layout.nodes];
        prior.curvature(grid, layout.r0(), &flat, deviations.r0_curvature);
        prior.by_temperature(grid, layout.r0(), &arrhenius_ln, deviations.r_by_temperature);
        prior.level(layout.r0(), level(layout.r0()), deviations.r_level);
        for i in 0..layout.branches {
            let (r, tau) = (layout.branch_r(i), layout.branch_tau(i));
            prior.curvature(grid, r, &flat, deviations.r_curvature);
            prior.by_temperature(grid, r, &arrhenius_ln, deviations.r_by_temperature);
            prior.level(r, level(r), deviations.r_level);
            prior.curvature(grid, tau, &flat, deviations.tau_curvature);
            prior.by_temperature(grid, tau, &flat, deviations.tau_by_temperature);
            prior.level(tau, level(tau), deviations.tau_level);
        }
        prior
    }

    /// Creates the prior around known resistances and time constants in `start`. It constrains their shape and size.
    /// For the OCV, it constrains only the differences between temperatures.
    pub fn about(grid: &Grid, layout: &Layout, start: &[f64], deviations: &PriorDeviations) -> Self {
        let mut prior = Self(Vec::new());
        let of = |first: usize| &start[first..first + layout.nodes];
        prior.by_temperature(grid, 0, of(0), deviations.ocv_by_temperature_v);
        let mut block = |first: usize, curvature: f64, by_temperature: f64, level: f64| {
            prior.curvature(grid, first, of(first), curvature);
            prior.by_temperature(grid, first, of(first), by_temperature);
            prior.level(first, of(first), level);
        };
        let PriorDeviations { r_by_temperature, tau_by_temperature, r_level, tau_level, .. } = *deviations;
        block(layout.r0(), deviations.r0_curvature, r_by_temperature, r_level);
        for i in 0..layout.branches {
            block(layout.branch_r(i), deviations.r_curvature, r_by_temperature, r_level);
            block(layout.branch_tau(i), deviations.tau_curvature, tau_by_temperature, tau_level);
        }
        prior
    }

    /// Adds the prior's cost and derivatives at `theta`.
    pub fn accumulate(&self, theta: &[f64], normal: &mut NormalEquations) {
        let (mut index, mut j) = (Vec::new(), Vec::new());
        for term in &self.0 {
            index.clear();
            j.clear();
            let mut residual = -term.target;
            for &(at, factor) in &term.terms {
                residual += factor * theta[at];
                index.push(at);
                j.push(factor);
            }
            let weight = 1.0 / (term.sigma * term.sigma);
            normal.cost += 0.5 * weight * residual * residual;
            normal.add(&index, &j, residual, weight);
        }
    }

    fn push(&mut self, terms: Vec<(usize, f64)>, first: usize, reference: &[f64], sigma: f64) {
        let target = terms.iter().map(|&(at, factor)| factor * reference[at - first]).sum();
        self.0.push(PriorDensity { terms, target, sigma });
    }

    fn curvature(&mut self, grid: &Grid, first: usize, reference: &[f64], sigma: f64) {
        let columns = grid.soc.len();
        for row in 0..grid.temperature_c.len() {
            for (s, soc) in grid.soc.windows(3).enumerate() {
                let (a, b) = (soc[1] - soc[0], soc[2] - soc[1]);
                let scale = 0.5 * (a + b);
                let at = first + row * columns + s;
                let terms = vec![(at, scale / a), (at + 1, -scale * (1.0 / a + 1.0 / b)), (at + 2, scale / b)];
                self.push(terms, first, reference, sigma);
            }
        }
    }

    fn by_temperature(&mut self, grid: &Grid, first: usize, reference: &[f64], sigma: f64) {
        let columns = grid.soc.len();
        for row in 1..grid.temperature_c.len() {
            for s in 0..columns {
                let at = first + row * columns + s;
                self.push(vec![(at - columns, -1.0), (at, 1.0)], first, reference, sigma);
            }
        }
    }

    fn level(&mut self, first: usize, reference: &[f64], sigma: f64) {
        for at in first..first + reference.len() {
            self.push(vec![(at, 1.0)], first, reference, sigma);
        }
    }
}

/// Returns a value for every node, computed from the temperature of the node.
pub fn per_node(grid: &Grid, value: impl Fn(f64) -> f64) -> Vec<f64> {
    grid.temperature_c.iter().flat_map(|&t| vec![value(t); grid.soc.len()]).collect()
}
