//! The cell of `[pack]`: a model file, or a chemistry with what is on the label.
//!
//! In: the keys of `[pack]`. Out: the model of a cell without a file; faults where keys are missing or do not fit together.

use super::cell_model::{LearnedFrom, MeasuredRange, ModelSource, SourcedModel};
use super::document::Faults;
use super::keys::Pack;
use super::tables::RawTables;
use crate::cell::{Coverage, Label};
use crate::monitor::{ModelState, ModelView};

/// What is on the label, where no file is named and nothing is missing.
pub(super) fn label(pack: &Pack) -> Option<Label> {
    let (chemistry, rated_ah) = (pack.chemistry.filter(|_| pack.cell_model.is_none())?, pack.rated_capacity_ah?);
    let usual = Label::usual(chemistry, rated_ah);
    Some(Label {
        voltage_min_v: pack.voltage_min_v.unwrap_or(usual.voltage_min_v),
        voltage_max_v: pack.voltage_max_v.unwrap_or(usual.voltage_max_v),
        ..usual
    })
}

/// The model by `chemistry`, where no file is named.
pub(super) fn model(raw: &RawTables, faults: &mut Faults) -> Option<SourcedModel> {
    let pack = raw.pack.as_ref()?;
    let Some(chemistry) = pack.chemistry else {
        pack.place.fault(
            faults,
            "cell_model",
            "must be a cell model file; or chemistry and rated_capacity_ah must be given",
        );
        return None;
    };
    let Some(label) = label(pack) else {
        pack.place.fault(faults, "chemistry", "needs rated_capacity_ah, the capacity on the label of one cell");
        return None;
    };
    let usual = Label::usual(chemistry, label.rated_ah);
    let model = of_label(&label);
    if model.is_none() {
        let Label { voltage_min_v, voltage_max_v, .. } = label;
        let (low, high) = (usual.voltage_min_v, usual.voltage_max_v);
        let what = format!(
            "no cell of {} is empty at {voltage_min_v} V and full at {voltage_max_v} V; usual are {low} and {high} V",
            chemistry.name()
        );
        pack.place.fault(faults, "chemistry", &what);
    }
    model
}

/// The model of a cell of which only the label is known; `None` = no cell of this chemistry has these voltages.
pub fn of_label(label: &Label) -> Option<SourcedModel> {
    let source = ModelSource {
        state: ModelState::Prior,
        chemistry: Some(label.chemistry.name().to_owned()),
        measured: MeasuredRange::default(),
        provenance: toml::Table::new(),
        learned: None,
    };
    label.model().map(|model| SourcedModel { model, source })
}

/// The model in force of a pack that learns it; `None` = it is of a model file.
pub fn of_view(view: &ModelView<'_>) -> Option<SourcedModel> {
    let label = view.label?;
    let SourcedModel { model: prior, source } = of_label(&label)?;
    let learned = LearnedFrom {
        seen: Coverage::of_rows(view.notebook.map_or(&[], |notebook| notebook.rows())),
        residual_v: view.own.map(|own| own.residual_v),
        chemistry: view.chemistry,
        fits: view.fits,
        changes: view.changes.to_vec(),
        prior: Box::new(prior.clone()),
    };
    let own = view.own.and_then(|own| Some(own.cell_model(&label)?.rebased(own.capacity.mean)));
    let origin = match &own {
        Some(_) => "learned on board from what the vehicle has noted of its own cells, starting from the label",
        None => "chemistry prior of the label",
    };
    let provenance = toml::Table::from_iter([("source".to_owned(), origin.into())]);
    let measured = own.as_ref().map_or_else(MeasuredRange::default, |_| seen_range(&learned.seen));
    let source = ModelSource { state: view.state, provenance, measured, learned: Some(learned), ..source };
    Some(SourcedModel { model: own.unwrap_or(prior), source })
}

/// From the lowest to the highest that was seen.
fn seen_range(seen: &Coverage) -> MeasuredRange {
    let whole = |ranges: Vec<[f64; 2]>| Some([ranges.first()?[0], ranges.last()?[1]]);
    MeasuredRange {
        temperature_c: whole(seen.temperature_ranges_c()),
        soc: whole(seen.soc_ranges()),
        ..MeasuredRange::default()
    }
}

/// Notes keys of a label beside a model file, which has them.
pub(super) fn check(pack: &Pack, faults: &mut Faults) {
    if pack.cell_model.is_none() {
        return;
    }
    let given = [
        ("chemistry", pack.chemistry.is_some()),
        ("voltage_min_v", pack.voltage_min_v.is_some()),
        ("voltage_max_v", pack.voltage_max_v.is_some()),
    ];
    for (key, _) in given.into_iter().filter(|(_, is_given)| *is_given) {
        pack.place.fault(faults, key, "must not be given together with cell_model, which states it");
    }
}
