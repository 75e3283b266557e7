//! Fits a Gaussian process to rows, predicts further rows, and returns the hyperparameters.
//!
//! Input: rows and settings. Output: a [`Model`] that predicts in units of the target. Invalid rows and settings give
//! an error.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rayon::ThreadPool;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::basis::Basis;
use super::calibration::{CALIBRATION_ROWS, Calibration};
use super::error::RegressionError;
use super::jitter::{self, Jitter};
use super::kernel::Kernel;
use super::minimise::Minimum;
use super::nearest::ConditionalFactors;
use super::plan::{Covariance, Plan};
use super::scale::{Scale, StandardisedRows, check};
use super::search::{SearchMonitor, descend, first_start, log_bounds, random_start};
use super::settings::{FitProgress, Form, GprSettings, ProgressCallback, TrainingRows};
use super::{exact, nearest};

/// Maximum number of rows that the search for hyperparameters uses with [`Form::Nearest`]. More rows do not change
/// predictions noticeably.
const SEARCH_ROWS: usize = 6000;
const MAX_THREADS: usize = 1024;
const MAX_RESTARTS: usize = 1000;

/// A hyperparameter. Length scales have the unit of the inputs, or no unit if the inputs are standardised. Standard
/// deviations have the unit of the target.
#[derive(Debug, Clone, PartialEq)]
pub struct Hyperparameter {
    /// Name, for example `matern32_1.length_scale_2` for the first shape of the kernel and the second input.
    pub name: String,
    /// Value of the hyperparameter.
    pub value: f64,
}

/// Prediction at one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// Mean of the function and, because noise has mean zero, of a measurement.
    pub mean: f64,
    /// Variance of the function's value. More training rows reduce it.
    pub function_variance: f64,
    /// Variance of a new measurement: variance of the function plus variance of the noise.
    pub measurement_variance: f64,
    /// Lower end of the interval that contains 95 % of new measurements (see [`Model::interval_factor`]). Its half
    /// width differs from 1.96 standard deviations if residuals are not Gaussian or if their width varies.
    pub low_95: f64,
    /// Upper end of the interval that contains 95 % of new measurements.
    pub high_95: f64,
}

/// A fitted Gaussian process.
#[derive(Debug)]
pub struct Model {
    /// Structure of the model.
    pub spec: ModelSpec,
    pub(super) scale: Scale,
    /// Natural logarithms of the hyperparameters, in standardised units.
    pub(super) theta: Vec<f64>,
    pub(super) posterior: Posterior,
    /// Result of the fit.
    pub outcome: FitOutcome,
    pub(super) calibration: Calibration,
    pub(super) pool: ThreadPool,
}

/// Structure of a model, without fitted values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSpec {
    /// Covariance function.
    pub kernel: Kernel,
    /// Mean function.
    pub basis: Basis,
    /// Whether every input has its own length scale.
    pub ard: bool,
    /// Form of the covariance: exact, or approximated with nearest neighbours.
    pub form: Form,
    /// Number of inputs of a row.
    pub dimensions: usize,
}

/// Result of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitOutcome {
    /// Log marginal likelihood of the standardised targets.
    pub log_likelihood: f64,
    /// Jitter (value added to the diagonal of the covariance) that the final model needed.
    pub jitter: Jitter,
    /// Number of steps of the best search. If the search selected neighbours several times, the steps of all rounds are
    /// added up.
    pub iterations: usize,
}

#[derive(Debug, Clone)]
pub(super) enum Posterior {
    Exact(Box<exact::Posterior>),
    Nearest(Box<nearest::Posterior>),
}

impl Posterior {
    pub(super) fn data(&self) -> &StandardisedRows {
        match self {
            Self::Exact(posterior) => &posterior.data,
            Self::Nearest(posterior) => &posterior.data,
        }
    }

    fn predict(&self, queries: &[f64]) -> Result<Vec<(f64, f64)>, RegressionError> {
        match self {
            Self::Exact(posterior) => Ok(posterior.predict(queries)),
            Self::Nearest(posterior) => posterior.predict(queries, None),
        }
    }

