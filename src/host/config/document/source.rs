//! Finds and reads the configuration file and its drop-ins.
//!
//! The drop-ins of `FILE` are the files `FILE.d/*.toml`, sorted by name. In: paths. Out: the texts, the main file
//! first. Positions count the bytes of all texts together, so a position identifies a file and a line.

use std::ffi::OsString;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::faults::{ConfigFaults, Faults, SourceLine};
use crate::bounded_file;
use crate::config::schema::nearest;

/// Largest number of drop-ins of one file. One per table is enough, and a file has about 40 tables.
const MAX_DROP_INS: usize = 100;

/// Reads the bytes of a file. The function reads from disk or, in the demo and in tests, from memory.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> std::io::Result<Vec<u8>>;

/// A configuration file and its drop-ins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigFiles {
    /// The configuration file.
    pub main: PathBuf,
    /// The drop-ins of the configuration file, in merge order.
    pub drop_ins: Vec<PathBuf>,
}

impl ConfigFiles {
    /// Finds the drop-ins of `main`: the files `main.d/*.toml`, sorted by name. Files whose name begins with a dot are
    /// ignored.
    ///
    /// # Errors
    /// Fails if the folder cannot be listed or has too many drop-ins.
    pub fn find(main: &Path) -> Result<Self, ConfigFaults> {
        let folder = drop_in_folder(main);
        let fault = |what: String| ConfigFaults(vec![format!("{}: {what}", folder.display())]);
        let drop_ins = list(&folder).map_err(|error| fault(format!("cannot be listed: {error}")))?;
        if drop_ins.len() > MAX_DROP_INS {
            return Err(fault(format!("contains {} drop-ins, must be at most {MAX_DROP_INS}", drop_ins.len())));
        }
        Ok(Self { main: main.to_owned(), drop_ins })
    }

    /// A configuration file without drop-ins.
    pub fn alone(main: &Path) -> Self {
        Self { main: main.to_owned(), drop_ins: Vec::new() }
    }

    /// All files, in merge order.
    pub fn all(&self) -> impl Iterator<Item = &Path> {
        std::iter::once(&self.main).chain(&self.drop_ins).map(PathBuf::as_path)
    }
}

/// The folder of the drop-ins: `packwatch.toml.d` for `packwatch.toml`.
fn drop_in_folder(main: &Path) -> PathBuf {
    let mut name = OsString::from(main);
    name.push(".d");
    PathBuf::from(name)
}

/// The drop-ins in a folder, sorted by name. Empty if the folder does not exist.
fn list(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error),
    };
    let mut paths = entries.map(|entry| entry.map(|entry| entry.path())).collect::<io::Result<Vec<_>>>()?;
    let is_hidden = |path: &Path| path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "toml") && !is_hidden(path));
    paths.sort();
    Ok(paths)
}

/// The text of one file.
#[derive(Debug)]
pub(crate) struct SourceFile {
    name: String,
    /// Position of the file's first byte in the sequence of all texts.
    start: usize,
    /// The text, preceded by `start` blanks. Positions in this string are therefore positions in the sequence of all
    /// texts.
    placed: String,
    /// Positions of the line breaks, so that a file with many tables is checked in linear time.
    breaks: Vec<usize>,
}

impl SourceFile {
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// The text to parse. Positions in this text are positions in the sequence of all texts.
    pub(crate) fn placed_text(&self) -> &str {
        &self.placed
    }

    /// Line, from 1, on which `span` begins.
    pub(crate) fn line(&self, span: &Range<usize>) -> usize {
        1 + self.breaks.partition_point(|at| *at < span.start)
    }
}

/// The contents of the configuration files (at least one), in merge order.
#[derive(Debug)]
pub(crate) struct Sources {
    files: Vec<SourceFile>,
}

impl Sources {
    /// Reads all files. If a file cannot be read, reports a fault and returns `None`.
    pub(crate) fn read(files: &ConfigFiles, read: ReadFile<'_>, faults: &Faults) -> Option<Self> {
        let text = |path: &Path| Some((path.display().to_string(), read_text(path, read, faults)?));
        // Reads every file before returning, so that each fault is reported.
        let texts: Vec<_> = files.all().map(text).collect();
        Some(Self::new(texts.into_iter().collect::<Option<Vec<_>>>()?))
    }

    fn new(texts: Vec<(String, String)>) -> Self {
        let (mut files, mut start) = (Vec::new(), 0);
        for (name, text) in texts {
            // A byte order mark is valid only at the start of a text, but would follow the blanks in the padded text.
            let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
            let placed = " ".repeat(start) + text;
            let end = placed.len();
            let breaks = placed.match_indices('\n').map(|(at, _)| at).collect();
            files.push(SourceFile { name, start, placed, breaks });
            start = end + 1;
        }
        Self { files }
    }

    pub(crate) fn files(&self) -> &[SourceFile] {
        &self.files
    }

    pub(crate) fn main_file(&self) -> &str {
        self.files.first().map_or("", |file| &file.name)
    }

    /// File and line on which `span` begins.
    pub(crate) fn line(&self, span: &Range<usize>) -> SourceLine {
        match self.at(span) {
            Some(file) => SourceLine { file: file.name.clone(), line: file.line(span) },
            None => SourceLine { file: String::new(), line: 0 },
        }
    }

    /// The source text at `span`.
    pub(crate) fn written(&self, span: &Range<usize>) -> &str {
        self.at(span).and_then(|file| file.placed.get(span.clone())).unwrap_or("")
    }

