//! Output of `fit`: progress on the terminal, and the table of residuals.

use std::io::{self, Write as _};
use std::path::Path;

use indicatif::ProgressBar;

use crate::ident::fit::Residual;
use crate::lab::fit::{FitOutcome, FitProgress};

pub(super) fn show(bar: &ProgressBar, progress: FitProgress) {
    bar.set_message(match progress {
        FitProgress::Read(done, all) => format!("read {done} of {all} files"),
        FitProgress::Pass(pass, cost) => format!("pass {pass}, cost {cost:.6e}"),
    });
    bar.tick();
}

pub(super) fn table(outcome: &FitOutcome, seconds: f64, path: &Path) -> io::Result<()> {
    let names: Vec<String> = outcome.files.iter().map(|file| file.path.display().to_string()).collect();
    let width = names.iter().map(String::len).max().unwrap_or(0).max(5);
    let mut out = io::stdout().lock();
    let head = ["rows", "seconds", "RMSE mV", "mean mV", "worst mV"];
    writeln!(out, "{:width$} {:>9} {:>9} {:>8} {:>8} {:>8}", "file", head[0], head[1], head[2], head[3], head[4])?;
    let mut line = |name: &str, rows: usize, file_s: f64, r: &Residual| {
        let (rmse, mean, worst) = (1e3 * r.rmse_v, 1e3 * r.mean_v, 1e3 * r.worst_v);
        writeln!(out, "{name:width$} {rows:>9} {file_s:>9.0} {rmse:>8.2} {mean:>8.2} {worst:>8.1}")
    };
    for (name, file) in names.iter().zip(&outcome.files) {
        line(name, file.rows, file.seconds, &file.residual)?;
    }
    let (rows, all_s) = outcome.files.iter().fold((0, 0.0), |(n, s), file| (n + file.rows, s + file.seconds));
    line("all", rows, all_s, &outcome.fit.total)?;
    for note in &outcome.notes {
        writeln!(out, "note: {note}")?;
    }
    for said in &outcome.verdict {
        writeln!(out, "verdict: {said}")?;
    }
    let fit = &outcome.fit;
    let ended = if fit.converged { "converged" } else { "stopped" };
    writeln!(out, "{ended} after {} passes, {seconds:.1} s; written to {}", fit.passes, path.display())
}
