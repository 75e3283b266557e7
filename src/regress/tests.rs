//! Compares the exact form of the regression with its nearest-neighbour form, compares gradients with finite
//! differences, and tests whole fits.

use std::ops::ControlFlow;

use super::nearest::ConditionalFactors;
use super::plan::Plan;
use super::scale::StandardisedRows;
use super::*;

/// Returns a generator of random numbers between -1 and 1.
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// Returns the inputs and the targets of `rows` rows. A target is 3, plus a sine of the first input, plus half the
/// product of both inputs, plus noise.
fn wavy_plane(rows: usize, seed: u64) -> (Vec<f64>, Vec<f64>) {
    let mut draw = noise(seed);
    let inputs: Vec<f64> = (0..2 * rows).map(|_| 2.0 * draw()).collect();
    let value = |row: &[f64]| (2.0 * row[0]).sin() + 0.5 * row[0] * row[1];
    let targets = inputs.chunks(2).map(|row| 3.0 + value(row) + 0.1 * (draw() + draw() + draw())).collect();
    (inputs, targets)
}

fn data(rows: usize, basis: Basis) -> StandardisedRows {
    let (inputs, targets) = wavy_plane(rows, 5);
    StandardisedRows { dimensions: 2, inputs, targets, basis }
}

const KERNELS: [&str; 3] =
    ["exponential", "rational_quadratic", "(matern32 + squared_exponential) * matern52 + exponential"];

fn theta(plan: &Plan) -> Vec<f64> {
    (0..plan.parameters.len()).map(|k| -0.3 + 0.4 * (k as f64 * 2.3).sin()).collect()
}

fn check_gradient(plan: &Plan, name: &str, of: impl Fn(&[f64]) -> (f64, Vec<f64>)) {
    let at = theta(plan);
    let (_, gradient) = of(&at);
    for k in 0..at.len() {
        let (mut low, mut high) = (at.clone(), at.clone());
        (low[k], high[k]) = (at[k] - 1e-5, at[k] + 1e-5);
        let slope = (of(&high).0 - of(&low).0) / 2e-5;
        let allowed = 2e-6 * (1.0 + slope.abs());
        assert!((slope - gradient[k]).abs() < allowed, "{name}, {:?}: {slope}, {}", plan.parameters[k], gradient[k]);
    }
}

#[test]
fn gradients_agree_with_finite_differences_in_both_forms() {
    for (kernel, basis, ard) in
        [(KERNELS[0], Basis::Constant, true), (KERNELS[1], Basis::Zero, false), (KERNELS[2], Basis::Linear, true)]
    {
        let data = data(60, basis);
        let plan = Plan::new(&kernel.parse().expect(kernel), 2, ard);
        check_gradient(&plan, "exact", |theta| {
            let posterior = exact::Posterior::new(data.clone(), plan.clone(), theta).expect("positive definite");
            (posterior.value, posterior.gradient())
        });
        let factors = ConditionalFactors::new(&data, (0..60).step_by(3).collect(), &[1.0, 1.0], 7);
        check_gradient(&plan, "nearest", |theta| {
            let sums = factors.sums(&data, &plan, theta, true).expect("positive definite");
            (sums.value, sums.gradient)
        });
    }
}

fn fitted(form: Form, change: impl Fn(&mut GprSettings)) -> Model {
    let (inputs, targets) = wavy_plane(120, 5);
    let mut settings = GprSettings::new("matern52".parse().expect("a kernel"), 120);
    settings.form = form;
    change(&mut settings);
    let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[] };
    fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).expect("a model")
}

fn assert_close(found: &[Prediction], expected: &[Prediction], within: f64) {
    for (f, e) in found.iter().zip(expected) {
        assert!((f.mean - e.mean).abs() < within, "{f:?}, {e:?}");
        assert!((f.function_variance - e.function_variance).abs() < within, "{f:?}, {e:?}");
        assert!((f.measurement_variance - e.measurement_variance).abs() < within, "{f:?}, {e:?}");
    }
}

#[test]
fn nearest_with_all_rows_agrees_with_exact() {
    for basis in [Basis::Zero, Basis::Constant, Basis::Linear] {
        let fixed = |settings: &mut GprSettings| {
            (settings.basis, settings.max_iterations, settings.calibrate) = (basis, 0, false);
        };
        let exact = fitted(Form::Exact, fixed);
        let queries: Vec<f64> = wavy_plane(40, 77).0;
        let expected = exact.predict(&queries).expect("finite");
        // With 120 neighbours, each prediction uses all 120 rows. Each term of the likelihood uses all earlier rows.
        let nearest = fitted(Form::Nearest { neighbours: 120 }, fixed);
        let likelihoods = (nearest.log_marginal_likelihood(), exact.log_marginal_likelihood());
        assert!((likelihoods.0 - likelihoods.1).abs() < 1e-5, "{likelihoods:?}");
        assert_close(&nearest.predict(&queries).expect("finite"), &expected, 1e-8);
    }
}

