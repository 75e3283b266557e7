//! Tests `check`, `replay` and `doctor` on cases from practice: a DBC with a faulty message, a current whose direction
//! is in another signal, and J1939 messages from an unexpected source address.

use std::path::{Path, PathBuf};

use crate::support::measured;

fn folder(case: &str) -> PathBuf {
    measured::path("../more-data/field").join(case)
}

/// A copy of a case's configuration in a folder of its own, with some text replaced.
struct Case {
    place: tempfile::TempDir,
    log: PathBuf,
}

impl Case {
    fn new(case: &str, name: &str, edits: &[(&str, &str)]) -> Self {
        let (place, from) = (tempfile::tempdir().unwrap(), folder(case));
        let project = env!("CARGO_MANIFEST_DIR");
        let mut text = std::fs::read_to_string(from.join(format!("{name}.toml"))).unwrap();
        text = text.replace("PROJECT", project).replace("dbc = [\"", &format!("dbc = [\"{}/", from.display()));
        for (old, new) in edits {
            assert!(text.contains(old), "{old}");
            text = text.replace(old, new);
        }
        std::fs::write(place.path().join("pack.toml"), text).unwrap();
        Self { place, log: from.join(format!("{}.log.gz", name.split('_').next().unwrap())) }
    }

    fn config(&self) -> PathBuf {
        self.place.path().join("pack.toml")
    }

    fn run(&self, args: &[&Path]) -> String {
        let done = assert_cmd::Command::cargo_bin("packwatch").unwrap().args(args).assert().success();
        String::from_utf8(done.get_output().stdout.clone()).unwrap()
    }

    fn doctor(&self) -> String {
        let output = assert_cmd::Command::cargo_bin("packwatch")
            .unwrap()
            .arg("doctor")
            .arg("-c")
            .arg(self.config())
            .arg(&self.log)
            .output();
        String::from_utf8(output.unwrap().stdout).unwrap()
    }

    /// Pack currents of the estimates (A).
    fn currents_a(&self) -> Vec<f64> {
        let csv = self.place.path().join("estimates.csv");
        self.run(&["replay".as_ref(), "-c".as_ref(), &self.config(), &self.log, "--estimates".as_ref(), &csv]);
        let text = std::fs::read_to_string(csv).unwrap();
        let column = text.lines().next().unwrap().split(',').position(|name| name == "current_a").unwrap();
        text.lines().skip(1).filter_map(|line| line.split(',').nth(column)?.parse().ok()).collect()
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "needs measured data")]
fn dbc_loses_only_its_faulty_message() {
    let text = std::fs::read_to_string(folder("06-dbc-29bit-no-flag").join("pack.toml")).unwrap();
    let case = Case::new("06-dbc-29bit-no-flag", "pack", &[]);
    assert!(text.contains("car.dbc"));
    let page = case.run(&["check".as_ref(), &case.config()]);
    assert!(page.contains("car.dbc:13: message CameraThing is left out: identifier 316495015, must be"), "{page}");
    assert!(page.contains("PackStatus.Current") && page.contains("CellVoltages.Cell4"), "{page}");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "needs measured data")]
fn sign_in_other_signal_gives_signed_current() {
    let case = "15-sign-magnitude-current";
    let sign = |signal: &str| {
        format!("positive = \"discharge\"\nsign = {{ signal = \"PackStatus.{signal}\", charge = [1] }}\n")
    };
    let old = "positive = \"discharge\"\n";
    let flag = Case::new(case, "flag", &[(old, &sign("Direction"))]);
    let bit = Case::new(case, "signmag_15", &[(old, &sign("Charging"))]);
    let (by_flag, by_bit) = (flag.currents_a(), bit.currents_a());
    assert!(by_flag.iter().any(|a| *a < -0.5) && by_flag.iter().any(|a| *a > 0.5));
    assert_eq!(by_flag.len(), by_bit.len());
    let apart = by_flag.iter().zip(&by_bit).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // The pack current is the sum over 20 strings. Its resolution is 0.1 A in the log whose direction is a separate
    // flag, and 0.01 A in the other log.
    assert!(apart < 0.06, "{apart}");
    for of in [flag, bit] {
        let page = of.doctor();
        assert!(page.contains("the sign of the current is right"), "{page}");
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "needs measured data")]
fn j1939_message_is_read_from_any_source() {
    let case = Case::new("17-j1939-source-address", "j", &[]);
    let currents_a = case.currents_a();
    assert!(currents_a.len() > 1000 && currents_a.iter().any(|a| a.abs() > 0.1), "{}", currents_a.len());
    assert!(case.doctor().contains("the sign of the current is right"));
    let exact = Case::new("17-j1939-source-address", "j", &[("[input]\n", "[input]\nsource_address = \"exact\"\n")]);
    assert!(exact.doctor().contains("never received"), "{}", exact.doctor());
}
