//! Formats the results of the study as `tests/alarm_tradeoff.md`.

use std::fmt::Write as _;

use super::Fleet;
use super::calibration::{EDGES, bins, errors};
use super::judged::{CANDIDATES, Candidate, RuleOutcome, judge};
use super::life::Life;

/// The median of the values, followed by their 5 % and 95 % quantiles in parentheses.
fn range(mut values: Vec<f64>, digits: usize) -> String {
    values.sort_by(f64::total_cmp);
    let Some(last) = values.len().checked_sub(1) else { return "-".to_owned() };
    let at = |part: f64| values[(part * last as f64).round() as usize];
    format!("{:.digits$} ({:.digits$} to {:.digits$})", at(0.5), at(0.05), at(0.95))
}

fn percent(count: usize, of: usize) -> String {
    format!("{:.1} %", 100.0 * count as f64 / of as f64)
}

fn row(fleet: &Fleet, rule: &Candidate) -> String {
    let judged: Vec<(&Life, RuleOutcome)> = fleet.ageing.iter().map(|life| (life, judge(rule, life))).collect();
    let healthy: Vec<RuleOutcome> = fleet.healthy.iter().map(|life| judge(rule, life)).collect();
    let in_time = || judged.iter().filter_map(|(life, judged)| Some((*life, judged.in_time(life)?)));
    let lead = in_time().filter_map(|(life, evaluation)| Some(life.end?.cycle - evaluation.cycle)).collect();
    let full =
        in_time().filter_map(|(life, evaluation)| Some(life.end?.full_cycles - evaluation.full_cycles)).collect();
    let delay = in_time().filter_map(|(life, evaluation)| Some(evaluation.cycle - life.crossing?.cycle)).collect();
    let count = |all: &[&RuleOutcome], wanted: &dyn Fn(&RuleOutcome) -> bool| all.iter().filter(|j| wanted(j)).count();
    let ageing: Vec<&RuleOutcome> = judged.iter().map(|(_, judged)| judged).collect();
    let healthy: Vec<&RuleOutcome> = healthy.iter().collect();
    let flickers = ageing.iter().map(|judged| judged.flickers).sum::<u32>();
    let (false_raises, far) = ageing.iter().fold((0, 0), |sum, j| (sum.0 + j.false_raises, sum.1 + j.far_false_raises));
    let first_true = count(&ageing, &|j| j.first.is_some() && !j.is_false(0.0));
    format!(
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {:.2} | {} |\n",
        rule.name,
        range(lead, 1),
        range(full, 1),
        range(delay, 1),
        percent(first_true, count(&ageing, &|j| j.first.is_some())),
        false_raises,
        far,
        count(&healthy, &|j| j.first.is_some()),
        count(&healthy, &|j| j.is_false(0.01)),
        f64::from(flickers) / ageing.len() as f64,
        ageing.len() - in_time().count(),
    )
}

/// Table with one line per rule.
pub(crate) fn rules_table(fleet: &Fleet) -> String {
    let mut text = "| rule | lead, cycles | lead, equivalent full cycles | delay, cycles | first raise true | false \
                    raises | by > 1 % | healthy cells raised | by > 1 % | flickers per life | missed |\n\
                    | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
        .to_owned();
    CANDIDATES.iter().for_each(|rule| text += &row(fleet, rule));
    text
}

pub(crate) fn document(fleets: &[Fleet]) -> String {
    let mut text = include_str!("head.md").to_owned();
    for fleet in fleets {
        let set = fleet.set;
        write!(text, "\n### {} sensors\n\n{}", set.name, rules_table(fleet)).expect("writing to a String cannot fail");
    }
    text += include_str!("calibration.md");
    text += "\n| sensors | mean error | error that stays for a life (standard deviation) | scatter within a life | stated standard deviation | inside 68 % | inside 95 % |\n| --- | --- | --- | --- | --- | --- | --- |\n";
    for fleet in fleets {
        let e = errors(fleet);
        writeln!(
            text,
            "| {} | {:+.2} | {:.2} | {:.2} | {:.2} | {:.0} % | {:.0} % |",
            fleet.set.name,
            e.mean,
            e.between_lives,
            e.within_life,
            e.stated,
            100.0 * e.inside_68,
            100.0 * e.inside_95
        )
        .expect("writing to a String cannot fail");
    }
    text += "\n| stated probability | ";
    fleets.iter().for_each(|fleet| text += &format!("{}: evaluations | stated | true | ", fleet.set.name));
    text += "\n| --- |";
    fleets.iter().for_each(|_| text += " --- | --- | --- |");
    let columns: Vec<_> = fleets.iter().map(bins).collect();
    for (index, edges) in EDGES.windows(2).enumerate() {
        write!(text, "\n| {} to {} |", edges[0], edges[1]).expect("writing to a String cannot fail");
        for column in &columns {
            let (count, stated_mean, found) = column[index];
            write!(text, " {count} | {:.1} % | {:.1} % |", 100.0 * stated_mean, 100.0 * found)
                .expect("writing to a String cannot fail");
        }
    }
    text + "\n"
}
