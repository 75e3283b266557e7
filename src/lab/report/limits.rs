//! Finds the limits of the alarms. The limits come from the configuration; without a configuration, they come from the
//! alarms in the record.

use super::context::PageContext;
use super::data::Data;
use crate::alarm::{Rule, Severity};

/// Returns the rule's threshold with the lowest severity.
pub(super) fn threshold(data: &Data, context: &PageContext<'_>, rule: Rule) -> Option<f64> {
    thresholds(data, context, rule).first().map(|(value, _)| *value)
}

/// Every threshold of a rule with its severity, the lowest severity first.
pub(super) fn thresholds(data: &Data, context: &PageContext<'_>, rule: Rule) -> Vec<(f64, String)> {
    let mut all: Vec<(f64, String)> = match context.config {
        Some(config) => {
            let rules = config.monitor.rules.iter().filter(|row| row.rule == rule);
            rules.map(|row| (row.threshold, row.severity.name().to_owned())).collect()
        }
        None => {
            let rows = data.alarms.iter().filter(|row| row.rule == rule.name());
            rows.filter_map(|row| Some((row.threshold?, row.severity.clone()))).collect()
        }
    };
    all.sort_by(|a, b| rank(&a.1).cmp(&rank(&b.1)).then(a.0.total_cmp(&b.0)));
    all.dedup();
    all
}

/// Rank of the severity with this name; 0 = the lowest severity, or an unknown name.
pub(super) fn rank(severity: &str) -> usize {
    Severity::ALL.iter().position(|known| known.name() == severity).unwrap_or(0)
}

/// Returns the rule with this name.
pub(super) fn rule(name: &str) -> Option<Rule> {
    Rule::ALL.into_iter().find(|rule| rule.name() == name)
}
