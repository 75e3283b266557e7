//! Output shared by the offline commands: tables, JSON documents, progress bars, result folders, failures.
//!
//! Tables and documents go to the writer given or to standard output, progress to standard error when that is a terminal.
//! A reader that closes standard output early (`| head`) is no failure.

use std::fmt::Display;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use super::Failure;

/// A failure of the work with this error's text.
pub(crate) fn failure(error: impl Display) -> Failure {
    Failure::new(error.to_string())
}

/// Ignores that the output was closed.
pub(crate) fn unless_closed(written: io::Result<()>) -> Result<(), Failure> {
    match written {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.map_err(failure),
    }
}

/// Writes to standard output.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let written = io::stdout().write_all(text.as_bytes());
    unless_closed(written)
        .map_err(|failure| Failure::new(format!("standard output cannot be written: {}", failure.message)))
}

/// A value of an enumeration, as in JSON.
pub(crate) fn word(value: impl serde::Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(word)) => word,
        _ => "?".to_owned(),
    }
}

/// Writes one JSON document to standard output.
pub(crate) fn print_json(document: &impl Serialize) -> io::Result<()> {
    let mut out = io::stdout().lock();
    serde_json::to_writer_pretty(&mut out, document)?;
    writeln!(out)
}

/// Columns as wide as their widest entry: the first `left` are aligned to the left, the others to the right.
pub(crate) fn table<H: AsRef<str>>(heads: &[H], rows: impl IntoIterator<Item = Vec<String>>, left: usize) -> String {
    let heads: Vec<String> = heads.iter().map(|head| head.as_ref().to_owned()).collect();
    let rows: Vec<Vec<String>> = Some(heads).filter(|heads| !heads.is_empty()).into_iter().chain(rows).collect();
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let entry = |row: &[String], column: usize| row.get(column).cloned().unwrap_or_default();
    let widths: Vec<usize> =
        (0..columns).map(|c| rows.iter().map(|row| entry(row, c).chars().count()).max().unwrap_or(0)).collect();
    let line = |row: &Vec<String>| {
        let cells = widths.iter().enumerate().map(|(column, &width)| {
            let text = entry(row, column);
            if column < left { format!("{text:<width$}") } else { format!("{text:>width$}") }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

/// Writes such a [`table`].
pub(crate) fn write_table<H: AsRef<str>>(
    out: &mut impl Write,
    heads: &[H],
    rows: impl IntoIterator<Item = Vec<String>>,
    left: usize,
) -> io::Result<()> {
    out.write_all(table(heads, rows, left).as_bytes())
}

/// A progress bar over `total` units, if they are known.
pub(crate) fn progress_bar(total: impl Into<Option<u64>>, template: &str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(total.into(), ProgressDrawTarget::stderr_with_hz(5));
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Creates a folder for results.
pub(crate) fn create_folder(folder: &Path) -> Result<(), Failure> {
    let created = std::fs::create_dir_all(folder);
    created.map_err(|error| Failure::new(format!("{}: cannot be created: {error}", folder.display())))
}

/// Rejects a file that is named twice.
pub(crate) fn check_distinct(files: &[PathBuf]) -> Result<(), Failure> {
    match files.iter().enumerate().find(|(index, file)| files[..*index].contains(file)) {
        Some((_, file)) => Err(Failure::new(format!("{}: named twice", file.display()))),
        None => Ok(()),
    }
}

/// Short names that distinguish the files: folder and name without endings, the whole path where two are the same.
pub(crate) fn short_names(files: &[PathBuf]) -> Vec<String> {
    let short = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name = name.split('.').next().unwrap_or_default().to_owned();
        let folder = path.parent().and_then(Path::file_name).map(|folder| folder.to_string_lossy().into_owned());
        folder.map_or(name.clone(), |folder| format!("{folder}/{name}"))
    };
    let all: Vec<String> = files.iter().map(short).collect();
    let is_twice = |name: &String| all.iter().filter(|other| *other == name).count() > 1;
    let full =
        |(name, path): (&String, &PathBuf)| if is_twice(name) { path.display().to_string() } else { name.clone() };
    all.iter().zip(files).map(full).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_distinguish_files() {
        let files = ["a/25C/x.csv.gz", "a/10C/x.csv.gz", "b/10C/x.csv", "y.csv"].map(PathBuf::from);
        assert_eq!(short_names(&files), ["25C/x", "a/10C/x.csv.gz", "b/10C/x.csv", "y"]);
    }
}
