//! Converts a kernel to a plan, which can be evaluated fast. The plan computes the kernel's values over a block of row
//! pairs. It also computes the exact derivatives of a weighted sum of these values with respect to every parameter
//! (reverse-mode differentiation).
//!
//! A block of `count` pairs is given as *squares*: for each input in turn, `count` squared differences. The parameters
//! are natural logarithms of length scales, of `alpha`, and of standard deviations, in one vector. The standard
//! deviation of the noise is always the last parameter. Inputs are not checked; NaN gives NaN.

use faer::traits::pulp::Arch;

use super::kernel::{Kernel, Node, Shape};
use super::scale::Scale;
use super::vector_math;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ParameterRole {
    Length,
    Alpha,
    Signal,
    Noise,
}

impl ParameterRole {
    /// Returns the factor from standardised units to the caller's units.
    pub(super) fn unit(self, scale: &Scale) -> f64 {
        if matches!(self, Self::Signal | Self::Noise) { scale.target_deviation } else { 1.0 }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Parameter {
    pub role: ParameterRole,
    pub name: String,
}

#[derive(Debug, Clone)]
struct Leaf {
    shape: Shape,
    /// Index of the first length scale. There is either one length scale for all inputs, or one per input.
    lengths: usize,
    alpha: Option<usize>,
    signal: Option<usize>,
}

#[derive(Debug, Clone)]
enum PlanStep {
    Leaf(usize),
    Sum(Vec<usize>),
    Product(Vec<usize>),
}

/// The kernel's tree in evaluation order, and its parameters.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    pub dimensions: usize,
    ard: bool,
    leaves: Vec<Leaf>,
    steps: Vec<PlanStep>,
    pub parameters: Vec<Parameter>,
}

/// A plan with parameter values: the covariance of the function at two rows.
#[derive(Debug, Clone)]
pub(super) struct Covariance {
    pub plan: Plan,
    /// Parameters of each shape in the form that the loops use.
    leaves: Vec<LeafValues>,
    /// Variance of the function at a point.
    pub prior_variance: f64,
    /// Variance of the measurement noise.
    pub noise_variance: f64,
}

#[derive(Debug, Clone)]
struct LeafValues {
    /// 1 / length^2 for every input.
    inverse_squares: Vec<f64>,
    alpha: f64,
    variance: f64,
}

/// Working memory of an evaluation, reused between blocks.
#[derive(Debug, Default)]
pub(super) struct Work {
    values: Vec<Vec<f64>>,
    adjoints: Vec<Vec<f64>>,
    /// For each shape, the derivatives of the values with respect to the squared distance. `alphas` holds the
    /// derivatives with respect to ln alpha.
    slopes: Vec<Vec<f64>>,
    alphas: Vec<Vec<f64>>,
}

impl Plan {
    pub(super) fn new(kernel: &Kernel, dimensions: usize, ard: bool) -> Self {
        let mut plan = Self { dimensions, ard, leaves: vec![], steps: vec![], parameters: vec![] };
        plan.add(&kernel.root, true);
        plan.parameters.push(Parameter { role: ParameterRole::Noise, name: "noise_sd".to_owned() });
        plan
    }

    /// Adds the node after its children and returns its index. `scaled`: the node has its own standard deviation.
    fn add(&mut self, node: &Node, scaled: bool) -> usize {
        let step = match node {
            Node::Leaf(shape) => PlanStep::Leaf(self.add_leaf(*shape, scaled)),
            Node::Sum(children) => {
                PlanStep::Sum(children.iter().enumerate().map(|(k, child)| self.add(child, scaled || k > 0)).collect())
            }
            Node::Product(children) => PlanStep::Product(
                children.iter().enumerate().map(|(k, child)| self.add(child, scaled && k == 0)).collect(),
            ),
        };
        self.steps.push(step);
        self.steps.len() - 1
    }

    fn add_leaf(&mut self, shape: Shape, scaled: bool) -> usize {
        let label = format!("{}_{}", shape.name(), self.leaves.len() + 1);
        let lengths = self.parameters.len();
        for d in 0..if self.ard { self.dimensions } else { 1 } {
            let name =
                if self.ard { format!("{label}.length_scale_{}", d + 1) } else { format!("{label}.length_scale") };
            self.parameters.push(Parameter { role: ParameterRole::Length, name });
        }
        let mut optional = |wanted: bool, role, name: &str| {
            wanted.then(|| {
                self.parameters.push(Parameter { role, name: format!("{label}.{name}") });
                self.parameters.len() - 1
            })
        };
        let alpha = optional(shape == Shape::RationalQuadratic, ParameterRole::Alpha, "alpha");
        let signal = optional(scaled, ParameterRole::Signal, "signal_sd");
        self.leaves.push(Leaf { shape, lengths, alpha, signal });
        self.leaves.len() - 1
    }

