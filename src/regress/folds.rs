//! Performs a k-fold cross-validation: every row is predicted by a model that was fitted without this row.
//!
//! The errors are in units of the target. The cross-validation fails if the number of folds is out of range or if a fit
//! fails.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::calibration::GAUSSIAN;
use super::error::RegressionError;
use super::jitter::Jitter;
use super::model::{Hyperparameter, Prediction, fit};
use super::scale::check;
use super::settings::{FitProgress, GprSettings, ProgressCallback, TrainingRows};

/// Result of one fold.
#[derive(Debug, Clone, PartialEq)]
pub struct Fold {
    /// Number of held-out rows.
    pub held_out: usize,
    /// Duration of the fit (s), measured with the caller's clock.
    pub fit_s: f64,
    /// Duration of the predictions (s).
    pub predict_s: f64,
    /// Fitted hyperparameters.
    pub hyperparameters: Vec<Hyperparameter>,
    /// Log marginal likelihood of the training rows.
    pub log_marginal_likelihood: f64,
    /// Factor of the 95 % interval (see [`Model::interval_factor`](super::Model::interval_factor)).
    pub interval_factor: f64,
    /// Jitter (a value added to the diagonal of the covariance matrices) that the fit needed.
    pub jitter: Jitter,
}

/// Result of a cross-validation.
#[derive(Debug, Clone, PartialEq)]
pub struct Folds {
    /// Prediction of every row, in the order of the rows. A row is predicted by the model that was fitted without it.
    pub predictions: Vec<Prediction>,
    /// Number of the fold that held out each row, from 0.
    pub fold_of_row: Vec<usize>,
    /// The result of each fold.
    pub folds: Vec<Fold>,
}

/// Errors of predictions, in units of the target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictionScore {
    /// Root of the mean squared error.
    pub rmse: f64,
    /// Mean absolute error.
    pub mean_absolute_error: f64,
    /// Fraction of the rows inside the 95 % interval.
    pub coverage_95: f64,
    /// Fraction of the rows whose residual is at most 1.96 standard deviations of a measurement. This is the coverage
    /// that the model has without a calibrated interval factor.
    pub gaussian_coverage_95: f64,
    /// Mean width of the 95 % interval, from lower to upper end.
    pub mean_width_95: f64,
}

/// Scores predictions against targets of the same length.
pub fn score(predictions: &[Prediction], targets: &[f64]) -> PredictionScore {
    let count = predictions.len() as f64;
    let mean = |of: &dyn Fn(&Prediction, f64) -> f64| {
        predictions.iter().zip(targets).map(|(p, y)| of(p, *y)).sum::<f64>() / count
    };
    PredictionScore {
        rmse: mean(&|p, y| (y - p.mean).powi(2)).sqrt(),
        mean_absolute_error: mean(&|p, y| (y - p.mean).abs()),
        coverage_95: mean(&|p, y| if (p.low_95..=p.high_95).contains(&y) { 1.0 } else { 0.0 }),
        gaussian_coverage_95: mean(&|p, y| {
            let inside = (y - p.mean).abs() <= GAUSSIAN * p.measurement_variance.sqrt();
            if inside { 1.0 } else { 0.0 }
        }),
        mean_width_95: mean(&|p, _| p.high_95 - p.low_95),
    }
}

/// Returns, for each row, the fold that holds it out. The rows are shuffled with the seed and divided into folds whose
/// sizes differ by at most one row.
pub fn assign(rows: usize, folds: usize, seed: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..rows).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    let mut fold_of_row = vec![0; rows];
    order.iter().enumerate().for_each(|(place, row)| fold_of_row[*row] = place * folds / rows);
    fold_of_row
}

/// Cross-validates. `clock` returns the time in seconds since an arbitrary origin, for the durations of the folds.
pub fn cross_validate(
    rows: &TrainingRows,
    settings: &GprSettings,
    folds: usize,
    clock: &dyn Fn() -> f64,
    watcher: &mut ProgressCallback,
) -> Result<Folds, RegressionError> {
    check(rows)?;
    let n = rows.targets.len();
    let most = (n / 2).min(1000);
    if !(2..=most).contains(&folds) {
        return Err(RegressionError::range("folds", folds, format!("2 to {most}")));
    }
    let fold_of_row = assign(n, folds, settings.seed);
    let mut predictions = vec![None; n];
    let mut done = Vec::with_capacity(folds);
    for fold in 0..folds {
        let mut watch = |mut progress: FitProgress| {
            (progress.fold, progress.folds) = (fold + 1, folds);
            watcher(progress)
        };
        done.push(one_fold(rows, settings, (fold, &fold_of_row), clock, &mut watch, &mut predictions)?);
    }
    Ok(Folds { predictions: predictions.into_iter().flatten().collect(), fold_of_row, folds: done })
}

fn one_fold(
    rows: &TrainingRows,
    settings: &GprSettings,
    (fold, fold_of_row): (usize, &[usize]),
    clock: &dyn Fn() -> f64,
    watcher: &mut ProgressCallback,
    predictions: &mut [Option<Prediction>],
) -> Result<Fold, RegressionError> {
    let (held, kept): (Vec<usize>, Vec<usize>) = (0..fold_of_row.len()).partition(|row| fold_of_row[*row] == fold);
    let inputs = |some: &[usize]| -> Vec<f64> {
        some.iter().flat_map(|row| rows.inputs[row * rows.dimensions..][..rows.dimensions].to_vec()).collect()
    };
    let targets: Vec<f64> = kept.iter().map(|row| rows.targets[*row]).collect();
    let start_s = clock();
    let training = TrainingRows { inputs: &inputs(&kept), dimensions: rows.dimensions, targets: &targets, lines: &[] };
    let model = fit(&training, settings, watcher)?;
    let fitted_s = clock();
    let found = model.predict(&inputs(&held))?;
    let end_s = clock();
    held.iter().zip(found).for_each(|(row, prediction)| predictions[*row] = Some(prediction));
    Ok(Fold {
        held_out: held.len(),
        fit_s: fitted_s - start_s,
        predict_s: end_s - fitted_s,
        hyperparameters: model.hyperparameters(),
        log_marginal_likelihood: model.log_marginal_likelihood(),
        interval_factor: model.interval_factor(),
        jitter: model.outcome.jitter,
    })
}
