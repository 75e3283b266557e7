//! Selects the cell model of a replayed or stored state: the model learned on board, else the configured model.

use packwatch_host::failure::Failure;

use super::output::failure;
use crate::config::cell_model::SourcedModel;
use crate::config::{self, Config};
use crate::monitor::Snapshot;

/// Returns the learned model of `snapshot` or, if none was learned, the configured model.
pub(crate) fn cell_model(
    snapshot: Option<&Snapshot>,
    config: Option<&Config>,
) -> Result<Option<SourcedModel>, Failure> {
    let label = config.and_then(|config| config.monitor.label);
    let view = snapshot.map(|snapshot| snapshot.model(label)).transpose().map_err(failure)?.flatten();
    let configured = || {
        let config = config?;
        Some(SourcedModel { model: config.monitor.model.clone(), source: config.model_source.clone() })
    };
    Ok(view.as_ref().and_then(config::of_view).or_else(configured))
}
