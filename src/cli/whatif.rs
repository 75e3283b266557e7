//! `packwatch whatif`: shows which alarms recorded logs would have raised with other settings.

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
    /// Fraction of the rated capacity.
    Part(f64),
}

/// Arguments of `whatif`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Each log is replayed once for all alarm settings, and once more for each combination of other settings (and of \
    input_missing). The first rows show the configuration without changes.\n\n\
    Columns:\n\
    lead: time from the first true raise to the end of life.\n\
    missed: the end of life came without a true raise.\n\
    false alarm: the end of life did not follow a raise within --horizon; without --horizon, a raise in a log without end of life.\n\
    open: the log ends before the horizon of a raise.\n\
    false raise: capacity_low was raised while the true capacity of the cell was above the threshold.\n\
    flickers: clears before the end of life.\n\
    Leads are medians over the logs (5 to 95 %).\n\n\
    The end of life comes from a truth file next to the log (NAME.truth.csv of simulate --truth, NAME_cycles.csv of score \
    --cycles, or --truth), else from the learned capacity; the table shows which. Sections of a CSV get their times from \
    --start-times, else from NAME_cycles.csv next to the CSV."
)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Values to try, for example capacity_low.warning=1.5,1.6. KEY is RULE.NAME for the alarms of a rule, where NAME
    /// is info, warning, severe (also with .set or .clear), threshold (that of the highest configured severity),
    /// probability, debounce_s and so on. KEY may also be any other configuration key, such as
    /// estimator.voltage_noise_v. Several options form a grid
    #[arg(long = "set", value_name = "KEY=V1,V2")]
    set: Vec<Choice>,
    /// Capacity of the weakest cell at its end of life: Ah, or percent of the rated capacity such as "70 %" [default:
    /// capacity.end_of_life of the configuration]. If [usable] is configured, a value given here is a usable capacity
    #[arg(long, value_name = "AH|PERCENT", value_parser = end_of_life)]
    end_of_life: Option<EndOfLifeArg>,
    /// A raise is false if the end of life does not follow within this time: equivalent full cycles, or days such as 90d [default:
    /// rest of the log]
    #[arg(long, value_name = "CYCLES|DAYSd", value_parser = horizon)]
    horizon: Option<Horizon>,
    /// CSV of true capacities, one per log in the same order [default: the CSV next to the log]
    #[arg(long, value_name = "TRUTH.csv")]
    truth: Vec<PathBuf>,
    /// Rules to show [default: those of --set; all if --set is absent or changes other keys]
    #[arg(long, value_name = "RULE", value_delimiter = ',', value_parser = rule_parser(), hide_possible_values = true)]
    rule: Vec<Rule>,
    /// Show every log in addition to the summary, as for a single log
    #[arg(long)]
    each: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Write a row per log, setting and alarm to this CSV; - writes standard output
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    logs: LogArgs,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let grid = variants::grid(&args.config, &args.set)
        .map_err(|faults| Failure { message: faults.join("\n"), code: EXIT_CONFIG })?;
    let plain = &grid.variants[0].config.monitor;
    let rated_ah = plain.model.rated_capacity_ah;
    if args.logs.is_stdin() && grid.replays > 1 {
        return Err(Failure::new(format!(
            "-: standard input can be read only once, but these settings need {} replays; give a file",
            grid.replays
        )));
    }
    let open = |config: &Config, logs: &[PathBuf]| args.logs.open(config, logs);
    let settings = WhatifSettings {
        access: LogAccess { open: &open, sleep_gap_s: args.logs.sleep_gap_s() },
        end_of_life_ah: match args.end_of_life {
            Some(EndOfLifeArg::Ah(ah)) => ah,
            Some(EndOfLifeArg::Part(part)) => part * rated_ah,
            None => plain.health.end_of_life_ah,
        },
        // The configured end of life is a capacity. If `[usable]` is configured, an end of life given on the command
        // line is a usable capacity.
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
            return Err(Failure::new(format!(
                "--truth is given {truths} times, must be once for each of the {logs} logs"
            )));
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
        None => above_0(text)
            .map(EndOfLifeArg::Ah)
            .map_err(|_| "must be Ah above 0, or a percentage such as \"70 %\"".to_owned()),
    }
}

fn horizon(text: &str) -> Result<Horizon, String> {
    let fault = |_| "must be equivalent full cycles above 0, or days such as 90d".to_owned();
    match text.trim().strip_suffix('d') {
        Some(days) => above_0(days).map(Horizon::Days).map_err(fault),
        None => above_0(text).map(Horizon::Cycles).map_err(fault),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn end_of_life_and_horizon_accept_units() {
        assert_eq!((end_of_life("1.4"), end_of_life("70 %")), (Ok(EndOfLifeArg::Ah(1.4)), Ok(EndOfLifeArg::Part(0.7))));
        assert!(["0", "-1", "x", "120 %", "NaN"].iter().all(|text| end_of_life(text).is_err()));
        assert_eq!((horizon("30"), horizon("90d")), (Ok(Horizon::Cycles(30.0)), Ok(Horizon::Days(90.0))));
        assert!(["0", "d", "-3d", "inf"].iter().all(|text| horizon(text).is_err()));
    }
}
