//! Output shared by the commands: tables, JSON documents, result folders, errors.
//!
//! Tables and documents are written to the given writer or to standard output. If the reader closes standard output
//! early (`| head`), the command still succeeds.

pub(crate) use crate::io::event_log::word;

use std::fmt::Display;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::io::paths;
use packwatch_host::failure::Failure;

pub(crate) use crate::io::text_table::printable;
pub(crate) use crate::io::text_table::text_table as table;

/// Makes a general failure from an error.
pub(crate) fn failure(error: impl Display) -> Failure {
    Failure::new(error.to_string())
}

/// Makes a failure about a file or folder.
pub(crate) fn named(path: &Path, what: impl Display) -> Failure {
    Failure::new(format!("{}: {what}", path.display()))
}

/// If the reader has closed the output, treats the error as success.
pub(crate) fn unless_closed(written: io::Result<()>) -> Result<(), Failure> {
    match written {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.map_err(failure),
    }
}

/// Writes a line for the user to standard error.
pub(crate) fn note(text: impl Display) {
    eprintln!("{}", printable(&text.to_string()));
}

/// Writes to standard output, without control characters.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    print_painted(&printable(text))
}

/// Writes to standard output. The text may contain colours, but no control characters from outside.
pub(crate) fn print_painted(text: &str) -> Result<(), Failure> {
    let written = io::stdout().write_all(text.as_bytes());
    unless_closed(written).map_err(|failure| Failure::new(format!("standard output: {}", failure.message)))
}

pub(crate) fn print_json(document: &impl Serialize) -> io::Result<()> {
    let mut out = io::stdout().lock();
    serde_json::to_writer_pretty(&mut out, document)?;
    writeln!(out)
}

pub(crate) fn write_table<H: AsRef<str>>(
    out: &mut impl Write,
    heads: &[H],
    rows: impl IntoIterator<Item = Vec<String>>,
    left: usize,
) -> io::Result<()> {
    out.write_all(table(heads, rows, left).as_bytes())
}

pub(crate) fn create_folder(folder: &Path) -> Result<(), Failure> {
    let created = std::fs::create_dir_all(folder);
    created.map_err(|error| named(folder, format!("cannot be created: {error}")))
}

/// Rejects a file that is named twice.
pub(crate) fn check_distinct(files: &[PathBuf]) -> Result<(), Failure> {
    paths::check_distinct(files).map_err(Failure::new)
}
