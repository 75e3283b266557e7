//! Reads files that describe signals, and gives the names of such files for use in a configuration.

use std::path::Path;

use packwatch_host::bounded_file;
use packwatch_host::failure::Failure;

use super::output::{named, note};
use crate::can::dbc::{Database, DbcError};

/// Reads a DBC file. Prints a warning for each message that is left out.
pub(crate) fn database(file: &Path) -> Result<Database, Failure> {
    let bytes = bounded_file::read(file).map_err(|error| unreadable(file, &error))?;
    let at = |fault: &DbcError| format!("{}:{}", file.display(), fault.line);
    let database =
        Database::parse_bytes(&bytes).map_err(|fault| Failure::new(format!("{}: {}", at(&fault), fault.what)))?;
    for fault in &database.left_out {
        note(format_args!("{}: warning: {}", at(fault), fault.what));
    }
    Ok(database)
}

pub(crate) fn read(file: &Path) -> Result<String, Failure> {
    bounded_file::read_text(file).map_err(|error| unreadable(file, &error))
}

fn unreadable(file: &Path, error: &std::io::Error) -> Failure {
    named(file, format!("cannot be read: {error}"))
}

/// Returns the name of a file as a configuration should write it. If the file is in the folder of the configuration or
/// below, the name is relative to this folder. Otherwise, it is the full path.
pub(crate) fn named_from(config: &Path, file: &Path) -> Result<String, Failure> {
    let whole = |path: &Path| std::path::absolute(path).map_err(|error| named(path, error));
    let (config, file) = (whole(config)?, whole(file)?);
    let name = config.parent().and_then(|folder| file.strip_prefix(folder).ok()).unwrap_or(&file);
    Ok(name.display().to_string())
}
