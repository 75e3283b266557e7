//! Runs `packwatch gpr` as a user does, on small generated data.

use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::lab::gpr::{ColumnSelection, ColumnTable, MissingPolicy, PartColumn, TrainedModel};
use packwatch::regress::{Form, GprSettings};
use serde_json::Value;

fn gpr(folder: &Path, args: &[&str]) -> std::process::Output {
    Command::cargo_bin("packwatch").unwrap().current_dir(folder).arg("gpr").args(args).output().unwrap()
}

fn printed(folder: &Path, args: &[&str]) -> String {
    let output = gpr(folder, args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn json(folder: &Path, args: &[&str]) -> Value {
    serde_json::from_str(&printed(folder, &[args, &["--json"]].concat())).unwrap()
}

/// Standard error of a run that must fail with this exit code and without standard output.
fn refused(folder: &Path, code: i32, args: &[&str]) -> String {
    let output = gpr(folder, args);
    assert_eq!(output.status.code(), Some(code), "{args:?}");
    assert!(output.stdout.is_empty(), "{args:?}");
    String::from_utf8(output.stderr).unwrap()
}

fn noise(mut state: u64) -> impl FnMut() -> f64 {
    move || {
        // The sum of twelve uniform numbers is approximately normal.
        let mut sum = -6.0;
        for _ in 0..12 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            sum += (state >> 11) as f64 / (1_u64 << 53) as f64;
        }
        sum
    }
}

/// Writes a CSV file in which the voltage is a function of time, temperature and current, with 20 mV of noise.
fn rows(folder: &Path, name: &str, count: u32, seed: u64) -> PathBuf {
    let mut draw = noise(seed);
    let mut text = "time_s,current_a,voltage_v,temperature_c,voltage_mv\n".to_owned();
    for k in 0..count {
        let (current, temperature) = (2.0 * draw(), 25.0 + 5.0 * draw());
        let voltage =
            3.7 + 0.2 * (f64::from(k) / 30.0).sin() - 0.1 * current + 0.01 * (temperature - 25.0) + 0.02 * draw();
        writeln!(text, "{k},{current:.4},{voltage:.4},{temperature:.3},{:.1}", 1000.0 * voltage).unwrap();
    }
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

const COLUMNS: [&str; 4] = ["--output", "voltage_v", "--inputs", "time,temperature,current"];

#[test]
fn cross_validation_reports_every_kernel() {
    let folder = tempfile::tempdir().unwrap();
    let (place, csv) = (folder.path(), rows(folder.path(), "cell.csv", 240, 3));
    let file = csv.file_name().unwrap().to_str().unwrap();
    let asked = ["--kernel", "exponential,squared-exponential,exponential + matern52", "--folds", "3"];
    let found = json(place, &[&["cv", file, "--predictions", "all.csv"], &COLUMNS[..], &asked].concat());
    assert_eq!(found["output"], "voltage_v");
    assert_eq!(found["inputs"], serde_json::json!(["time_s", "temperature_c", "current_a"]));
    assert_eq!((&found["rows"], &found["form"]), (&240.into(), &"exact".into()));
    let kernels = found["kernels"].as_array().unwrap();
    let names: Vec<&str> = kernels.iter().map(|kernel| kernel["kernel"].as_str().unwrap()).collect();
    assert_eq!(names, ["exponential", "squared_exponential", "exponential + matern52"]);
    for kernel in kernels {
        let number = |name: &str| kernel[name].as_f64().unwrap();
        // The 20 mV of noise cannot be predicted. A constant prediction (the mean) would have an error of 280 mV.
        assert!((0.019..0.06).contains(&number("rmse")), "{kernel}");
        assert!(number("mean_absolute_error") < number("rmse") && number("training_s") > 0.0, "{kernel}");
        assert!((0.89..=0.995).contains(&number("coverage_95")), "{kernel}");
        assert!(number("peak_memory_kib") > 1000.0 && kernel["folds"].as_array().unwrap().len() == 3, "{kernel}");
    }
    // The printed score must equal the score computed from the written rows.
    let text = std::fs::read_to_string(place.join("all.csv")).unwrap();
    assert_eq!(
        text.lines().next().unwrap(),
        "kernel,file,line,fold,voltage_v,voltage_mean_v,voltage_std_v,voltage_low_95_v,voltage_high_95_v"
    );
    let squares: Vec<f64> = text
        .lines()
        .skip(1)
        .take(240)
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            assert_eq!((cells[0], cells[1]), ("exponential", "cell.csv"));
            (cells[4].parse::<f64>().unwrap() - cells[5].parse::<f64>().unwrap()).powi(2)
        })
        .collect();
    assert_eq!(text.lines().count(), 1 + 3 * 240);
    let rmse = (squares.iter().sum::<f64>() / 240.0).sqrt();
    assert!((rmse - kernels[0]["rmse"].as_f64().unwrap()).abs() < 1e-12);
    let shown = printed(
        place,
        &[&["cv", file, "--kernel", "matern32", "--folds", "2", "--plots", "plots"], &COLUMNS[..]].concat(),
    );
    assert!(shown.contains("form exact (chosen by the number of rows") && shown.contains("RMSE"), "{shown}");
    assert!(shown.lines().any(|line| line.starts_with("matern32") && line.ends_with("240")), "{shown}");
    let picture = std::fs::read_to_string(place.join("plots/cv_matern32.svg")).unwrap();
    assert!(picture.contains("predicted against measured") && picture.contains("95 % interval"));
}

