//! `packwatch whatif`: evaluates the alarms of logs under other settings.

mod document;
mod report;

use std::path::{Path, PathBuf};

use super::common::control::rule_parser;
use super::common::many_logs::LogArgs;
use super::common::numbers::{above_0, percent};
use super::common::output::{failure, unless_closed};
use crate::alarm::Rule;
use crate::config::Config;
use crate::io::result_file::check_place;
use crate::lab::fleet::LogAccess;
use crate::lab::fleet::judge::Horizon;
use crate::lab::fleet::truth;
use crate::lab::fleet::variants::{self, Choice};
use crate::lab::fleet::whatif::{self, LogResult, WhatifJob, WhatifSettings};
use packwatch_host::failure::{EXIT_CONFIG, Failure};

/// Capacity at the end of life.
#[derive(Debug, Clone, Copy, PartialEq)]
enum EndOfLifeArg {
    Ah(f64),
    /// Part of the rated capacity.
    Part(f64),
}

/// Arguments of `whatif`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Each log is replayed once for all settings of alarms, and once more per combination of other settings \
                  (and of input_missing). The first rows are the configuration as it is.\n\n\
                  lead: from the first true raise to the end of life. missed: the end came without a true raise. false alarm: a raise \
                  with which the end did not come within --horizon; without --horizon, a raise in a log that has no end of life. open: \
                  such a raise, but the log ends before the horizon does. false raise: capacity_low raised while the true capacity of the \
                  cell was above the threshold. flickers: clears before the end. Leads are medians over the logs (5 to 95 %).\n\n\
                  The end of life is judged by a truth next to the log (NAME.truth.csv of simulate --truth, NAME_cycles.csv as \
                  score --cycles takes it, or --truth), else by the learned capacity; the table shows which. The sections of a CSV are dated by \
                  --start-times, else by NAME_cycles.csv next to it."
)]
pub(crate) struct Args {
    /// Configuration
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Values to try, as capacity_low.warning=1.5,1.6: a rule's info, warning, severe (also .set, .clear), threshold (the gravest it
    /// has), probability, debounce_s and so on, or any key, as estimator.voltage_noise_v=0.005; several make a grid
    #[arg(long = "set", value_name = "KEY=V1,V2")]
    set: Vec<Choice>,
    /// Capacity of the weakest cell at which its life is over: Ah, or a part of the rated capacity as "70 %" (default:
    /// capacity.end_of_life of the configuration). A number given here is one of the usable capacity where [usable] is configured
    #[arg(long, value_name = "AH|PERCENT", value_parser = end_of_life)]
    end_of_life: Option<EndOfLifeArg>,
    /// A raise is false when the end of life does not come this soon after it: equivalent full cycles, or days as 90d (default: the
    /// rest of the log)
    #[arg(long, value_name = "CYCLES|DAYSd", value_parser = horizon)]
    horizon: Option<Horizon>,
    /// CSV of the true capacities, one per log in the logs' order (default: the CSV next to the log)
    #[arg(long, value_name = "TRUTH.csv")]
    truth: Vec<PathBuf>,
    /// Rules in the table (default: those of --set; all when --set names another key, or is not given)
    #[arg(long, value_name = "RULE", value_delimiter = ',', value_parser = rule_parser(), hide_possible_values = true)]
    rule: Vec<Rule>,
    /// Show every log in addition to the summary (as for a single log)
    #[arg(long)]
    each: bool,
    /// Print one JSON document
    #[arg(long)]
    json: bool,
    /// Write a row per log, setting and alarm as CSV; - is standard output
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    logs: LogArgs,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let grid = variants::grid(&args.config, &args.set)
        .map_err(|faults| Failure { message: faults.join("\n"), code: EXIT_CONFIG })?;
    let plain = &grid.variants[0].config.monitor;
    let rated_ah = plain.model.rated_capacity_ah;
    if args.logs.is_stdin() && grid.replays > 1 {
        return Err(Failure::new(format!("-: is read once, must be a file to be replayed {} times", grid.replays)));
    }
    let open = |config: &Config, logs: &[PathBuf]| args.logs.open(config, logs);
    let settings = WhatifSettings {
        access: LogAccess { open: &open, sleep_gap_s: args.logs.sleep_gap_s() },
        end_of_life_ah: match args.end_of_life {
            Some(EndOfLifeArg::Ah(ah)) => ah,
            Some(EndOfLifeArg::Part(part)) => part * rated_ah,
            None => plain.health.end_of_life_ah,
        },
        // The configured end of life is one of the capacity; for a number given here `[usable]` decides which capacity is meant.
        judges_usable: args.end_of_life.is_some(),
        horizon: args.horizon,
        jobs: args.logs.threads(),
    };
    let jobs = args.jobs();
    let bar = args.logs.bar(grid.replays);
    let results = whatif::run(&grid, &jobs, &settings, &|bytes| bar.inc(bytes));
    bar.finish_and_clear();
    let results = results.map_err(failure)?;
    let failed = results.iter().filter_map(|result| Some(result.as_ref().err()?.to_string())).collect();
    let rules = args.rules(&grid);
    let good: Vec<&LogResult> = results.iter().filter_map(|result| result.as_ref().ok()).collect();
    let shown = report::WhatifReport { grid: &grid, settings: &settings, rated_ah, rules: &rules, logs: &good, failed };
    unless_closed(args.write(&shown))?;
    if shown.failed.is_empty() { Ok(()) } else { Err(Failure::new(shown.failed.join("\n"))) }
}

