//! Loads a configuration from texts of `pack.toml` and `pack.dbc`, with the shipped cell models.

use std::path::Path;

use packwatch::config::{self, Config, ConfigFiles};

/// Loads the configuration. Panics with all its faults.
pub(crate) fn load(pack: &str, dbc: &str) -> Config {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let read = |path: &Path| match path.to_str() {
        Some("pack.toml") => Ok(pack.as_bytes().to_vec()),
        Some("pack.dbc") => Ok(dbc.as_bytes().to_vec()),
        _ => std::fs::read(shipped.join(path)),
    };
    let files = ConfigFiles::alone(Path::new("pack.toml"));
    config::load_with(&files, &read).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")))
}
