//! Runs `packwatch cells` and `packwatch model` as a user does.

use std::path::{Path, PathBuf};
use std::process::Output;

use assert_cmd::Command;
use serde_json::Value;

fn packwatch(args: &[&str]) -> Output {
    Command::cargo_bin("packwatch").unwrap().current_dir(env!("CARGO_MANIFEST_DIR")).args(args).output().unwrap()
}

fn good(args: &[&str]) -> String {
    let output = packwatch(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn json(args: &[&str]) -> Value {
    serde_json::from_str(&good(args)).unwrap()
}

fn refused(code: i32, args: &[&str]) -> String {
    let output = packwatch(args);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stderr).unwrap()
}

const PANASONIC: &str = "config/cells/panasonic_18650pf.toml";

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn name(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }
}

#[test]
fn cells_lists_shipped_models_and_chemistries() {
    let page = good(&["cells"]);
    for part in ["Panasonic NCR18650PF", "NASA PCoE B0005", "licence: MIT", "lfp-graphite", "not stated"] {
        assert!(page.contains(part), "no {part} in\n{page}");
    }
    let document = json(&["cells", "--json", "config/cells"]);
    let models = document["models"].as_array().unwrap();
    let shipped = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/cells")).unwrap();
    let files = shipped.filter(|entry| entry.as_ref().unwrap().path().extension().is_some_and(|it| it == "toml"));
    assert_eq!(models.len(), files.count());
    let leaf = models.iter().find(|model| model["name"] == "Nissan Leaf 2013 cell").unwrap();
    assert_eq!(leaf["licence"], "MIT");
    assert_eq!(leaf["measured"]["temperature_c"], serde_json::json!([10.0, 40.0]));
    let error_v = leaf["voltage_error_v"].as_f64().unwrap();
    assert!(error_v > 0.002 && error_v < 0.1, "{error_v}");
    let chemistries = document["chemistries"].as_array().unwrap();
    assert_eq!(chemistries.len(), packwatch::cell::Chemistry::ALL.len());
    assert!(chemistries.iter().all(|it| (1.0..10.0).contains(&it["soc_error_points"].as_f64().unwrap())), "{document}");
}

#[test]
fn invalid_cell_model_is_reported_last() {
    let place = Place::new();
    std::fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join(PANASONIC), place.path("good.toml")).unwrap();
    std::fs::write(place.path("bad.toml"), "format = 1\n").unwrap();
    let output = packwatch(&["cells", &place.name("")]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stdout).unwrap().contains("Panasonic NCR18650PF"));
    assert!(String::from_utf8(output.stderr).unwrap().contains("bad.toml:1: name is missing"));
    assert!(refused(1, &["cells", "/nonexistent"]).contains("/nonexistent: cannot be listed"));
}

fn numbers(value: &Value, found: &mut Vec<(String, f64)>, path: &str) {
    match value {
        Value::Number(number) => found.push((path.to_owned(), number.as_f64().unwrap())),
        Value::Array(items) => items.iter().for_each(|item| numbers(item, found, path)),
        Value::Object(items) => items.iter().for_each(|(key, item)| numbers(item, found, &format!("{path}.{key}"))),
        _ => {}
    }
}

#[test]
fn show_states_valid_bands_and_priors() {
    for source in ["nca-graphite:2.9", "lfp-graphite:280", PANASONIC, "config/cells/nasa_b0005.toml"] {
        let document = json(&["model", "show", "--json", source]);
        let mut found = Vec::new();
        numbers(&document, &mut found, "");
        let bands: Vec<_> = found.iter().filter(|(path, _)| path.contains("std")).collect();
        assert!(bands.len() > 5 && bands.iter().all(|(_, value)| *value >= 0.0), "{source}: {bands:?}");
        // JSON has no NaN, so NaN would be written as null. Null is allowed only if the model states no error.
        let is_stated = document["soc_error_points"].is_number();
        assert_eq!(is_stated, !source.contains("nasa"), "{source}");
        let nulls = document["curve"].as_array().unwrap().iter().filter(|row| row["ocv_std_v"].is_null()).count();
        assert_eq!(nulls == 0, is_stated, "{source}");
    }
    let page = good(&["model", "show", "--chemistry", "nca-graphite", "--rated", "2.9"]);
    assert!(page.contains("label only (prior)") && page.contains("most useful measurements"), "{page}");
    let page = good(&["model", "show", PANASONIC]);
    assert!(page.contains("measured") && page.contains("extrapolated") && page.contains("Mendeley"), "{page}");
    let page = good(&["model", "show", "-c", "config/measured.toml"]);
    assert!(page.contains("NASA PCoE B0005") && page.contains("unknown"), "{page}");
    assert_eq!(page, good(&["model", "show", "config/measured.toml"]), "a configuration is recognised");
}

