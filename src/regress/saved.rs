//! Saves models as text and loads them.
//!
//! The text has two lines of JSON. The first line is a header with the version and a checksum of the second line. The
//! second line is the model: its (standardised) rows, its hyperparameters, the result of its fit, and the ratios that
//! calibrate its intervals. For [`Form::Nearest`], it also has the coefficients of the mean function. Everything else
//! is computed on loading, which takes time proportional to n^3 for an exact model with n rows. A damaged text or
//! another version gives an error.

use serde::{Deserialize, Serialize};

use super::basis::Coefficients;
use super::calibration::Calibration;
use super::error::RegressionError;
use super::model::{FitOutcome, Model, ModelSpec, Posterior, threads};
use super::plan::Plan;
use super::scale::{Scale, StandardisedRows};
use super::settings::{Form, MAX_DIMENSIONS};
use super::{exact, nearest};

const FORMAT: &str = "packwatch gaussian process";
const VERSION: u32 = 1;

#[derive(Debug, Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    #[serde(default)]
    checksum: String,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Body {
    spec: ModelSpec,
    scale: Scale,
    theta: Vec<f64>,
    outcome: FitOutcome,
    inputs: Vec<f64>,
    targets: Vec<f64>,
    /// Coefficients of the mean function. An exact model stores neither the coefficients nor their covariance; loading
    /// computes both again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    beta: Vec<f64>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    beta_covariance: Vec<f64>,
    /// Indices of the rows that were left out to calibrate the intervals. For each of these rows, `ratios` has
    /// |residual| / predicted standard deviation.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    left_out: Vec<u32>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    ratios: Vec<f64>,
}

/// Computes a 64-bit FNV-1a hash. It detects damage but not deliberate changes.
fn checksum(text: &str) -> String {
    let hash = text
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3));
    format!("{hash:016x}")
}

fn damaged(what: impl std::fmt::Display) -> RegressionError {
    RegressionError::Saved(format!("damaged: {what}"))
}

impl Model {
    /// Converts the model to a text of two lines.
    pub fn save(&self) -> Result<String, RegressionError> {
        let data = self.posterior.data();
        let mut body = Body {
            spec: self.spec.clone(),
            scale: self.scale.clone(),
            theta: self.theta.clone(),
            outcome: self.outcome,
            inputs: data.inputs.clone(),
            targets: data.targets.clone(),
            beta: vec![],
            beta_covariance: vec![],
            left_out: self.calibration.rows.clone(),
            ratios: self.calibration.ratios.clone(),
        };
        if let Posterior::Nearest(posterior) = &self.posterior {
            body.beta.clone_from(&posterior.coefficients.beta);
            body.beta_covariance.clone_from(&posterior.coefficients.covariance);
        }
        let json = |error: serde_json::Error| RegressionError::Saved(format!("cannot be written: {error}"));
        let body = serde_json::to_string(&body).map_err(json)?;
        let header = Header { format: FORMAT.to_owned(), version: VERSION, checksum: checksum(&body) };
        Ok(format!("{}\n{body}\n", serde_json::to_string(&header).map_err(json)?))
    }

    /// Loads a model from its text. The model uses `thread_count` threads.
    pub fn load(text: &str, thread_count: usize) -> Result<Self, RegressionError> {
        let (header, rest) = text.split_once('\n').ok_or_else(|| damaged("has one line, must have two"))?;
        let header: Header = serde_json::from_str(header).map_err(|e| damaged(format!("line 1: {e}")))?;
        if header.format != FORMAT {
            return Err(RegressionError::Saved(format!("line 1: format = {:?}, must be {FORMAT:?}", header.format)));
        }
        if header.version != VERSION {
            let newer = if header.version > VERSION { "; written by a newer version of packwatch" } else { "" };
            return Err(RegressionError::Saved(format!(
                "line 1: version = {}, must be {VERSION}{newer}",
                header.version
            )));
        }
        let body = rest.trim_end_matches(['\n', '\r']);
        let found = checksum(body);
        if found != header.checksum {
            return Err(damaged(format!("checksum of line 2 = {found}, must be {}", header.checksum)));
        }
        let body: Body = serde_json::from_str(body).map_err(|e| damaged(format!("line 2: {e}")))?;
        body.check()?;
        body.model(thread_count)
    }
}

impl Body {
    /// Checks that all lengths fit together and all numbers are finite, so that later code cannot use an invalid index.
    fn check(&self) -> Result<(), RegressionError> {
        let (d, n) = (self.spec.dimensions, self.targets.len());
        let same = |what: &str, found: usize, expected: usize| {
            if found == expected { Ok(()) } else { Err(damaged(format!("{what} = {found}, must be {expected}"))) }
        };
        if d == 0 || d > MAX_DIMENSIONS || n == 0 {
            return Err(damaged(format!("{n} rows of {d} inputs")));
        }
        same("ratios", self.ratios.len(), self.left_out.len())?;
        same("inputs", self.inputs.len(), d * n)?;
        same("means", self.scale.means.len(), d)?;
        same("deviations", self.scale.deviations.len(), d)?;
        let plan = Plan::new(&self.spec.kernel, d, self.spec.ard);
        same("theta", self.theta.len(), plan.parameters.len())?;
        let size = self.spec.basis.size(d);
        self.spec.form.check(n).map_err(damaged)?;
        if matches!(self.spec.form, Form::Nearest { .. }) {
            same("coefficients", self.beta.len(), size)?;
            same("covariance of the coefficients", self.beta_covariance.len(), size * size)?;
        }
        let scale = &self.scale;
        let numbers = [&self.inputs, &self.targets, &self.theta, &scale.means, &scale.deviations, &self.beta];
        let finite = numbers.into_iter().chain([&self.beta_covariance, &self.ratios]).flatten().all(|x| x.is_finite());
        let positive = scale.deviations.iter().chain([&scale.target_deviation]).all(|x| *x > 0.0);
        let small = self.theta.iter().all(|x| x.abs() < 100.0);
        let rows = scale.target_mean.is_finite() && self.left_out.iter().all(|row| (*row as usize) < n);
        if finite && positive && small && rows { Ok(()) } else { Err(damaged("a number out of its range")) }
    }

    fn model(self, thread_count: usize) -> Result<Model, RegressionError> {
        let pool = threads(thread_count)?;
        let (spec, theta) = (self.spec, self.theta);
        let plan = Plan::new(&spec.kernel, spec.dimensions, spec.ard);
        let (dimensions, basis) = (spec.dimensions, spec.basis);
        let data = StandardisedRows { dimensions, inputs: self.inputs, targets: self.targets, basis };
        let posterior = pool.install(|| match spec.form {
            Form::Exact => Ok(Posterior::Exact(Box::new(exact::Posterior::new(data, plan, &theta)?))),
            Form::Nearest { neighbours } => {
                let coefficients =
                    Coefficients { beta: self.beta, covariance: self.beta_covariance, squared_norm: 0.0 };
                let posterior = nearest::Posterior::new(data, plan, &theta, coefficients, neighbours);
                Ok::<_, RegressionError>(Posterior::Nearest(Box::new(posterior)))
            }
        })?;
        let calibration = match self.left_out.len() {
            0 => Calibration::none(),
            _ => Calibration::new(posterior.data(), self.left_out, self.ratios),
        };
        Ok(Model { spec, scale: self.scale, theta, posterior, outcome: self.outcome, calibration, pool })
    }
}
