//! Measured data: the folder named by `PACKWATCH_DATA`, or the folder next to the project.
//!
//! Tests that need measured data are ignored without `cfg(measured_data)`, which the build script sets.

use std::path::{Path, PathBuf};

/// The folder with measured data.
pub(crate) fn root() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("PACKWATCH_DATA").map_or_else(default, PathBuf::from)
}

/// A file or folder of the measured data.
pub(crate) fn path(name: &str) -> PathBuf {
    root().join(name)
}
