//! Writes the merged tables of a configuration as one TOML text for people.

use std::fmt::Write as _;
use std::path::Path;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::faults::{ConfigFaults, Faults};
use super::merge::{Document, is_list_of_tables};
use super::source::{ConfigFiles, ReadFile, Sources, read_file};

/// The configuration file and its drop-ins as one TOML text. A comment after each key and table states its file and
/// line. Keys and values are not checked.
///
/// # Errors
/// Fails if a file cannot be read or is not TOML, and returns every such fault.
pub fn merged(path: &Path) -> Result<String, ConfigFaults> {
    merged_with(&ConfigFiles::find(path)?, &read_file)
}

/// Like [`merged`], but reads files with `read`.
///
/// # Errors
/// Fails if a file cannot be read or is not TOML, and returns every such fault.
pub fn merged_with(files: &ConfigFiles, read: ReadFile<'_>) -> Result<String, ConfigFaults> {
    let faults = Faults::default();
    let sources = Sources::read(files, read, &faults);
    let text = sources.as_ref().map(|sources| text(&Document::parse(sources, &faults)));
    text.filter(|_| faults.is_empty()).ok_or_else(|| faults.lines())
}

/// The merged tables as TOML, in the order of the files. Parsing this text gives the same tables.
fn text(document: &Document<'_>) -> String {
    let mut page = String::new();
    table(document, "", document.root(), &mut page);
    page
}

fn table(document: &Document<'_>, path: &str, table: &DeTable<'_>, page: &mut String) {
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(key, _)| key.span().start);
    // Values are written before tables: after the header of a subtable, values would belong to that subtable.
    let (tables, values): (Vec<_>, Vec<_>) = entries.into_iter().partition(|(_, value)| has_header(document, value));
    for (key, value) in values {
        let (name, text) = (document.written(&key.span()), document.written(&value.span()));
        // Writing to a String cannot fail.
        let _ = writeln!(page, "{name} = {text} # {}", document.line(&key.span()));
    }
    for (key, value) in tables {
        let name = document.written(&key.span());
        let path = if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
        tables_at(document, &path, value, page);
    }
}

/// Writes the table, or the list of tables, at `path`.
fn tables_at(document: &Document<'_>, path: &str, value: &Spanned<DeValue<'_>>, page: &mut String) {
    let (items, header) = match value.get_ref() {
        DeValue::Array(items) => (items.iter().collect(), format!("[[{path}]]")),
        _ => (vec![value], format!("[{path}]")),
    };
    for item in items {
        let DeValue::Table(below) = item.get_ref() else { continue };
        let _ = writeln!(page, "\n{header} # {}", document.line(&item.span()));
        table(document, path, below, page);
    }
}

/// Whether a value is written under a header. This holds for tables and lists of tables that are not inline.
fn has_header(document: &Document<'_>, value: &Spanned<DeValue<'_>>) -> bool {
    (value.get_ref().is_table() || is_list_of_tables(value)) && !is_inline(document, value)
}

/// Whether a single piece of text in one file contains the whole value. This is not the case if the value is a table
/// with a header, or if another file adds keys or elements to the value.
fn is_inline(document: &Document<'_>, value: &Spanned<DeValue<'_>>) -> bool {
    let (span, written) = (value.span(), document.written(&value.span()));
    let is_within = |part: std::ops::Range<usize>| span.start <= part.start && part.end <= span.end;
    match value.get_ref() {
        DeValue::Table(table) => {
            written.starts_with('{')
                && table.iter().all(|(key, below)| is_within(key.span()) && is_inline(document, below))
        }
        DeValue::Array(items) => items.iter().all(|item| is_within(item.span()) && is_inline(document, item)),
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::{Path, PathBuf};

    use crate::config::{ConfigFiles, merged_with};

    /// The merged text of these files; the first is the main file, the others are its drop-ins.
    fn merged(texts: &[(&str, &str)]) -> String {
        let texts: BTreeMap<PathBuf, &str> = texts.iter().map(|(name, text)| (PathBuf::from(name), *text)).collect();
        let mut names = texts.keys().cloned();
        let files = ConfigFiles { main: names.next().expect("a file"), drop_ins: names.collect() };
        let read = |path: &Path| Ok(texts[path].as_bytes().to_vec());
        merged_with(&files, &read).unwrap_or_else(|faults| panic!("{faults:?}"))
    }

    #[test]
    fn tables_merge_keys_replace_lists_append() {
        let page = merged(&[
            ("a", "top = 1\n[pack]\ncells = 4 # as built\nlist = [1, 2]\n[[alarm]]\nrule = \"x\"\n"),
            ("b", "pack.cells = 5\npack.strings = 2\n[[alarm]]\nrule = \"y\"\nwarning = { set = 1,\n clear = 2 }\n"),
            ("c", "[pack]\nlist = [3]\n[new.table]\n\"a key\" = 1\n"),
        ]);
        let expected = "top = 1 # a:1\n\n[pack] # a:2\ncells = 5 # b:1\nstrings = 2 # b:2\nlist = [3] # c:2\n\n\
                        [[alarm]] # a:5\nrule = \"x\" # a:6\n\n[[alarm]] # b:3\nrule = \"y\" # b:4\n\
                        warning = { set = 1,\n clear = 2 } # b:5\n\n[new] # c:3\n\n[new.table] # c:3\n\"a key\" = 1 # c:4\n";
        assert_eq!(page, expected);
    }

    #[test]
    fn empty_list_removes_earlier_tables() {
        let page =
            merged(&[("a", "[[alarm]]\nrule = \"x\"\n"), ("b", "alarm = []\n"), ("c", "[[alarm]]\nrule = \"y\"\n")]);
        assert_eq!(page.parse::<toml::Table>(), "[[alarm]]\nrule = \"y\"\n".parse());
    }

    #[test]
    fn merged_text_parses_to_same_tables() {
        let one = "t = { x = 1, y = { z = 2 } }\nl = [{ a = 1 }, { a = 2 }]\n[deep.er]\ns = \"\"\"\nmany # no comment\n\"\"\"\n\
                   [[deep.list]]\nk = 1\n[[deep.list.below]]\nm = [\n 1, # one\n 2,\n]\n";
        assert_eq!(merged(&[("a", one)]).parse::<toml::Table>(), one.parse());
        let page = merged(&[("a", one), ("b", "t.y.w = 3\n[[l]]\na = 3\n")]);
        let whole = one.replace("z = 2 }", "z = 2, w = 3 }").replace("{ a = 2 }]", "{ a = 2 }, { a = 3 }]");
        assert_eq!(page.parse::<toml::Table>(), whole.parse(), "{page}");
    }

    #[test]
    fn shipped_configuration_is_unchanged_by_merging() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/example.toml");
        let text = std::fs::read_to_string(&path).expect("shipped");
        assert_eq!(merged(&[("example.toml", &text)]).parse::<toml::Table>(), text.parse());
    }
}
