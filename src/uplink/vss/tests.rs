//! Tests the overlay as vspec and JSON, and the page of the manual.

use super::*;

/// Paths of the leaves below a JSON node, with datatypes.
fn leaves(path: &str, node: &Value, found: &mut Vec<(String, String)>) {
    if node["type"] == "branch" {
        for (name, child) in node["children"].as_object().unwrap() {
            leaves(&format!("{path}.{name}"), child, found);
        }
    } else {
        found.push((path.to_owned(), node["datatype"].as_str().unwrap().to_owned()));
    }
}

#[test]
fn both_files_list_exactly_the_overlay_signals() {
    for branch in ["Vehicle.Powertrain.TractionBattery.Packwatch", "Vehicle.Private.Makers.Packwatch"] {
        let mut expected: Vec<_> =
            signals::of_overlay().map(|signal| (signal.path(branch), signal.data_type.name().to_owned())).collect();
        expected.sort();
        let tree: Value = serde_json::from_str(&json_text(branch)).unwrap();
        let mut found = Vec::new();
        leaves("Vehicle", &tree["Vehicle"], &mut found);
        found.sort();
        assert_eq!(found, expected);
        let yaml = vspec(branch);
        for (path, data_type) in expected {
            assert!(yaml.contains(&format!("\n{path}:\n  type: sensor\n  datatype: {data_type}\n")), "{path}");
        }
    }
}

#[test]
fn own_branch_defines_parents_but_no_vss_branches() {
    let yaml = vspec("Vehicle.Private.Packwatch");
    assert!(yaml.contains("\nVehicle.Private:\n  type: branch\n") && yaml.contains("\nVehicle.Private.Packwatch:\n"));
    assert!(yaml.contains("\nVehicle.Private.Packwatch.Cells:\n  type: branch\n"));
    assert!(!yaml.contains("\nVehicle:\n"));
    let yaml = vspec("Vehicle.Powertrain.TractionBattery.Packwatch");
    assert!(!yaml.contains("\nVehicle.Powertrain:\n") && !yaml.contains("\nVehicle.Powertrain.TractionBattery:\n"));
}

#[test]
fn names_follow_vss_rules() {
    for signal in signals::of_overlay() {
        let leaf = signal.name.rsplit('.').next().unwrap();
        assert!(
            signal.name.split('.').all(|name| name.starts_with(|first: char| first.is_ascii_uppercase())),
            "{}",
            signal.name
        );
        assert!(signal.name.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '.'), "{}", signal.name);
        let is_flag = signal.data_type.name().starts_with("boolean");
        assert_eq!(is_flag, leaf.starts_with("Is"), "{}", signal.name);
        assert!(
            signal.unit.is_none_or(|unit| ["percent", "V", "A", "Ah", "kWh", "W", "s", "day"].contains(&unit)),
            "{}",
            signal.name
        );
        let branch = signal.name.split_once('.').map(|(branch, _)| description(branch));
        assert_ne!(branch, Some(description("")), "{} has a branch without a description", signal.name);
    }
}

#[test]
fn manual_page_matches_reference() {
    let page =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/src/reference/vss.md")).unwrap();
    assert!(page == reference(), "regenerate it: packwatch vss --reference > docs/src/reference/vss.md");
}
