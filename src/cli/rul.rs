//! `packwatch rul`: forecasts the remaining useful life from measured capacity histories, either at the end of the
//! history or at earlier points of it.

mod report;

use std::path::PathBuf;
use std::str::FromStr as _;

use super::common::numbers::{finite, fraction};
use super::common::output::{check_distinct, failure, print, unless_closed};
use crate::io::paths::short_names;
use crate::lab::rul::{self, CurrentForecast, HistoryScore, Threshold};
use packwatch_host::failure::Failure;

/// Arguments of `rul`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "If a file has a type column, life is counted in full cycles, one per discharge; otherwise in days, which \
    include rest. The end of life is where a non-increasing least-squares line through all capacities crosses \
    the threshold, so a temporary recovery after a rest does not change it. With --at, a forecast uses only \
    the readings up to its point of the life."
)]
pub(crate) struct Args {
    /// Capacity histories: CSV (.gz, .zst) with date or start (ISO 8601 or seconds, ascending), capacity_ah or capacity_ah_source
    /// (Ah), and optionally type (charge, discharge) and duration_s
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Capacity at the end of life: Ah, or percent of the first capacity in the file, for example 1.4 or "70 %". Several give a
    /// forecast each
    #[arg(long, value_name = "AH|PERCENT", required = true, value_delimiter = ',', value_parser = Threshold::from_str)]
    end_of_life: Vec<Threshold>,
    /// Points of the life at which to forecast and score, percent: 40,50,60,70,80 [default: one forecast, now]
    #[arg(long, value_name = "PERCENT,..", value_delimiter = ',', value_parser = part)]
    at: Vec<f64>,
    /// Largest allowed error of the median, as a fraction of the true remaining life
    #[arg(long, value_name = "FRACTION", default_value_t = 0.2, value_parser = fraction)]
    alpha: f64,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    // At most one point for each percent is useful.
    if args.at.len() > 99 {
        return Err(Failure::new(format!("--at: {} points, must be at most 99", args.at.len())));
    }
    check_distinct(&args.files)?;
    let shown = if args.at.is_empty() {
        let forecasts: Vec<CurrentForecast> = each(args, rul::now)?;
        if args.json {
            return print(&rul::now_json(&forecasts).map_err(failure)?);
        }
        report::now_table(&forecasts)
    } else {
        let score = |history: &rul::History, name: &str, t| rul::score(history, name, t, &args.at, args.alpha, &|| ());
        let scored: Vec<HistoryScore> = each(args, score)?;
        if args.json {
            return print(&rul::scored_json(&scored, args.alpha).map_err(failure)?);
        }
        report::scored_table(&scored, args.alpha)
    };
    unless_closed(shown)
}

/// Runs `work` for every file with every threshold, in the order of the arguments.
fn each<T>(args: &Args, work: impl Fn(&rul::History, &str, Threshold) -> T) -> Result<Vec<T>, Failure> {
    let mut all = Vec::with_capacity(args.files.len() * args.end_of_life.len());
    for (path, name) in args.files.iter().zip(short_names(&args.files)) {
        let history = rul::History::read(path).map_err(failure)?;
        all.extend(args.end_of_life.iter().map(|&threshold| work(&history, &name, threshold)));
    }
    Ok(all)
}

/// Parses a percentage above 0 and below 100, and returns a fraction.
fn below_100(percent: &str) -> Option<f64> {
    finite(percent).ok().filter(|percent| *percent > 0.0 && *percent < 100.0).map(|percent| percent / 100.0)
}

/// Parses a percentage above 0 and below 100, with or without a percent sign. Returns a fraction.
fn part(text: &str) -> Result<f64, String> {
    below_100(text.trim().trim_end_matches('%')).ok_or_else(|| "must be a percentage above 0 and below 100".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threshold_accepts_ampere_hours_or_percent() {
        for (text, expected) in [
            ("1.4", Threshold::AmpereHours(1.4)),
            ("1.4 Ah", Threshold::AmpereHours(1.4)),
            ("70 %", Threshold::OfFirst(0.7)),
            ("70%", Threshold::OfFirst(0.7)),
        ] {
            assert_eq!(text.parse(), Ok(expected));
        }
        assert!(
            ["0", "-1", "100 %", "0%", "soon", "", "inf", "nan %"]
                .iter()
                .all(|text| text.parse::<Threshold>().is_err())
        );
        assert_eq!(part("40"), Ok(0.4));
        assert!(part("100").is_err() && part("0").is_err() && fraction("0").is_err() && fraction("x").is_err());
    }
}
