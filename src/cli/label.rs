//! A cell by what is on its label, on the command line.

#[cfg(feature = "lab")]
use std::path::Path;

#[cfg(feature = "lab")]
use super::Failure;
use super::numbers::above_0;
use crate::cell::{Chemistry, Label};
#[cfg(feature = "lab")]
use crate::config::{self, Config, ConfigFaults, ConfigFiles};

/// The configuration used when none is given, and what it names; the cell model comes from the command line.
#[cfg(feature = "lab")]
pub(crate) const BUILT_IN: [(&str, &[u8]); 2] = [
    ("score.toml", include_bytes!("../../config/score.toml")),
    ("measured.dbc", include_bytes!("../../config/measured.dbc")),
];

/// A cell without a model.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Label, instead of a cell model")]
pub(crate) struct LabelArgs {
    /// Chemistry on the label, as in [pack] chemistry
    #[arg(long, value_parser = one_of_chemistries(), requires = "rated", conflicts_with = "config")]
    pub(crate) chemistry: Option<String>,
    /// Capacity on the label, Ah
    #[arg(long, value_name = "AH", value_parser = above_0, requires = "chemistry")]
    pub(crate) rated: Option<f64>,
    /// Lowest voltage [default: usual of the chemistry]
    #[arg(long, value_name = "V", value_parser = above_0, requires = "chemistry")]
    pub(crate) voltage_min: Option<f64>,
    /// Highest voltage [default: usual of the chemistry]
    #[arg(long, value_name = "V", value_parser = above_0, requires = "chemistry")]
    pub(crate) voltage_max: Option<f64>,
}

impl LabelArgs {
    /// The label; `None` without a chemistry.
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
    /// The built-in configuration of one measured cell with this label; `None` without a chemistry.
    ///
    /// # Errors
    /// When no cell of this chemistry has these voltages.
    pub(crate) fn configuration(&self) -> Result<Option<Config>, Failure> {
        Ok(self.keys().map(|keys| of_label(&keys)).transpose()?)
    }

    /// The keys of [pack] that they stand for; `None` without a chemistry.
    fn keys(&self) -> Option<String> {
        let mut text = format!("chemistry = \"{}\"\n", self.chemistry.as_ref()?);
        let numbers = [
            ("rated_capacity_ah", self.rated),
            ("voltage_min_v", self.voltage_min),
            ("voltage_max_v", self.voltage_max),
        ];
        for (key, value) in numbers {
            value.iter().for_each(|value| text.push_str(&format!("{key} = {value:?}\n")));
        }
        Some(text)
    }
}

/// The names of chemistries.
pub(crate) fn one_of_chemistries() -> clap::builder::PossibleValuesParser {
    Chemistry::ALL.map(|(_, name)| name).into()
}

/// The built-in configuration with the keys of a label in place of the cell model.
#[cfg(feature = "lab")]
fn of_label(keys: &str) -> Result<Config, ConfigFaults> {
    let read = |file: &Path| {
        let known = BUILT_IN.iter().find(|(name, _)| Path::new(name) == file);
        let (name, bytes) = known.ok_or(std::io::ErrorKind::NotFound)?;
        if *name != BUILT_IN[0].0 {
            return Ok(bytes.to_vec());
        }
        let with_label =
            |line: &str| if line.starts_with("cell_model") { keys.to_owned() } else { format!("{line}\n") };
        Ok(String::from_utf8_lossy(bytes).lines().map(with_label).collect::<String>().into_bytes())
    };
    config::load_with(&ConfigFiles::alone(Path::new(BUILT_IN[0].0)), &read)
}