#[test]
fn exported_model_reads_back_unchanged() {
    let place = Place::new();
    let (out, again) = (place.name("out.toml"), place.name("again.toml"));
    for source in ["nmc811-graphite:60", PANASONIC, "config/cells/nasa_b0005.toml"] {
        good(&["model", "export", source, "-o", &out]);
        let document = json(&["model", "compare", "--json", source, &out]);
        assert_eq!(document["ocv_v"]["rms"], 0.0, "{document}");
        assert_eq!(document["capacity"], 0.0);
        assert!(document["rest_soc"]["worst"].as_f64().unwrap().abs() < 1e-12);
        let first = std::fs::read_to_string(&out).unwrap();
        good(&["model", "export", &out, "-o", &again]);
        let second = std::fs::read_to_string(&again).unwrap();
        let body = |text: &str| text.split_once('\n').unwrap().1.to_owned();
        assert_eq!(body(&first), body(&second), "{source}");
    }
    assert!(
        refused(1, &["model", "export", &out, "-o", &out]).contains("out.toml"),
        "an input must not be overwritten"
    );
}

#[test]
fn exported_label_gives_same_intervals() {
    let place = Place::new();
    let model = place.name("cell.toml");
    good(&["model", "export", "nca-graphite:2.9", "-o", &model]);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    std::fs::copy(root.join("config/measured.dbc"), place.path("measured.dbc")).unwrap();
    let score = std::fs::read_to_string(root.join("config/score.toml")).unwrap();
    let with = |name: &str, keys: &str| {
        let line = |line: &str| if line.starts_with("cell_model") { keys.to_owned() } else { line.to_owned() };
        let text: Vec<String> = score.lines().map(line).collect();
        std::fs::write(place.path(name), text.join("\n")).unwrap();
        packwatch::config::load(&place.path(name)).unwrap().monitor
    };
    let label = with("label.toml", "chemistry = \"nca-graphite\"\nrated_capacity_ah = 2.9");
    let file = with("file.toml", "cell_model = \"cell.toml\"");
    assert_eq!(label.estimator, file.estimator);
    assert_eq!(label.model, file.model);
}

#[test]
fn compare_reports_distance_of_models() {
    let document = json(&["model", "compare", "--json", "nca-graphite:2.9", PANASONIC]);
    let rms_v = document["ocv_v"]["rms"].as_f64().unwrap();
    assert!(rms_v > 0.005 && rms_v < 0.2, "{document}");
    let back = json(&["model", "compare", "--json", PANASONIC, "nca-graphite:2.9"]);
    assert_eq!(back["ocv_v"]["rms"].as_f64().unwrap(), rms_v);
    assert_eq!(back["ocv_v"]["worst"].as_f64().unwrap(), -document["ocv_v"]["worst"].as_f64().unwrap());
    assert!(document["temperatures"].as_array().unwrap().len() >= 5);
    let page = good(&["model", "compare", PANASONIC, PANASONIC]);
    assert!(page.contains("0.0 mV rms") && page.contains("+0.0 %") && !page.contains("-0.0"), "{page}");
}

#[test]
fn invalid_source_error_lists_allowed_sources() {
    assert!(refused(1, &["model", "show", "nosuch"]).contains("nosuch: no such file; must be a cell model file"));
    assert!(refused(1, &["model", "show", "nmc:3"]).contains("chemistries: nmc811-graphite, nmc-graphite, "));
    assert!(refused(1, &["model", "show", "nca-graphite:-3"]).contains("must be a finite number above 0 (Ah)"));
    let unusual = ["model", "show", "--chemistry", "lfp-graphite", "--rated", "5", "--voltage-min", "3.9"];
    assert!(refused(1, &unusual).contains("is not a plausible range for lfp-graphite"));
    refused(2, &["model", "show"]);
    assert!(refused(78, &["model", "show", "Cargo.toml"]).contains("Cargo.toml:"));
    assert!(refused(1, &["model", "show", "--state", "config"]).contains("no history found"));
}

