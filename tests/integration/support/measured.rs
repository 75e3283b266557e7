//! Measured data, where they are: the folder that `PACKWATCH_DATA` names, else that beside the project.

use std::path::{Path, PathBuf};

/// The folder, whether it is there or not.
pub(crate) fn root() -> PathBuf {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("PACKWATCH_DATA").map_or_else(beside, PathBuf::from)
}

/// A file of it; `None`, said on the output, where it is not.
#[expect(clippy::print_stdout, reason = "a skipped test says so")]
pub(crate) fn file(name: &str) -> Option<PathBuf> {
    let path = root().join(name);
    let is_there = path.is_file();
    if !is_there {
        println!("SKIPPED: no measured data {}", path.display());
    }
    is_there.then_some(path)
}
