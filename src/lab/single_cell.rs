//! Creates the configuration of a single measured cell, from a given file or from the built-in configuration.
//!
//! Another model file can replace the cell model. In the built-in configuration, a label (chemistry, rated capacity,
//! voltage limits) can also replace the cell model. The built-in configuration has the input signals of `measured.dbc`
//! and the default estimator keys.

use std::path::{Path, PathBuf};

use crate::config::{self, Config, ConfigFaults, ConfigFiles};
use packwatch_host::bounded_file;

const BUILT_IN: [(&str, &[u8]); 2] =
    [("score.toml", include_bytes!("score.toml")), ("measured.dbc", include_bytes!("measured.dbc"))];

/// Data on the label of a cell, as in the keys of `[pack]`.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelKeys {
    /// Name of the chemistry.
    pub chemistry: String,
    /// Rated capacity (Ah). Loading fails without it.
    pub rated_ah: Option<f64>,
    /// Lowest voltage (V); `None` = typical for the chemistry.
    pub voltage_min_v: Option<f64>,
    /// Highest voltage (V); `None` = typical for the chemistry.
    pub voltage_max_v: Option<f64>,
}

/// Source of a cell's configuration. If there is a label, `config` and `cell` are ignored. Otherwise, `cell` replaces
/// the cell model that the configuration names.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CellSource {
    /// Configuration file; `None` = the built-in configuration.
    pub config: Option<PathBuf>,
    /// Cell model file.
    pub cell: Option<PathBuf>,
    /// Label that replaces the cell model of the built-in configuration.
    pub label: Option<LabelKeys>,
}

impl CellSource {
    /// Loads the configuration.
    ///
    /// # Errors
    /// The files are faulty, or no cell of this chemistry has the given voltages. The error contains all faults.
    pub fn load(&self) -> Result<Config, ConfigFaults> {
        if let Some(label) = &self.label {
            return label.configuration();
        }
        let built_in = self.config.is_none();
        let path = self.config.clone().unwrap_or_else(|| PathBuf::from(BUILT_IN[0].0));
        let Some(cell) = &self.cell else { return config::load(&path) };
        // The model is first loaded alone, so that its errors are reported with its own file name.
        config::cell_model::load(cell)?;
        let read = |file: &Path| {
            let known = BUILT_IN.iter().find(|(name, _)| built_in && Path::new(name) == file);
            known.map_or_else(|| bounded_file::read(file), |(_, bytes)| Ok(bytes.to_vec()))
        };
        let files = if built_in { ConfigFiles::alone(&path) } else { ConfigFiles::find(&path)? };
        let named = named_cell(&files, &read)?;
        let read = |file: &Path| if file == named { bounded_file::read(cell) } else { read(file) };
        config::load_with(&files, &read)
    }
}

impl LabelKeys {
    /// Returns the built-in configuration, with this label in place of the cell model.
    ///
    /// # Errors
    /// No cell of this chemistry has these voltages, or the capacity is missing.
    pub fn configuration(&self) -> Result<Config, ConfigFaults> {
        let keys = self.text();
        let read = |file: &Path| {
            let known = BUILT_IN.iter().find(|(name, _)| Path::new(name) == file);
            let (name, bytes) = known.ok_or(std::io::ErrorKind::NotFound)?;
            if *name != BUILT_IN[0].0 {
                return Ok(bytes.to_vec());
            }
            let with_label =
                |line: &str| if line.starts_with("cell_model") { keys.clone() } else { format!("{line}\n") };
            Ok(String::from_utf8_lossy(bytes).lines().map(with_label).collect::<String>().into_bytes())
        };
        config::load_with(&ConfigFiles::alone(Path::new(BUILT_IN[0].0)), &read)
    }

    fn text(&self) -> String {
        let mut text = format!("chemistry = {}\n", toml::Value::from(self.chemistry.as_str()));
        let numbers = [
            ("rated_capacity_ah", self.rated_ah),
            ("voltage_min_v", self.voltage_min_v),
            ("voltage_max_v", self.voltage_max_v),
        ];
        for (key, value) in numbers {
            value.iter().for_each(|value| text.push_str(&format!("{key} = {value:?}\n")));
        }
        text
    }
}

fn named_cell(files: &ConfigFiles, read: config::ReadFile<'_>) -> Result<PathBuf, ConfigFaults> {
    let text = config::merged_with(files, read)?;
    let named = text.parse::<toml::Table>().ok().and_then(|table| {
        let model = table.get("pack")?.get("cell_model")?.as_str()?.to_owned();
        Some(files.main.parent().unwrap_or(Path::new("")).join(model))
    });
    // If the configuration names no model, the empty path is returned and replaces nothing. Loading then reports that
    // the model is missing, unless the configuration has a chemistry.
    Ok(named.unwrap_or_default())
}
