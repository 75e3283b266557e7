//! Modelling stage: learns a model of the pack's cells (without modules of another kind) from data of the vehicle.
//!
//! In: the filter steps of these cells, and the times at which the vehicle rests or sleeps. Out: a new model for the
//! estimators, the state in which they continue, and a [`ModelView`]. The stage learns a model only if the
//! configuration describes the cells by a [`Label`]. Otherwise the model comes from a file.
//!
//! The [`Notebook`] collects rows, which are means of the cells' data over a short time. If the vehicle rests and there
//! are enough new rows, a fit starts. The fit is a [`FitTask`], which a host can run on another thread. The estimators
//! change to the new model some time later during the rest, never while driving.
//!
//! The task also compares the present model and the previous model on the new rows, to which neither was fitted. If the
//! previous model predicts these rows clearly better, the present model is dropped. A settled model has little
//! remaining uncertainty. It is fitted again only if the pack has reached another range of temperature or state of
//! charge. Until then, only the half-cycles update the capacity.

use serde::{Deserialize, Serialize};

use crate::cell::own_model::task::{FitFindings, FitTask};
use crate::cell::{
    AdoptedState, CellModel, CellStep, Chemistry, EstimatorConfig, FleetPrior, InitialState, Label, Notebook,
    NotebookConfig, OwnModel,
};
use crate::filter::ScalarGaussian;
use crate::monitor::config::MonitorConfig;
use crate::monitor::message::{Event, EventKind, ModelState};
use crate::quantity::{InvalidState, Mode, Timestamp};

/// Smallest number of new rows for a fit, and smallest charge moved in these rows (fraction of the rated capacity).
const LEAST_NEW_ROWS: usize = 6;
const LEAST_NEW_CHARGE: f64 = 0.12;

/// Shortest rest (s) after which a fit starts. This rest is longer than a stop at a red light.
const REST_S: f64 = 120.0;

/// Time (s) from the start of a fit to the change of the model. Even a slow computer fits a model in less time.
const FIT_S: f64 = 30.0;

/// Largest misfit of a usable fit: root mean square of the residuals, in standard deviations. With typical sensors, the
/// misfit is at most 0.65. It is larger after heavy load in the cold, with a faulty sensor, or if the pack was
/// exchanged between the rows.
const MOST_MISFIT: f64 = 0.7;
/// If the misfit of a fit exceeds this value, the present model is also dropped, unless it is settled. The rows then
/// deviate even from the best model by more than the assumed errors.
const HOPELESS_MISFIT: f64 = 1.0;

/// Largest relative standard deviation of a usable fit's capacity. The capacity from the label has a relative standard
/// deviation of 0.1. Rows that determine the capacity poorly also determine the curve poorly.
const MOST_CAPACITY_STD: f64 = 0.05;

const MAX_CHANGES: usize = 16;

/// A change of the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelChange {
    pub time: Timestamp,
    /// State of the model after the change.
    pub state: ModelState,
    /// Learned capacity (Ah); `None` for the label's model.
    pub capacity: Option<ScalarGaussian>,
    /// Root mean square of the residuals of the rows (V).
    pub residual_v: Option<f64>,
    /// The chemistry that explains the voltages better than the label's chemistry, if any.
    pub chemistry: Option<Chemistry>,
    /// Whether the fit dropped a model, so that the previous model or the label's model is used again.
    pub is_taken_back: bool,
}

/// The cell model, and how it was learned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModelView<'a> {
    /// How well the model is known.
    pub state: ModelState,
    /// The label; `None` = a model file is used.
    pub label: Option<Label>,
    /// What other vehicles have learned about cells of this label.
    pub fleet: Option<&'a FleetPrior>,
    /// The learned model; `None` while the label's model or a model file is used.
    pub own: Option<&'a OwnModel>,
    /// Rows from which the model is learned.
    pub notebook: Option<&'a Notebook>,
    /// The chemistry that explains the voltages better than the label's chemistry, if any.
    pub chemistry: Option<Chemistry>,
    /// Number of fits, including fits whose model was not used.
    pub fits: u32,
    /// Number of times a model was dropped and the previous model or the label's model was used again.
    pub taken_back: u32,
    /// The latest changes, oldest first.
    pub changes: &'a [ModelChange],
}