/// Simulates the log of a one-cell vehicle and replays it with a configuration that states only the cell's label, so
/// that the monitor learns the cell model. Returns the folder with the log, the snapshot and the store. The log
/// contains deep charges and discharges for most of a day, and the first readings after the night.
fn learned() -> Place {
    let place = Place::new();
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    for name in ["measured.dbc", "packwatch.dbc"] {
        std::fs::copy(config.join(name), place.path(name)).unwrap();
    }
    let text = std::fs::read_to_string(config.join("paper.toml")).unwrap();
    let with_cell = |keys: &str| {
        let line = |line: &str| if line.starts_with("cell_model") { keys.to_owned() } else { line.to_owned() };
        text.lines().map(line).collect::<Vec<_>>().join("\n")
    };
    std::fs::write(place.path("pack.toml"), with_cell("chemistry = \"nmc811-graphite\"\nlearn_model = true")).unwrap();
    std::fs::write(place.path("truth.toml"), with_cell("cell_model = \"cell.toml\"")).unwrap();
    good(&["model", "export", "nmc811-graphite:2.6", "-o", &place.name("cell.toml")]);
    let log = place.name("day.log");
    good(&["simulate", "random-walk", "-c", &place.name("truth.toml"), "-o", &log, "--duration", "60000"]);
    let mut lines = std::fs::read_to_string(&log).unwrap();
    let last = lines.lines().last().unwrap().to_owned();
    let (stamp, frame) = last.trim_start_matches('(').split_once(')').unwrap();
    let evening_s: f64 = stamp.parse().unwrap();
    lines.extend((0..30).map(|second| format!("({:.6}){frame}\n", evening_s + 20_000.0 + f64::from(second))));
    std::fs::write(&log, lines).unwrap();
    let (pack, snapshot) = (place.name("pack.toml"), place.name("snapshot.json"));
    good(&["replay", "-c", &pack, &log, "--snapshot", &snapshot, "--state", &place.name("state")]);
    place
}

#[test]
fn learned_model_is_shown_exported_and_reported() {
    let place = learned();
    let (snapshot, pack) = (place.name("snapshot.json"), place.name("pack.toml"));
    let document = json(&["model", "show", "--json", &snapshot]);
    assert!(["learning", "learned"].contains(&document["state"].as_str().unwrap()), "{document}");
    assert!(document["learned"]["fits"].as_u64().unwrap() >= 1 && document["learned"]["residual_v"].is_number());
    assert!(document["learned"]["soc_share"].as_f64().unwrap() > 0.2, "{document}");
    let rows = ["curve", "resistances"].map(|table| document[table].as_array().unwrap());
    let known: Vec<&str> = rows.into_iter().flatten().map(|row| row["known_by"].as_str().unwrap()).collect();
    assert!(known.contains(&"data") && known.contains(&"prior"), "{known:?}");
    let prior = json(&["model", "show", "--json", &pack]);
    let points = |document: &Value| document["soc_error_points"].as_f64().unwrap();
    assert!(points(&document) < 0.8 * points(&prior), "{} of {}", points(&document), points(&prior));
    let same = |of: &Value| Value::from(vec![of["curve"].clone(), of["resistances"].clone(), of["advice"].clone()]);
    let stored = json(&["model", "show", "--json", "--state", &place.name("state")]);
    assert_close(&same(&stored), &same(&document));
    let out = place.name("learned.toml");
    good(&["model", "export", &snapshot, "-o", &out]);
    let compared = json(&["model", "compare", "--json", &snapshot, &out]);
    assert_eq!((&compared["ocv_v"]["rms"], &compared["capacity"]), (&Value::from(0.0), &Value::from(0.0)));
    let exported = json(&["model", "show", "--json", &out]);
    assert_eq!(exported["capacity_std_ah"], document["capacity_std_ah"]);
    assert!(exported["data"].as_str().unwrap().contains("learned on board"), "{exported}");
    #[cfg(feature = "lab")]
    check_report(&place, &document);
}

