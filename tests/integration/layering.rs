//! Checks the code against the map of modules in `src/lib.rs`. No module may name a module that it may not import. The
//! core may not name a runtime, a clock, a file, a socket or a print macro.
//!
//! Comments, documentation and literals are ignored. Paths are resolved from `crate::`, from chains of `super::` that
//! reach the crate root, and inside braces.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Each row: module, modules it may import, whether it belongs to the pure core. The lowest modules come first.
///
/// The crates under `src` re-export the modules of lower crates, so a module has the same name everywhere.
const TABLE: &[(&str, &[&str], Core)] = &[
    ("quantity", &[], Core::Pure),
    ("filter", &["quantity"], Core::Pure),
    ("regress", &[], Core::Pure),
    ("can", &["quantity"], Core::Pure),
    ("sample", &["quantity"], Core::Pure),
    ("cell", &["quantity", "filter", "sample"], Core::Pure),
    ("health", &["quantity", "filter", "sample", "cell"], Core::Pure),
    ("cell_faults", &["quantity", "filter", "cell"], Core::Pure),
    ("alarm", &["quantity", "filter"], Core::Pure),
    ("monitor", &["quantity", "filter", "can", "sample", "cell", "health", "cell_faults", "alarm"], Core::Pure),
    ("sim", &["quantity", "can", "cell"], Core::Pure),
    ("wiring", &["quantity", "filter", "can", "sample", "cell", "monitor"], Core::Pure),
    ("ident", &["quantity", "filter", "regress", "cell"], Core::Pure),
    ("formats", &["quantity", "can"], Core::Shell),
    ("bounded_file", &[], Core::Shell),
    ("config", BELOW_CONFIG, Core::Shell),
    ("token_bucket", &["quantity"], Core::Shell),
    ("io", MODULES.split_at(14).0, Core::Shell),
    ("logging", MODULES.split_at(15).0, Core::Shell),
    ("control", MODULES.split_at(16).0, Core::Shell),
    ("store", MODULES.split_at(17).0, Core::Shell),
    ("status", MODULES.split_at(17).0, Core::Shell),
    ("service", MODULES.split_at(19).0, Core::Shell),
    ("http", &["io"], Core::Shell),
    ("exporter", MODULES.split_at(21).0, Core::Shell),
    ("replay", MODULES.split_at(20).0, Core::Shell),
    ("wiring_check", MODULES.split_at(20).0, Core::Shell),
    ("failure", &["config"], Core::Shell),
    ("lab", BELOW_LAB, Core::Shell),
    // A separate program. It reads the daemon's status but does not use the daemon's loop.
    (
        "uplink",
        &["quantity", "cell_faults", "alarm", "monitor", "io", "logging", "control", "status", "http", "failure"],
        Core::Shell,
    ),
    ("python", &MODULES, Core::Shell),
    ("cli", &MODULES, Core::Shell),
    ("main", &["cli"], Core::Shell),
];