    fn leaf_values(&self, leaf: &Leaf, theta: &[f64]) -> LeafValues {
        let length = |d: usize| theta[leaf.lengths + if self.ard { d } else { 0 }];
        LeafValues {
            inverse_squares: (0..self.dimensions).map(|d| (-2.0 * length(d)).exp()).collect(),
            alpha: leaf.alpha.map_or(1.0, |at| theta[at].exp()),
            variance: leaf.signal.map_or(1.0, |at| (2.0 * theta[at]).exp()),
        }
    }
}

impl Covariance {
    pub(super) fn new(plan: Plan, theta: &[f64]) -> Self {
        let leaves = plan.leaves.iter().map(|leaf| plan.leaf_values(leaf, theta)).collect();
        let noise_variance = (2.0 * theta[plan.parameters.len() - 1]).exp();
        let mut covariance = Self { plan, leaves, prior_variance: 0.0, noise_variance };
        let zero = vec![0.0; covariance.plan.dimensions];
        covariance.prior_variance = covariance.evaluate(&zero, 1, &mut Work::default())[0];
        covariance
    }

    /// Returns the weights of the inputs for the distance between rows: the inverse of each input's shortest length
    /// scale.
    pub(super) fn metric(&self) -> Vec<f64> {
        let of = |d: usize| self.leaves.iter().map(|leaf| leaf.inverse_squares[d].sqrt()).fold(0.0, f64::max);
        (0..self.plan.dimensions).map(of).collect()
    }

    pub(super) fn evaluate<'w>(&self, squares: &[f64], count: usize, work: &'w mut Work) -> &'w [f64] {
        self.forward(squares, count, work, false);
        &work.values[self.plan.steps.len() - 1][..count]
    }

    /// Adds the derivatives of the weighted sum of a block's kernel values to `gradient`, for every parameter except
    /// the noise.
    pub(super) fn add_gradient(&self, squares: &[f64], weights: &[f64], work: &mut Work, gradient: &mut [f64]) {
        let count = weights.len();
        self.forward(squares, count, work, true);
        work.adjoints.resize_with(self.plan.steps.len(), Vec::new);
        let root = &mut work.adjoints[self.plan.steps.len() - 1];
        root.clear();
        root.extend_from_slice(weights);
        for at in (0..self.plan.steps.len()).rev() {
            match &self.plan.steps[at] {
                PlanStep::Leaf(leaf) => self.leaf_gradient(at, *leaf, squares, work, gradient),
                PlanStep::Sum(children) => {
                    let (below, here) = work.adjoints.split_at_mut(at);
                    for child in children {
                        below[*child].clone_from(&here[0]);
                    }
                }
                PlanStep::Product(children) => product_adjoints(at, children, work),
            }
        }
    }

    fn leaf_gradient(&self, at: usize, leaf: usize, squares: &[f64], work: &Work, gradient: &mut [f64]) {
        let (adjoints, numbers, leaf_values) = (&work.adjoints[at], &work.values[at], &self.leaves[leaf]);
        let (count, slopes, leaf) = (adjoints.len(), &work.slopes[leaf], (&self.plan.leaves[leaf], &work.alphas[leaf]));
        let dot = |a: &[f64], b: &[f64]| Arch::new().dispatch(|| dot_product(a, b));
        if let Some(signal) = leaf.0.signal {
            gradient[signal] += 2.0 * dot(adjoints, &numbers[..count]);
        }
        if let Some(alpha) = leaf.0.alpha {
            gradient[alpha] += dot(adjoints, &leaf.1[..count]);
        }
        let weighted: Vec<f64> = adjoints.iter().zip(slopes).map(|(a, s)| a * s).collect();
        for d in 0..self.plan.dimensions {
            let target = leaf.0.lengths + if self.plan.ard { d } else { 0 };
            let sum = dot(&weighted, &squares[d * count..][..count]);
            gradient[target] -= 2.0 * leaf_values.inverse_squares[d] * sum;
        }
    }

    fn forward(&self, squares: &[f64], count: usize, work: &mut Work, slopes: bool) {
        work.values.resize_with(self.plan.steps.len(), Vec::new);
        work.slopes.resize_with(self.leaves.len(), Vec::new);
        work.alphas.resize_with(self.leaves.len(), Vec::new);
        for at in 0..self.plan.steps.len() {
            let (below, here) = work.values.split_at_mut(at);
            let out = &mut here[0];
            out.resize(count, 0.0);
            match &self.plan.steps[at] {
                PlanStep::Leaf(leaf) => {
                    distances(&self.leaves[*leaf].inverse_squares, squares, out);
                    let (slope, alpha) = (&mut work.slopes[*leaf], &mut work.alphas[*leaf]);
                    slope.resize(if slopes { count } else { 0 }, 0.0);
                    alpha.resize(slope.len(), 0.0);
                    shape_values(self.plan.leaves[*leaf].shape, &self.leaves[*leaf], out, slope, alpha);
                }
                PlanStep::Sum(children) => combine(below, children, out, |total, value| total + value),
                PlanStep::Product(children) => combine(below, children, out, |total, value| total * value),
            }
        }
    }
}

