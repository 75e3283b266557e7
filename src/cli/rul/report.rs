//! Prints the tables of `rul`.

use std::io::{self, Write};

use crate::cli::common::output::write_table;
use crate::health::{Axis, Remaining};
use crate::lab::rul::{self, CurrentForecast, ForecastScore, HistoryScore, ScoreTotal, WORST_ERROR};

pub(super) fn now_table(forecasts: &[CurrentForecast]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "remaining: median (5 to 95 %) from the last reading; days at the recent rate of use\n")?;
    let heads = ["file", "end of life", "readings", "capacity", "loss per unit", "cycles", "days"];
    let rows = forecasts.iter().map(|now| {
        let life = now.remaining;
        vec![
            now.name.clone(),
            format!("{:.3} Ah", now.threshold_ah),
            now.readings.to_string(),
            format!("{:.3} +- {:.3} Ah", now.level_ah.0, now.level_ah.1),
            format!("{:.2} +- {:.2} mAh/{}", 1e3 * now.rate_ah.0, 1e3 * now.rate_ah.1, unit(now.axis)),
            amount(life.and_then(|life| life.cycles)),
            amount(life.and_then(|life| life.days)),
        ]
    });
    write_table(&mut out, &heads, rows, 2)?;
    for now in forecasts {
        if let Some(why) = &now.refused {
            writeln!(out, "{}, {:.3} Ah: no forecast: {why}", now.name, now.threshold_ah)?;
        }
    }
    Ok(())
}

pub(super) fn scored_table(files: &[HistoryScore], alpha: f64) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let percent = 100.0 * alpha;
    writeln!(out, "remaining: median (5 to 95 %); passes if the median is within {percent:.0} % of the truth")?;
    writeln!(out, "errors are |median - truth| as a fraction of the life, capped at {:.0} %\n", 100.0 * WORST_ERROR)?;
    #[rustfmt::skip]
    let heads = [
        "file", "end of life", "at", "readings", "unit", "truth", "forecast", "alpha", "interval", "error", "line", "error",
        "double exp.", "error",
    ];
    let rows: Vec<_> = files.iter().flat_map(|file| file.judged.iter().map(|score| judged_row(file, score))).collect();
    if !rows.is_empty() {
        write_table(&mut out, &heads, rows, 2)?;
        writeln!(out)?;
    }
    notes(&mut out, files)?;
    match rul::total(files) {
        Some(total) => totals(&mut out, &total),
        None => writeln!(out, "no forecasts were scored"),
    }
}

fn judged_row(file: &HistoryScore, judged: &ForecastScore) -> Vec<String> {
    let forecast = judged.forecast.map(|[low, median, high]| Remaining { low, median, high });
    let baseline = |end: Option<f64>| end.map_or("never".to_owned(), |end| format!("{end:.1}"));
    vec![
        file.name.clone(),
        format!("{:.3} Ah", file.threshold_ah),
        part(judged.at),
        judged.readings.to_string(),
        format!("{}s", unit(file.axis)),
        format!("{:.1}", judged.truth),
        amount(forecast),
        if judged.within_alpha { "pass" } else { "fail" }.to_owned(),
        if judged.covered { "holds" } else { "misses" }.to_owned(),
        part(judged.error),
        baseline(judged.straight),
        part(judged.straight_error),
        baseline(judged.double_exponential),
        part(judged.double_exponential_error),
    ]
}

/// Prints the end of life of each file, or that the file was not scored. Lists the forecasts that were not possible.
fn notes(out: &mut impl Write, files: &[HistoryScore]) -> io::Result<()> {
    for file in files {
        let (name, threshold_ah) = (&file.name, file.threshold_ah);
        match file.end_of_life {
            None => writeln!(
                out,
                "{name}: does not stay below {threshold_ah:.3} Ah (least capacity {:.3} Ah): not scored",
                file.least_capacity_ah
            )?,
            Some(end) => writeln!(out, "{name}: falls below {threshold_ah:.3} Ah after {end:.1} {}s", unit(file.axis))?,
        }
        for judged in &file.judged {
            if let Some(why) = &judged.refused {
                writeln!(out, "{name}, {threshold_ah:.3} Ah, at {}: no forecast: {why}", part(judged.at))?;
            }
        }
    }
    Ok(())
}

fn totals(out: &mut impl Write, total: &ScoreTotal) -> io::Result<()> {
    writeln!(out, "\n{} forecasts, {} not possible", total.forecasts, total.refused)?;
    writeln!(out, "interval holds the truth  {}", part(total.coverage))?;
    writeln!(out, "median passes alpha       {}", part(total.within_alpha))?;
    writeln!(out, "mean error                {:.1} %", 100.0 * total.mean_error)?;
    writeln!(out, "  straight line           {:.1} %", 100.0 * total.straight_mean_error)?;
    writeln!(out, "  double exponential      {:.1} %", 100.0 * total.double_exponential_mean_error)
}

fn unit(axis: Axis) -> &'static str {
    if axis == Axis::Cycles { "cycle" } else { "day" }
}

fn part(part: f64) -> String {
    format!("{:.0} %", 100.0 * part)
}

fn amount(remaining: Option<Remaining>) -> String {
    remaining.map_or("unknown".to_owned(), |r| format!("{:.1} ({:.1} to {:.1})", r.median, r.low, r.high))
}
