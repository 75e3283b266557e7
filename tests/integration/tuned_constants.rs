//! Compares `docs/src/reference/tuned-constants.md` with the source. Every row must have the constant's value and name
//! a test. Every floating-point constant of the algorithms must be a row or listed as not tuned.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

const PAGE: &str = "docs/src/reference/tuned-constants.md";

/// Places under `src` whose floating-point constants must be on the page.
const ALGORITHMS: [&str; 13] = [
    "core/cell",
    "core/cell_faults",
    "core/wiring",
    "core/health",
    "core/sample",
    "core/monitor",
    "core/alarm",
    "regress",
    "lab/ident",
    "lab/fit",
    "lab/rul",
    "lab/gpr",
    "lab/discover",
];

/// A constant of a source file, with the source text of its type and its value.
struct Constant {
    name: String,
    type_text: String,
    value: String,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn rust_files(base: &Path, folder: &Path, found: &mut Vec<PathBuf>) {
    let mut paths: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            rust_files(base, &path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path.strip_prefix(base).unwrap().to_owned());
        }
    }
}

/// Source text without white space and without the trailing commas of wrapped lines.
fn compact(text: &str) -> String {
    let text: String = text.split_whitespace().collect();
    text.replace(",]", "]").replace(",)", ")").replace(",}", "}")
}

/// The constants of a source text, except those of the test module.
fn constants(source: &str) -> Vec<Constant> {
    let code: Vec<&str> = source.lines().map(|line| line.split("//").next().unwrap_or_default()).collect();
    let code = code.join("\n");
    let code = code.split("mod tests {").next().unwrap_or_default();
    let mut found = Vec::new();
    for (at, _) in code.match_indices("const ") {
        let before = code[..at].rsplit('\n').next().unwrap_or_default().trim();
        let Some((name, rest)) = code[at + 6..].split_once(": ") else { continue };
        if !(before.is_empty() || before.starts_with("pub")) || name.contains(' ') {
            continue;
        }
        let mut depth = 0;
        let end = rest.find(|c| {
            depth += i32::from("([{".contains(c)) - i32::from(")]}".contains(c));
            c == ';' && depth == 0
        });
        // A generic parameter (`const N: usize,`) on its own line has no value.
        let item = end.and_then(|end| rest[..end].split_once(" =")).filter(|(type_text, _)| !type_text.contains('\n'));
        if let Some((type_text, value)) = item {
            found.push(Constant { name: name.into(), type_text: type_text.into(), value: compact(value) });
        }
    }
    found
}

fn quoted(line: &str) -> Vec<&str> {
    line.split('`').skip(1).step_by(2).collect()
}

/// The rows of the page as (constant, file, value, test). The test is `None` if the row names no test.
fn rows(page: &str) -> Vec<(&str, &str, &str, Option<&str>)> {
    page.lines()
        .filter(|line| line.starts_with("| `"))
        .map(|line| {
            let columns: Vec<&str> = line.trim_matches('|').split(" | ").collect();
            let [name, file, value, _, test] = columns[..] else { panic!("{PAGE}: not five columns: {line}") };
            let test = if test.trim_start().starts_with("none") { None } else { Some(quoted(test)[0]) };
            (quoted(name)[0], quoted(file)[0], quoted(value)[0], test)
        })
        .collect()
}

/// The constants listed as not tuned: pairs of file and name.
fn not_tuned(page: &str) -> BTreeSet<(&str, &str)> {
    let (_, list) = page.split_once("## Not tuned").expect("the list");
    let mut file = "";
    let mut found = BTreeSet::new();
    for text in list.lines().filter(|line| line.starts_with("- ")).flat_map(quoted) {
        if text.ends_with(".rs") {
            file = text;
        } else {
            found.insert((file, text));
        }
    }
    found
}

/// Whether the table of keys states this default. `key` has the form `table.key`; `default` has no backticks.
fn has_default(source: &str, key: &str, default: &str) -> bool {
    let (table, key) = key.split_once('.').expect("table.key");
    let (_, section) = source.split_once(&format!("at \"{table}\"")).expect("the table");
    let section = section.split("section! {").next().unwrap_or_default();
    let line = section.lines().find(|line| line.trim_start().starts_with(&format!("{key}: "))).unwrap_or_default();
    line.replace('`', "").contains(&format!("(\"{}\")", default.replace('"', "\\\"")))
}

#[test]
fn rows_match_source_values() {
    let page = read(PAGE);
    let mut files: BTreeMap<&str, (String, Vec<Constant>)> = BTreeMap::new();
    let rows = rows(&page);
    assert!(rows.len() > 200, "only {} rows in {PAGE}", rows.len());
    for (name, file, value, _) in rows {
        let (source, constants) = files.entry(file).or_insert_with(|| {
            let source = read(Path::new("src").join(file));
            let constants = constants(&source);
            (source, constants)
        });
        let is_in_source = if name.contains('.') {
            has_default(source, name, value)
        } else {
            constants.iter().any(|constant| constant.name == name && constant.value == compact(value))
        };
        assert!(is_in_source, "{PAGE}: {name} = {value} is not in src/{file}");
    }
}

#[test]
fn named_tests_exist() {
    let page = read(PAGE);
    let mut paths = Vec::new();
    for folder in ["src", "tests"] {
        rust_files(root(), &root().join(folder), &mut paths);
    }
    let sources: String = paths.iter().map(read).collect();
    let functions: BTreeSet<&str> = sources.split("fn ").filter_map(|after| after.split('(').next()).collect();
    for (name, _, _, test) in rows(&page) {
        let function = test.and_then(|test| test.rsplit("::").next());
        assert!(
            function.is_none_or(|function| functions.contains(function)),
            "{PAGE}: {name} names a test that does not exist: {test:?}"
        );
    }
}

#[test]
fn every_constant_is_listed_on_page() {
    let page = read(PAGE);
    let tuned = rows(&page).into_iter().map(|(name, file, ..)| (file, name));
    let listed: BTreeSet<(&str, &str)> = tuned.chain(not_tuned(&page)).collect();
    let src = root().join("src");
    let mut paths = Vec::new();
    for place in ALGORITHMS {
        rust_files(&src, &src.join(place), &mut paths);
        paths.extend(Some(PathBuf::from(format!("{place}.rs"))).filter(|path| src.join(path).exists()));
    }
    let mut missing = Vec::new();
    for path in paths.iter().filter(|path| !path.iter().any(|part| part == "tests" || part == "tests.rs")) {
        let file = path.to_str().expect("UTF-8");
        let numbers = constants(&read(Path::new("src").join(path)));
        let numbers = numbers.iter().filter(|it| it.type_text.contains("f64") || it.type_text.contains("f32"));
        missing
            .extend(numbers.filter(|it| !listed.contains(&(file, &*it.name))).map(|it| format!("{file}: {}", it.name)));
    }
    assert!(missing.is_empty(), "add to {PAGE}, as tuned or as not tuned: {missing:#?}");
}
