//! Holds the inputs of a page in addition to the data: title, configuration, reference and provenance.

use super::reference::Reference;
use crate::cell_faults::{CellFaultDetector, Imbalance, UnknownImbalance};
use crate::config::Config;
use crate::config::cell_model::SourcedModel;
use crate::health::UseRecord;
use crate::quantity::CellIndex;

/// Inputs of a page in addition to the data.
#[derive(Debug, Default)]
pub struct PageContext<'a> {
    /// Title shown on the page.
    pub title: String,
    /// Configuration with thresholds and rated capacity; `None` = unknown.
    pub config: Option<&'a Config>,
    /// Text of the configuration file, shown at the end of the page.
    pub config_text: Option<String>,
    /// Model of the cells at the end of the data; `None` = unknown.
    pub model: Option<SourcedModel>,
    /// Findings about single cells; `None` = the cells were not compared.
    pub diagnosis: Option<&'a CellFaultDetector>,
    /// Charge lost because the cells differ; `None` = the cells were not compared.
    pub imbalance: Option<Result<Imbalance, UnknownImbalance>>,
    /// How the pack was used; `None` = unknown.
    pub use_record: Option<UseRecord>,
    /// Measured or true values.
    pub reference: Reference,
    /// Lines of the provenance, each with name and value.
    pub provenance: Vec<(String, String)>,
}

impl PageContext<'_> {
    /// Returns the rated capacity of a cell (Ah); `None` = no configuration.
    pub(super) fn rated_ah(&self, cell: usize) -> Option<f64> {
        let cell = CellIndex(u16::try_from(cell).ok()?);
        self.config.map(|config| config.monitor.model_of(cell).rated_capacity_ah)
    }
}