fn means(text: &str) -> Vec<u64> {
    let mean = |line: &str| line.split(',').nth(6).unwrap().parse::<f64>().unwrap().to_bits();
    text.lines().skip(1).map(mean).collect()
}

/// Bit patterns of the means predicted directly after the fit, without saving the model.
fn means_of_a_model_never_saved(folder: &Path, form: &str) -> Vec<u64> {
    let table = |name: &str| {
        let columns = ["time", "temperature", "current", "voltage_v"].map(str::to_owned);
        let wanted = ColumnSelection { columns: &columns, optional: &[], missing: MissingPolicy::Rejected };
        ColumnTable::read(&[folder.join(name)], &wanted, &PartColumn::None).unwrap()
    };
    let mut settings = GprSettings::new("matern32".parse().unwrap(), 200);
    settings.form = match form {
        "exact" => Form::Exact,
        _ => Form::Nearest { neighbours: 40 },
    };
    let trained = TrainedModel::fit(&table("cell.csv"), &settings, &mut |_| ControlFlow::Continue(())).unwrap();
    trained.predict(&table("later.csv")).unwrap().iter().map(|prediction| prediction.mean.to_bits()).collect()
}

#[test]
fn saved_model_predicts_bit_identically() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    rows(place, "cell.csv", 200, 3);
    rows(place, "later.csv", 60, 4);
    for form in ["exact", "nearest"] {
        let train = ["train", "cell.csv", "--form", form, "--kernel", "matern32", "-o", "model.json"];
        let first = json(place, &[&train[..], &COLUMNS].concat());
        assert_eq!((&first["rows"], &first["kernel"]), (&200.into(), &"matern32".into()));
        let model = std::fs::read(place.join("model.json")).unwrap();
        printed(place, &[&train[..], &COLUMNS].concat());
        assert!(
            std::fs::read(place.join("model.json")).unwrap() == model,
            "{form}: two trainings gave different models"
        );
        let found = json(place, &["predict", "model.json", "later.csv", "-o", "out.csv"]);
        assert_eq!((&found["rows"], &found["known"]), (&60.into(), &60.into()));
        assert!(found["score"]["rmse"].as_f64().unwrap() < 0.08, "{form}: {found}");
        assert!(found["score"]["coverage_95"].as_f64().unwrap() > 0.85, "{form}: {found}");
        let written = std::fs::read_to_string(place.join("out.csv")).unwrap();
        // Predict again from the saved model with one thread.
        let again = printed(place, &["predict", "model.json", "later.csv", "--threads", "1"]);
        assert!(again == written, "{form}: other predictions");
        assert_eq!(means_of_a_model_never_saved(place, form), means(&written), "{form}");
    }
    // Without the output column there is no score, but the rows must still be predicted.
    std::fs::write(place.join("new.csv"), "current_a,temperature_c,time_s\n1,25,10\n0,30,20\n").unwrap();
    let found = json(place, &["predict", "model.json", "new.csv", "-o", "out.csv"]);
    assert_eq!((&found["rows"], &found["known"], &found["score"]), (&2.into(), &0.into(), &Value::Null));
}

