//! Modelling stage: a model of the pack's own cells, learned from what the vehicle notes of them.
//!
//! In: the steps of all cells; the moments at which the vehicle rests or sleeps. Out: another model for the estimators with the
//! state in which they continue, and what is known of it ([`ModelView`]). Only a pack whose cells are known by their [`Label`] has
//! one; that of a model file is given.
//!
//! A model is fitted again when the vehicle rests and enough new rows have come, and the estimators change to it there, never while
//! driving. The fit is a [`FitTask`]: it begins some time before the change, so that a host can run it on another thread. Before the
//! change the model in force and the one before it are judged on the new rows, which neither has seen: the one that predicts them
//! worse is not kept. Once a model is settled it is fitted again only where the pack has seen another
//! temperature or part of the charge; the capacity is then left to the half-cycles.

use serde::{Deserialize, Serialize};

use crate::cell::own_model::task::{FitFindings, FitTask};
use crate::cell::{
    AdoptedState, CellModel, CellStep, Chemistry, EstimatorConfig, InitialState, Label, Notebook, NotebookConfig,
    OwnModel,
};
use crate::filter::ScalarGaussian;
use crate::monitor::config::MonitorConfig;
use crate::monitor::message::{Event, EventKind, ModelState};
use crate::quantity::{InvalidState, Mode, Timestamp};

/// Fewest new rows for which a fit is made, and least charge that moved in them, part of the rated capacity.
const LEAST_NEW_ROWS: usize = 6;
const LEAST_NEW_CHARGE: f64 = 0.12;

/// Shortest rest in which a fit begins, s: longer than a red light.
const REST_S: f64 = 120.0;

/// Time from there to the change of the model, s: for a thread of a slow computer.
const FIT_S: f64 = 30.0;

/// Misfit above which a fit is not used: with usual sensors it is up to 0.65; heavy load in the cold, a faulty sensor or another pack
/// half-way have more.
const MOST_MISFIT: f64 = 0.7;
/// The same above which the model in force is given up: rows deviate more than they should.
const HOPELESS_MISFIT: f64 = 1.0;

/// Deviation of the capacity above which a fit is not used, fraction: the label's is 0.1, and where the rows say little of the
/// capacity they say little of the curve.
const MOST_CAPACITY_STD: f64 = 0.05;

/// Most changes of the model that are kept.
const MAX_CHANGES: usize = 16;

/// A change of the model: when, and what was known after it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelChange {
    /// When.
    pub time: Timestamp,
    /// How well the model is known since.
    pub state: ModelState,
    /// Its capacity, Ah; `None` = the label's model.
    pub capacity: Option<ScalarGaussian>,
    /// Root mean square of the rows' residuals, V.
    pub residual_v: Option<f64>,
    /// The chemistry that explains the voltages better than that on the label.
    pub chemistry: Option<Chemistry>,
    /// The model before holds again.
    pub is_taken_back: bool,
}

/// What is known of the cells' model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModelView<'a> {
    /// How well it is known.
    pub state: ModelState,
    /// On the label; `None` = a model file.
    pub label: Option<Label>,
    /// What was learned; `None` = nothing yet.
    pub own: Option<&'a OwnModel>,
    /// Rows from which it is learned.
    pub notebook: Option<&'a Notebook>,
    /// The chemistry that explains the voltages better than that on the label.
    pub chemistry: Option<Chemistry>,
    /// Fits so far, and models taken back because the one before was better.
    pub fits: u32,
    /// Models taken back.
    pub taken_back: u32,
    /// The latest changes, oldest first.
    pub changes: &'a [ModelChange],
}

/// The modelling stage.
#[derive(Debug)]
pub(crate) struct Modelling {
    label: Option<Label>,
    /// Of the configuration: the label's.
    model: CellModel,
    estimator: EstimatorConfig,
    notebook: NotebookConfig,
    pub(crate) state: ModellingState,
    /// The fit under way has not been offered to the host.
    is_offered: bool,
    /// A task that the host has run.
    given: Option<(FitTask, FitFindings)>,
    /// Of the latest fit.
    outcome: FitOutcome,
}

