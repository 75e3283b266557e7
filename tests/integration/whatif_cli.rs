//! Runs `packwatch whatif` as a user does. One replay must serve all alarm settings.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use serde_json::Value;

/// With 2.6 Ah and a fade of 0.05 Ah per cycle, the capacity falls below 80 % (2.08 Ah) after eleven cycles.
const CYCLES: &str = "12";

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        for (name, seed) in [("a", "1"), ("b", "2")] {
            let (log, truth) = (format!("{name}.log.gz"), format!("{name}.truth.csv"));
            let args = ["simulate", "paper", "--out", &log, "--truth", &truth, "--truth-period", "60", "--seed", seed];
            bench.run(&args, &["--cycles", CYCLES]).success();
        }
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn run(&self, args: &[&str], more: &[&str]) -> assert_cmd::assert::Assert {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo.toml");
        let mut command = Command::cargo_bin("packwatch").unwrap();
        command.current_dir(self.folder.path()).args(args).arg("--config").arg(config).args(more).assert()
    }

    fn whatif(&self, more: &[&str]) -> Value {
        let output = self.run(&["whatif", "--json"], more).success().get_output().stdout.clone();
        serde_json::from_slice(&output).unwrap()
    }
}

fn row(document: &Value, log: usize, setting: usize) -> &Value {
    let alarms = document["logs"][log]["alarms"].as_array().unwrap();
    alarms.iter().find(|row| row["setting"] == setting && row["rule"] == "capacity_low").unwrap()
}

#[test]
fn grid_replay_equals_single_replays() {
    let bench = Bench::new();
    let choices = ["--set", "capacity_low.threshold=2.35,2.2", "--set", "capacity_low.probability=0.5,0.9", "--set"];
    let sweep = bench.whatif(&[&choices[..], &["soc_low.warning=0.35", "--end-of-life", "80 %", "a.log.gz"]].concat());
    assert_eq!((sweep["replays_per_log"].as_u64(), sweep["settings"].as_array().unwrap().len()), (Some(1), 5));
    // A key outside the alarms requires a separate replay for each of its settings. Here, the key is set to its default
    // value, so the alarms must stay the same.
    let alone = ["estimator.voltage_noise_v=0.005", "--end-of-life", "80 %", "a.log.gz"];
    let alone = bench.whatif(&[&choices[..], &["soc_low.warning=0.35", "--set"], &alone].concat());
    assert_eq!(alone["replays_per_log"], 2);
    assert_eq!(sweep["logs"][0]["alarms"], {
        let all = alone["logs"][0]["alarms"].as_array().unwrap();
        let printed = all.iter().filter(|row| row["rule"] == "capacity_low" || row["rule"] == "soc_low");
        Value::Array(printed.cloned().collect())
    });
    let raises: Vec<_> = (1..5).map(|setting| row(&sweep, 0, setting)["raises"].as_u64().unwrap()).collect();
    assert!(raises[0] >= 1, "{raises:?}");
}

#[test]
fn lead_times_follow_truth_file() {
    let bench = Bench::new();
    let set = ["--set", "capacity_low.warning=2.35,2.2", "--end-of-life", "2.08", "a.log.gz", "b.log.gz"];
    let document = bench.whatif(&set);
    for log in 0..2 {
        let life = &document["logs"][log];
        assert_eq!(life["judged_by"], "true_capacity");
        let end = life["end_of_life"]["days"].as_f64().unwrap();
        let found = row(&document, log, 1);
        let raised = found["first"]["days"].as_f64().unwrap();
        assert!((found["lead_days"].as_f64().unwrap() - (end - raised)).abs() < 1e-9);
        assert_eq!((&found["missed"], &found["false_alarms"]), (&Value::Bool(false), &Value::from(0)));
        // A lower threshold must not be reached earlier.
        let later = row(&document, log, 2)["first"]["days"].as_f64();
        assert!(later.is_none_or(|later| later >= raised), "{later:?} before {raised}");
    }
    // If the cell never reaches its end of life (here 1.0 Ah), every raised alarm counts as a false alarm. With a
    // horizon, the end of life must follow a raised alarm within this time. If the log ends earlier, the alarm cannot be
    // judged and counts as open.
    let healthy = [&set[..3], &["1.0", "a.log.gz"]].concat();
    let document = bench.whatif(&healthy);
    assert_eq!(row(&document, 0, 1)["false_alarms"], row(&document, 0, 1)["raises"]);
    let document = bench.whatif(&[&healthy[..], &["--horizon", "1000"]].concat());
    assert_eq!(row(&document, 0, 1)["open"], row(&document, 0, 1)["raises"]);
}

