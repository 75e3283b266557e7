//! Runs `packwatch score` as a user does, on files whose true values can be calculated by hand.

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use assert_cmd::assert::Assert;
use serde_json::Value;

/// A cell of 2 Ah. Its open-circuit voltage is linear (3 V + 1.2 V x SOC), and its resistance is very small, so that
/// every estimate can be calculated by hand.
const MODEL: &str = "format = 1
name = \"straight\"
rated_capacity_ah = 2.0
capacity_ah = 2.0
voltage_min_v = 2.7
voltage_max_v = 4.2
[tables]
soc = [0, 0.5, 1]
temperature_c = [25]
ocv_v = [[3.0, 3.6, 4.2]]
r0_ohm = [[0.001, 0.001, 0.001]]
[[tables.branches]]
r_ohm = [[0.001, 0.001, 0.001]]
c_farad = [[10000, 10000, 10000]]
";

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.write("model.toml", MODEL);
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    /// Writes a discharge of `hours` at 1 A from full. The voltages belong to a cell whose SOC is higher by `offset`.
    fn write_discharge(&self, name: &str, hours: f64, offset: f64) {
        let mut text = String::from("time_s,current_a,voltage_v,temperature_c,discharged_ah\n");
        for second in 0..=(hours * 3600.0) as u32 {
            let discharged_ah = f64::from(second) / 3600.0;
            let soc = 1.0 - discharged_ah / 2.0 + offset;
            text.push_str(&format!("{second},1,{:.5},25,{discharged_ah:.6}\n", 3.0 + 1.2 * soc - 0.002));
        }
        self.write(name, &text);
    }

    fn score(&self, args: &[&str]) -> Assert {
        let mut command = Command::cargo_bin("packwatch").unwrap();
        command.current_dir(self.folder.path()).args(["score", "--cell", "model.toml"]).args(args).assert()
    }

    fn json(&self, args: &[&str]) -> Value {
        let output = self.score(&[args, &["--json"]].concat()).success();
        serde_json::from_slice(&output.get_output().stdout).unwrap()
    }
}

fn fault(run: Assert, code: i32) -> String {
    String::from_utf8(run.code(code).get_output().stderr.clone()).unwrap()
}

fn number(score: &Value, key: &str) -> f64 {
    score["soc"][key].as_f64().unwrap_or_else(|| panic!("{key} of {score}"))
}

#[test]
fn perfect_cell_converges_from_20_points() {
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 1.5, 0.0);
    let document = bench.json(&["drive.csv", "--told=-20"]);
    let score = &document["scores"][0];
    assert!(number(score, "rmse_points") < 0.2 && number(score, "max_abs_error_points") < 0.5, "{score}");
    assert!(number(score, "converge_s") < 600.0 && number(score, "coverage") > 0.95, "{score}");
    assert_eq!(score["soc"]["samples"], 5400 - 600 + 1);
    assert_eq!((&score["soc"]["left_out_rows"], &score["uncarried_values"]), (&Value::from(0), &Value::from(0)));
    assert_eq!((&score["start"], &score["told_points"]), (&Value::from("full"), &Value::from(-20.0)));
}

#[test]
fn cell_error_appears_in_score() {
    // The voltages belong to an SOC that is 8 points higher than the SOC from the counted charge. The estimator trusts
    // the voltages.
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 1.5, 0.08);
    let score = &bench.json(&["drive.csv", "--start", "middle", "--told", "0", "--soc-std", "30"])["scores"][0];
    assert!((number(score, "mean_error_points") - 8.0).abs() < 0.5, "{score}");
    assert!((number(score, "rmse_points") - 8.0).abs() < 0.5, "{score}");
    assert!(score["soc"]["converge_s"].is_null() && number(score, "coverage") < 0.05, "{score}");
}

#[test]
fn truth_uses_given_capacity() {
    // After 1.5 Ah, a cell of 2 Ah has 25 % left and a cell of 3 Ah has 50 % left.
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 1.5, 0.0);
    let score = &bench.json(&["drive.csv", "--told", "0", "--truth-capacity", "3", "--settle", "0"])["scores"][0];
    assert!((number(score, "max_abs_error_points") - 25.0).abs() < 1.0, "{score}");
    assert!((number(score, "mean_error_points") + 12.5).abs() < 1.0, "{score}");
}