    /// Predicts each given row from all other rows. Returns the residual and the measurement variance of each row.
    fn left_out(&self, rows: &[u32], noise_variance: f64) -> Result<Vec<(f64, f64)>, RegressionError> {
        match self {
            Self::Exact(posterior) => Ok(posterior.left_out(rows)),
            Self::Nearest(posterior) => {
                let data = &posterior.data;
                let queries: Vec<f64> = rows.iter().flat_map(|row| data.row(*row as usize).to_vec()).collect();
                let found = posterior.predict(&queries, Some(rows))?;
                let with_row = found.into_iter().zip(rows);
                Ok(with_row.map(|((m, v), row)| (data.targets[*row as usize] - m, v + noise_variance)).collect())
            }
        }
    }
}

/// Fits a Gaussian process to rows. Calls `watcher` before the first step and after every step of a search. `watcher`
/// can cancel the fit.
pub fn fit(
    rows: &TrainingRows,
    settings: &GprSettings,
    watcher: &mut ProgressCallback,
) -> Result<Model, RegressionError> {
    check(rows)?;
    let job = FitJob::new(rows, settings)?;
    let (theta, iterations) = if settings.max_iterations == 0 { (job.first_start()?, 0) } else { job.search(watcher)? };
    job.finish(theta, iterations)
}

struct FitJob<'a> {
    settings: &'a GprSettings,
    scale: Scale,
    data: StandardisedRows,
    plan: Plan,
    pool: ThreadPool,
    /// Geometric mean of the inputs' standard deviations; 1 if the inputs are standardised.
    spread: f64,
}

impl<'a> FitJob<'a> {
    fn new(rows: &TrainingRows, settings: &'a GprSettings) -> Result<Self, RegressionError> {
        let n = rows.targets.len();
        check_settings(settings, n)?;
        let scale = Scale::of(rows, settings.standardise, settings.basis);
        let natural = Scale::of(rows, true, settings.basis);
        if let Some(what) = natural.too_wide() {
            return Err(RegressionError::range(&what, "values whose mean or variance overflows", "smaller"));
        }
        let logs: f64 = natural.deviations.iter().zip(&scale.deviations).map(|(d, unit)| (d / unit).ln()).sum();
        let d = rows.dimensions;
        let mut data = StandardisedRows {
            dimensions: d,
            inputs: scale.inputs(rows.inputs),
            targets: scale.targets(rows.targets),
            basis: settings.basis,
        };
        if matches!(settings.form, Form::Nearest { .. }) {
            let mut order: Vec<usize> = (0..n).collect();
            order.shuffle(&mut ChaCha8Rng::seed_from_u64(settings.seed));
            data.inputs = order.iter().flat_map(|row| data.inputs[row * d..][..d].to_vec()).collect();
            data.targets = order.iter().map(|row| data.targets[*row]).collect();
        }
        let plan = Plan::new(&settings.kernel, d, settings.ard);
        Ok(Self { settings, scale, data, plan, pool: threads(settings.threads)?, spread: (logs / d as f64).exp() })
    }

    fn first_start(&self) -> Result<Vec<f64>, RegressionError> {
        let given = &self.settings.start;
        if given.is_empty() {
            return Ok(first_start(&self.plan, self.spread));
        }
        let count = self.plan.parameters.len();
        if given.len() != count || given.iter().any(|value| !(value.is_finite() && *value > 0.0)) {
            return Err(RegressionError::range("start", format!("{given:?}"), format!("{count} positive numbers")));
        }
        Ok(given.iter().zip(&self.plan.parameters).map(|(value, p)| (value / p.role.unit(&self.scale)).ln()).collect())
    }

    fn search(&self, watcher: &mut ProgressCallback) -> Result<(Vec<f64>, usize), RegressionError> {
        let searches = self.settings.restarts + 1;
        let mut best: Option<Minimum> = None;
        for k in 0..searches {
            let start = match k {
                0 => self.first_start()?,
                _ => random_start(&self.plan, self.spread, self.settings.seed, k),
            };
            let progress = FitProgress {
                fold: 1,
                folds: 1,
                search: k + 1,
                searches,
                iteration: 0,
                max_iterations: self.settings.max_iterations,
                log_likelihood_per_row: f64::NEG_INFINITY,
            };
            let is_sampled = matches!(self.settings.form, Form::Nearest { .. });
            let rows = self.data.len().min(if is_sampled { SEARCH_ROWS } else { usize::MAX });
            let found = self.one_search(start, &mut SearchMonitor { watcher, progress, rows })?;
            best = match (best, found) {
                (Some(old), Some(new)) if new.value < old.value => Some(new),
                (None, new) => new,
                (old, _) => old,
            };
        }
        best.map(|best| (best.x, best.iterations)).ok_or(RegressionError::NotPositiveDefinite { jitter: jitter::LAST })
    }

