//! Minimises the cost within bounds: projected Levenberg-Marquardt on normal equations.
//!
//! Some parameters form a *rising* block (the OCV over SOC). There, the solver uses the first value and the rises from
//! node to node instead of the node values. A bound on each rise keeps the curve monotone. The damped quadratic model
//! is minimised within the bounds by block pivoting: each iteration changes the set of parameters that are held at a
//! bound, and solves for the others by a Cholesky factorisation. A step is taken if it lowers the true cost.

use nalgebra::{DMatrix, DVector};

use super::pass::NormalEquations;
use crate::filter::levenberg_marquardt::{self, Damping};

const MAX_PASSES: usize = 60;
/// The fit has converged if the cost falls by less than this fraction in two consecutive steps with weak damping
/// ([`DAMPING_WEAK`]).
const CONVERGED: f64 = 3e-4;
/// Damping of the steps. If a step succeeded only with more damping, the damping then falls less, because much weaker
/// damping would probably fail again.
const DAMPING: Damping = Damping { first: 0.3, fall: 0.1, fall_after_growth: 0.6, growth: 8.0, least: 1e-4, most: 1e8 };
/// Up to this damping, a step is nearly undamped.
const DAMPING_WEAK: f64 = 0.02;
/// Maximum number of times that one step changes the set of parameters held at a bound. The result is then clamped.
const MAX_EXCHANGES: usize = 30;

/// Bounds and structure of the parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Space {
    /// Lowest values. For a rising block: lowest first value, then lowest rises.
    pub low: Vec<f64>,
    /// Highest values, in the same form.
    pub high: Vec<f64>,
    /// Rising blocks: first index and length.
    pub rising: Vec<(usize, usize)>,
}

impl Space {
    fn to_steps(&self, theta: &[f64]) -> Vec<f64> {
        let mut y = theta.to_vec();
        for &(first, len) in &self.rising {
            for k in (first + 1..first + len).rev() {
                y[k] -= y[k - 1];
            }
        }
        y
    }

    fn to_nodes(&self, y: &[f64]) -> Vec<f64> {
        let mut theta = y.to_vec();
        for &(first, len) in &self.rising {
            for k in first + 1..first + len {
                theta[k] += theta[k - 1];
            }
        }
        theta
    }

    /// Returns `theta` moved into the bounds.
    pub fn inside(&self, theta: &[f64]) -> Vec<f64> {
        let mut y = self.to_steps(theta);
        for (k, y) in y.iter_mut().enumerate() {
            *y = y.clamp(self.low[k], self.high[k]);
        }
        self.to_nodes(&y)
    }

    /// Converts gradient and matrix to first values and rises. A rise affects all nodes above it.
    fn pull_back(&self, normal: &NormalEquations) -> (DMatrix<f64>, DVector<f64>) {
        let n = normal.g.len();
        let mut h = DMatrix::from_vec(n, n, normal.symmetric());
        let mut g = DVector::from_column_slice(&normal.g);
        for &(first, len) in &self.rising {
            for k in (first..first + len - 1).rev() {
                g[k] += g[k + 1];
                for other in 0..n {
                    h[(other, k)] += h[(other, k + 1)];
                }
            }
            for column in 0..n {
                for k in (first..first + len - 1).rev() {
                    h[(k, column)] += h[(k + 1, column)];
                }
            }
        }
        (h, g)
    }
}

/// Result of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// Node values.
    pub theta: Vec<f64>,
    /// Cost at these values.
    pub cost: f64,
    /// Number of passes over the data.
    pub passes: usize,
    /// Whether the cost stopped falling.
    pub converged: bool,
}

/// Minimises the cost of `evaluate` from `start`; `progress` receives the pass number and the cost.
pub fn minimise(
    space: &Space,
    start: &[f64],
    evaluate: impl Fn(&[f64]) -> NormalEquations,
    mut progress: impl FnMut(usize, f64),
) -> Solution {
    let theta = space.inside(start);
    let normal = evaluate(&theta);
    let (mut passes, mut unchanged) = (1, 0);
    progress(passes, normal.cost);
    let step = |(theta, normal): &(Vec<f64>, NormalEquations), damping: f64| {
        passes += 1;
        let y = space.to_steps(theta);
        let (h, g) = space.pull_back(normal);
        let step = bounded_step(&h, &g, damping, &y, space)?;
        let moved: Vec<f64> = y.iter().zip(step.iter()).map(|(y, d)| y + d).collect();
        let trial = space.to_nodes(&moved);
        let evaluated = evaluate(&trial);
        let is_better = evaluated.cost < normal.cost;
        if is_better {
            progress(passes, evaluated.cost);
        }
        is_better.then_some((trial, evaluated))
    };
    let has_converged = |from: &(_, NormalEquations), to: &(_, NormalEquations), damping: f64| {
        let fall = (from.1.cost - to.1.cost) / from.1.cost;
        // Under strong damping, a small fall of the cost does not mean convergence.
        unchanged = if fall < CONVERGED && damping <= DAMPING_WEAK { unchanged + 1 } else { 0 };
        unchanged >= 2
    };
    let found = levenberg_marquardt::minimise(&DAMPING, MAX_PASSES - 1, (theta, normal), step, has_converged);
    let (theta, normal) = found.best;
    Solution { theta, cost: normal.cost, passes: found.steps + 1, converged: found.has_converged }
}

