//! Defines the parameter vector of a fit. For every node (a point of the grid of SOC and temperature), it contains the
//! OCV (V), ln R0, and ln R and ln tau of each RC branch.
//!
//! Parameters of one kind are consecutive and in node order (temperature row by temperature row). The capacitance of a
//! node is C = tau / R.

use super::grid::Grid;
use crate::cell::{Branch, Table};

/// Position of each kind of parameter in the vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Number of nodes of a table.
    pub nodes: usize,
    /// Number of SOC columns.
    pub columns: usize,
    /// Number of RC branches.
    pub branches: usize,
}

impl Layout {
    /// Creates the layout for `branches` branches on `grid`.
    pub fn new(grid: &Grid, branches: usize) -> Self {
        Self { nodes: grid.nodes(), columns: grid.soc.len(), branches }
    }

    /// Returns the number of parameters.
    pub fn len(&self) -> usize {
        self.nodes * (2 + 2 * self.branches)
    }

    /// Whether the vector is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the index of the first ln R0.
    pub fn r0(&self) -> usize {
        self.nodes
    }

    /// Returns the index of the first ln R of branch `i`.
    pub fn branch_r(&self, i: usize) -> usize {
        self.nodes * (2 + 2 * i)
    }

    /// Returns the index of the first ln tau of branch `i`.
    pub fn branch_tau(&self, i: usize) -> usize {
        self.nodes * (3 + 2 * i)
    }
}

/// Tables that a parameter vector describes, in node order.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterTables {
    /// Open-circuit voltage (V).
    pub ocv_v: Vec<f64>,
    /// Series resistance (ohm).
    pub r0_ohm: Vec<f64>,
    /// Resistance of each branch (ohm).
    pub r_ohm: Vec<Vec<f64>>,
    /// Time constant of each branch (s).
    pub tau_s: Vec<Vec<f64>>,
}

impl ParameterTables {
    /// Returns the tables of the parameter vector `theta`.
    pub fn new(layout: &Layout, theta: &[f64]) -> Self {
        let exp = |first: usize| theta[first..first + layout.nodes].iter().map(|&x| libm::exp(x)).collect::<Vec<_>>();
        Self {
            ocv_v: theta[..layout.nodes].to_vec(),
            r0_ohm: exp(layout.r0()),
            r_ohm: (0..layout.branches).map(|i| exp(layout.branch_r(i))).collect(),
            tau_s: (0..layout.branches).map(|i| exp(layout.branch_tau(i))).collect(),
        }
    }

    /// Returns the tables of a cell model: OCV, R0, branches.
    pub fn model(&self, columns: usize) -> (Table, Table, Vec<Branch>) {
        let table = |values: &[f64]| Table { values: values.chunks(columns).map(<[f64]>::to_vec).collect() };
        let farad = |(r, tau): (&Vec<f64>, &Vec<f64>)| r.iter().zip(tau).map(|(r, tau)| tau / r).collect::<Vec<f64>>();
        let branches = self.r_ohm.iter().zip(&self.tau_s);
        (
            table(&self.ocv_v),
            table(&self.r0_ohm),
            branches.map(|(r, tau)| Branch { r_ohm: table(r), c_farad: table(&farad((r, tau))) }).collect(),
        )
    }
}