    /// Runs one search. For [`Form::Nearest`], neighbours are selected again and the search is repeated until the new
    /// length scales order the distances like the previous ones.
    fn one_search(&self, mut start: Vec<f64>, monitor: &mut SearchMonitor) -> Result<Option<Minimum>, RegressionError> {
        let (low, high) = log_bounds(&self.plan, self.spread);
        let mut found: Option<Minimum> = None;
        // Neighbours are selected at most 4 times.
        for _ in 0..4 {
            let metric = self.metric(&start);
            let Some(mut minimum) = self.one_round(&start, &metric, (&low, &high), monitor)? else { break };
            minimum.iterations += found.map_or(0, |before| before.iterations);
            start.clone_from(&minimum.x);
            found = Some(minimum);
            if matches!(self.settings.form, Form::Exact) || is_same_metric(&metric, &self.metric(&start)) {
                break;
            }
        }
        Ok(found)
    }

    fn metric(&self, theta: &[f64]) -> Vec<f64> {
        Covariance::new(self.plan.clone(), theta).metric()
    }

    fn one_round(
        &self,
        start: &[f64],
        metric: &[f64],
        bounds: (&[f64], &[f64]),
        monitor: &mut SearchMonitor,
    ) -> Result<Option<Minimum>, RegressionError> {
        let steps = self.settings.max_iterations;
        match self.settings.form {
            Form::Exact => descend(start, bounds, steps, monitor, |theta| {
                self.pool.install(|| {
                    let posterior = exact::Posterior::new(self.data.clone(), self.plan.clone(), theta)?;
                    Ok((posterior.value, posterior.gradient()))
                })
            }),
            Form::Nearest { neighbours } => {
                let rows = evenly_spaced(self.data.len(), SEARCH_ROWS);
                let factors = self.pool.install(|| ConditionalFactors::new(&self.data, rows, metric, neighbours));
                descend(start, bounds, steps, monitor, |theta| {
                    let sums = self.pool.install(|| factors.sums(&self.data, &self.plan, theta, true))?;
                    Ok((sums.value, sums.gradient))
                })
            }
        }
    }

    fn finish(self, theta: Vec<f64>, iterations: usize) -> Result<Model, RegressionError> {
        let metric = self.metric(&theta);
        let noise_variance = (2.0 * theta[theta.len() - 1]).exp();
        let (data, plan) = (self.data, self.plan);
        let (posterior, value, jitter) = self.pool.install(|| match self.settings.form {
            Form::Exact => {
                let posterior = exact::Posterior::new(data, plan, &theta)?;
                let (value, jitter) = (posterior.value, posterior.jitter);
                Ok((Posterior::Exact(Box::new(posterior)), value, jitter))
            }
            Form::Nearest { neighbours } => {
                let factors =
                    ConditionalFactors::new(&data, evenly_spaced(data.len(), usize::MAX), &metric, neighbours);
                let sums = factors.sums(&data, &plan, &theta, false)?;
                let posterior = nearest::Posterior::new(data, plan, &theta, sums.coefficients, neighbours);
                Ok::<_, RegressionError>((Posterior::Nearest(Box::new(posterior)), sums.value, sums.jitter))
            }
        })?;
        let outcome = FitOutcome { log_likelihood: -value, jitter, iterations };
        let mut calibration = Calibration::none();
        if self.settings.calibrate {
            let rows = evenly_spaced(posterior.data().len(), CALIBRATION_ROWS);
            let left_out = self.pool.install(|| posterior.left_out(&rows, noise_variance))?;
            let ratios = left_out.into_iter().map(|(residual, variance)| residual.abs() / variance.sqrt()).collect();
            calibration = Calibration::new(posterior.data(), rows, ratios);
        }
        let settings = self.settings;
        let spec = ModelSpec {
            kernel: settings.kernel.clone(),
            basis: settings.basis,
            ard: settings.ard,
            form: settings.form,
            dimensions: self.scale.means.len(),
        };
        Ok(Model { spec, scale: self.scale, theta, posterior, outcome, calibration, pool: self.pool })
    }
}

/// Returns at most `most` row numbers, evenly spaced in `0..n`. For [`Form::Nearest`], the rows are in random order, so
/// the result is a random sample.
fn evenly_spaced(n: usize, most: usize) -> Vec<u32> {
    let count = n.min(most);
    (0..count).map(|k| u32::try_from(k * n / count).unwrap_or(u32::MAX)).collect()
}

