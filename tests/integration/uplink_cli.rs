//! Tests that `packwatch mqtt`, `kuksa` and `vss` run the program `packwatch-uplink` if it is installed.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Creates a copy of the program in an otherwise empty folder.
fn alone(folder: &Path) -> PathBuf {
    let (built, own) = (Path::new(env!("CARGO_BIN_EXE_packwatch")), folder.join("packwatch"));
    if fs::hard_link(built, &own).is_err() {
        fs::copy(built, &own).unwrap();
    }
    own
}

fn run(program: &Path, arguments: &[&str], path: &Path) -> Output {
    Command::new(program).args(arguments).env("PATH", path).output().unwrap()
}

fn put_uplink(folder: &Path, word: &str) {
    let uplink = folder.join("packwatch-uplink");
    fs::write(&uplink, format!("#!/bin/sh\necho {word}\nprintf '%s\\n' \"$@\"\nexit 7\n")).unwrap();
    fs::set_permissions(&uplink, fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn commands_without_uplink_name_package() {
    let folder = tempfile::tempdir().unwrap();
    let program = alone(folder.path());
    for command in ["mqtt", "kuksa", "vss"] {
        let output = run(&program, &[command, "-c", "uplink.toml"], folder.path());
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(text.starts_with(&format!("packwatch {command}: packwatch-uplink is not installed")), "{text}");
        assert_eq!(output.status.code(), Some(1));
    }
}

#[test]
fn uplink_gets_arguments_and_returns_exit_code() {
    let (folder, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let program = alone(folder.path());
    let arguments = ["mqtt", "-c", "a b.toml", "--help", "--log=debug"];
    put_uplink(elsewhere.path(), "of-path");
    let output = run(&program, &arguments, elsewhere.path());
    assert_eq!(String::from_utf8(output.stdout).unwrap(), "of-path\nmqtt\n-c\na b.toml\n--help\n--log=debug\n");
    assert_eq!(output.status.code(), Some(7));
    // The uplink in packwatch's own folder takes precedence over the uplink in PATH because it has the same version.
    put_uplink(folder.path(), "beside");
    let output = run(&program, &["vss"], elsewhere.path());
    assert_eq!(String::from_utf8(output.stdout).unwrap(), "beside\nvss\n");
}