#[inline(always)]
fn dot_product(a: &[f64], b: &[f64]) -> f64 {
    // Eight partial sums let the compiler vectorise the loop.
    let mut sums = [0.0; 8];
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_chunks.zip(b_chunks) {
        for k in 0..8 {
            sums[k] += x[k] * y[k];
        }
    }
    sums.iter().sum::<f64>() + rest
}

fn combine(below: &[Vec<f64>], children: &[usize], out: &mut [f64], join: impl Fn(f64, f64) -> f64) {
    out.copy_from_slice(&below[children[0]][..out.len()]);
    for child in &children[1..] {
        for (total, value) in out.iter_mut().zip(&below[*child]) {
            *total = join(*total, *value);
        }
    }
}

/// Sets the adjoint of each factor: the adjoint of the product times the values of all other factors.
fn product_adjoints(at: usize, children: &[usize], work: &mut Work) {
    let (below, here) = work.adjoints.split_at_mut(at);
    for child in children {
        below[*child].clone_from(&here[0]);
        for other in children.iter().filter(|other| *other != child) {
            for (adjoint, value) in below[*child].iter_mut().zip(&work.values[*other]) {
                *adjoint *= value;
            }
        }
    }
}

/// Computes squared distances, after each difference is divided by the length scale of its input.
fn distances(inverse_squares: &[f64], squares: &[f64], out: &mut [f64]) {
    let count = out.len();
    out.fill(0.0);
    Arch::new().dispatch(|| {
        for (d, weight) in inverse_squares.iter().enumerate() {
            let stripe = &squares[d * count..][..count];
            for (total, square) in out.iter_mut().zip(stripe) {
                *total += weight * square;
            }
        }
    });
}

/// Replaces squared distances by kernel values. Fills `slopes` and `alphas`, unless they are empty.
fn shape_values(shape: Shape, values: &LeafValues, out: &mut [f64], slopes: &mut [f64], alphas: &mut [f64]) {
    /// Avoids a division by zero at distance 0. The slope is later multiplied by the squared differences, which are 0
    /// there, so its value has no effect.
    const TINY: f64 = 1e-150;
    let (s, a) = (values.variance, values.alpha);
    match shape {
        Shape::Exponential => fill(out, slopes, |r2| {
            let r = r2.sqrt();
            let k = s * vector_math::exp(-r);
            (k, -0.5 * k / r.max(TINY))
        }),
        Shape::Matern32 => fill(out, slopes, |r2| {
            let u = (3.0 * r2).sqrt();
            let e = s * vector_math::exp(-u);
            ((1.0 + u) * e, -1.5 * e)
        }),
        Shape::Matern52 => fill(out, slopes, |r2| {
            let u = (5.0 * r2).sqrt();
            let e = s * vector_math::exp(-u);
            ((1.0 + u + u * u / 3.0) * e, -5.0 / 6.0 * (1.0 + u) * e)
        }),
        Shape::SquaredExponential => fill(out, slopes, |r2| {
            let k = s * vector_math::exp(-0.5 * r2);
            (k, -0.5 * k)
        }),
        Shape::RationalQuadratic => {
            let power = |r2: f64| {
                let base = 1.0 + 0.5 / a * r2;
                let log = vector_math::ln(base);
                (s * vector_math::exp(-a * log), base, log)
            };
            if !alphas.is_empty() {
                Arch::new().dispatch(|| {
                    for (r2, alpha) in out.iter().zip(alphas) {
                        let (k, base, log) = power(*r2);
                        *alpha = a * k * ((base - 1.0) / base - log);
                    }
                });
            }
            fill(out, slopes, |r2| {
                let (k, base, _) = power(r2);
                (k, -0.5 * k / base)
            });
        }
    }
}

