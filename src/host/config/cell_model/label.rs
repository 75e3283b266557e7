//! Makes a cell model from the label of a cell (chemistry, rated capacity, voltages), for cells without a model file.
//! The daemon in the vehicle then improves this model by learning.

use super::source::{LearnedFrom, MeasuredRange, ModelSource, SourcedModel};
use crate::cell::{Coverage, FleetPrior, Label};
use crate::monitor::{ModelState, ModelView};

/// Returns the model made from a cell's label; `None` = the voltages are not plausible for the chemistry.
pub fn of_label(label: &Label) -> Option<SourcedModel> {
    let source = ModelSource {
        state: ModelState::Prior,
        chemistry: Some(label.chemistry.name().to_owned()),
        measured: MeasuredRange::default(),
        provenance: toml::Table::new(),
        learned: None,
        fleet: None,
    };
    label.model().map(|model| SourcedModel { model, source })
}

/// Returns the initial model of a vehicle that starts from a fleet prior (what other vehicles have learned about such
/// cells). `None` = the voltages are not plausible for the chemistry.
pub fn of_fleet(prior: FleetPrior) -> Option<SourcedModel> {
    let SourcedModel { source, .. } = of_label(&prior.label)?;
    let origin = format!("learned by {} other vehicles with cells of this label", prior.vehicles);
    let provenance = toml::Table::from_iter([("source".to_owned(), origin.into())]);
    let model = prior.cell_model()?;
    Some(SourcedModel { model, source: ModelSource { provenance, fleet: Some(Box::new(prior)), ..source } })
}

/// Returns the present model of a pack that learns its model on board; `None` = the pack's model comes from a file.
pub fn of_view(view: &ModelView<'_>) -> Option<SourcedModel> {
    let label = view.label?;
    let SourcedModel { model: prior, source } =
        view.fleet.map_or_else(|| of_label(&label), |fleet| of_fleet(fleet.clone()))?;
    let learned = LearnedFrom {
        seen: Coverage::of_rows(view.notebook.map_or(&[], |notebook| notebook.rows())),
        residual_v: view.own.map(|own| own.residual_v),
        chemistry: view.chemistry,
        fits: view.fits,
        changes: view.changes.to_vec(),
        prior: Box::new(prior.clone()),
    };
    let own = view.own.and_then(|own| Some(own.cell_model(&label)?.rebased(own.capacity.mean)));
    let origin = match (&own, view.fleet) {
        (Some(_), None) => "learned on board from the vehicle's own data, starting from the label",
        (Some(_), Some(_)) => "learned on board from the vehicle's own data, starting from a fleet's prior",
        (None, None) => "chemistry prior of the label",
        (None, Some(_)) => "prior of a fleet",
    };
    let provenance = toml::Table::from_iter([("source".to_owned(), origin.into())]);
    let measured = own.as_ref().map_or_else(MeasuredRange::default, |_| seen_range(&learned.seen));
    let source = ModelSource { state: view.state, provenance, measured, learned: Some(learned), ..source };
    Some(SourcedModel { model: own.unwrap_or(prior), source })
}

/// Returns the lowest and highest temperature and SOC that the data covered; the range of the current is unknown.
fn seen_range(seen: &Coverage) -> MeasuredRange {
    let whole = |ranges: Vec<[f64; 2]>| Some([ranges.first()?[0], ranges.last()?[1]]);
    MeasuredRange {
        temperature_c: whole(seen.temperature_ranges_c()),
        soc: whole(seen.soc_ranges()),
        ..MeasuredRange::default()
    }
}
