//! The full-screen live view.

use std::path::Path;

/// Runs the view until it is left.
pub(super) fn run(_path: &Path) -> Result<(), String> {
    Err("not built yet".to_owned())
}
