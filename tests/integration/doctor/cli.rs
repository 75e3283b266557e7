//! Runs `packwatch doctor` as a user does.

use assert_cmd::Command;

use super::bench::{Bench, BrokenPack};

fn doctor(broken: &BrokenPack, args: &[&str]) -> (i32, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let config = broken.write(folder.path());
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.arg("doctor").arg("-c").arg(config).arg(folder.path().join("pack.log")).args(args);
    let output = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

#[test]
fn healthy_pack_exits_0_and_lists_checks() {
    let (status, page, _) = doctor(&BrokenPack::of(Bench::Pack12, 1), &[]);
    assert_eq!(status, 0, "{page}");
    for words in [
        "No faults found",
        "12 of 12 cell voltages every 100 ms",
        "pack current every 10 ms",
        "the sign of the current is right",
    ] {
        assert!(page.contains(words), "{words}: {page}");
    }
}

#[test]
fn finding_exits_1_and_shows_both_lines() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.config("positive = \"charge\"", "positive = \"discharge\"");
    let (status, page, _) = doctor(&broken, &[]);
    assert_eq!(status, 1, "{page}");
    for words in [
        "the sign of the current is inverted",
        "pack.toml:19  [input.current]",
        "- positive = \"discharge\"",
        "+ positive = \"charge\"",
    ] {
        assert!(page.contains(words), "{words}: {page}");
    }
    let (status, json, _) = doctor(&broken, &["--json"]);
    let document: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((status, document["ok"].as_bool()), (1, Some(false)));
    let first = &document["report"]["findings"][0];
    assert_eq!((first["topic"].as_str(), first["severity"].as_str()), (Some("current_sign"), Some("error")));
    assert_eq!(first["changes"][0]["now"].as_str(), Some("\"discharge\""));
}

#[test]
fn unknown_signal_is_reported_and_others_diagnosed() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.config("PackStatus.Current\"", "PackStatus.Curent\"");
    broken.table("[input.cell_voltage]", "scale = 1000.0");
    let (status, page, _) = doctor(&broken, &[]);
    assert_eq!(status, 78, "{page}");
    for words in ["did you mean PackStatus.Current", "cell voltages: off by a factor of 1000", "+ scale = 1.0"] {
        assert!(page.contains(words), "{words}: {page}");
    }
}

#[test]
fn configuration_without_cell_model_is_rejected() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.config = "[pack]\ncells = 3\n".to_owned();
    let (status, page, faults) = doctor(&broken, &[]);
    assert_eq!((status, page.as_str()), (78, ""));
    assert!(faults.contains("pack.cell_model is not set"), "{faults}");
}

#[test]
fn partial_log_is_judged_and_other_interface_named() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.frames(|stamp, _, id, data| Some(format!("{stamp} can9 {id}#{data}")));
    let (status, page, _) = doctor(&broken, &["-i", "can9", "--for", "20"]);
    assert_eq!(status, 0, "{page}");
    assert!(page.contains(": 20 s, "), "{page}");
}

#[test]
fn wrong_byte_order_is_first_finding() {
    let mut broken = BrokenPack::of(Bench::Pack96, 1);
    broken.dbc("|16@1", "|16@0");
    let (status, page, _) = doctor(&broken, &[]);
    let first = page.lines().find(|line| line.starts_with("ERROR")).unwrap();
    assert!(first.contains("cell voltages: wrong byte order"), "{page}");
    assert_eq!((status, page.matches("ERROR").count()), (78, 2), "{page}");
    assert!(page.contains("ends in byte 9") || page.contains("end in byte 9"), "{page}");
    assert!(page.lines().count() < 60, "{page}");
    for below in ["temperatures: wrong byte order", "16|16@1+; in the DBC: "] {
        let words = page.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains(below), "{below}: {page}");
    }
}