#[test]
fn bad_input_error_names_place_and_range() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    rows(place, "cell.csv", 40, 3);
    let cv =
        |output: &str, inputs: &str| refused(place, 1, &["cv", "cell.csv", "--output", output, "--inputs", inputs]);
    assert_eq!(
        cv("pressure", "time"),
        "cell.csv:1: no column \"pressure\", must be one of time_s, current_a, voltage_v, temperature_c, voltage_mv\n"
    );
    assert!(cv("voltage", "time").contains("\"voltage\" is ambiguous, found voltage_v, voltage_mv"));
    assert!(cv("voltage_v", "time,voltage_v").contains("column voltage_v is given twice"));
    assert!(refused(place, 1, &[&["cv", "nowhere.csv"], &COLUMNS[..]].concat()).starts_with("nowhere.csv: "));
    // A row with a missing value is rejected with its line number, or skipped and counted.
    let text = std::fs::read_to_string(place.join("cell.csv")).unwrap();
    let holes: String = text
        .lines()
        .enumerate()
        .map(|(k, line)| match k {
            7 => "6,,3.7,25,3700\n".to_owned(),
            9 => "8,1.0,NaN,25,3700\n".to_owned(),
            _ => format!("{line}\n"),
        })
        .collect();
    std::fs::write(place.join("holes.csv"), holes).unwrap();
    let hole = refused(place, 1, &[&["cv", "holes.csv"], &COLUMNS[..]].concat());
    assert!(hole.starts_with("holes.csv:8: column current_a: found \"\", must be a finite number"), "{hole}");
    let some =
        [&["cv", "holes.csv", "--skip-missing", "--kernel", "exponential", "--folds", "2"], &COLUMNS[..]].concat();
    let found = json(place, &some);
    assert_eq!((&found["rows"], &found["skipped"]), (&38.into(), &2.into()));
    assert!(printed(place, &some).contains("2 rows left out: a value is missing"));
    std::fs::write(place.join("few.csv"), text.lines().take(4).collect::<Vec<_>>().join("\n")).unwrap();
    let few = refused(place, 1, &[&["cv", "few.csv"], &COLUMNS[..]].concat());
    assert!(few.contains("folds = 5, must be"), "{few}");
    let kernel = refused(place, 2, &[&["cv", "cell.csv", "--kernel", "gaussian"], &COLUMNS[..]].concat());
    assert!(kernel.contains("found gaussian, allowed: exponential, squared_exponential"), "{kernel}");
    assert!(
        refused(place, 1, &["predict", "cell.csv", "cell.csv"])
            .contains("line 1: not a model file of `packwatch gpr train`")
    );
    printed(place, &[&["train", "cell.csv", "-o", "model.json"], &COLUMNS[..]].concat());
    let model = std::fs::read_to_string(place.join("model.json")).unwrap();
    std::fs::write(place.join("model.json"), model.replacen("targets\":[", "targets\":[1", 1)).unwrap();
    assert!(refused(place, 1, &["predict", "model.json", "cell.csv"]).contains("damaged: checksum"));
    let lags = refused(place, 1, &["forecast", "cell.csv", "--outputs", "voltage_v", "--lags", "60"]);
    assert!(lags.contains("lags = 60, must be at most the rows of a part before the origin"), "{lags}");
    let steps = refused(place, 1, &["forecast", "cell.csv", "--outputs", "voltage_v", "--steps", "20"]);
    assert!(steps.contains("windows of 5 lags and"), "{steps}");
}

/// Writes a CSV file with a voltage and a temperature, in parts of 400 rows. The voltage is autoregressive,
/// x(t) = 1.6 x(t-1) - 0.64 x(t-2) + e, and drives the temperature.
fn process(folder: &Path) {
    let mut draw = noise(11);
    let mut text = "cycle,time_s,voltage_v,temperature_c\n".to_owned();
    for cycle in 0..6 {
        let (mut x, mut y) = ([0.0, 0.0], 25.0);
        for k in 0..450 {
            x = [1.6 * x[0] - 0.64 * x[1] + 0.01 * draw(), x[0]];
            y += 0.1 * (25.0 + 20.0 * x[0] - y) + 0.05 * draw();
            // Skip the beginning of each part because it still depends on the initial values.
            if k >= 50 {
                writeln!(text, "{cycle},{},{:.5},{:.4}", 10 * (k - 50), 3.7 + x[0], y).unwrap();
            }
        }
    }
    std::fs::write(folder.join("process.csv"), text).unwrap();
}

