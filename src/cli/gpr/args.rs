//! Arguments shared by the subcommands of `gpr`: files, kernel grammar, form of the model.

use std::path::{Path, PathBuf};

use crate::cli::common::numbers::{NamedValue, integer, one_of, whole};
use crate::io::result_file::check_place;
use crate::lab::gpr::MissingPolicy;
use crate::regress::{Basis, Form, GprSettings, Kernel, MAX_NEIGHBOURS};
use packwatch_host::failure::Failure;

/// Text below the options.
pub(super) const GRAMMAR: &str = "\
Gaussian process regression predicts a value and its standard deviation from rows with similar inputs. The covariance function \
(kernel) states how fast this similarity falls with the distance between the inputs.\n\n\
KERNEL is one of exponential, squared_exponential, matern32, matern52, rational_quadratic (or with dashes), or a sum or product of \
kernels with brackets: \"exponential + matern52 * (squared_exponential + rational_quadratic)\". For a linear trend in the inputs, use \
--basis linear.\n\n\
Columns are found by name, with or without unit. Length scales are in standard deviations of the inputs. The 95 % interval is \
calibrated on training rows, each predicted without itself.";

/// Files with rows.
#[derive(Debug, clap::Args)]
pub(super) struct FileArgs {
    /// CSV files (.gz, .zst) with a heading, read in this order
    #[arg(required = true, value_name = "FILE.csv")]
    pub(super) files: Vec<PathBuf>,
    /// Skip rows with a missing value (empty or NaN) and report their number [default: fail with file and line]
    #[arg(long)]
    skip_missing: bool,
}

impl FileArgs {
    /// Checks that the result can be written and is not an input file.
    pub(super) fn check_result(&self, result: &Path) -> Result<(), Failure> {
        check_place(result, self.files.iter()).map_err(Failure::new)
    }

    /// Returns a failure about the rows of the files.
    pub(super) fn fault(&self, error: impl std::fmt::Display) -> Failure {
        let names: Vec<String> = self.files.iter().map(|file| file.display().to_string()).collect();
        Failure::new(format!("{}: {error}", names.join(", ")))
    }

    pub(super) fn missing(&self) -> MissingPolicy {
        if self.skip_missing { MissingPolicy::Skipped } else { MissingPolicy::Rejected }
    }
}

/// Form of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum FormName {
    /// Use the covariance of all pairs of rows; for up to a few thousand rows
    Exact,
    /// Use the covariance of each row with its nearest rows (Vecchia); for any number of rows
    Nearest,
}

/// Mean functions by name.
const BASES: [NamedValue<Basis>; 3] = [
    ("zero", Basis::Zero, "0"),
    ("constant", Basis::Constant, "One constant"),
    ("linear", Basis::Linear, "A constant and a slope for every input"),
];

/// Settings of a model.
#[derive(Debug, clap::Args)]
pub(super) struct ModelArgs {
    /// Mean function of the model
    #[arg(long, value_parser = one_of(&BASES), default_value = "constant")]
    basis: Basis,
    /// Fit a length scale for every input instead of a common one
    #[arg(long)]
    ard: bool,
    /// Form of the covariance matrix [default: exact up to 2000 rows, else nearest]
    #[arg(long, value_enum)]
    form: Option<FormName>,
    /// Neighbours of a row with --form nearest
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = whole::<1, MAX_NEIGHBOURS>)]
    neighbours: usize,
    /// Additional searches for hyperparameters, from random starts
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = whole::<0, 100>)]
    restarts: usize,
    /// Maximum number of steps of a hyperparameter search
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = whole::<1, 10_000>)]
    max_iterations: usize,
    /// Seed of folds, starts and orders
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = integer::<u64>(0, u64::MAX))]
    pub(super) seed: u64,
    /// Number of threads [default: one per core]
    #[arg(long, value_name = "N", value_parser = whole::<1, 1024>)]
    threads: Option<usize>,
}

impl ModelArgs {
    /// Returns the settings of a model with this kernel and number of rows.
    pub(super) fn settings(&self, kernel: &Kernel, rows: usize) -> GprSettings {
        let mut settings = GprSettings::new(kernel.clone(), rows);
        settings.form = match self.form {
            Some(FormName::Exact) => Form::Exact,
            Some(FormName::Nearest) => Form::Nearest { neighbours: self.neighbours },
            None if settings.form == Form::Exact => Form::Exact,
            None => Form::Nearest { neighbours: self.neighbours },
        };
        settings.basis = self.basis;
        (settings.ard, settings.restarts, settings.seed) = (self.ard, self.restarts, self.seed);
        settings.max_iterations = self.max_iterations;
        settings.threads = threads(self.threads);
        settings
    }

    /// Whether the form is chosen by the number of rows.
    pub(super) fn by_rows(&self) -> bool {
        self.form.is_none()
    }
}

/// Returns the given number of threads, or one per core.
pub(super) fn threads(given: Option<usize>) -> usize {
    given.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
}
