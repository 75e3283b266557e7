//! Paths of the measured data: the folder `PACKWATCH_DATA`, or else `../shared/data` next to the project.

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