fn fill(out: &mut [f64], slopes: &mut [f64], of: impl Fn(f64) -> (f64, f64)) {
    Arch::new().dispatch(
        #[inline(always)]
        || {
            if slopes.is_empty() {
                for number in out.iter_mut() {
                    *number = of(*number).0;
                }
            } else {
                for (number, slope) in out.iter_mut().zip(slopes) {
                    (*number, *slope) = of(*number);
                }
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_match_closed_forms() {
        for (name, expected) in [
            ("exponential", (-1.5_f64).exp()),
            ("matern32", (1.0 + 1.5 * 3.0_f64.sqrt()) * (-1.5 * 3.0_f64.sqrt()).exp()),
            ("matern52", (1.0 + 1.5 * 5.0_f64.sqrt() + 3.75) * (-1.5 * 5.0_f64.sqrt()).exp()),
            ("squared_exponential", (-1.125_f64).exp()),
            ("rational_quadratic", (1.0 + 2.25 / 1.4_f64).powf(-0.7)),
        ] {
            let plan = Plan::new(&name.parse().expect(name), 1, false);
            let theta: Vec<f64> = (plan.parameters.iter())
                .map(|p| match p.role {
                    ParameterRole::Length => 2.0_f64.ln(),
                    ParameterRole::Alpha => 0.7_f64.ln(),
                    ParameterRole::Signal => 3.0_f64.ln(),
                    ParameterRole::Noise => 0.1_f64.ln(),
                })
                .collect();
            let covariance = Covariance::new(plan.clone(), &theta);
            let found = covariance.evaluate(&[9.0], 1, &mut Work::default())[0];
            assert!((found - 9.0 * expected).abs() < 1e-14, "{name}: {found}, expected {}", 9.0 * expected);
            assert!(
                (covariance.prior_variance - 9.0).abs() < 1e-14 && (covariance.noise_variance - 0.01).abs() < 1e-16
            );
        }
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let squares = [0.3, 0.0, 1.7, 4.0, 0.01, 0.9, 0.0, 0.2, 2.5, 0.4];
        let weights = [1.0, -0.7, 0.3, 2.0, 0.5];
        for text in [
            "exponential",
            "matern32",
            "matern52",
            "squared_exponential",
            "rational_quadratic",
            "matern32 + squared_exponential * rational_quadratic",
            "(exponential + matern52) * (matern32 + rational_quadratic) * squared_exponential",
        ] {
            for ard in [false, true] {
                let plan = Plan::new(&text.parse().expect(text), 2, ard);
                let theta: Vec<f64> = (0..plan.parameters.len()).map(|k| 0.3 * (k as f64 * 1.7).sin()).collect();
                let sum = |theta: &[f64]| {
                    let mut work = Work::default();
                    let covariance = Covariance::new(plan.clone(), theta);
                    dot_product(covariance.evaluate(&squares, 5, &mut work), &weights)
                };
                let mut gradient = vec![0.0; theta.len()];
                Covariance::new(plan.clone(), &theta).add_gradient(
                    &squares,
                    &weights,
                    &mut Work::default(),
                    &mut gradient,
                );
                for k in 0..theta.len() {
                    let (mut low, mut high) = (theta.clone(), theta.clone());
                    (low[k], high[k]) = (theta[k] - 1e-5, theta[k] + 1e-5);
                    let slope = (sum(&high) - sum(&low)) / 2e-5;
                    assert!((slope - gradient[k]).abs() < 1e-8, "{text}, ard {ard}, {:?}", plan.parameters[k]);
                }
            }
        }
    }

    #[test]
    fn only_identifiable_parameters_exist() {
        let names = |text: &str| -> Vec<String> {
            let plan = Plan::new(&text.parse().expect(text), 1, false);
            plan.parameters.into_iter().filter(|p| p.role == ParameterRole::Signal).map(|p| p.name).collect()
        };
        assert_eq!(names("exponential * matern32"), ["exponential_1.signal_sd"]);
        assert_eq!(
            names("(exponential + matern32) * (matern52 + exponential)"),
            ["exponential_1.signal_sd", "matern32_2.signal_sd", "exponential_4.signal_sd"]
        );
    }
}
