//! Checks the metrics of a sample status document: their text, and whether promtool of the Prometheus project accepts
//! them.

use std::io::Write as _;
use std::process::{Command, Stdio};

use super::super::sample::sample;
use super::*;
use crate::quantity::catalogue::{Quantity, TABLE};

/// The samples of a metric family, as written.
fn samples<'a>(text: &'a str, name: &str) -> Vec<&'a str> {
    text.lines().filter(|line| line.split(['{', ' ']).next() == Some(name)).collect()
}

#[test]
fn values_have_units_and_cells_count_from_1() {
    let text = openmetrics(Some(sample(2)));
    assert_eq!(samples(&text, "packwatch_up"), ["packwatch_up 1.0"]);
    assert_eq!(samples(&text, "packwatch_cell_voltage_volts"), ["packwatch_cell_voltage_volts{cell=\"1\"} 3.6"]);
    assert_eq!(samples(&text, "packwatch_pack_soc_ratio"), ["packwatch_pack_soc_ratio 0.632"]);
    assert_eq!(
        samples(&text, "packwatch_alarm_active"),
        ["packwatch_alarm_active{rule=\"capacity_low\",severity=\"severe\",cell=\"1\"} 1.0"]
    );
    let dropped = samples(&text, "packwatch_interface_dropped_frames_total");
    assert_eq!(dropped[0], "packwatch_interface_dropped_frames_total{interface=\"can0\",reason=\"kernel\"} 6");
    let buckets = samples(&text, "packwatch_frame_to_estimate_seconds_bucket");
    assert_eq!(buckets.last(), Some(&"packwatch_frame_to_estimate_seconds_bucket{le=\"+Inf\"} 5"));
    assert!(text.contains("# UNIT packwatch_cell_voltage_volts volts\n") && text.ends_with("# EOF\n"));
}

#[test]
fn vehicle_is_a_metric_not_a_label() {
    let mut document = sample(2);
    let without = openmetrics(Some(document.clone()));
    document.vehicle.name = Some("Bus \"12\"".to_owned());
    document.vehicle.pack = Some("front".to_owned());
    let text = openmetrics(Some(document));
    let wanted = r#"packwatch_vehicle_info{name="Bus \"12\"",pack="front"} 1"#;
    assert_eq!(samples(&text, "packwatch_vehicle_info"), [wanted]);
    let others: Vec<&str> = text.lines().filter(|line| !line.contains("packwatch_vehicle")).collect();
    assert_eq!(others, without.lines().collect::<Vec<_>>());
}

#[test]
fn unknown_values_are_omitted() {
    let mut document = sample(2);
    document.pack.values.set(Quantity::Soc, None::<f64>);
    document.cells[0].values.set(Quantity::Voltage, None::<f64>);
    let text = openmetrics(Some(document));
    assert!(!text.contains("packwatch_pack_soc_ratio") && !text.contains("packwatch_cell_voltage_volts"));
    let mut samples_only = text.lines().filter(|line| !line.starts_with('#'));
    assert!(samples_only.all(|line| !line.ends_with("NaN") && !line.ends_with("inf")));
    // The second cell is silent. The first cell has all values except its voltage.
    assert_eq!(samples(&text, "packwatch_cell_soc_ratio"), ["packwatch_cell_soc_ratio{cell=\"1\"} 0.6"]);
    // Without a daemon there is only one metric.
    let none = openmetrics(None);
    assert_eq!(none.lines().filter(|line| !line.starts_with('#')).collect::<Vec<_>>(), ["packwatch_up 0.0"]);
}

#[test]
fn older_format_has_full_counter_names_without_units() {
    let text = prometheus_text(&openmetrics(Some(sample(2))));
    assert!(text.contains("# TYPE packwatch_half_cycles_total counter\npackwatch_half_cycles_total 12\n"), "{text}");
    assert!(text.contains("# TYPE packwatch_build_info gauge\npackwatch_build_info{version=\"1.2.3\"} 1\n"));
    assert!(!text.contains("# UNIT") && !text.contains("# EOF"));
}

/// Runs `promtool check metrics` of the Debian package `prometheus`; `None` = promtool is not installed.
fn promtool(text: &str) -> Option<(bool, String)> {
    let mut child = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .ok()?;
    child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    Some((output.status.success(), String::from_utf8_lossy(&said).into_owned()))
}

#[test]
fn promtool_accepts_metrics() {
    for cells in [1, 96, 1024] {
        let text = prometheus_text(&openmetrics(Some(sample(cells))));
        let Some((is_good, said)) = promtool(&text) else { return println!("SKIPPED: no promtool here") };
        assert!(is_good && said.is_empty(), "{said}");
    }
    let (is_good, said) = promtool("# TYPE bad_total gauge\nbad_total 1\n").unwrap();
    assert!(!is_good && !said.is_empty(), "promtool must report a bad name");
}

#[test]
fn dashboard_and_rules_use_existing_metrics() {
    let mut document = sample(2);
    for row in &TABLE {
        document.pack.values.set(row.quantity, Some((0.5, 0.1)));
        document.cells[0].values.set(row.quantity, Some((0.5, 0.1)));
    }
    let text = openmetrics(Some(document));
    let known: HashSet<&str> = text.lines().filter_map(|line| line.split(['{', ' ']).next()).collect();
    for file in [
        include_str!("../../../../config/grafana/packwatch.json"),
        include_str!("../../../../config/prometheus/packwatch.rules.yml"),
    ] {
        let words = file.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
        let names: HashSet<&str> = words.filter(|word| word.starts_with("packwatch_")).collect();
        assert!(names.len() > 5 && names.is_subset(&known), "{:?}", names.difference(&known));
    }
}
