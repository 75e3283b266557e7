//! Creates the beginning of the page: problems, and the condition that follows from them. If there is no problem, a
//! single entry states how much is known.

use super::context::PageContext;
use super::data::Data;
use super::forecast::Outlook;
use super::known::Knowledge;
use super::problems::{Problem, problems};

/// Condition of the battery, the best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Condition {
    Good,
    Unknown,
    Watch,
    Plan,
    Act,
}

impl Condition {
    pub(super) const fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Watch => "watch",
            Self::Plan => "plan",
            Self::Act => "act",
            Self::Unknown => "unknown",
        }
    }

    /// Symbol of the condition, for readers who cannot distinguish the colours.
    pub(super) const fn sign(self) -> &'static str {
        match self {
            Self::Good => "\u{2713}",
            Self::Watch => "i",
            Self::Plan => "!",
            Self::Act => "!!",
            Self::Unknown => "?",
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Summary {
    pub(super) condition: Condition,
    /// Problems, the worst first. Never empty: if nothing is wrong, a single entry says so.
    pub(super) problems: Vec<Problem>,
    pub(super) knowledge: Knowledge,
}

pub(super) fn of(data: &Data, context: &PageContext<'_>, outlook: &Result<Outlook, String>) -> Summary {
    let knowledge = Knowledge::of(data, context, outlook);
    let mut problems = problems(data, context, outlook.as_ref().ok());
    if problems.is_empty() {
        problems.push(no_problem(data, context, &knowledge));
    }
    Summary { condition: problems[0].condition, problems, knowledge }
}

/// Returns the entry for a battery without problems, which states how much is known.
fn no_problem(data: &Data, context: &PageContext<'_>, knowledge: &Knowledge) -> Problem {
    let compared = context.imbalance.as_ref().and_then(|pack| pack.as_ref().ok()).map(|pack| pack.cells);
    let limits = if knows_limits(data, context) { " No alarm is raised." } else { "" };
    let say = |condition, what: String, advice: &str| Problem {
        condition,
        what,
        advice: advice.to_owned(),
        note: String::new(),
        is_alarm: false,
    };
    let measured = knowledge.measured_cells;
    let all = context.config.map_or(0, |config| usize::from(config.monitor.sample.cells)).max(data.cells());
    match compared {
        Some(cells) if measured < all => say(
            Condition::Unknown,
            format!(
                "Nothing wrong was found: {cells} cells were compared, and none stands out.{limits} The wear of the battery is not known yet."
            ),
            "Nothing now. The table below says what would teach more.",
        ),
        None if measured == 0 => say(
            Condition::Unknown,
            "Unknown: nothing has been learned about this battery yet.".to_owned(),
            "Use the battery through a deep discharge and a full charge, then create the report again.",
        ),
        None if measured < all => say(
            Condition::Unknown,
            format!("Unknown: nothing has been learned yet about {} of {} cells.{limits}", all - measured, all),
            "Use the battery through a deep discharge and a full charge, then create the report again.",
        ),
        _ if limits.is_empty() => say(
            Condition::Unknown,
            "Unknown: no alarm is raised, but this record states no limit.".to_owned(),
            "Create the report with the configuration (-c), which defines the limits.",
        ),
        Some(cells) => say(
            Condition::Good,
            format!("Nothing is wrong: {cells} cells were compared, and none stands out.{limits}"),
            "Nothing.",
        ),
        None => say(Condition::Good, format!("Nothing is wrong.{limits}"), "Nothing."),
    }
}

fn knows_limits(data: &Data, context: &PageContext<'_>) -> bool {
    context.config.is_some() || !data.alarms.is_empty()
}

#[cfg(test)]
mod tests;