#[derive(Debug)]
pub(crate) struct Modelling {
    label: Option<Label>,
    fleet: Option<FleetPrior>,
    /// The configured model, from the label or from the fleet.
    model: CellModel,
    estimator: EstimatorConfig,
    notebook: NotebookConfig,
    pub(crate) state: ModellingState,
    /// Whether the fit in progress waits for the host to take it.
    is_offered: bool,
    /// A task that the host has run, with its findings.
    given: Option<(FitTask, FitFindings)>,
    outcome: FitOutcome,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FitOutcome {
    Nothing,
    Adopted,
    /// A model was dropped: the previous model or the label's model is used again.
    Returned,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ModellingState {
    /// The label with which the state was learned.
    label: Option<Label>,
    notebook: Notebook,
    own: Option<OwnModel>,
    /// The previous model; `None` = the label's model.
    before: Option<OwnModel>,
    chemistry: Option<Chemistry>,
    fits: u32,
    taken_back: u32,
    changes: Vec<ModelChange>,
    rest_since: Option<Timestamp>,
    /// Start of the fit in progress. No row is closed during a fit.
    fit_since: Option<Timestamp>,
    has_row: bool,
}

/// A new model for the estimators.
#[derive(Debug)]
pub(crate) struct Adoption {
    pub(crate) model: CellModel,
    pub(crate) config: EstimatorConfig,
    /// State of the mean cell.
    pub(crate) mean: AdoptedState,
    /// Whether the cells' capacities restart from the capacity of the mean cell.
    pub(crate) with_capacity: bool,
    /// Whether the model was learned. If not, this is the label's model, and the capacity is not learned yet.
    pub(crate) is_learned: bool,
}

impl ModellingState {
    /// Drops what a gap interrupts: the present rest, the fit in progress and the complete row. Called for a restart,
    /// and for a pack that is stored until it returns.
    pub(crate) fn restart(&mut self) {
        (self.rest_since, self.fit_since, self.has_row) = (None, None, false);
    }

    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        self.notebook.check()?;
        self.own.iter().chain(&self.before).try_for_each(OwnModel::check)?;
        let (count, most) = (self.changes.len(), MAX_CHANGES);
        InvalidState::unless(count <= most, "the changes of the model", count as f64, "at most 16")
    }

    /// `label`: the label of the cells; `None` if the model comes from a file.
    fn view(&self, label: Option<Label>) -> ModelView<'_> {
        let Self { notebook, own, chemistry, fits, taken_back, changes, .. } = self;
        let state = match (label, own) {
            (None, _) => ModelState::Given,
            _ if chemistry.is_some() => ModelState::Unfit,
            (_, None) => ModelState::Prior,
            (_, Some(own)) if own.is_settled() => ModelState::Learned,
            _ => ModelState::Learning,
        };
        ModelView {
            state,
            label,
            fleet: None,
            own: own.as_ref(),
            notebook: label.map(|_| notebook),
            chemistry: *chemistry,
            fits: *fits,
            taken_back: *taken_back,
            changes,
        }
    }

    /// View of the stored model, for the label with which it was learned. If the stored state has no label, uses
    /// `label`. `None` if there is no label.
    pub(crate) fn stored_view(&self, label: Option<Label>) -> Option<ModelView<'_>> {
        let label = self.label.or(label)?;
        Some(self.view(Some(label)))
    }

    fn fits_label(&self, label: &Label) -> bool {
        self.label.is_none_or(|stored| stored == *label)
    }
}