#[derive(Clone, Copy, PartialEq)]
enum BoundState {
    Free,
    Low,
    High,
}

/// Minimises g d + d'(H + damping diag H)d / 2 with low <= y + d <= high; `None` if the matrix cannot be factorised.
fn bounded_step(h: &DMatrix<f64>, g: &DVector<f64>, damping: f64, y: &[f64], space: &Space) -> Option<DVector<f64>> {
    let n = y.len();
    let mut damped = h.clone();
    for k in 0..n {
        damped[(k, k)] += damping * h[(k, k)] + f64::MIN_POSITIVE;
    }
    let mut held = vec![BoundState::Free; n];
    for k in 0..n {
        if y[k] <= space.low[k] && g[k] > 0.0 {
            held[k] = BoundState::Low;
        } else if y[k] >= space.high[k] && g[k] < 0.0 {
            held[k] = BoundState::High;
        }
    }
    let mut d = DVector::zeros(n);
    for _ in 0..MAX_EXCHANGES {
        solve_free(&damped, g, y, space, &held, &mut d)?;
        if !exchange(&damped, g, y, space, &mut held, &d) {
            break;
        }
    }
    for k in 0..n {
        d[k] = d[k].clamp(space.low[k] - y[k], space.high[k] - y[k]);
    }
    Some(d)
}

fn solve_free(
    damped: &DMatrix<f64>,
    g: &DVector<f64>,
    y: &[f64],
    space: &Space,
    held: &[BoundState],
    d: &mut DVector<f64>,
) -> Option<()> {
    let free: Vec<usize> = (0..y.len()).filter(|&k| held[k] == BoundState::Free).collect();
    for k in 0..y.len() {
        d[k] = match held[k] {
            BoundState::Free => 0.0,
            BoundState::Low => space.low[k] - y[k],
            BoundState::High => space.high[k] - y[k],
        };
    }
    let pushed = damped * &*d + g;
    // The matrix is scaled to a unit diagonal, because volts and logarithms differ by orders of magnitude.
    let scale: Vec<f64> = free.iter().map(|&k| 1.0 / damped[(k, k)].sqrt()).collect();
    let matrix = DMatrix::from_fn(free.len(), free.len(), |a, b| damped[(free[a], free[b])] * scale[a] * scale[b]);
    let right = DVector::from_fn(free.len(), |a, _| -pushed[free[a]] * scale[a]);
    let solved = matrix.cholesky()?.solve(&right);
    for (a, &k) in free.iter().enumerate() {
        d[k] = solved[a] * scale[a];
    }
    d.iter().all(|d| d.is_finite()).then_some(())
}

/// Holds free parameters that left their bounds, and frees held parameters that the gradient pushes inwards. Returns
/// whether anything changed.
fn exchange(
    damped: &DMatrix<f64>,
    g: &DVector<f64>,
    y: &[f64],
    space: &Space,
    held: &mut [BoundState],
    d: &DVector<f64>,
) -> bool {
    let gradient = damped * d + g;
    let mut changed = false;
    for k in 0..y.len() {
        let tolerance = 1e-12 * (1.0 + y[k].abs());
        let now = match held[k] {
            BoundState::Free if y[k] + d[k] < space.low[k] - tolerance => BoundState::Low,
            BoundState::Free if y[k] + d[k] > space.high[k] + tolerance => BoundState::High,
            BoundState::Low if gradient[k] < 0.0 => BoundState::Free,
            BoundState::High if gradient[k] > 0.0 => BoundState::Free,
            same => same,
        };
        changed |= now != held[k];
        held[k] = now;
    }
    changed
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fits a curve to four points, with its first value and its rises as parameters. Each rise is at least 0.5.
    #[test]
    fn rising_block_reaches_the_bounded_optimum() {
        let points = [0.0, 2.0, 1.9, 4.0];
        let evaluate = |theta: &[f64]| {
            let mut normal = NormalEquations::new(4);
            for (k, point) in points.iter().enumerate() {
                let residual = theta[k] - point;
                normal.cost += 0.5 * residual * residual;
                normal.add(&[k], &[1.0], residual, 1.0);
            }
            normal
        };
        let space = Space { low: vec![-10.0, 0.5, 0.5, 0.5], high: vec![10.0, 9.0, 9.0, 9.0], rising: vec![(0, 4)] };
        let solution = minimise(&space, &[0.0, 1.0, 2.0, 3.0], evaluate, |_, _| {});
        // The falling points 2 and 1.9 become 1.7 and 2.2: a rise of 0.5 around their mean of 1.95.
        for (found, expected) in solution.theta.iter().zip([0.0, 1.7, 2.2, 4.0]) {
            assert!((found - expected).abs() < 1e-6, "{:?}", solution.theta);
        }
        assert!(solution.converged);
    }
}