#[test]
fn forecast_interval_holds_and_error_grows() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    process(place);
    let asked = ["forecast", "process.csv", "--outputs", "voltage,temperature", "--lags", "3", "--steps", "12"];
    let more = ["--rows", "250", "--predictions", "all.csv", "--plots", "plots"];
    let found = json(place, &[&asked[..], &more].concat());
    assert_eq!((&found["parts"], &found["origin_rows"], &found["rows"]), (&6.into(), &1680.into(), &2400.into()));
    assert_eq!((&found["time_step"]["median"], &found["time_step"]["even"]), (&10.0.into(), &true.into()));
    for output in found["outputs"].as_array().unwrap() {
        let horizons = output["horizons"].as_array().unwrap();
        assert_eq!(horizons.last().unwrap()["steps"], 12);
        let of = |name: &str| -> Vec<f64> { horizons.iter().map(|h| h["score"][name].as_f64().unwrap()).collect() };
        let (rmse, width, inside) = (of("rmse"), of("mean_width_95"), of("coverage_95"));
        for (k, coverage) in inside.iter().enumerate() {
            assert!((0.90..=0.985).contains(coverage), "{}, {k}: {inside:?}", output["name"]);
        }
        // The error must grow with the horizon. Because the sample is finite, it may fall slightly between two
        // horizons.
        assert!(rmse.windows(2).all(|pair| pair[1] > 0.98 * pair[0]), "{}: {rmse:?}", output["name"]);
        assert!(rmse[rmse.len() - 1] > 2.0 * rmse[0] && width[width.len() - 1] > 2.0 * width[0]);
        let persistence = of("persistence_rmse");
        assert!(rmse.iter().zip(&persistence).all(|(ours, naive)| ours < naive), "{rmse:?} against {persistence:?}");
    }
    // The error one step ahead is the process noise of 10 mV.
    let first = found["outputs"][0]["horizons"][0]["score"]["rmse"].as_f64().unwrap();
    assert!((0.0092..0.0115).contains(&first), "{first}");
    let text = std::fs::read_to_string(place.join("all.csv")).unwrap();
    assert!(
        text.starts_with(
            "output,ahead,file,line,origin,mean,std,low_95,high_95,measured\nvoltage_v,1,process.csv,1681,"
        )
    );
    assert!(
        place.join("plots/forecast_voltage_v.svg").is_file()
            && place.join("plots/forecast_temperature_c.svg").is_file()
    );
}

#[test]
fn forecast_ignores_rows_after_origin() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    process(place);
    let text = std::fs::read_to_string(place.join("process.csv")).unwrap();
    let known: String = text.lines().take(1 + 1320).map(|line| format!("{line}\n")).collect();
    std::fs::write(place.join("known.csv"), known).unwrap();
    let asked = ["--outputs", "voltage", "--inputs", "temperature", "--lags", "2", "--steps", "3", "--rows", "120"];
    let judged = json(place, &[&["forecast", "process.csv", "--origin", "55"], &asked[..]].concat());
    let ahead = json(place, &[&["forecast", "known.csv", "--origin", "100"], &asked[..]].concat());
    let of = |found: &Value| -> Vec<Value> {
        found["outputs"][0]["horizons"].as_array().unwrap().iter().map(|h| h["at_origin"].clone()).collect()
    };
    assert_eq!(of(&judged), of(&ahead));
    assert_eq!(ahead["outputs"][0]["horizons"][2]["score"], Value::Null);
    let shown = printed(place, &[&["forecast", "known.csv", "--origin", "100"], &asked[..]].concat());
    assert!(
        shown.contains("low 95 %") && shown.contains("1320 rows are known; forecast from known.csv:1321"),
        "{shown}"
    );
}