#[test]
fn left_out_rows_match_model_fitted_without_them() {
    let data = data(50, Basis::Zero);
    let plan = Plan::new(&"matern32".parse().expect("a kernel"), 2, false);
    let at = theta(&plan);
    let all = exact::Posterior::new(data.clone(), plan.clone(), &at).expect("positive definite");
    for row in [0_usize, 17, 49] {
        let mut without = data.clone();
        without.inputs.drain(2 * row..2 * row + 2);
        without.targets.remove(row);
        let without = exact::Posterior::new(without, plan.clone(), &at).expect("positive definite");
        let (mean, variance) = without.predict(data.row(row))[0];
        let expected = (data.targets[row] - mean, variance + without.covariance.noise_variance);
        let (residual, measured) = all.left_out(&[row as u32])[0];
        assert!((residual - expected.0).abs() < 1e-5 && (measured - expected.1).abs() < 1e-5, "row {row}");
    }
}

#[test]
fn search_recovers_noise_and_function() {
    for form in [Form::Exact, Form::Nearest { neighbours: 25 }] {
        let model = fitted(form, |settings| settings.restarts = 1);
        let hyperparameters = model.hyperparameters();
        let noise_sd = hyperparameters.last().expect("the noise is there").value;
        // The standard deviation of the noise in these 120 rows is 0.086.
        assert!((0.075..0.1).contains(&noise_sd), "{form:?}: {hyperparameters:?}");
        let (queries, targets) = wavy_plane(400, 99);
        let predictions = model.predict(&queries).expect("finite");
        let score = score(&predictions, &targets);
        assert!(score.rmse < 0.15 && (0.90..0.99).contains(&score.coverage_95), "{form:?}: {score:?}");
        assert!(predictions.iter().all(|p| p.function_variance < p.measurement_variance && p.low_95 < p.mean));
    }
}

#[test]
fn zero_steps_keep_given_start() {
    let start = [0.7, 1.4, 0.9, 0.2];
    let model = fitted(Form::Exact, |settings| {
        (settings.ard, settings.max_iterations) = (true, 0);
        settings.start = start.to_vec();
    });
    let found: Vec<f64> = model.hyperparameters().iter().map(|h| h.value).collect();
    assert!(found.iter().zip(start).all(|(f, s)| (f / s - 1.0).abs() < 1e-12), "{found:?}");
    assert_eq!(model.outcome.iterations, 0);
}

#[test]
fn results_do_not_depend_on_threads() {
    for form in [Form::Nearest { neighbours: 20 }, Form::Exact] {
        let of = |threads| {
            let model = fitted(form, |settings| settings.threads = threads);
            (model.predict(&[0.3, -0.4]).expect("finite")[0].mean, model.log_marginal_likelihood())
        };
        let (one, three) = (of(1), of(3));
        assert!((one.0 - three.0).abs() < 1e-7 && (one.1 - three.1).abs() < 1e-5, "{form:?}: {one:?} {three:?}");
    }
}

#[test]
fn equal_rows_with_little_noise_count_jitter() {
    let inputs: Vec<f64> = (0..40).map(|k| f64::from(k / 4) * 1e-3).collect();
    let targets: Vec<f64> = inputs.iter().map(|x| x.sin()).collect();
    let rows = TrainingRows { inputs: &inputs, dimensions: 1, targets: &targets, lines: &[] };
    for form in [Form::Exact, Form::Nearest { neighbours: 30 }] {
        let mut settings = GprSettings::new("squared_exponential".parse().expect("a kernel"), 40);
        (settings.form, settings.max_iterations) = (form, 0);
        settings.start = vec![3.0, 1.0, 1e-12];
        let model = fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).expect("jitter helps");
        let jitter = model.outcome.jitter;
        assert!(jitter.matrices > 0 && jitter.largest >= 1e-10, "{form:?}: {jitter:?}");
    }
    assert_eq!(fitted(Form::Exact, |_| ()).outcome.jitter, Jitter::default());
}

#[test]
fn saved_model_loads_unchanged() {
    for form in [Form::Exact, Form::Nearest { neighbours: 20 }] {
        let model = fitted(form, |settings| settings.basis = Basis::Linear);
        let text = model.save().expect("can be written");
        let loaded = Model::load(&text, 1).expect("sound");
        let queries = [0.1, 0.2, -1.0, 1.0];
        assert_eq!(loaded.predict(&queries), model.predict(&queries), "{form:?}");
        assert_eq!(loaded.hyperparameters(), model.hyperparameters());
        assert_eq!(loaded.log_marginal_likelihood(), model.log_marginal_likelihood());
        assert_eq!(loaded.save().expect("can be written"), text);
    }
}

