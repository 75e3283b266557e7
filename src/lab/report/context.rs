//! Title, configuration, reference and provenance of a page.

use super::reference::Reference;
use crate::cell_faults::{CellFaultDetector, Imbalance, UnknownImbalance};
use crate::config::Config;
use crate::config::cell_model::SourcedModel;
use crate::quantity::CellIndex;

/// Content of a page in addition to the data.
#[derive(Debug, Default)]
pub struct PageContext<'a> {
    /// Title of the page.
    pub title: String,
    /// Thresholds, rated capacity; `None` = not known.
    pub config: Option<&'a Config>,
    /// The configuration file's text, for the page's end.
    pub config_text: Option<String>,
    /// The cells' model, as it was at the end of the data; `None` = not known.
    pub model: Option<SourcedModel>,
    /// What is found of single cells; `None` = they were not compared.
    pub diagnosis: Option<&'a CellFaultDetector>,
    /// What the differences between the cells cost the pack; `None` = they were not compared.
    pub imbalance: Option<Result<Imbalance, UnknownImbalance>>,
    /// Measured or true values.
    pub reference: Reference,
    /// Lines of the provenance: name and value.
    pub provenance: Vec<(String, String)>,
}

impl PageContext<'_> {
    /// Rated capacity of a cell, Ah; `None` = without a configuration.
    pub(super) fn rated_ah(&self, cell: usize) -> Option<f64> {
        let cell = CellIndex(u16::try_from(cell).ok()?);
        self.config.map(|config| config.monitor.model_of(cell).rated_capacity_ah)
    }
}