/// What a fit has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FitOutcome {
    Nothing,
    /// The new model is in force.
    Adopted,
    /// The model before is in force again.
    Returned,
}

/// The stage's part of the snapshot.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ModellingState {
    /// What was on the label when it was learned.
    label: Option<Label>,
    notebook: Notebook,
    /// The model in force.
    own: Option<OwnModel>,
    /// The one before; `None` = that of the label.
    before: Option<OwnModel>,
    chemistry: Option<Chemistry>,
    fits: u32,
    taken_back: u32,
    changes: Vec<ModelChange>,
    /// Since when the pack rests.
    rest_since: Option<Timestamp>,
    /// Since when a fit is under way; no row ends meanwhile.
    fit_since: Option<Timestamp>,
    /// A row is complete.
    has_row: bool,
}

/// Another model for the estimators.
#[derive(Debug)]
pub(crate) struct Adoption {
    pub(crate) model: CellModel,
    pub(crate) config: EstimatorConfig,
    /// State of the mean cell.
    pub(crate) mean: AdoptedState,
    /// Whether the cells' capacities begin with that of the mean cell.
    pub(crate) with_capacity: bool,
    /// Whether the model was learned; if not it is the label's, and nothing is known of the capacity.
    pub(crate) is_learned: bool,
}

impl ModellingState {
    /// What is known when the rows before do not continue: after a restart, or of a pack that is not connected.
    pub(crate) fn restart(&mut self) {
        (self.rest_since, self.fit_since, self.has_row) = (None, None, false);
    }