#[test]
fn damaged_and_newer_models_are_rejected() {
    let text = fitted(Form::Nearest { neighbours: 20 }, |settings| settings.max_iterations = 0).save().expect("text");
    let refused = |text: &str| Model::load(text, 1).expect_err("not sound").to_string();
    assert!(refused("").contains("has one line"));
    assert!(
        refused(&text.replace("\"version\":1", "\"version\":2")).contains("version = 2, must be 1; written by a newer")
    );
    assert!(refused(&text.replace("packwatch gaussian process", "something")).contains("format = "));
    assert!(refused(&text.replacen("\"theta\":[", "\"theta\":[1", 1)).contains("damaged: checksum"));
    assert!(refused(&text[..text.len() / 2]).contains("damaged: checksum"));
    let (header, _) = text.split_once('\n').expect("two lines");
    assert!(refused(&format!("{header}\n{{}}\n")).contains("damaged"));
}

#[test]
fn callback_cancels_fit() {
    let (inputs, targets) = wavy_plane(100, 5);
    let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[] };
    let settings = GprSettings::new("exponential".parse().expect("a kernel"), 100);
    let mut calls = 0;
    let mut watcher = |progress: FitProgress| {
        calls += 1;
        if progress.iteration == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    assert_eq!(fit(&rows, &settings, &mut watcher).expect_err("cancelled"), RegressionError::Cancelled);
    assert_eq!(calls, 3);
}

#[test]
fn cross_validation_holds_out_every_row_once() {
    let (inputs, targets) = wavy_plane(203, 5);
    let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[] };
    let mut settings = GprSettings::new("matern52".parse().expect("a kernel"), 203);
    settings.ard = true;
    let ticks = std::cell::Cell::new(0.0);
    let clock = || {
        ticks.set(ticks.get() + 1.0);
        ticks.get()
    };
    let mut folds_seen = std::collections::BTreeSet::new();
    let mut watcher = |progress: FitProgress| {
        folds_seen.insert((progress.fold, progress.folds));
        ControlFlow::Continue(())
    };
    let done = cross_validate(&rows, &settings, 5, &clock, &mut watcher).expect("a cross-validation");
    assert_eq!(done.predictions.len(), 203);
    assert_eq!(done.folds.iter().map(|fold| fold.held_out).sum::<usize>(), 203);
    assert!(done.folds.iter().all(|fold| (40..=41).contains(&fold.held_out) && fold.fit_s == 1.0));
    assert_eq!(folds_seen.into_iter().collect::<Vec<_>>(), (1..=5).map(|k| (k, 5)).collect::<Vec<_>>());
    let score = score(&done.predictions, &targets);
    assert!(score.rmse > 0.09 && score.rmse < 0.15 && score.coverage_95 > 0.9, "{score:?}");
    assert!(cross_validate(&rows, &settings, 1, &clock, &mut |_| ControlFlow::Continue(())).is_err());
    assert!(cross_validate(&rows, &settings, 102, &clock, &mut |_| ControlFlow::Continue(())).is_err());
}

#[test]
fn settings_out_of_range_are_rejected() {
    let (inputs, targets) = wavy_plane(30, 5);
    let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[] };
    let refused = |change: &dyn Fn(&mut GprSettings)| {
        let mut settings = GprSettings::new("exponential".parse().expect("a kernel"), 30);
        change(&mut settings);
        fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).expect_err("out of range").to_string()
    };
    assert_eq!(refused(&|s| s.threads = 0), "threads = 0, must be 1 to 1024");
    assert_eq!(refused(&|s| s.form = Form::Nearest { neighbours: 0 }), "neighbours = 0, must be 1 to 500");
    assert_eq!(refused(&|s| s.start = vec![1.0]), "start = [1.0], must be 3 positive numbers");
    assert_eq!(refused(&|s| s.restarts = usize::MAX), format!("restarts = {}, must be at most 1000", usize::MAX));
    let model = fitted(Form::Exact, |_| ());
    assert!(model.predict(&[1.0]).is_err() && model.predict(&[1.0, f64::NAN]).is_err());
}

#[test]
fn numbers_too_large_to_square_are_rejected() {
    for form in [Form::Exact, Form::Nearest { neighbours: 30 }] {
        let model = fitted(form, |_| ());
        let predicted = model.predict(&[1.0, 1.0, 1e160, 0.0]).map(|all| all[1]);
        // The row is very distant, so the result is either the prior or an error that names the row.
        match predicted {
            Ok(one) => assert!(one.mean.is_finite() && one.function_variance > 0.0, "{form:?}: {one:?}"),
            Err(fault) => assert!(fault.to_string().starts_with("inputs of row 2 = [1e160, 0.0]"), "{fault}"),
        }
    }
    let (mut inputs, targets) = wavy_plane(30, 5);
    inputs.iter_mut().step_by(2).for_each(|x| *x *= 1e200);
    let rows = TrainingRows { inputs: &inputs, dimensions: 2, targets: &targets, lines: &[] };
    let settings = GprSettings::new("exponential".parse().expect("a kernel"), 30);
    let fault = fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).expect_err("too large").to_string();
    assert_eq!(fault, "input 1 = values whose mean or variance overflows, must be smaller");
}