impl Modelling {
    pub(crate) fn new(config: &MonitorConfig) -> Self {
        let rated_ah = config.label.map_or(config.model.rated_capacity_ah, |label| label.rated_ah);
        Self {
            label: config.label,
            fleet: config.fleet.clone(),
            model: config.model.clone(),
            estimator: config.estimator,
            notebook: NotebookConfig::new(config.own_cells(), rated_ah),
            state: ModellingState::default(),
            is_offered: false,
            given: None,
            outcome: FitOutcome::Nothing,
        }
    }

    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        (self.model, self.estimator) = (config.model.clone(), config.estimator);
        self.fleet.clone_from(&config.fleet);
    }

    pub(crate) fn forget(&mut self) {
        self.state = ModellingState::default();
    }

    /// Restores a stored state. If the state was learned with another label, only the rows are kept.
    pub(crate) fn restore(&mut self, state: ModellingState) {
        let Some(label) = &self.label else { return };
        self.state = if state.fits_label(label) {
            state
        } else {
            ModellingState { notebook: state.notebook.all_unread(), ..ModellingState::default() }
        };
    }

    /// The present model, and the estimators' settings for this model.
    pub(crate) fn in_force(&self) -> (CellModel, EstimatorConfig) {
        let own = self.label.as_ref().zip(self.state.own.as_ref());
        let learned = own.and_then(|(label, own)| {
            let model = own.cell_model(label)?;
            let estimator = own.estimator_config(&self.estimator, &self.model, &model);
            Some((model, estimator))
        });
        learned.unwrap_or_else(|| (self.model.clone(), self.estimator))
    }

    #[inline]
    pub(crate) fn note(&mut self, step: &CellStep) {
        if self.label.is_some() {
            self.state.has_row |= self.state.notebook.add(&self.notebook, step);
        }
    }

    /// Whether [`Self::close_row`] is due.
    #[inline]
    pub(crate) fn has_row(&self) -> bool {
        self.state.has_row && self.state.fit_since.is_none()
    }

    /// Adds the complete row to the notebook. `soc`: mean SOC of the cells.
    pub(crate) fn close_row(&mut self, soc: f64) {
        self.state.has_row = false;
        self.state.notebook.close_row(&self.notebook, soc);
    }

    /// Tracks the rest of the vehicle by the pack's mode. Returns whether the fit in progress is due to end. If so, the
    /// caller calls [`Self::refit`].
    pub(crate) fn observe_mode(&mut self, now: Timestamp, mode: Mode) -> bool {
        if self.label.is_none() || mode != Mode::Rest {
            (self.state.rest_since, self.state.fit_since) = (None, None);
            return false;
        }
        let rest_since = *self.state.rest_since.get_or_insert(now);
        if let Some(since) = self.state.fit_since {
            return now.since(since) >= FIT_S;
        }
        if now.since(rest_since) >= REST_S && self.is_due() {
            self.state.notebook.finish_row(&self.notebook);
            (self.state.fit_since, self.is_offered) = (Some(now), true);
        }
        false
    }

    /// Returns the fit in progress once, for a host that runs it on another thread.
    pub(crate) fn take_task(&mut self) -> Option<FitTask> {
        let is_new = std::mem::take(&mut self.is_offered) && self.state.fit_since.is_some();
        is_new.then(|| self.task()).flatten()
    }

    /// Receives the findings of a task that the host has run. If the host gives no findings, the stage runs the task
    /// itself, with the same result.
    pub(crate) fn give(&mut self, task: FitTask, findings: FitFindings) {
        self.given = Some((task, findings));
    }

    fn task(&self) -> Option<FitTask> {
        let ModellingState { notebook, own, before, .. } = &self.state;
        Some(FitTask::new((self.label?, self.fleet.as_ref()), notebook, own.as_ref(), before.as_ref()))
    }

    /// Whether the label's model is used, because no model was given and none has been learned.
    pub(crate) fn is_label(&self) -> bool {
        self.label.is_some() && self.state.own.is_none()
    }

    /// Whether there is enough new data for a fit.
    pub(crate) fn is_due(&self) -> bool {
        let ModellingState { notebook, own, chemistry, .. } = &self.state;
        let is_settled = own.as_ref().is_some_and(OwnModel::is_settled) && chemistry.is_none();
        self.label.is_some()
            && notebook.unread() >= LEAST_NEW_ROWS
            && notebook.new_charge_ah() >= LEAST_NEW_CHARGE * self.notebook.rated_ah
            && (!is_settled || notebook.rows_of_new_classes(self.notebook.rated_ah) >= LEAST_NEW_ROWS)
    }

    /// Ends the fit in progress, or runs a new fit: compares the present and the previous model on the new rows, and
    /// fits a model to all rows. Returns the model that the estimators must adopt, if any.
    pub(crate) fn refit(&mut self) -> Option<Adoption> {
        let label = self.label?;
        if self.state.fit_since.take().is_none() {
            self.state.notebook.finish_row(&self.notebook);
        }
        let task = self.task()?;
        let given = self.given.take().filter(|(given, _)| *given == task).map(|(_, findings)| findings);
        let FitFindings { is_before_better, is_enough, fit, chemistry } = given.unwrap_or_else(|| task.run());
        self.outcome = FitOutcome::Nothing;
        if is_before_better {
            self.state.own = self.state.before.take();
            self.state.taken_back = self.state.taken_back.saturating_add(1);
            self.outcome = FitOutcome::Returned;
        }
        let is_label_again = is_before_better && self.state.own.is_none();
        let unless_fitted = |modelling: &Self| is_label_again.then(|| modelling.label_adoption());
        let was_settled = self.state.own.as_ref().is_some_and(OwnModel::is_settled);
        self.state.notebook.mark_read();
        if is_enough {
            self.state.fits = self.state.fits.saturating_add(1);
            self.state.chemistry = chemistry;
        }
        if self.state.chemistry.is_some() || fit.as_ref().is_some_and(|it| it.misfit > HOPELESS_MISFIT) {
            return self.return_to_label().or_else(|| unless_fitted(self));
        }
        let Some(fitted) = fit else { return unless_fitted(self) };
        // Fits of LFP cells are not used. Hysteresis hides the flat voltage curve of LFP, and the error assumed for a
        // row does not include hysteresis.
        let is_flat = label.chemistry == Chemistry::LfpGraphite;
        let is_rough = fitted.misfit > MOST_MISFIT;
        if is_flat || is_rough || fitted.own.capacity.std() > MOST_CAPACITY_STD * fitted.own.capacity.mean {
            return unless_fitted(self);
        }
        let (soc, soc_by_capacity) = fitted.soc(self.state.notebook.present()).unzip();
        let soc_by_capacity = soc_by_capacity.unwrap_or(0.0);
        let own = fitted.own;
        let filtered_a = self.state.notebook.filtered_a();
        let mean = AdoptedState { soc, soc_by_capacity, capacity: own.capacity, log_resistance: 0.0, filtered_a };
        self.state.label = Some(label);
        self.state.before = self.state.own.replace(own);
        self.outcome = FitOutcome::Adopted;
        let (model, config) = self.in_force();
        Some(Adoption { model, config, mean, with_capacity: !was_settled, is_learned: true })
    }

    /// Returns to the label's model, unless the present model is settled. Called if the rows contradict the present
    /// model. `None` if the model does not change.
    fn return_to_label(&mut self) -> Option<Adoption> {
        self.state.own.take_if(|own| !own.is_settled())?;
        self.state.before = None;
        self.state.taken_back = self.state.taken_back.saturating_add(1);
        self.outcome = FitOutcome::Returned;
        Some(self.label_adoption())
    }

    /// The label's model, with an unknown capacity.
    fn label_adoption(&self) -> Adoption {
        let InitialState { capacity_ah, capacity_std_ah, .. } = self.estimator.initial;
        let capacity = ScalarGaussian::from_std(capacity_ah, capacity_std_ah);
        let mean = AdoptedState { soc: None, soc_by_capacity: 0.0, capacity, log_resistance: 0.0, filtered_a: None };
        let (model, config) = (self.model.clone(), self.estimator);
        Adoption { model, config, mean, with_capacity: true, is_learned: false }
    }

    /// The configured model, for cells whose stored estimates come from the model of another label. `soc`: mean of the
    /// stored estimates. The stored `capacity` is kept if it is more accurate than the configured capacity.
    pub(crate) fn other_model_adoption(&self, soc: Option<ScalarGaussian>, capacity: ScalarGaussian) -> Adoption {
        let adoption = self.label_adoption();
        let with_capacity = capacity.variance > adoption.mean.capacity.variance;
        Adoption { mean: AdoptedState { soc, ..adoption.mean }, with_capacity, ..adoption }
    }

    /// Whether the latest fit returned to the previous model or to the label's model.
    pub(crate) fn has_returned(&self) -> bool {
        self.outcome == FitOutcome::Returned
    }

    /// The state to be stored; `None` if the stage does not learn a model.
    pub(crate) fn stored(&self) -> Option<ModellingState> {
        self.label.map(|_| self.state.clone())
    }

    /// Records the change that the latest fit caused, and returns the event; `None` without a change. `before`: the
    /// model's state before the fit.
    pub(crate) fn note_change(&mut self, time: Timestamp, before: ModelState) -> Option<Event> {
        let ModelView { state, own, chemistry, .. } = self.view();
        if state == before && self.outcome == FitOutcome::Nothing {
            return None;
        }
        let (capacity, residual_v) = own.map(|own| (own.capacity, own.residual_v)).unzip();
        let is_taken_back = self.has_returned();
        let changes = &mut self.state.changes;
        if changes.len() == MAX_CHANGES {
            changes.remove(0);
        }
        changes.push(ModelChange { time, state, capacity, residual_v, chemistry, is_taken_back });
        let (capacity_ah, capacity_std_ah) = capacity.map(|it| (it.mean, it.std())).unzip();
        let kind = EventKind::Model { state, capacity_ah, capacity_std_ah, residual_v, chemistry, is_taken_back };
        Some(Event { time, kind })
    }

    pub(crate) fn view(&self) -> ModelView<'_> {
        ModelView { fleet: self.fleet.as_ref(), ..self.state.view(self.label) }
    }

    /// Ends the present rest, the fit in progress, and the notebook's stretch of contiguous rows.
    pub(crate) fn end_stretch(&mut self) {
        (self.state.rest_since, self.state.fit_since) = (None, None);
        if self.label.is_some() {
            self.state.notebook.end_stretch(&self.notebook);
        }
    }
}