/// The modules of `src/core` and `src/host`, lowest first, then the lab's modules.
const MODULES: [&str; 28] = [
    "quantity",
    "filter",
    "can",
    "sample",
    "cell",
    "health",
    "cell_faults",
    "alarm",
    "monitor",
    "sim",
    "wiring",
    "bounded_file",
    "config",
    "token_bucket",
    "io",
    "logging",
    "control",
    "store",
    "status",
    "service",
    "http",
    "exporter",
    "replay",
    "wiring_check",
    "failure",
    "regress",
    "ident",
    "lab",
];
const BELOW_CONFIG: &[&str] = MODULES.split_at(12).0;
const BELOW_LAB: &[&str] = MODULES.split_at(27).0;
/// Crates under `src`. `Some`: the table has one row for the whole crate.
const CRATES: [(&str, Option<&str>); 7] = [
    ("core", None),
    ("formats", Some("formats")),
    ("host", None),
    ("lab", Some("lab")),
    ("python", Some("python")),
    ("regress", Some("regress")),
    ("uplink", Some("uplink")),
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Core {
    Pure,
    Shell,
}

/// The core must not name these paths: they read a clock, a file, a socket or the environment, or log.
const IMPURE_PATHS: &[&str] = &["tokio", "tracing", "std::fs", "std::net", "std::env", "std::process"];
/// The core must not use these names with any path.
const IMPURE_NAMES: &[&str] = &["Instant", "SystemTime"];
const IMPURE_MACROS: &[&str] = &["println", "eprintln", "print", "eprint", "dbg"];
/// Module, and path that it must not use. The simulator computes the truth, so it must not use the estimator under
/// test.
const FORBIDDEN_TO: &[(&str, &str)] = &[("sim", "crate::cell::estimator")];

/// Test file, and the additional module that it may name. The store's tests run a replay that records to the store.
const ALLOWED_IN_TESTS: &[(&str, &str)] = &[("host/store/tests.rs", "crate::replay")];

/// A word or a punctuation mark of the source, without comments and literals.
#[derive(Debug, Clone, PartialEq)]
struct Token {
    line: usize,
    text: String,
}

fn tokens(source: &str) -> Vec<Token> {
    let chars: Vec<char> = source.chars().collect();
    let (mut found, mut at, mut line) = (Vec::new(), 0, 1);
    while at < chars.len() {
        let end = match skipped(&chars, at) {
            Some(end) => end,
            None => {
                let end = token_end(&chars, at);
                found.push(Token { line, text: chars[at..end].iter().collect() });
                end
            }
        };
        line += chars[at..end].iter().filter(|c| **c == '\n').count();
        at = end;
    }
    found
}

/// End of the white space, comment or literal that starts at `at`. `None` if a token starts there.
fn skipped(chars: &[char], at: usize) -> Option<usize> {
    let next = chars.get(at + 1).copied();
    match chars[at] {
        c if c.is_whitespace() => Some(at + 1),
        '/' if next == Some('/') => Some(find(chars, at, |rest| rest[0] == '\n')),
        '/' if next == Some('*') => Some(block_comment_end(chars, at)),
        '"' => Some(string_end(chars, at)),
        'r' | 'b' | 'c' if !word_before(chars, at) => raw_string_end(chars, at),
        '\'' if next == Some('\\') => Some(find(chars, at + 3, |rest| rest[0] == '\'') + 1),
        '\'' if chars.get(at + 2) == Some(&'\'') => Some(at + 3),
        _ => None,
    }
}

fn find(chars: &[char], from: usize, is_end: impl Fn(&[char]) -> bool) -> usize {
    (from..chars.len()).find(|&at| is_end(&chars[at..])).unwrap_or(chars.len())
}

fn block_comment_end(chars: &[char], start: usize) -> usize {
    let (mut depth, mut at) = (0, start);
    while at < chars.len() {
        match (chars[at], chars.get(at + 1)) {
            ('/', Some('*')) => (depth, at) = (depth + 1, at + 2),
            ('*', Some('/')) => (depth, at) = (depth - 1, at + 2),
            _ => at += 1,
        }
        if depth == 0 {
            return at;
        }
    }
    at
}

fn string_end(chars: &[char], start: usize) -> usize {
    let mut at = start + 1;
    while at < chars.len() && chars[at] != '"' {
        at += if chars[at] == '\\' { 2 } else { 1 };
    }
    (at + 1).min(chars.len())
}

/// End of the raw string (`r"`, `br#"`, ...) that starts at `at`. `None` if no raw string starts there.
fn raw_string_end(chars: &[char], at: usize) -> Option<usize> {
    let r = find(chars, at, |rest| rest[0] != 'b' && rest[0] != 'c');
    let open = find(chars, r + 1, |rest| rest[0] != '#');
    if chars.get(r) != Some(&'r') || chars.get(open) != Some(&'"') {
        return None;
    }
    let hashes = open - r - 1;
    let closes =
        |rest: &[char]| rest[0] == '"' && rest[1..].iter().take(hashes).filter(|c| **c == '#').count() == hashes;
    Some((find(chars, open + 1, closes) + 1 + hashes).min(chars.len()))
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

fn word_before(chars: &[char], at: usize) -> bool {
    at > 0 && is_word(chars[at - 1])
}

fn token_end(chars: &[char], at: usize) -> usize {
    if is_word(chars[at]) {
        find(chars, at, |rest| !is_word(rest[0]))
    } else if chars[at..].starts_with(&[':', ':']) {
        at + 2
    } else {
        at + 1
    }
}

/// Every path in a text, with braces expanded: `use std::{fs, net::TcpStream}` gives two paths. `depth` is the module
/// depth of the text. A chain of `super` that reaches the root becomes `crate`.
fn paths(tokens: &[Token], depth: usize) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let (mut at, mut braces) = (0, 0_usize);
    let mut inline_modules: Vec<usize> = Vec::new();
    while at < tokens.len() {
        match tokens[at].text.as_str() {
            "{" => {
                braces += 1;
                if at >= 2 && tokens[at - 2].text == "mod" {
                    inline_modules.push(braces);
                }
            }
            "}" => {
                if inline_modules.last() == Some(&braces) {
                    inline_modules.pop();
                }
                braces = braces.saturating_sub(1);
            }
            word if word.starts_with(is_word) => {
                let first = found.len();
                at = spread(tokens, at, "", &mut found);
                for (_, path) in &mut found[first..] {
                    *path = from_root(path, depth + inline_modules.len());
                }
                continue;
            }
            _ => {}
        }
        at += 1;
    }
    found
}

/// Reads one path or tree of paths from `at`. Returns its end.
fn spread(tokens: &[Token], mut at: usize, prefix: &str, found: &mut Vec<(usize, String)>) -> usize {
    let text = |at: usize| tokens.get(at).map_or("", |token| token.text.as_str());
    let mut path = prefix.to_owned();
    loop {
        if text(at) == "{" {
            at += 1;
            while at < tokens.len() && text(at) != "}" {
                at = if text(at) == "," { at + 1 } else { spread(tokens, at, &path, found) };
            }
            return at + 1;
        }
        let line = tokens.get(at).map_or(0, |token| token.line);
        if !path.is_empty() {
            path.push_str("::");
        }
        path.push_str(text(at));
        at += 1;
        let goes_on = text(at) == "::" && (text(at + 1) == "{" || text(at + 1).starts_with(is_word));
        if !goes_on {
            found.push((line, path));
            return at;
        }
        at += 1;
    }
}

fn from_root(path: &str, depth: usize) -> String {
    let relative = path.strip_prefix("self::").unwrap_or(path);
    let supers = relative.split("::").take_while(|part| *part == "super").count();
    if supers == 0 || supers < depth {
        return path.to_owned();
    }
    relative.split("::").skip(supers).fold("crate".to_owned(), |root, part| root + "::" + part)
}

/// Module of a file below `src`, and the module depth of the file in its crate.
fn place(file: &str) -> (&str, usize) {
    let mut parts: Vec<&str> = file.trim_end_matches(".rs").split('/').filter(|part| *part != "mod").collect();
    let member = CRATES.iter().find(|(name, _)| parts.len() > 1 && parts[0] == *name);
    let Some((_, whole)) = member else { return (parts[0], parts.len()) };
    parts.remove(0);
    // Separate programs and language bindings may name their files freely.
    let is_apart = matches!(*whole, Some("python" | "uplink"));
    let is_known = !is_apart && TABLE.iter().any(|(name, ..)| *name == parts[0]);
    let module = if is_known { parts[0] } else { whole.unwrap_or(parts[0]) };
    (module, parts.len())
}

/// Rewrites a path as if all crates were one: `packwatch_core::can` and `packwatch::can` become `crate::can`.
fn in_one_crate(path: &str) -> String {
    let Some((first, rest)) = path.split_once("::") else { return path.to_owned() };
    match first {
        "packwatch" | "packwatch_core" | "packwatch_host" => format!("crate::{rest}"),
        "packwatch_lab" => format!("crate::lab::{rest}"),
        "packwatch_regress" => format!("crate::regress::{rest}"),
        "packwatch_uplink" => format!("crate::uplink::{rest}"),
        _ => path.to_owned(),
    }
}

/// Violations in one file, as lines `file:line: text`.
fn violations(file: &str, source: &str) -> Vec<String> {
    let (module, depth) = place(file);
    let Some((_, allowed, core)) = TABLE.iter().find(|(name, ..)| *name == module) else {
        return vec![format!("src/{file}:1: module {module} has no row in the table of tests/integration/layering.rs")];
    };
    let tokens = tokens(source);
    let mut faults = Vec::new();
    for (line, path) in paths(&tokens, depth) {
        let path = in_one_crate(&path);
        if ALLOWED_IN_TESTS.iter().any(|(tests, what)| *tests == file && is_within(&path, what)) {
            continue;
        }
        if let Some(why) = forbidden_import(module, allowed, &path).or_else(|| impure(*core, &path)) {
            faults.push(format!("src/{file}:{line}: {why}"));
        }
    }
    let calls = tokens.windows(2).filter(|pair| *core == Core::Pure && pair[1].text == "!");
    for pair in calls.filter(|pair| IMPURE_MACROS.contains(&pair[0].text.as_str())) {
        faults.push(format!("src/{file}:{}: the core calls {}!", pair[0].line, pair[0].text));
    }
    faults
}

fn forbidden_import(module: &str, allowed: &[&str], path: &str) -> Option<String> {
    let target = path.strip_prefix("crate::")?.split("::").next()?;
    let is_module = TABLE.iter().any(|(name, ..)| *name == target);
    let in_table = !is_module || target == module || allowed.contains(&target);
    let singled_out = FORBIDDEN_TO.iter().any(|(who, what)| *who == module && is_within(path, what));
    (!in_table || singled_out).then(|| format!("{module} may not import {path}, allowed: {}", allowed.join(", ")))
}

fn impure(core: Core, path: &str) -> Option<String> {
    let named = IMPURE_PATHS.iter().any(|impure| is_within(path, impure))
        || path.split("::").any(|part| IMPURE_NAMES.contains(&part));
    (core == Core::Pure && named).then(|| format!("the core names {path}"))
}

fn is_within(path: &str, outer: &str) -> bool {
    path.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
}

fn source_files(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("src can be listed") {
        let path = entry.expect("src can be listed").path();
        if path.is_dir() {
            source_files(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

#[test]
fn modules_import_only_what_map_allows() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    source_files(&src, &mut files);
    files.sort();
    assert!(files.len() > 20, "found only {} source files", files.len());
    let mut report = String::new();
    for path in files {
        let file = path.strip_prefix(&src).expect("below src").to_string_lossy().replace('\\', "/");
        // A lib.rs only declares modules.
        if file == "lib.rs" || file.ends_with("/lib.rs") {
            continue;
        }
        let source = std::fs::read_to_string(&path).expect("a source file can be read");
        for fault in violations(&file, &source) {
            writeln!(report, "{fault}").expect("writing to a String cannot fail");
        }
    }
    assert!(report.is_empty(), "the layering of src/lib.rs is broken:\n{report}");
}

#[test]
fn table_lists_all_declared_modules() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut declared = ["formats", "regress", "ident", "lab", "uplink", "python", "main"].map(str::to_owned).to_vec();
    for lib in ["lib.rs", "core/lib.rs", "host/lib.rs"] {
        let source = std::fs::read_to_string(src.join(lib)).expect("a lib.rs");
        let names =
            source.lines().filter_map(|line| line.trim_start_matches("pub ").strip_prefix("mod ")?.strip_suffix(';'));
        declared.extend(names.map(str::to_owned));
    }
    declared.sort_unstable();
    let mut listed: Vec<&str> = TABLE.iter().map(|(name, ..)| *name).collect();
    listed.sort_unstable();
    assert_eq!(declared, listed);
}

#[test]
fn planted_violations_are_reported_with_line() {
    let planted: &[(&str, &str, &str)] = &[
        ("sample/mod.rs", "\nuse crate::can::Frame;", "src/sample/mod.rs:2: sample may not import crate::can::Frame"),
        ("sample/mod.rs", "use crate::{quantity::Fault,\n can::decode};", "src/sample/mod.rs:2:"),
        ("alarm/mod.rs", "fn f(x: crate::cell::CellModel) {}", "alarm may not import crate::cell::CellModel"),
        ("alarm/mod.rs", "use super::cell::CellModel;", "alarm may not import"),
        ("alarm/engine.rs", "use super::super::cell::CellModel;", "alarm may not import"),
        ("alarm/mod.rs", "mod tests { use super::super::can; }", "alarm may not import"),
        ("can/mod.rs", "use tokio::time;", "src/can/mod.rs:1: the core names tokio::time"),
        ("cell/mod.rs", "use std::{fmt, fs::File};", "the core names std::fs::File"),
        ("monitor/mod.rs", "fn f() { let t = std::time::Instant::now(); }", "the core names std::time::Instant::now"),
        ("health/mod.rs", "use std::time::{Duration, SystemTime};", "the core names std::time::SystemTime"),
        ("health/mod.rs", "/* a\nb */ fn f() { println!(\"x\"); }", "src/health/mod.rs:2: the core calls println!"),
        (
            "filter/mod.rs",
            "#[cfg(test)] mod tests { fn f() { tracing::info!(\"x\"); } }",
            "the core names tracing::info",
        ),
        (
            "sim/mod.rs",
            "use crate::cell::{CellModel, estimator::Estimator};",
            "sim may not import crate::cell::estimator",
        ),
        ("host/io/log.rs", "use crate::service::Clock;", "io may not import crate::service::Clock"),
        ("host/status.rs", "use super::service::Clock;", "status may not import crate::service::Clock"),
        ("core/alarm/mod.rs", "use super::cell::CellModel;", "src/core/alarm/mod.rs:1: alarm may not import"),
        ("regress/kernel.rs", "use packwatch_core::can::Frame;", "regress may not import crate::can::Frame"),
        ("lab/ident/fit.rs", "use packwatch_host::io::log;", "ident may not import crate::io::log"),
        ("python/fit.rs", "use packwatch::cli::Failure;", "python may not import crate::cli::Failure"),
        ("uplink/mqtt/link.rs", "use packwatch_host::service::notify;", "uplink may not import crate::service::notify"),
        ("uplink/main.rs", "use packwatch_host::store::Store;", "uplink may not import crate::store::Store"),
        ("cli/uplink.rs", "use packwatch_uplink::mqtt;", "cli may not import crate::uplink::mqtt"),
        ("main.rs", "fn main() { packwatch::service::run(); }", "main may not import crate::service::run"),
        ("novel/mod.rs", "", "src/novel/mod.rs:1: module novel has no row"),
    ];
    for (file, source, expected) in planted {
        let found = violations(file, source);
        assert_eq!(found.len(), 1, "{file} {source:?} gave {found:?}");
        assert!(found[0].contains(expected), "{file} {source:?} gave {found:?}");
    }
}

#[test]
fn allowed_imports_and_mentions_pass() {
    let clean: &[(&str, &str)] = &[
        ("alarm/mod.rs", "use crate::quantity::{CellIndex, Timestamp};\nuse crate::alarm::Rule;"),
        (
            "alarm/mod.rs",
            "//! See [`crate::cell`] and tokio.\n/// std::fs /* */\n// println!(\"x\")\n/* tokio /* std::fs */ */",
        ),
        (
            "alarm/mod.rs",
            "const A: &str = \"crate::cell \\\" tokio::x\"; const B: &str = r#\"std::fs \" println!()\"#;",
        ),
        ("alarm/mod.rs", "fn f<'a>(x: &'a str) -> char { let q = '\"'; let e = '\\''; q }"),
        ("alarm/engine.rs", "use super::Rule;\nmod tests { use super::super::Rule; }"),
        ("alarm/engine/tests.rs", "use super::super::Rule;"),
        ("cell/mod.rs", "use std::time::Duration; let instant = 1; struct Instantaneous;"),
        ("host/service.rs", "use tokio::time::Instant; use crate::io::Log; fn f() { println!(\"x\"); }"),
        ("lab/report.rs", "use crate::chart::Axis; use packwatch_host::store::Store;"),
        ("regress/kernel.rs", "use crate::basis::Basis;"),
    ];
    for (file, source) in clean {
        assert_eq!(violations(file, source), Vec::<String>::new(), "{file} {source:?}");
    }
}
