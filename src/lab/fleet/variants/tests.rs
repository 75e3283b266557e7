//! Tests which configurations a grid contains, and which keys are rejected.

use std::fs;
use std::path::PathBuf;

use super::*;
use crate::alarm::{Comparison, Severity};

const ALARMS: &str = "
[[alarm]]
rule = \"capacity_low\"
info = { set = 2.2, clear = 2.3 }
warning = 2.0
debounce_events = 2
[[alarm]]
rule = \"input_missing\"
severe = 5.0
";

/// Writes the demo's configuration with the alarms above into a folder.
fn written(folder: &tempfile::TempDir) -> PathBuf {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
    let text = fs::read_to_string(shipped.join("demo.toml")).expect("shipped");
    let at = text.find("[[alarm]]").expect("alarms");
    let end = text.find("[output]").expect("output");
    let text = format!("{}{ALARMS}{}", &text[..at], &text[end..]);
    let text = text.replace("\"measured.dbc\"", &format!("\"{}\"", shipped.join("measured.dbc").display()));
    let text = text.replace("\"cells/", &format!("\"{}/cells/", shipped.display()));
    let path = folder.path().join("pack.toml");
    fs::write(&path, text).expect("written");
    path
}

fn made(choices: &[&str]) -> Result<VariantGrid, Vec<String>> {
    let folder = tempfile::tempdir().expect("a folder");
    let choices: Vec<Choice> = choices.iter().map(|choice| choice.parse().expect("a choice")).collect();
    grid(&written(&folder), &choices)
}

fn threshold(variant: &Variant, severity: Severity) -> (f64, f64) {
    let rules = &variant.config.monitor.rules;
    let rule = rules.iter().find(|rule| rule.rule == Rule::CapacityLow && rule.severity == severity);
    rule.map(|rule| (rule.threshold, rule.clear)).expect("configured")
}

#[test]
fn grid_without_choices_is_the_configuration_alone() {
    let grid = made(&[]).expect("good");
    assert_eq!((grid.variants.len(), grid.replays), (1, 1));
}

#[test]
fn thresholds_of_one_rule_share_a_replay() {
    let grid = made(&["capacity_low.threshold=1.9,1.8", "capacity_low.probability=0.5,0.9"]).expect("good");
    assert_eq!((grid.variants.len(), grid.replays), (5, 1));
    assert_eq!(grid.variants[2].values, ["1.9", "0.9"]);
    assert_eq!(threshold(&grid.variants[1], Severity::Warning).0, 1.9);
    assert_eq!(threshold(&grid.variants[0], Severity::Warning).0, 2.0);
    assert!(grid.variants[2].config.monitor.rules.iter().any(|rule| rule.when == Comparison::Probability(0.9)));
    assert_eq!(grid.notes, ["capacity_low.threshold is capacity_low.warning"]);
    assert_eq!(grid.rules, [Rule::CapacityLow]);
}

#[test]
fn set_and_clear_are_changed_separately() {
    let grid = made(&["capacity_low.info=2.25", "capacity_low.warning.clear=2.1"]).expect("good");
    assert_eq!(threshold(&grid.variants[1], Severity::Info), (2.25, 2.3));
    assert_eq!(threshold(&grid.variants[1], Severity::Warning), (2.0, 2.1));
}

#[test]
fn percentages_texts_and_tables_are_accepted() {
    let grid = made(&["capacity_low.severe=60 %,70%", "capacity_low.when=mean,{ probability = 0.9 }"]).expect("good");
    assert_eq!(grid.variants.len(), 5);
    assert!((threshold(&grid.variants[1], Severity::Severe).0 - 0.6 * 2.6).abs() < 1e-12);
}

#[test]
fn other_keys_and_input_missing_need_separate_replays() {
    let grid = made(&["estimator.voltage_noise_v=0.005,0.01", "capacity_low.warning=1.9,1.8"]).expect("good");
    // The first noise is the default, which the file does not state.
    assert_eq!((grid.variants.len(), grid.replays, grid.other_keys), (5, 3, true));
    assert_eq!(made(&["input_missing.severe=4.0,6.0"]).expect("good").replays, 3);
}

#[test]
fn rule_without_alarm_can_be_tried() {
    let grid = made(&["soc_low.warning=0.1"]).expect("good");
    assert!(grid.variants[1].config.monitor.rules.iter().any(|rule| rule.rule == Rule::SocLow));
    let fault = made(&["soc_low.threshold=0.1"]).expect_err("no severity to mean");
    assert!(fault[0].contains("has no alarm of soc_low: use soc_low.info"), "{fault:?}");
}

#[test]
fn invalid_combinations_are_left_out_and_reported() {
    let grid = made(&["capacity_low.warning=1.9,2.25"]).expect("one is good");
    assert_eq!(grid.variants.len(), 2);
    assert!(grid.notes[0].starts_with("1 combinations are not valid configurations"), "{:?}", grid.notes);
    assert!(grid.notes[0].contains("capacity_low.warning=2.25: alarm["), "{:?}", grid.notes);
    let faults = made(&["capacity_low.warning=2.25"]).expect_err("none is good");
    assert!(faults[0].starts_with("capacity_low.warning=2.25: alarm[1].warning"), "{faults:?}");
}

#[test]
fn unknown_key_is_rejected_with_a_suggestion() {
    let faults = |choice: &str| made(&[choice]).expect_err("means nothing").join("; ");
    assert!(faults("capacity_low.treshold=1").contains("must be threshold, info, warning, severe"));
    assert!(
        faults("capacity_lo.warning=1").contains("did you mean capacity_low"),
        "{}",
        faults("capacity_lo.warning=1")
    );
    assert!(faults("nothing.at_all=1").contains("or a rule (rules: capacity_low, "), "{}", faults("nothing.at_all=1"));
    assert!(faults("estimator.nois=1").contains("estimator.nois is not a known key"));
    assert!(faults("interface[3].name=a").contains("the configuration has 1 of them"));
    assert!(faults("capacity_low.warning=a").contains("alarm[1].warning"), "{}", faults("capacity_low.warning=a"));
    let many: Vec<String> = (0..32).map(|n| format!("0.{n:03}")).collect();
    let list = |key: &str| format!("{key}={}", many.join(","));
    let (one, other) = (list("capacity_low.warning"), list("soc_low.warning"));
    assert!(made(&[&one, &other]).expect_err("too many")[0].contains("32 x 32 combinations, must be at most 1000"));
}

#[test]
fn choice_needs_a_key_and_values() {
    for bad in ["", "a.b", "=1", "a.b=", "a.b=1,", "a..b=1", "a.b=1,1"] {
        assert!(bad.parse::<Choice>().is_err(), "{bad:?}");
    }
    let choice: Choice = "a.b={ x = [1, 2] },\"1,2\"".parse().expect("a choice");
    assert_eq!(choice.values.len(), 2);
}