    /// Checks the numbers of a stored state.
    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        self.notebook.check()?;
        self.own.iter().chain(&self.before).try_for_each(OwnModel::check)?;
        let (count, most) = (self.changes.len(), MAX_CHANGES);
        InvalidState::unless(count <= most, "the changes of the model", count as f64, "at most 16")
    }

    /// What is known of cells with this label; `None` = of a model file.
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
            own: own.as_ref(),
            notebook: label.map(|_| notebook),
            chemistry: *chemistry,
            fits: *fits,
            taken_back: *taken_back,
            changes,
        }
    }

    /// What a stored state says; the label is that with which it was learned, else `label`. `None` without either.
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
            model: config.model.clone(),
            estimator: config.estimator,
            notebook: NotebookConfig::new(config.own_cells(), rated_ah),
            state: ModellingState::default(),
            is_offered: false,
            given: None,
            outcome: FitOutcome::Nothing,
        }
    }

    /// Other settings for the same cells.
    pub(crate) fn reconfigure(&mut self, config: &MonitorConfig) {
        (self.model, self.estimator) = (config.model.clone(), config.estimator);
    }

    /// Forgets what was learned: another pack is connected.
    pub(crate) fn forget(&mut self) {
        self.state = ModellingState::default();
    }

    /// Continues from a stored state. What was learned with another label is forgotten, its rows are not.
    pub(crate) fn restore(&mut self, state: ModellingState) {
        let Some(label) = &self.label else { return };
        self.state = if state.fits_label(label) {
            state
        } else {
            ModellingState { notebook: state.notebook.all_unread(), ..ModellingState::default() }
        };
    }

    /// The model and settings in force.
    pub(crate) fn in_force(&self) -> (CellModel, EstimatorConfig) {
        let own = self.label.as_ref().zip(self.state.own.as_ref());
        let learned = own.and_then(|(label, own)| {
            let model = own.cell_model(label)?;
            let estimator = own.estimator_config(&self.estimator, &self.model, &model);
            Some((model, estimator))
        });
        learned.unwrap_or_else(|| (self.model.clone(), self.estimator))
    }

    /// Notes a cell's step.
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

    /// Ends a row, at the mean SOC of the cells.
    pub(crate) fn close_row(&mut self, soc: f64) {
        self.state.has_row = false;
        self.state.notebook.close_row(&self.notebook, soc);
    }

    /// Takes the pack's mode; whether a fit ends: [`Self::refit`] is due.
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

    /// The fit under way, once: for a host that runs it beside the monitor.
    pub(crate) fn take_task(&mut self) -> Option<FitTask> {
        let is_new = std::mem::take(&mut self.is_offered) && self.state.fit_since.is_some();
        is_new.then(|| self.task()).flatten()
    }

    /// Takes the findings of a task. They change nothing but who computes them.
    pub(crate) fn give(&mut self, task: FitTask, findings: FitFindings) {
        self.given = Some((task, findings));
    }

    fn task(&self) -> Option<FitTask> {
        let ModellingState { notebook, own, before, .. } = &self.state;
        Some(FitTask::new(self.label?, notebook, own.as_ref(), before.as_ref()))
    }

    /// Whether half-cycles teach the capacity: while the model is the label's, its errors would be taken for lost capacity.
    pub(crate) fn teaches_capacity(&self) -> bool {
        self.label.is_none() || self.state.own.is_some()
    }

    /// Whether enough is new for another fit.
    pub(crate) fn is_due(&self) -> bool {
        let ModellingState { notebook, own, chemistry, .. } = &self.state;
        let is_settled = own.as_ref().is_some_and(OwnModel::is_settled) && chemistry.is_none();
        self.label.is_some()
            && notebook.unread() >= LEAST_NEW_ROWS
            && notebook.new_charge_ah() >= LEAST_NEW_CHARGE * self.notebook.rated_ah
            && (!is_settled || notebook.rows_of_new_classes(self.notebook.rated_ah) >= LEAST_NEW_ROWS)
    }

    /// Fits a model to all rows, after those in force were judged on the new ones. `None` = none is to be adopted.
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
        // The flat curve of LFP is hidden by its hysteresis, which no row's error holds.
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

    /// Returns to the label's model from one that is not settled: the rows contradict it. `None` = it is in force.
    fn return_to_label(&mut self) -> Option<Adoption> {
        self.state.own.take_if(|own| !own.is_settled())?;
        self.state.before = None;
        self.state.taken_back = self.state.taken_back.saturating_add(1);
        self.outcome = FitOutcome::Returned;
        Some(self.label_adoption())
    }

    /// The label's model, of whose capacity nothing is known.
    fn label_adoption(&self) -> Adoption {
        let InitialState { capacity_ah, capacity_std_ah, .. } = self.estimator.initial;
        let capacity = ScalarGaussian::from_std(capacity_ah, capacity_std_ah);
        let mean = AdoptedState { soc: None, soc_by_capacity: 0.0, capacity, log_resistance: 0.0, filtered_a: None };
        let (model, config) = (self.model.clone(), self.estimator);
        Adoption { model, config, mean, with_capacity: true, is_learned: false }
    }

    /// Whether the latest fit ended with the model before.
    pub(crate) fn has_returned(&self) -> bool {
        self.outcome == FitOutcome::Returned
    }

    /// The state, to be stored; `None` = nothing is learned here.
    pub(crate) fn stored(&self) -> Option<ModellingState> {
        self.label.map(|_| self.state.clone())
    }

    /// Notes what the latest fit has changed, as the event it is; `None` when nothing has. `before` is the state before it.
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

    /// What is known.
    pub(crate) fn view(&self) -> ModelView<'_> {
        self.state.view(self.label)
    }

    /// What follows does not hang together with the rows so far.
    pub(crate) fn end_stretch(&mut self) {
        (self.state.rest_since, self.state.fit_since) = (None, None);
        if self.label.is_some() {
            self.state.notebook.end_stretch(&self.notebook);
        }
    }
}
