//! Runs `cantools` as an independent reference (oracle) for DBC decoding, through `tests/tools/dbc_oracle.py`.

use std::collections::HashMap;
use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

/// The value of `PACKWATCH_PYTHON`. If the variable is not set, prints a note and returns `None`.
pub(crate) fn python() -> Option<OsString> {
    let python = std::env::var_os("PACKWATCH_PYTHON");
    if python.is_none() {
        eprintln!("SKIPPED: PACKWATCH_PYTHON is not set to a Python with cantools");
    }
    python
}

/// Sends the lines to the oracle and returns its answers.
pub(crate) fn ask(python: &OsString, dbc: &Path, arguments: &[&str], lines: &[String]) -> Vec<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/dbc_oracle.py");
    let mut command = Command::new(python);
    command.arg(script).arg(dbc).args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let (mut stdin, text) = (child.stdin.take().unwrap(), lines.join("\n"));
    // Ignore write errors. The oracle's exit status reports a failure.
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()));
    let output = child.wait_with_output().unwrap();
    let _ = writer.join().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

/// Signal values of one answer. Panics with the reason if cantools rejected the payload.
pub(crate) fn values(question: &str, answer: &str) -> HashMap<String, f64> {
    assert!(!answer.starts_with('!'), "cantools rejected {question}: {answer}");
    let pair = |pair: &str| pair.split_once('=').map(|(name, value)| (name.to_owned(), value.parse().unwrap()));
    answer.split('\t').filter_map(pair).collect()
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
