//! Finds the limits of the alarms in the configuration or, without a configuration, in the alarms of the record.

use super::context::PageContext;
use super::data::Data;
use crate::alarm::{Rule, Severity};

pub(super) fn threshold(data: &Data, context: &PageContext<'_>, rule: Rule) -> Option<f64> {
    thresholds(data, context, rule).first().map(|(value, _)| *value)
}

/// Returns the thresholds of a rule with their severities, the lowest severity first.
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

/// Returns the rank of a severity; 0 = the lowest severity, or an unknown name.
pub(super) fn rank(severity: &str) -> usize {
    Severity::ALL.iter().position(|known| known.name() == severity).unwrap_or(0)
}

pub(super) fn rule(name: &str) -> Option<Rule> {
    Rule::ALL.into_iter().find(|rule| rule.name() == name)
}