/// Whether the weights of two metrics are nearly proportional, so that both order rows in the same way.
fn is_same_metric(a: &[f64], b: &[f64]) -> bool {
    let ratios = || a.iter().zip(b).map(|(a, b)| (a / b).ln());
    let (low, high) = ratios().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), r| (l.min(r), h.max(r)));
    high - low < 1.3_f64.ln()
}

pub(super) fn threads(count: usize) -> Result<ThreadPool, RegressionError> {
    if count == 0 || count > MAX_THREADS {
        return Err(RegressionError::range("threads", count, format!("1 to {MAX_THREADS}")));
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .build()
        .map_err(|error| RegressionError::Threads(error.to_string()))
}

fn check_settings(settings: &GprSettings, rows: usize) -> Result<(), RegressionError> {
    if settings.restarts > MAX_RESTARTS {
        return Err(RegressionError::range("restarts", settings.restarts, format!("at most {MAX_RESTARTS}")));
    }
    settings.form.check(rows)
}

impl Model {
    /// Predicts rows of inputs in row-major order.
    pub fn predict(&self, inputs: &[f64]) -> Result<Vec<Prediction>, RegressionError> {
        let d = self.spec.dimensions;
        if !inputs.len().is_multiple_of(d) {
            return Err(RegressionError::range("number of inputs", inputs.len(), format!("a multiple of {d}")));
        }
        if let Some(at) = inputs.iter().position(|x| !x.is_finite()) {
            let what = format!("input {}", at % d + 1);
            return Err(RegressionError::NotFinite { line: (at / d) as u64 + 1, what, found: inputs[at] });
        }
        let queries = self.scale.inputs(inputs);
        self.pool.install(|| {
            let found = self.posterior.predict(&queries)?;
            // The square of a very distant input may overflow.
            if let Some(row) = found.iter().position(|(mean, variance)| !mean.is_finite() || !variance.is_finite()) {
                let far = format!("{:?}", &inputs[row * d..(row + 1) * d]);
                return Err(RegressionError::range(
                    &format!("inputs of row {}", row + 1),
                    far,
                    "nearer to the model's rows",
                ));
            }
            let rows = queries.par_chunks_exact(d).with_min_len(64);
            Ok(found
                .into_par_iter()
                .zip(rows)
                .map(|((mean, variance), row)| self.prediction(row, mean, variance))
                .collect())
        })
    }

    fn prediction(&self, row: &[f64], mean: f64, variance: f64) -> Prediction {
        let unit = self.scale.target_deviation;
        let mean = self.scale.target_mean + unit * mean;
        let noise = (2.0 * self.theta[self.theta.len() - 1]).exp();
        let measurement_variance = (variance + noise) * unit * unit;
        let half = self.calibration.half_width(row) * measurement_variance.sqrt();
        Prediction {
            mean,
            function_variance: variance * unit * unit,
            measurement_variance,
            low_95: mean - half,
            high_95: mean + half,
        }
    }

    /// Returns the fitted hyperparameters in the order of [`GprSettings::start`]. The standard deviation of the noise
    /// is last.
    pub fn hyperparameters(&self) -> Vec<Hyperparameter> {
        let plan = Plan::new(&self.spec.kernel, self.spec.dimensions, self.spec.ard);
        let named = plan.parameters.into_iter().zip(&self.theta);
        named.map(|(p, value)| Hyperparameter { name: p.name, value: value.exp() * p.role.unit(&self.scale) }).collect()
    }

    /// Returns the log density of the training targets, in their units. For [`Form::Nearest`], it is the density of the
    /// approximation.
    pub fn log_marginal_likelihood(&self) -> f64 {
        self.outcome.log_likelihood - self.rows() as f64 * self.scale.target_deviation.ln()
    }

    /// Returns the half width of the 95 % interval divided by the standard deviation of a measurement: 1.96 for
    /// Gaussian residuals. With [`GprSettings::calibrate`], the factor comes from leave-one-out predictions of training
    /// rows. It is the average: the interval is wider where the residuals of nearby training rows are large, and
    /// narrower where they are small.
    pub fn interval_factor(&self) -> f64 {
        self.calibration.factor
    }

    /// Returns the number of training rows.
    pub fn rows(&self) -> usize {
        self.posterior.data().len()
    }
}
