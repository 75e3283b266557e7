//! Loads a configuration from texts: `pack.toml` and `pack.dbc` as given, other files (cell models) as shipped.

use std::path::Path;

use packwatch::config::{self, Config, ConfigFiles};

/// Loads the configuration. If it is faulty, panics with all its faults.
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
