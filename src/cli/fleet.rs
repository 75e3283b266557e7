//! What the commands over many logs have in common: how logs are read, progress, failures of single logs, tables.

use std::io::Write;
use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::Failure;
use super::replay::{CsvSign, column};
use crate::lab::fleet::Reading;

/// How logs are read.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Logs")]
pub(crate) struct LogArgs {
    /// Journals, candump logs or CSV files, also .gz or .zst; each is a life or a trip of its own
    #[arg(required = true, value_name = "LOG")]
    pub(crate) logs: Vec<PathBuf>,
    /// A log ends in failure at its first malformed line (default: such lines are left out and told)
    #[arg(long)]
    strict: bool,
    /// A hole in a record longer than this means that the recorder was asleep: no ticks, s
    #[arg(long, value_name = "S", default_value_t = 30.0, value_parser = positive)]
    sleep_gap: f64,
    /// CSV column of time, current, voltage, temperature or section (empty = none), as current=Current(A);
    /// with {n}, one per cell or sensor from 1, as voltage{n}=U{n}
    #[arg(long = "column", value_name = "ROLE=NAME", value_parser = column)]
    columns: Vec<(String, String)>,
    /// Sign of a CSV's current
    #[arg(long, value_enum, default_value = "discharge")]
    csv_sign: CsvSign,
    /// CSV table with the section's column and `start`, which makes stamps absolute, for one log
    #[arg(long, value_name = "TABLE.csv")]
    start_times: Option<PathBuf>,
    /// Threads (default: one per core)
    #[arg(short, long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
}

impl LogArgs {
    /// What one argument alone cannot tell.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        for (index, log) in self.logs.iter().enumerate() {
            if self.logs[..index].contains(log) {
                return Err(Failure::new(format!("{}: named twice", log.display())));
            }
        }
        if self.start_times.is_some() && self.logs.len() > 1 {
            let found = self.logs.len();
            return Err(Failure::new(format!("--start-times given for {found} logs, must be for 1")));
        }
        if self.logs.len() > 1 && self.logs.iter().any(|log| log == Path::new("-")) {
            return Err(Failure::new("-: standard input must be the only log"));
        }
        Ok(())
    }

    /// How the logs are read.
    pub(crate) fn reading(&self) -> Reading {
        Reading {
            strict: self.strict,
            columns: self.columns.clone(),
            charge_positive: self.csv_sign == CsvSign::Charge,
            start_times: self.start_times.clone(),
            sleep_gap_s: self.sleep_gap,
        }
    }

    /// Threads asked for.
    pub(crate) fn threads(&self) -> Option<usize> {
        self.jobs.map(usize::from)
    }

    /// Progress in bytes, each log read `times`.
    pub(crate) fn bar(&self, times: usize) -> Bar {
        let size = |path: &PathBuf| std::fs::metadata(path).map_or(0, |meta| meta.len());
        let total = self.logs.iter().map(size).sum::<u64>() * times as u64;
        let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(5));
        let template = "{bar:32} {bytes}/{total_bytes} eta {eta}";
        bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
        Bar(bar)
    }
}

/// Progress on standard error, when that is a terminal.
#[derive(Debug)]
pub(crate) struct Bar(ProgressBar);

impl Bar {
    /// More bytes were read.
    pub(crate) fn advance(&self, bytes: u64) {
        self.0.inc(bytes);
    }

    /// Takes the bar away.
    pub(crate) fn clear(&self) {
        self.0.finish_and_clear();
    }
}

/// A table with a heading, columns as wide as they need; the first `left` are aligned left.
pub(crate) fn write_table(
    out: &mut impl Write,
    heads: &[&str],
    left: usize,
    rows: &[Vec<String>],
) -> std::io::Result<()> {
    let head: Vec<String> = heads.iter().map(|head| (*head).to_owned()).collect();
    let all = || std::iter::once(&head).chain(rows);
    let wide = |column: usize| {
        all().filter_map(|row| row.get(column)).map(|cell: &String| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..heads.len()).map(wide).collect();
    for row in all() {
        let cells = row.iter().zip(&widths).enumerate();
        let cells = cells.map(|(column, (cell, &width))| match column < left {
            true => format!("{cell:<width$}"),
            false => format!("{cell:>width$}"),
        });
        writeln!(out, "{}", cells.collect::<Vec<_>>().join("  ").trim_end())?;
    }
    Ok(())
}

/// A number above 0.
pub(crate) fn positive(text: &str) -> Result<f64, String> {
    let value: f64 = text.trim().parse().map_err(|_| "must be a number".to_owned())?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("must be above 0".to_owned()) }
}