#[test]
fn start_in_middle_drops_earlier_rows() {
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 1.5, 0.0);
    let document = bench.json(&["drive.csv", "--start", "full,middle", "--told=-10", "--remove", "0.25"]);
    let rows: Vec<u64> = document["scores"].as_array().unwrap().iter().map(|s| s["rows"].as_u64().unwrap()).collect();
    // At 1 A, the SOC falls to 0.75 (0.5 of 2 Ah removed) after 1800 s.
    assert_eq!(rows, [5401, 5401 - 1800]);
    // The initial SOC is 10 points too low. The first voltage reading already corrects a part of this error.
    assert!((-10.1..-0.1).contains(&number(&document["scores"][1], "first_error_points")), "{document}");
}

#[test]
fn current_offset_is_added_before_core() {
    // In 1.5 h, a current of 0.1 A moves 7.5 % of 2 Ah.
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 1.5, 0.0);
    let args = ["drive.csv", "--told", "0", "--current-offset=-0.1,0,0.1"];
    let document = bench.json(&args);
    let offsets: Vec<_> =
        document["scores"].as_array().unwrap().iter().map(|s| s["current_offset_a"].as_f64().unwrap()).collect();
    assert_eq!(offsets, [-0.1, 0.0, 0.1]);
    let errors: Vec<_> = (0..3).map(|i| number(&document["scores"][i], "mean_error_points")).collect();
    // With +0.1 A, more charge is counted than flows, so the estimate is too low. The voltage keeps the error far below
    // 7.5 points.
    assert!(errors[0] > errors[1] + 0.02 && errors[2] < errors[1] - 0.02, "{errors:?}");
    assert!(errors.iter().all(|error| error.abs() < 1.5), "{errors:?}");
    let table = String::from_utf8(bench.score(&args).success().get_output().stdout.clone()).unwrap();
    assert!(table.contains("full told +0 I -0.1 A") && table.contains("full told +0 I +0.1 A"), "{table}");
}

#[test]
fn cases_run_on_all_files_in_order() {
    let bench = Bench::new();
    bench.write_discharge("a.csv", 1.0, 0.0);
    bench.write_discharge("b.csv", 0.8, 0.0);
    let document = bench.json(&["b.csv", "a.csv", "--told=-20,-5", "--capacity-error=-5,5", "--plot", "plots"]);
    let cases: Vec<_> = document["scores"].as_array().unwrap().iter().collect();
    let printed = |case: &Value| (case["name"].as_str().unwrap().to_owned(), case["told_points"].as_f64().unwrap());
    assert_eq!(cases.len(), 8);
    assert_eq!(printed(cases[0]), ("b".to_owned(), -20.0));
    assert_eq!(printed(cases[7]), ("a".to_owned(), -5.0));
    assert_eq!(document["totals"].as_array().unwrap().len(), 4);
    assert_eq!(document["totals"][0]["files"], 2);
    assert_eq!(fs::read_dir(bench.path("plots")).unwrap().count(), 8);
    let plot = fs::read_to_string(bench.path("plots/a_full_told-5_capacity-5.svg")).unwrap();
    assert!(plot.starts_with("<svg") && plot.contains("estimate - truth"));
}

#[test]
fn table_has_line_per_case_and_omissions() {
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 0.5, 0.0);
    let text = fs::read_to_string(bench.path("drive.csv")).unwrap();
    let holes: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(n, l)| if n == 900 { l[..=l.rfind(',').unwrap()].to_owned() } else { l.to_owned() })
        .collect();
    bench.write("drive.csv", &(holes.join("\n") + "\n"));
    let output = bench.score(&["drive.csv", "--told=-20"]).success();
    let table = String::from_utf8(output.get_output().stdout.clone()).unwrap();
    assert!(table.starts_with("cell model straight\n\nSOC in points of 2 Ah, after 600 s"), "{table}");
    assert!(table.lines().any(|line| line.starts_with("drive  full told -20  ")), "{table}");
    assert!(table.contains("drive, full told -20: 1 of 1801 rows left out (no truth or no estimate)"), "{table}");
}

