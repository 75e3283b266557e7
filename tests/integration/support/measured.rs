//! Measured data: the folder that `PACKWATCH_DATA` names, or the one next to the project.
//!
//! A test that needs them is ignored without `cfg(measured_data)`, which the build script sets.

use std::path::{Path, PathBuf};

/// The folder.
pub(crate) fn root() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("PACKWATCH_DATA").map_or_else(default, PathBuf::from)
}

/// A file or folder of it.
pub(crate) fn path(name: &str) -> PathBuf {
    root().join(name)
}
