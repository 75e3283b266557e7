//! Tests drop-ins: their settings are merged, and their faults name the right file.

use super::*;

fn good_with(drop_ins: &[&str]) -> Config {
    read_merged(PACK, CELL, DBC, drop_ins).unwrap().0
}

fn faults_with(drop_ins: &[&str]) -> Vec<String> {
    read_merged(PACK, CELL, DBC, drop_ins).unwrap_err()
}

#[test]
fn later_files_replace_keys_and_append_tables() {
    let alarm = |rule: &str| format!("[[alarm]]\nrule = \"{rule}\"\nwarning = 0.2\n");
    let config = good_with(&[
        &format!("[pack]\nambient_c = 10\ncells = 3\n{}", alarm("soc_low")),
        &format!("pack.ambient_c = 11\n{}", alarm("cell_imbalance")),
    ]);
    assert_eq!((config.monitor.sample.ambient_c, config.monitor.sample.cells), (11.0, 3));
    assert_eq!(config.monitor.rules.len(), 2);
    assert_eq!(good_with(&["[store]\ncheckpoint_s = 7\n"]).store.checkpoint_s, 7.0);
}

#[test]
fn fault_names_drop_in_and_line() {
    let all = faults_with(&[
        "\n[pack]\ncells = 0\n[[interface]]\nname = \"can0\"\n",
        "[pack]\n\nstrngs = 2\n[[alarm]]\nrule = \"soc_low\"\n[store]\ncheckpoint_s = 0\n",
    ]);
    let expected = [
        "2.toml:3: pack.strngs is not a known key, did you mean strings",
        "2.toml:4: alarm[1] has no threshold, must have info, warning or severe",
        "2.toml:7: store.checkpoint_s = 0, must be 1 to 3600",
        "1.toml:3: pack.cells = 0, must be 1 to 1024",
        "1.toml:5: interface[2].name = \"can0\", must be unique, but is also the name in pack.toml:5",
        "pack.toml:8: input.current.interface is not set, must be can0",
        "pack.toml:11: input.cell_voltage.interface is not set, must be can0",
        "pack.toml:13: input.temperature[1].interface is not set, must be can0",
    ];
    assert_eq!(all, expected);
}

#[test]
fn syntax_error_in_drop_in_does_not_hide_other_faults() {
    let all = faults_with(&["[pack]\ncells = \n", "[store]\ncheckpoint_s = 0\n"]);
    assert!(all.iter().any(|fault| fault.starts_with("1.toml:2: ")), "{all:?}");
    assert!(all.contains(&"2.toml:2: store.checkpoint_s = 0, must be 1 to 3600".to_owned()), "{all:?}");
}

#[test]
fn table_of_other_type_is_rejected_at_its_file() {
    let all = faults_with(&["pack = 3\n"]);
    assert_eq!(all, ["1.toml:1: pack = 3, must be one table [pack]"]);
}
