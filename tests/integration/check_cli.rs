//! Runs `packwatch check` as a user does.

use std::path::{Path, PathBuf};

use assert_cmd::Command;

fn packwatch() -> Command {
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command
}

/// Standard output of a run that must succeed without standard error.
fn good(args: &[&str]) -> String {
    let output = packwatch().args(args).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{args:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Exit code and standard error of a check that must fail without standard output.
fn bad(file: &Path) -> (i32, Vec<String>) {
    let output = packwatch().arg("check").arg(file).output().unwrap();
    assert!(output.stdout.is_empty());
    let lines = String::from_utf8(output.stderr).unwrap().lines().map(str::to_owned).collect();
    (output.status.code().unwrap(), lines)
}

fn shipped(folder: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)).unwrap();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "toml"));
    files.sort();
    assert!(!files.is_empty());
    files
}

#[test]
fn every_shipped_configuration_is_valid() {
    // The uplink's tests check `uplink.toml`.
    for file in shipped("config").into_iter().filter(|file| !file.ends_with("uplink.toml")) {
        let printed = good(&["check", file.to_str().unwrap()]);
        assert!(printed.starts_with(&format!("{}: good\n", file.display())), "{printed}");
    }
}

/// The file's comment, key and alarm must give the same percentage.
#[test]
fn measured_cell_end_of_life_is_consistent() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    let printed = text.split_once("End of life as stated by the publishers of the data: ").unwrap().1;
    let (percent, printed) = printed.split_once(" % below the ").unwrap();
    let rated_ah: f64 = printed.split_once(" Ah").unwrap().0.parse().unwrap();
    let end_ah = rated_ah * (1.0 - percent.parse::<f64>().unwrap() / 100.0);

    let config = packwatch::config::load(&file).unwrap().monitor;
    assert!((config.health.end_of_life_ah - end_ah).abs() < 1e-9, "key: {}", config.health.end_of_life_ah);
    let alarm = config.rules.iter().find(|rule| rule.rule == packwatch::alarm::Rule::UsableCapacityLow).unwrap();
    assert!((alarm.threshold - end_ah).abs() < 1e-9, "alarm: {}", alarm.threshold);
}

#[test]
fn every_shipped_cell_model_is_valid() {
    for file in shipped("config/cells") {
        packwatch::config::cell_model::load(&file).unwrap();
    }
}

#[test]
fn valid_file_is_explained() {
    let printed = good(&["check", "config/example.toml"]);
    for part in [
        "96 cells in series, each with its own voltage",
        "can0: classic, kernel filter 100 110 120",
        "bit 0 length 16 little-endian signed     x 0.1 + 0 A",
        "positive = charge on the bus; not available 8000",
        "CellVoltages.CellVoltage96 [Page = 31]",
        "cells 89-96; not available 8000",
        "pack current from -15 to 30 A, stale after 0.5 s",
        "severe when a cell's capacity is below 1.82 Ah (70 % of rated) with a probability above 80 %, cleared at 1.872 Ah",
    ] {
        assert!(printed.contains(part), "{part} in\n{printed}");
    }
}

#[test]
fn json_output_matches_text() {
    let json: serde_json::Value = serde_json::from_str(&good(&["check", "--json", "config/example.toml"])).unwrap();
    assert_eq!(json["signals"].as_array().unwrap().len(), 1 + 12 + 96);
    assert_eq!(json["signals"][0]["channel"], "pack current");
    assert_eq!(json["signals"][0]["scale"], -1.0);
    assert_eq!(json["signals"][108]["multiplex"], "Page = 31");
    assert_eq!(json["interfaces"][0]["filter_ids"], serde_json::json!(["100", "110", "120"]));
}

#[test]
fn all_faults_are_reported_with_code_78() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("cell.toml", "format = 1\nname = \"x\"\nrated_capacity_ah = 0\n");
    write("pack.dbc", "VERSION \"\"\nBO_ 1 A: 8 X\n SG_ nonsense\n");
    write("pack.toml", "[pack]\ncells = 0\ncell_model = \"cell.toml\"\n[input]\ndbc = [\"pack.dbc\"]\nspeed = 3\n");
    let (code, lines) = bad(&folder.path().join("pack.toml"));
    assert_eq!(code, 78);
    let at = |name: &str, line: usize| format!("{}:{line}: ", folder.path().join(name).display());
    let beginnings = [
        at("pack.toml", 1) + "the file has no table [[interface]], must have at least one",
        at("pack.toml", 4) + "input.current.signal is missing",
        at("pack.toml", 2) + "pack.cells = 0, must be 1 to 1024",
        at("pack.toml", 6) + "input.speed is not a known key",
        at("cell.toml", 1) + "tables.soc is missing",
        at("cell.toml", 3) + "rated_capacity_ah = 0, must be 0.001 to 100000",
        at("pack.dbc", 3),
    ];
    for beginning in beginnings {
        assert!(lines.iter().any(|line| line.starts_with(&beginning)), "{beginning} in {lines:#?}");
    }
}

