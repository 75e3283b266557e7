//! Formats the first part of the report page (problems and key figures) as text for the terminal.

use super::context::PageContext;
use super::data::Data;
use super::{forecast, summary};

/// Content of the first part of the report page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// What is wrong, the worst first, with the advice. If nothing is wrong, a single entry says so.
    pub problems: Vec<String>,
    /// Known figures: name and value.
    pub known: Vec<(&'static str, String)>,
    /// Unknown figures: name and reason.
    pub unknown: Vec<(&'static str, String)>,
}

impl Verdict {
    /// Evaluates the data in the same way as the report page.
    pub fn of(data: &Data, context: &PageContext<'_>) -> Self {
        let summary = summary::of(data, context, &forecast::outlook(data, context));
        let known = summary.knowledge.tiles.into_iter().map(|tile| {
            let doubt = tile.doubt.map_or_else(String::new, |doubt| format!(" ({doubt})"));
            (tile.name, tile.value + &doubt)
        });
        Self {
            problems: summary
                .problems
                .iter()
                .map(|problem| {
                    format!("{} {} {} {}", problem.condition.sign(), problem.what, problem.note, problem.advice)
                })
                .map(|text| text.split_whitespace().collect::<Vec<_>>().join(" "))
                .collect(),
            known: known.collect(),
            unknown: summary.knowledge.gaps.into_iter().map(|gap| (gap.name, gap.why)).collect(),
        }
    }
}
