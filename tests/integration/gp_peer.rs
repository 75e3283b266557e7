//! Compares packwatch's exact Gaussian process with scikit-learn's (interpreter `PACKWATCH_PYTHON`). With the same rows
//! and hyperparameters, means and standard deviations must agree to 1e-8. `tests/peers/run --only gp` also compares the
//! fit times.

use std::io::{BufRead, BufReader, Write};
use std::ops::ControlFlow;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

use packwatch::regress::{Basis, Form, GprSettings, Model, TrainingRows, fit};

/// Number of rows, maximum fit time relative to scikit-learn's, and number of repetitions.
const BARS: [(usize, f64, usize); 2] = [(2000, 0.8, 7), (5000, 0.6, 3)];

struct Oracle {
    child: Child,
    stdin: ChildStdin,
    stdout: BufReader<ChildStdout>,
}

impl Oracle {
    /// Starts the oracle, a Python process that runs scikit-learn. If Python or scikit-learn is missing, prints a note
    /// and returns `None`.
    fn start(threads: usize) -> Option<Self> {
        let Some(python) = std::env::var_os("PACKWATCH_PYTHON") else {
            eprintln!("SKIPPED: PACKWATCH_PYTHON is not set to a Python with scikit-learn");
            return None;
        };
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/gp_oracle.py");
        let mut command = Command::new(python);
        command
            .arg(script)
            .env("OPENBLAS_NUM_THREADS", threads.to_string())
            .env("OMP_NUM_THREADS", threads.to_string());
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (stdin, stdout) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        let mut oracle = Self { child, stdin, stdout };
        let folder = std::env::temp_dir();
        if oracle.ask(&format!("make 2 {}", folder.display())).is_empty() {
            assert_eq!(oracle.child.wait().unwrap().code(), Some(77), "the oracle failed");
            eprintln!("SKIPPED: scikit-learn is missing from the Python in PACKWATCH_PYTHON");
            return None;
        }
        Some(oracle)
    }

    fn ask(&mut self, line: &str) -> String {
        let mut answer = String::new();
        // Ignore write errors: if the process has exited, its answer is missing and the caller fails.
        let _ = writeln!(self.stdin, "{line}");
        self.stdout.read_line(&mut answer).unwrap();
        answer.trim().to_owned()
    }

    /// Sends the line to the oracle. Returns the wall-clock time of the oracle's calculation (s).
    fn seconds(&mut self, line: &str) -> f64 {
        self.ask(line).split(' ').next().unwrap().parse().unwrap()
    }
}

impl Drop for Oracle {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

struct Case {
    inputs: Vec<f64>,
    targets: Vec<f64>,
    queries: Vec<f64>,
}

fn numbers(path: &Path) -> Vec<f64> {
    let bytes = std::fs::read(path).unwrap();
    bytes.chunks_exact(8).map(|chunk| f64::from_le_bytes(chunk.try_into().unwrap())).collect()
}

fn case(oracle: &mut Oracle, rows: usize, folder: &Path) -> Case {
    assert_eq!(oracle.ask(&format!("make {rows} {}", folder.display())), "made");
    let all = numbers(&folder.join("rows.f64"));
    Case {
        inputs: all[..3 * rows].to_vec(),
        targets: all[3 * rows..4 * rows].to_vec(),
        queries: all[4 * rows..].to_vec(),
    }
}

/// Fits packwatch's model with the oracle's hyperparameters: length scale 1.5, signal 1, noise variance 0.01, mean
/// function 0.
fn ours(case: &Case, threads: usize) -> Model {
    let mut settings = GprSettings::new("exponential".parse().unwrap(), case.targets.len());
    (settings.basis, settings.form, settings.threads) = (Basis::Zero, Form::Exact, threads);
    (settings.standardise, settings.calibrate, settings.max_iterations) = (false, false, 0);
    settings.start = vec![1.5, 1.0, 0.1];
    let rows = TrainingRows { inputs: &case.inputs, dimensions: 3, targets: &case.targets, lines: &[] };
    fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).unwrap()
}

/// Returns the largest difference between the means of packwatch and scikit-learn, and the largest difference between
/// their standard deviations.
fn differences(oracle: &mut Oracle, case: &Case, model: &Model, folder: &Path) -> (f64, f64) {
    oracle.ask("fit");
    oracle.ask("predict");
    let found = model.predict(&case.queries).unwrap();
    let most = |name: &str, of: &dyn Fn(usize) -> f64| {
        let theirs = numbers(&folder.join(name));
        assert_eq!(theirs.len(), found.len());
        theirs.iter().enumerate().map(|(k, value)| (value - of(k)).abs()).fold(0.0, f64::max)
    };
    (most("mean.f64", &|k| found[k].mean), most("std.f64", &|k| found[k].function_variance.sqrt()))
}

#[test]
fn means_and_deviations_match_scikit_learn() {
    let Some(mut oracle) = Oracle::start(1) else { return };
    let folder = tempfile::tempdir().unwrap();
    let case = case(&mut oracle, 400, folder.path());
    let (mean, deviation) = differences(&mut oracle, &case, &ours(&case, 1), folder.path());
    assert!(mean < 1e-8 && deviation < 1e-8, "means differ by {mean:e}, standard deviations by {deviation:e}");
}

#[test]
fn fit_is_faster_than_scikit_learn() {
    if cfg!(debug_assertions) || std::env::var_os("PACKWATCH_TIME_PEERS").is_none() {
        eprintln!("SKIPPED: tests/peers/run --only gp compares the times");
        return;
    }
    for threads in [1, 2] {
        let Some(mut oracle) = Oracle::start(threads) else { return };
        let folder = tempfile::tempdir().unwrap();
        for (rows, bar, rounds) in BARS {
            let case = case(&mut oracle, rows, folder.path());
            let (mean, deviation) = differences(&mut oracle, &case, &ours(&case, threads), folder.path());
            assert!(mean < 1e-8 && deviation < 1e-8, "{rows} rows: {mean:e}, {deviation:e}");
            let (mut own_s, mut their_s) = (Vec::new(), Vec::new());
            for _ in 0..rounds {
                let start = Instant::now();
                std::hint::black_box(ours(&case, threads));
                own_s.push(start.elapsed().as_secs_f64());
                their_s.push(oracle.seconds("fit"));
            }
            let median = |times: &mut Vec<f64>| {
                times.sort_by(f64::total_cmp);
                times[times.len() / 2]
            };
            let (own_s, their_s) = (median(&mut own_s), median(&mut their_s));
            let ratio = own_s / their_s;
            eprintln!(
                "{rows} rows, {threads} thread(s): fit {own_s:.3} s, scikit-learn {their_s:.3} s, ratio {ratio:.2} \
                 (bar {bar}); means differ by {mean:.1e}, standard deviations by {deviation:.1e}"
            );
            assert!(ratio <= bar, "{rows} rows, {threads} thread(s): ratio {ratio:.2}, must be at most {bar}");
        }
    }
}