#[test]
fn missing_truth_falls_back_to_learned_capacity() {
    let bench = Bench::new();
    std::fs::remove_file(bench.path("a.truth.csv")).unwrap();
    let more = ["--set", "capacity_low.threshold=2.3", "--end-of-life", "85 %", "a.log.gz"];
    let table = bench.run(&["whatif"], &more).success().get_output().stdout.clone();
    let table = String::from_utf8(table).unwrap();
    assert!(table.contains("judged by the learned capacity (1)"), "{table}");
    assert!(table.contains("capacity_low.threshold is capacity_low.warning"), "{table}");
    assert!(table.contains("unchanged"), "{table}");
}

#[test]
fn csv_has_row_per_log_setting_and_alarm() {
    let bench = Bench::new();
    let more = ["--set", "capacity_low.warning=2.3,2.2", "--csv", "rows.csv", "a.log.gz", "b.log.gz"];
    bench.run(&["whatif"], &more).success();
    let mut reader = csv::Reader::from_path(bench.path("rows.csv")).unwrap();
    assert!(reader.headers().unwrap().iter().any(|name| name == "capacity_low.warning"));
    assert_eq!(reader.records().map(Result::unwrap).count(), 2 * 3);
    let document = bench.whatif(&["a.log.gz"]);
    assert_eq!(document["end_of_life_ah"], 0.8 * 2.6, "capacity.end_of_life of the configuration");
}

#[test]
fn failed_log_is_reported_and_others_continue() {
    let bench = Bench::new();
    let printed = bench.run(&["whatif"], &["--set", "capacity_low.warning=2.3", "a.log.gz", "none.log"]).code(1);
    let output = printed.get_output();
    assert!(String::from_utf8_lossy(&output.stderr).contains("none.log: cannot be read"), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("a.log.gz"), "{output:?}");
    // Settings that need a separate replay must not affect the next log.
    let noises = ["--set", "estimator.voltage_noise_v=0.005,0.01", "none.log", "a.log.gz"];
    let printed = bench.run(&["whatif"], &noises).code(1);
    let output = printed.get_output();
    assert_eq!(String::from_utf8_lossy(&output.stderr).matches("none.log").count(), 1, "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("a.log.gz"), "{output:?}");
    std::fs::write(bench.path("other.log"), "(1700000000.000000) can9 123#00\n").unwrap();
    let printed = bench.run(&["whatif"], &["other.log"]).code(1);
    let output = printed.get_output();
    assert!(output.stdout.is_empty(), "no table without results: {output:?}");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("contains no record: no frame of the configured interfaces: the log has can9"), "{stderr}");
    let printed = bench.run(&["whatif"], &["--set", "estimator.voltage_noise_v=0.01", "-"]).code(1);
    let stderr = String::from_utf8_lossy(&printed.get_output().stderr).into_owned();
    assert!(stderr.contains("-: standard input can be read only once"), "{stderr}");
    let printed = bench.run(&["whatif"], &["--set", "capacity_lo.warning=2.3", "a.log.gz"]).code(78);
    assert!(String::from_utf8_lossy(&printed.get_output().stderr).contains("did you mean capacity_low"));
}
