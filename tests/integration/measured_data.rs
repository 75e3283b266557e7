//! Build script. Sets `cfg(measured_data)` if measured data are present. Otherwise the tests that need them are
//! ignored.
//!
//! `PACKWATCH_DATA` names the data folder; the default is `../shared/data` next to the project.
#![expect(clippy::print_stdout, reason = "Cargo reads the output of a build script")]

use std::path::{Path, PathBuf};

fn main() {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let folder = std::env::var_os("PACKWATCH_DATA").map_or(default, PathBuf::from);
    println!("cargo::rustc-check-cfg=cfg(measured_data)");
    println!("cargo::rerun-if-env-changed=PACKWATCH_DATA");
    println!("cargo::rerun-if-changed={}", folder.display());
    if folder.is_dir() {
        println!("cargo::rustc-cfg=measured_data");
    }
}