/// A copy of `config/paper.toml` with the files it names, and the given drop-ins.
fn with_drop_ins(drop_ins: &[(&str, &str)]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    std::fs::create_dir_all(folder.path().join("cells")).unwrap();
    std::fs::create_dir_all(folder.path().join("paper.toml.d")).unwrap();
    for entry in std::fs::read_dir(shipped.join("cells")).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, folder.path().join("cells").join(path.file_name().unwrap())).unwrap();
    }
    for name in ["paper.toml", "packwatch.dbc", "pack96.dbc", "measured.dbc"] {
        std::fs::copy(shipped.join(name), folder.path().join(name)).unwrap();
    }
    for (name, text) in drop_ins {
        std::fs::write(folder.path().join("paper.toml.d").join(name), text).unwrap();
    }
    let path = folder.path().join("paper.toml");
    (folder, path)
}

#[test]
fn drop_ins_are_merged_with_their_places() {
    let drop_ins = [("20-late.toml", "[pack]\nambient_c = 12.5\n"), ("10-early.toml", "[pack]\nambient_c = 3\n")];
    let (_folder, file) = with_drop_ins(&drop_ins);
    let name = file.to_str().unwrap();
    let page = good(&["check", "--merged", name]);
    assert!(page.contains(&format!("\nambient_c = 12.5 # {name}.d/20-late.toml:2\n")), "{page}");
    assert!(!page.contains("ambient_c = 3"), "{page}");
    let table: toml::Table = page.parse().unwrap();
    assert_eq!(table["pack"]["cells"].as_integer(), Some(1));
    let printed = good(&["check", name]);
    let head = format!("{name}: good\n  with {name}.d/10-early.toml\n  with {name}.d/20-late.toml\n");
    assert!(printed.starts_with(&head), "{printed}");
}

#[test]
fn commands_without_key_are_called_unauthenticated() {
    let commands = "[commands]\nenabled = true\ne2e = \"1A\"\ndata_id = 0x321\n";
    let (_folder, file) = with_drop_ins(&[("commands.toml", commands)]);
    let printed = good(&["check", file.to_str().unwrap()]);
    assert!(
        printed.contains("commands of other ECUs are unauthenticated: every node on the bus can send them"),
        "{printed}"
    );
}

#[test]
fn faulty_drop_in_is_rejected_but_shown_merged() {
    let (_folder, file) = with_drop_ins(&[("a.toml", "[pack]\ncells = 0\n")]);
    let fault = format!("{}.d/a.toml:2: pack.cells = 0, must be 1 to 1024", file.display());
    assert_eq!(bad(&file), (78, vec![fault.clone()]));
    let output = packwatch().args(["check", "--merged"]).arg(&file).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    assert_eq!((output.status.code(), text(output.stderr)), (Some(78), fault + "\n"));
    assert!(text(output.stdout).contains("cells = 0 # "));
}

#[test]
fn fingerprint_covers_all_files_in_order() {
    use packwatch::status::document::ConfigFile;
    let (folder, file) = with_drop_ins(&[]);
    let plain = ConfigFile::of(&file).unwrap();
    std::fs::write(folder.path().join("paper.toml.d/a.toml"), "[pack]\nambient_c = 1\n").unwrap();
    let merged = ConfigFile::of(&file).unwrap();
    assert_ne!(plain.sha256, merged.sha256);
    assert_eq!(merged.drop_ins, [format!("{}.d/a.toml", file.display())]);
    let whole = folder.path().join("whole.toml");
    let text = std::fs::read_to_string(&file).unwrap() + "[pack]\nambient_c = 1\n";
    std::fs::write(&whole, text).unwrap();
    assert_eq!(merged.sha256, ConfigFile::of(&whole).unwrap().sha256);
}

#[test]
fn missing_file_is_invalid_configuration() {
    let (code, lines) = bad(Path::new("no/such/file.toml"));
    assert_eq!((code, lines.len()), (78, 1));
    assert!(lines[0].starts_with("no/such/file.toml: cannot be read: "), "{lines:?}");
}

#[test]
fn reference_page_is_printed() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/src/reference/keys.md")).unwrap();
    assert_eq!(good(&["check", "--reference"]), page);
}

#[test]
fn file_with_warning_is_usable_but_flagged() {
    let folder = tempfile::tempdir().unwrap();
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    std::fs::create_dir(folder.path().join("cells")).unwrap();
    for name in ["pack96.dbc", "cells/example_nmc_2600.toml"] {
        std::fs::copy(config.join(name), folder.path().join(name)).unwrap();
    }
    let text = std::fs::read_to_string(config.join("example.toml")).unwrap();
    let file = folder.path().join("pack.toml");
    std::fs::write(&file, text.replace("strings = 1", "strings = 1\nrated_capacity_ah = 5.2")).unwrap();
    let printed = good(&["check", file.to_str().unwrap()]);
    assert!(
        printed.starts_with(&format!("{}: usable, 1 warning\n\nwarnings\n  {}", file.display(), file.display())),
        "{printed}"
    );
    assert!(printed.contains("for 2 cells in parallel set strings = 2 and remove this key"), "{printed}");
}
