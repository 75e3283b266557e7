//! Files that describe signals: read, and named in a configuration.

use std::path::Path;

use packwatch_host::failure::Failure;

use super::output::named;
use crate::can::dbc::Database;

/// Largest file read; the largest known signal set has 0.5 MB.
const MAX_BYTES: u64 = 64 << 20;

/// A DBC file, read.
pub(crate) fn database(file: &Path) -> Result<Database, Failure> {
    let bytes = std::fs::read(file).map_err(|error| unreadable(file, &error))?;
    Database::parse_bytes(&bytes).map_err(|error| named(file, error))
}

/// The text of a file of reasonable size.
pub(crate) fn read(file: &Path) -> Result<String, Failure> {
    let bytes = std::fs::metadata(file).map_err(|error| unreadable(file, &error))?.len();
    if bytes > MAX_BYTES {
        return Err(named(file, format!("has {bytes} bytes, must be at most {MAX_BYTES}")));
    }
    std::fs::read_to_string(file).map_err(|error| unreadable(file, &error))
}

fn unreadable(file: &Path, error: &std::io::Error) -> Failure {
    named(file, format!("cannot be read: {error}"))
}

/// A file as a configuration beside it names it: by its name in the same folder, otherwise by its whole path.
pub(crate) fn named_from(config: &Path, file: &Path) -> Result<String, Failure> {
    let whole = |path: &Path| std::path::absolute(path).map_err(|error| named(path, error));
    let (config, file) = (whole(config)?, whole(file)?);
    let name = config.parent().and_then(|folder| file.strip_prefix(folder).ok()).unwrap_or(&file);
    Ok(name.display().to_string())
}
