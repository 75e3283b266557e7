//! The beginning of the page as text, for the terminal.

use super::context::PageContext;
use super::data::Data;
use super::{forecast, summary};

/// What the page says first: what is wrong with the battery, what is known and what is not known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// What is wrong, the worst first, with the advice. Without a problem, the only entry says so.
    pub problems: Vec<String>,
    /// Known figures: name and value.
    pub known: Vec<(&'static str, String)>,
    /// Unknown figures: name, and why.
    pub unknown: Vec<(&'static str, String)>,
}

impl Verdict {
    /// Judges the data like the page.
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
