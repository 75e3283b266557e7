//! Arguments that describe a cell by the data on its label.

use super::numbers::above_0;
use crate::cell::{Chemistry, Label};
#[cfg(feature = "lab")]
use crate::lab::single_cell::LabelKeys;

/// A cell without a model file.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Cell label (instead of a cell model)")]
pub(crate) struct LabelArgs {
    /// Chemistry on the label, as in `pack.chemistry`
    #[arg(long, value_parser = one_of_chemistries(), requires = "rated", conflicts_with = "config")]
    pub(crate) chemistry: Option<String>,
    /// Capacity on the label (Ah)
    #[arg(long, value_name = "AH", value_parser = above_0, requires = "chemistry")]
    pub(crate) rated: Option<f64>,
    /// Lowest voltage [default: typical of the chemistry]
    #[arg(long, value_name = "VOLTS", value_parser = above_0, requires = "chemistry")]
    pub(crate) voltage_min: Option<f64>,
    /// Highest voltage [default: typical of the chemistry]
    #[arg(long, value_name = "VOLTS", value_parser = above_0, requires = "chemistry")]
    pub(crate) voltage_max: Option<f64>,
}

impl LabelArgs {
    /// Returns the label; `None` without a chemistry.
    pub(crate) fn label(&self) -> Option<Label> {
        let name = self.chemistry.as_ref()?;
        let (chemistry, _) = Chemistry::ALL.into_iter().find(|(_, known)| known == name)?;
        let usual = Label::usual(chemistry, self.rated?);
        Some(Label {
            voltage_min_v: self.voltage_min.unwrap_or(usual.voltage_min_v),
            voltage_max_v: self.voltage_max.unwrap_or(usual.voltage_max_v),
            ..usual
        })
    }
}

#[cfg(feature = "lab")]
impl LabelArgs {
    /// Returns the keys of `[pack]` with the same meaning; `None` without a chemistry.
    pub(crate) fn keys(&self) -> Option<LabelKeys> {
        Some(LabelKeys {
            chemistry: self.chemistry.clone()?,
            rated_ah: self.rated,
            voltage_min_v: self.voltage_min,
            voltage_max_v: self.voltage_max,
        })
    }
}

pub(crate) fn one_of_chemistries() -> clap::builder::PossibleValuesParser {
    Chemistry::ALL.map(|(_, name)| name).into()
}
