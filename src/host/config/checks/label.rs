//! The cell of `[pack]`: a model file, or a chemistry with what is on the label.
//!
//! In: the keys of `[pack]`. Out: the model of a cell without a file; faults where keys are missing or do not fit together.

use crate::cell::Label;
use crate::config::cell_model::{SourcedModel, of_label};
use crate::config::document::Faults;
use crate::config::schema::RawTables;
use crate::config::schema::keys::Pack;

/// What is on the label, where no file is named and nothing is missing.
pub(crate) fn label(pack: &Pack) -> Option<Label> {
    let (chemistry, rated_ah) = (pack.chemistry.filter(|_| pack.cell_model.is_none())?, pack.rated_capacity_ah?);
    let usual = Label::usual(chemistry, rated_ah);
    Some(Label {
        voltage_min_v: pack.voltage_min_v.unwrap_or(usual.voltage_min_v),
        voltage_max_v: pack.voltage_max_v.unwrap_or(usual.voltage_max_v),
        ..usual
    })
}

/// The model by `chemistry`, where no file is named.
pub(crate) fn model(raw: &RawTables, faults: &mut Faults) -> Option<SourcedModel> {
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

/// Notes keys of a label beside a model file, which has them.
pub(crate) fn check(pack: &Pack, faults: &mut Faults) {
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