#[test]
fn life_is_scored_against_its_table() {
    // Four discharges of a 2 Ah cell from 4.2 V to the cut-off at 3 V, with charges between them.
    let bench = Bench::new();
    let mut text = String::from("cycle,type,time_s,current_a,voltage_v,temperature_c\n");
    let mut table = String::from("cycle,type,start,capacity_ah_source\n");
    for cycle in 0..8 {
        let (kind, sign) = if cycle % 2 == 0 { ("discharge", 1.0) } else { ("charge", -1.0) };
        for row in 0..=720 {
            let part = f64::from(row) / 720.0;
            let soc = if cycle % 2 == 0 { 1.0 - part } else { part };
            let (seconds, voltage) = (row * 10, 3.0 + 1.2 * soc - 0.002 * sign);
            text.push_str(&format!("{cycle},{kind},{seconds},{sign},{voltage:.5},25\n"));
        }
        let capacity = if cycle % 2 == 0 { "2.0" } else { "" };
        table.push_str(&format!("{cycle},{kind},{},{capacity}\n", 9000 * cycle));
    }
    bench.write("cell.csv", &text);
    bench.write("cycles.csv", &table);
    let asked =
        ["cell.csv", "--cycles", "cycles.csv", "--skip-cycles", "2", "--capacity-error=-10", "--load", "1,25,3"];
    let life = &bench.json(&[&asked[..], &["--threshold", "1.8"]].concat())["scores"][0]["life"];
    assert_eq!(
        (&life["discharges"], &life["scored"], &life["left_out"]),
        (&Value::from(4), &Value::from(2), &Value::from(0))
    );
    let error_ah = life["mean_abs_error_ah"].as_f64().unwrap();
    assert!(error_ah < 0.05, "{life}");
    assert_eq!((&life["first_below_estimate"], &life["first_below_truth"]), (&Value::Null, &Value::Null));
    let life = &bench.json(&[&asked[..], &["--threshold", "2.2"]].concat())["scores"][0]["life"];
    assert_eq!((&life["first_below_estimate"], &life["first_below_truth"]), (&Value::from(3), &Value::from(3)));
    let seen = &bench.json(&[&asked[..], &["--window", "0.4,0.7", "--seed", "5,6"]].concat())["scores"];
    assert_eq!((&seen[0]["seed"], &seen[1]["seed"]), (&Value::from(5), &Value::from(6)));
    let rows = seen[0]["rows"].as_f64().unwrap() / 5768.0;
    assert!((0.4..0.7).contains(&rows), "{rows}");
    let no_load = fault(bench.score(&asked[..6]), 1);
    assert!(no_load.contains("--cycles needs --load"), "{no_load}");
}

#[test]
fn bad_input_error_names_place_and_range() {
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 0.5, 0.0);
    bench.write("no_counter.csv", "time_s,current_a,voltage_v\n0,1,4\n1,1,4\n");
    bench.write("empty.csv", "");
    bench.write("header.csv", "time_s,current_a,voltage_v,discharged_ah\n");
    let of = |args: &[&str]| fault(bench.score(args), 1);
    assert!(
        of(&["no_counter.csv"])
            .contains("no_counter.csv: no values in column discharged_ah, and no table with --cycles")
    );
    assert!(of(&["empty.csv"]).contains("empty.csv: is empty"));
    assert!(of(&["header.csv"]).contains("header.csv: no rows after the header"));
    assert!(of(&["missing.csv"]).contains("missing.csv: "));
    assert_eq!(
        of(&["drive.csv", "--told", "20"]).trim_end(),
        "drive.csv: initial SOC is 100.0 % and +20 points: 120.0 %, must be 0 to 100 %"
    );
    assert!(of(&["drive.csv", "--start", "middle"]).contains("drive.csv: the SOC never falls to 0.700"));
    assert!(of(&["drive.csv", "drive.csv"]).contains("drive.csv: named twice"));
    for wrong in [["--told", "much"], ["--remove", "1.5"], ["--settle", "soon"], ["--window", "0.7,0.4"]] {
        let printed = fault(bench.score(&[&["drive.csv"], &wrong[..]].concat()), 2);
        assert!(printed.contains("must be"), "{wrong:?}: {printed}");
    }
}

#[test]
fn bad_model_is_a_configuration_fault() {
    let bench = Bench::new();
    bench.write_discharge("drive.csv", 0.5, 0.0);
    bench.write("bad.toml", &MODEL.replace("capacity_ah = 2.0", "capacity_ah = -2.0"));
    let mut command = Command::cargo_bin("packwatch").unwrap();
    let run = command.current_dir(bench.folder.path()).args(["score", "--cell", "bad.toml", "drive.csv"]).assert();
    let printed = fault(run, 78);
    assert!(printed.contains("bad.toml:") && printed.contains("capacity_ah"), "{printed}");
    let missing = fault(bench.score(&["-c", "none.toml", "drive.csv"]), 78);
    assert!(missing.contains("none.toml: cannot be read"), "{missing}");
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let example = fault(bench.score(&["-c", shipped.join("example.toml").to_str().unwrap(), "drive.csv"]), 1);
    assert!(example.contains("must be 1 to score files of one cell"), "{example}");
}
