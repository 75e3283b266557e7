//! Describes a fit of the pack's own cell model as a task with inputs and a result.
//!
//! A fit takes hundreds of times longer than a tick of the monitor may take. A live host therefore runs the task on a
//! separate thread. A replay runs it on the calling thread, with the same result, because the result depends only on
//! the inputs.

use super::fit::{self, Fit};
use super::{OwnModel, rows_cost};
use crate::cell::chemistry::{Chemistry, Label, LabelPrior};
use crate::cell::fleet_prior::FleetPrior;
use crate::cell::notebook::{Notebook, Row};

/// Inputs of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct FitTask {
    label: Label,
    fleet: Option<FleetPrior>,
    rows: Vec<Row>,
    /// Number of rows that were not yet used by any fit. These rows are at the end of `rows`.
    new_rows: usize,
    /// Present model (`own`) and previous model (`before`); `None` = the label's model.
    own: Option<OwnModel>,
    before: Option<OwnModel>,
}

/// Result of a task.
#[derive(Debug, Clone, PartialEq)]
pub struct FitFindings {
    /// Whether the previous model predicts the new rows better than the present model.
    pub is_before_better: bool,
    /// Whether the rows suffice for a fit.
    pub is_enough: bool,
    /// The fit to all rows; `None` if there are too few rows, or if the capacity is far from the label's capacity.
    pub fit: Option<Fit>,
    /// The chemistry that explains the rows clearly better than the label's chemistry, if any.
    pub chemistry: Option<Chemistry>,
}

impl FitTask {
    /// Creates a task from the rows of a notebook (averaged readings from drives and charges), the present model and
    /// the previous model.
    pub fn new(
        (label, fleet): (Label, Option<&FleetPrior>),
        notebook: &Notebook,
        own: Option<&OwnModel>,
        before: Option<&OwnModel>,
    ) -> Self {
        let new_rows = notebook.new_rows().len();
        Self {
            label,
            fleet: fleet.cloned(),
            rows: notebook.rows().to_vec(),
            new_rows,
            own: own.cloned(),
            before: before.cloned(),
        }
    }

    /// Runs the fit.
    pub fn run(&self) -> FitFindings {
        let is_enough = fit::says_enough(&self.label, &self.rows);
        let nothing = FitFindings { is_before_better: false, is_enough, fit: None, chemistry: None };
        let prior = self.fleet.as_ref().map_or_else(|| self.label.prior(), FleetPrior::prior);
        let Some(prior) = prior else { return nothing };
        let fit = fit::fit(&prior, &self.rows);
        let chemistry = if is_enough { self.better_chemistry(&prior, fit.as_ref()) } else { None };
        FitFindings { is_before_better: self.is_before_better(&prior), fit, chemistry, ..nothing }
    }

    fn is_before_better(&self, prior: &LabelPrior) -> bool {
        let Some(own) = &self.own else { return false };
        let new_rows = &self.rows[self.rows.len() - self.new_rows..];
        let cost = |own: Option<&OwnModel>| rows_cost(prior, own, new_rows);
        let costs = cost(Some(own)).zip(cost(self.before.as_ref()));
        // If the cost is lower by 4, the model is about 50 times more likely.
        costs.is_some_and(|(present, before)| before < present - 4.0)
    }

    /// The chemistry that explains the rows clearly better than the label's chemistry, if any. The cost of a chemistry
    /// is the lowest of its costs at the fitted, rated and expected capacities.
    fn better_chemistry(&self, prior: &LabelPrior, fitted: Option<&Fit>) -> Option<Chemistry> {
        let Self { label, rows, .. } = self;
        // A margin of 4 means that the better chemistry is about 50 times more likely. The margin grows above a misfit
        // of 0.45, which is typical of drives that a circuit model describes well. On drives of four cells, the costs
        // of NCA and NMC differ by 4 to 9, and the cost of LFP differs from all others by hundreds.
        let margin = 4.0 * fitted.map_or(1.0, |it| (it.misfit / 0.45).max(1.0));
        let fitted_ah = fitted.map(|it| it.own.capacity.mean);
        let expected_ah = prior.expected.as_ref().map(|own| own.capacity.mean);
        let capacities_ah: Vec<f64> = [label.rated_ah].into_iter().chain(fitted_ah).chain(expected_ah).collect();
        let own = fit::label_cost(prior, rows, &capacities_ah)?;
        let others = Chemistry::ALL.iter().map(|(chemistry, _)| *chemistry).filter(|other| *other != label.chemistry);
        let costs = others.filter_map(|chemistry| {
            let other = label.with_chemistry(chemistry).prior()?;
            Some((chemistry, fit::label_cost(&other, rows, &capacities_ah)?))
        });
        let best = costs.min_by(|a, b| a.1.total_cmp(&b.1));
        best.filter(|(_, cost)| *cost < own - margin).map(|(chemistry, _)| chemistry)
    }
}