    fn at(&self, span: &Range<usize>) -> Option<&SourceFile> {
        self.files.iter().rev().find(|file| file.start <= span.start)
    }
}

/// Resolves `named` relative to the folder of `path`.
pub(crate) fn beside(path: &Path, named: &str) -> PathBuf {
    path.parent().unwrap_or(Path::new("")).join(named)
}

/// Returns `, did you mean FILE` if the missing file `named` resembles a file with the same extension. Searches the
/// named folder, the folder of `config`, and the folders directly below that folder.
pub(crate) fn meant_file(config: &Path, named: &str) -> String {
    /// Largest number of folders and of files that are searched.
    const MOST: usize = 1000;
    let folder = beside(config, "");
    let path = beside(config, named);
    let paths = |folder: &Path| {
        let listed = if folder == Path::new("") { Path::new(".") } else { folder };
        let entries = std::fs::read_dir(listed).into_iter().flatten().flatten().take(MOST);
        let mut paths: Vec<PathBuf> = entries.map(|entry| folder.join(entry.file_name())).collect();
        paths.sort();
        paths
    };
    let own = paths(&folder);
    let below = own.iter().filter(|path| path.is_dir()).flat_map(|folder| paths(folder));
    let of_named = path.parent().map(paths).unwrap_or_default();
    // All candidates have the same extension, so only the names before it are compared.
    let name_of = |path: &Path| path.file_stem().and_then(|name| name.to_str()).map(str::to_owned);
    let is_alike = |other: &PathBuf| other.extension() == path.extension() && *other != path && other.is_file();
    let files = of_named.into_iter().chain(own.clone()).chain(below).filter(is_alike).take(MOST);
    let files: Vec<(String, PathBuf)> = files.filter_map(|file| Some((name_of(&file)?, file))).collect();
    let wanted = name_of(&path).unwrap_or_default();
    let Some(name) = nearest(&wanted, files.iter().map(|(name, _)| name.as_str())) else { return String::new() };
    let file =
        files.iter().find(|(other, _)| other == name).map(|(_, file)| file.strip_prefix(&folder).unwrap_or(file));
    file.map_or_else(String::new, |file| format!(", did you mean {}", file.display()))
}

pub(crate) fn read_file(path: &Path) -> std::io::Result<Vec<u8>> {
    bounded_file::read(path)
}

/// The file as UTF-8 text. If it cannot be read or is not UTF-8, reports a fault and returns `None`.
pub(crate) fn read_text(path: &Path, read: ReadFile<'_>, faults: &Faults) -> Option<String> {
    let file = path.display().to_string();
    let bytes = read(path).map_err(|error| faults.add(&file, 0, format!("cannot be read: {error}"))).ok()?;
    match String::from_utf8(bytes) {
        Ok(text) => Some(text),
        Err(error) => {
            let good = error.utf8_error().valid_up_to();
            let line = 1 + error.as_bytes()[..good].iter().filter(|&&b| b == b'\n').count();
            faults.add(&file, line, "is not UTF-8 text, must be a TOML file");
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drop_ins_are_toml_files_sorted_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let main = folder.path().join("pack.toml");
        assert_eq!(ConfigFiles::find(&main), Ok(ConfigFiles::alone(&main)), "no folder, no drop-ins");
        let drop_ins = folder.path().join("pack.toml.d");
        std::fs::create_dir(&drop_ins).expect("created");
        for name in ["20-b.toml", "10-z.toml", "note.txt", ".hidden.toml", "10-a.toml~"] {
            std::fs::write(drop_ins.join(name), "").expect("written");
        }
        let found = ConfigFiles::find(&main).expect("listed");
        assert_eq!(found.drop_ins, ["10-z.toml", "20-b.toml"].map(|name| drop_ins.join(name)));
    }

    #[test]
    fn unlistable_or_overfull_drop_in_folder_is_rejected() {
        let folder = tempfile::tempdir().expect("a folder");
        let main = folder.path().join("pack.toml");
        std::fs::write(folder.path().join("pack.toml.d"), "").expect("written");
        let faults = ConfigFiles::find(&main).expect_err("no folder").0;
        assert!(faults[0].contains("pack.toml.d: cannot be listed: "), "{faults:?}");
        std::fs::remove_file(folder.path().join("pack.toml.d")).expect("removed");
        std::fs::create_dir(folder.path().join("pack.toml.d")).expect("created");
        for number in 0..=MAX_DROP_INS {
            std::fs::write(folder.path().join(format!("pack.toml.d/{number}.toml")), "").expect("written");
        }
        let faults = ConfigFiles::find(&main).expect_err("too many").0;
        assert!(faults[0].ends_with("pack.toml.d: contains 101 drop-ins, must be at most 100"), "{faults:?}");
    }

    #[test]
    fn position_identifies_file_and_line() {
        let texts = [("a", "x = 1\ny = 2\n"), ("b", "\u{feff}"), ("c", "z = 3\n\nw = 4")];
        let sources = Sources::new(texts.map(|(name, text)| (name.to_owned(), text.to_owned())).into());
        for (written, line) in [("y = 2", "a:2"), ("z", "c:1"), ("w = 4", "c:3")] {
            let file = sources.files().iter().find(|file| file.placed.contains(written)).expect("the text exists");
            let start = file.placed.find(written).expect("the text exists");
            let span = start..start + written.len();
            assert_eq!((sources.written(&span), sources.line(&span).to_string()), (written, line.to_owned()));
        }
    }
}
