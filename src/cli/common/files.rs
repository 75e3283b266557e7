//! Files that describe signals: read, and named in a configuration.

use std::path::Path;

use packwatch_host::failure::Failure;

use crate::can::dbc::Database;

/// Largest file read; the largest known signal set has 0.5 MB.
const MAX_BYTES: u64 = 64 << 20;

/// A DBC file, read.
pub(crate) fn database(file: &Path) -> Result<Database, Failure> {
    let fault = |error: &dyn std::fmt::Display| Failure::new(format!("{}: {error}", file.display()));
    let bytes = std::fs::read(file).map_err(|error| fault(&format!("cannot be read: {error}")))?;
    Database::parse_bytes(&bytes).map_err(|error| fault(&error))
}

/// The text of a file of reasonable size.
pub(crate) fn read(file: &Path) -> Result<String, Failure> {
    let fault = |what: String| Failure::new(format!("{}: {what}", file.display()));
    let bytes = std::fs::metadata(file).map_err(|error| fault(format!("cannot be read: {error}")))?.len();
    if bytes > MAX_BYTES {
        return Err(fault(format!("has {bytes} bytes, must be at most {MAX_BYTES}")));
    }
    std::fs::read_to_string(file).map_err(|error| fault(format!("cannot be read: {error}")))
}

/// A file as a configuration beside it names it: by its name in the same folder, otherwise by its whole path.
pub(crate) fn named_from(config: &Path, file: &Path) -> Result<String, Failure> {
    let whole =
        |path: &Path| std::path::absolute(path).map_err(|error| Failure::new(format!("{}: {error}", path.display())));
    let (config, file) = (whole(config)?, whole(file)?);
    let name = match config.parent() {
        Some(folder) => file.strip_prefix(folder).unwrap_or(&file),
        None => &file,
    };
    Ok(name.display().to_string())
}