impl Args {
    fn check(&self) -> Result<(), Failure> {
        self.logs.check()?;
        let (truths, logs) = (self.truth.len(), self.logs.logs.len());
        if truths != 0 && truths != logs {
            return Err(Failure::new(format!("--truth given {truths} times for {logs} logs, must be once per log")));
        }
        if let Some(csv) = &self.csv {
            let inputs = self.logs.logs.iter().chain(&self.truth).chain([&self.config]);
            check_place(csv, inputs).map_err(Failure::new)?;
        }
        if self.json && self.csv.as_deref() == Some(Path::new("-")) {
            return Err(Failure::new("only one of --json and --csv can go to standard output"));
        }
        Ok(())
    }

    fn jobs(&self) -> Vec<WhatifJob> {
        let found = truth::find_next_to(&self.logs.logs);
        let logs = self.logs.logs.iter().zip(found).enumerate();
        logs.map(|(index, (log, found))| WhatifJob {
            log: log.clone(),
            truth: self.truth.get(index).cloned().or(found),
        })
        .collect()
    }

    /// Rules in the table.
    fn rules(&self, grid: &variants::VariantGrid) -> Vec<Rule> {
        let named = if self.rule.is_empty() { &grid.rules } else { &self.rule };
        let all = self.rule.is_empty() && (grid.other_keys || grid.rules.is_empty());
        Rule::ALL.into_iter().filter(|rule| all || named.contains(rule)).collect()
    }

    fn write(&self, shown: &report::WhatifReport<'_>) -> std::io::Result<()> {
        if let Some(path) = &self.csv {
            shown.csv(path)?;
            if path == Path::new("-") {
                return Ok(());
            }
        }
        if self.json { shown.json() } else { shown.table(self.each) }
    }
}

fn end_of_life(text: &str) -> Result<EndOfLifeArg, String> {
    match text.trim().strip_suffix('%') {
        Some(digits) => percent(digits).map(|percent| EndOfLifeArg::Part(percent / 100.0)),
        None => {
            above_0(text).map(EndOfLifeArg::Ah).map_err(|_| "must be Ah above 0, or a text like \"70 %\"".to_owned())
        }
    }
}

fn horizon(text: &str) -> Result<Horizon, String> {
    let fault = |_| "must be equivalent full cycles above 0, or days like 90d".to_owned();
    match text.trim().strip_suffix('d') {
        Some(days) => above_0(days).map(Horizon::Days).map_err(fault),
        None => above_0(text).map(Horizon::Cycles).map_err(fault),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn end_of_life_and_horizon_have_units() {
        assert_eq!((end_of_life("1.4"), end_of_life("70 %")), (Ok(EndOfLifeArg::Ah(1.4)), Ok(EndOfLifeArg::Part(0.7))));
        assert!(["0", "-1", "x", "120 %", "NaN"].iter().all(|text| end_of_life(text).is_err()));
        assert_eq!((horizon("30"), horizon("90d")), (Ok(Horizon::Cycles(30.0)), Ok(Horizon::Days(90.0))));
        assert!(["0", "d", "-3d", "inf"].iter().all(|text| horizon(text).is_err()));
    }
}