/// Asserts that two documents agree. Numbers may differ by 1e-6 because a stored state keeps nine digits.
fn assert_close(found: &Value, wanted: &Value) {
    match (found, wanted) {
        (Value::Array(found), Value::Array(wanted)) if found.len() == wanted.len() => {
            found.iter().zip(wanted).for_each(|(found, wanted)| assert_close(found, wanted));
        }
        (Value::Object(found), Value::Object(wanted)) if found.len() == wanted.len() => {
            wanted.iter().for_each(|(name, wanted)| assert_close(&found[name], wanted));
        }
        (Value::Number(found), Value::Number(wanted)) => {
            let [found, wanted] = [found, wanted].map(|number| number.as_f64().unwrap());
            assert!((found - wanted).abs() <= 1e-6 * wanted.abs().max(1.0), "{found} is not {wanted}");
        }
        _ => assert_eq!(found, wanted),
    }
}

#[test]
fn learned_model_is_in_history() {
    let place = learned();
    let state = place.name("state");
    let document = json(&["history", "--state", &state, "--kind", "model", "--json"]);
    let rows = document["rows"].as_array().unwrap();
    let last = rows.last().unwrap();
    let known = json(&["model", "show", "--json", "--state", &state]);
    let change = known["learned"]["changes"].as_array().unwrap().last().unwrap();
    for column in ["state", "capacity_ah", "capacity_std_ah", "residual_v"] {
        assert_close(&last[column], &change[column]);
    }
    assert_eq!((&last["cell"], &last["chemistry"], &last["taken_back"]), (&Value::Null, &Value::Null, &Value::from(0)));
    assert!(last["capacity_ah"].as_f64().is_some_and(|ah| (2.3..2.9).contains(&ah)), "{last}");
    assert!(good(&["history", "--state", &state, "verify"]).contains("none changed"));
    let table = good(&["history", "--state", &state, "--kind", "model"]);
    let line = table.lines().last().unwrap();
    assert!(line.contains("model") && line.contains(" pack ") && line.contains(" Ah, residuals 0.0"), "{line}");
    let csv = good(&["history", "--state", &state, "export", "--kind", "model"]);
    let heads = "cell,state,capacity_ah,capacity_std_ah,residual_v,chemistry,taken_back";
    assert!(csv.lines().next().unwrap().ends_with(heads) && csv.lines().count() == 1 + rows.len(), "{csv}");
    let one_cell = json(&["history", "--state", &state, "--kind", "model", "--cell", "1", "--json"]);
    assert_eq!(one_cell["rows"], Value::Array(Vec::new()), "the model belongs to all cells, not to one");
    let later = json(&["history", "--state", &state, "--kind", "model", "--since", "4000000000", "--json"]);
    assert_eq!(later["rows"], Value::Array(Vec::new()));
}

/// Reports of the log and of the store must give the same advice as `model show`.
#[cfg(feature = "lab")]
fn check_report(place: &Place, document: &Value) {
    let page = place.name("page.html");
    good(&["report", "-c", &place.name("pack.toml"), &place.name("day.log"), "-o", &page]);
    let from_log = std::fs::read_to_string(&page).unwrap();
    good(&["report", "--state", &place.name("state"), "-o", &page]);
    let from_store = std::fs::read_to_string(&page).unwrap();
    let advice = document["advice"].as_array().unwrap();
    assert!(!advice.is_empty());
    for page in [from_log, from_store] {
        assert!(page.contains("How well the battery is known") && page.contains("from the vehicle's own data"));
        assert!(page.contains("Learned changes of the model") && page.contains(">learning</td>"), "no history");
        for it in advice {
            let (measurement, left) = (it["measurement"].as_str().unwrap(), it["left_points"].as_f64().unwrap());
            assert!(page.contains(&format!("<li>{measurement} (error then: {left:.1} points)</li>")), "no {it}");
        }
    }
}

#[cfg(feature = "lab")]
#[test]
fn plot_writes_all_pictures_as_svg() {
    let place = Place::new();
    let out = place.name("model.svg");
    good(&["model", "plot", "nca-graphite:2.9", "-o", &out]);
    let text = std::fs::read_to_string(&out).unwrap();
    for part in ["open-circuit voltage", "Slope of the curve", "over SOC", "over temperature", "Error of the SOC"] {
        assert!(text.contains(part), "no {part}");
    }
    assert!(text.contains("95 % interval") && !text.contains("NaN"));
    assert!(refused(1, &["model", "plot", PANASONIC, "-o", &place.name("model.jpg")]).contains("must end in .svg"));
}
