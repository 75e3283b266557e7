//! Runs `packwatch export` as a user does. The tables must contain what a replay reports. A failed export must leave no
//! partial table.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;
use serde_json::Value;

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        Self::of_cycles("3")
    }

    fn of_cycles(cycles: &str) -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.run(&["simulate", "paper", "--out", "life.log", "--cycles", cycles]).success();
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn run(&self, args: &[&str]) -> assert_cmd::assert::Assert {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo.toml");
        let mut command = Command::cargo_bin("packwatch").unwrap();
        command.current_dir(self.folder.path()).args(args).arg("--config").arg(config).assert()
    }

    fn csv(&self, name: &str) -> Vec<BTreeMap<String, String>> {
        let mut reader = csv::Reader::from_path(self.path(name)).unwrap();
        reader.deserialize().map(Result::unwrap).collect()
    }

    fn parquet(&self, name: &str) -> SerializedFileReader<fs::File> {
        SerializedFileReader::new(fs::File::open(self.path(name)).unwrap()).unwrap()
    }
}

#[test]
fn exported_estimates_match_replay() {
    let bench = Bench::new();
    bench.run(&["replay", "--estimates", "e.csv", "life.log"]).success();
    bench.run(&["export", "--period", "0", "--out", "out", "life.log"]).success();
    let mut replayed = csv::Reader::from_path(bench.path("e.csv")).unwrap();
    let column = |name: &str, headers: &csv::StringRecord| headers.iter().position(|header| header == name).unwrap();
    let headers = replayed.headers().unwrap().clone();
    let (soc, capacity) = (column("soc", &headers), column("capacity_ah", &headers));
    let reader = bench.parquet("out/life/estimates.parquet");
    let mut rows = reader.get_row_iter(None).unwrap();
    let mut count = 0;
    for wanted in replayed.records().map(Result::unwrap) {
        let found = rows.next().unwrap().unwrap();
        assert_eq!(found.get_double(4).unwrap(), wanted[soc].parse::<f64>().unwrap());
        assert_eq!(found.get_double(9).unwrap(), wanted[capacity].parse::<f64>().unwrap());
        count += 1;
    }
    assert!(count > 1000 && rows.next().is_none());
}

#[test]
fn exported_half_cycles_and_alarms_match_replay() {
    let bench = Bench::of_cycles("12");
    bench.run(&["replay", "--events", "e.jsonl", "life.log"]).success();
    bench.run(&["export", "--format", "csv", "--out", "out", "life.log"]).success();
    let text = fs::read_to_string(bench.path("e.jsonl")).unwrap();
    let events: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |kind: &str| events.iter().filter(|event| event["event"] == kind).collect::<Vec<_>>();
    assert_eq!(bench.csv("out/life/alarms.csv").len(), of("alarm").len());
    let rows = bench.csv("out/life/half_cycles.csv");
    assert_eq!((rows.len(), rows.len()), (of("half_cycle").len(), of("capacity").len()));
    let outlooks = bench.csv("out/life/outlook.csv");
    assert_eq!((outlooks.len(), of("half_cycle").len()), (of("outlook").len(), of("outlook").len()));
    for (row, outlook) in outlooks.iter().zip(of("outlook")) {
        for column in ["remaining_energy_wh", "energy_to_full_std_wh", "energy_soh", "charge_power_10s_w"] {
            assert_eq!(row[column].parse::<f64>().ok(), outlook[column].as_f64(), "{column}");
        }
    }
    let mut known = 0;
    for (row, capacity) in rows.iter().zip(of("capacity")) {
        assert_eq!(row["capacity_ah"].parse::<f64>().unwrap(), capacity["capacity_ah"].as_f64().unwrap());
        let left = of("remaining_life").into_iter().find(|left| left["time"] == capacity["time"]);
        for (column, key) in
            [("cycles", "cycles"), ("cycles_low", "cycles_low"), ("cycles_high", "cycles_high"), ("days", "days")]
        {
            let printed = row[&format!("remaining_{column}")].parse::<f64>().ok();
            assert_eq!(printed, left.and_then(|left| left[key].as_f64()), "{column} of {row:?}");
        }
        known += usize::from(!row["remaining_cycles"].is_empty());
    }
    assert!(known > 5 && known < rows.len(), "{known} of {} rows have a forecast", rows.len());
}

#[test]
fn replacing_tables_of_other_log_is_reported() {
    let bench = Bench::new();
    bench.run(&["export", "--out", "out", "life.log"]).success();
    fs::create_dir(bench.path("b")).unwrap();
    fs::copy(bench.path("life.log"), bench.path("b/life.log")).unwrap();
    let printed = bench.run(&["export", "--out", "out", "b/life.log"]).success();
    let stdout = String::from_utf8_lossy(&printed.get_output().stdout).into_owned();
    assert!(stdout.contains("replaced the tables of life.log"), "{stdout}");
    let printed = bench.run(&["export", "--out", "out", "b/life.log"]).success();
    assert!(
        !String::from_utf8_lossy(&printed.get_output().stdout).contains("replaced"),
        "the tables of the same log are not reported as replaced"
    );
}

#[test]
fn csv_is_dated_by_cycles_table() {
    let bench = Bench::new();
    fs::write(bench.path("b5.csv"), "cycle,time_s,current_a,voltage_v,temperature_c\n7,0,1,3.9,24\n7,10,1,3.9,24\n")
        .unwrap();
    fs::write(bench.path("b5_cycles.csv"), "cycle,start\n7,2008-04-02T13:08:17.921\n").unwrap();
    bench.run(&["export", "--out", "out", "b5.csv"]).success();
    let about: Value = serde_json::from_slice(&fs::read(bench.path("out/b5/about.json")).unwrap()).unwrap();
    assert_eq!(about["metadata"]["packwatch.start_utc"], "2008-04-02T13:08:17.921000Z");
    assert_eq!(about["notes"][0], "dated by b5_cycles.csv");
}

#[test]
fn period_thins_only_estimates() {
    let bench = Bench::new();
    for (out, period) in [("all", "0"), ("thin", "60")] {
        bench.run(&["export", "--period", period, "--out", out, "life.log"]).success();
    }
    let rows = |name: &str| bench.parquet(name).metadata().file_metadata().num_rows();
    let (all, thin) = (rows("all/life/estimates.parquet"), rows("thin/life/estimates.parquet"));
    assert!((all / 60..=all / 60 + 1).contains(&thin), "{thin} of {all} rows, must be one in 60");
    assert_eq!(rows("all/life/half_cycles.parquet"), rows("thin/life/half_cycles.parquet"));
    assert!(rows("all/life/half_cycles.parquet") >= 5);
}

#[test]
fn csv_and_parquet_hold_same_rows() {
    let bench = Bench::new();
    bench.run(&["export", "--out", "p", "life.log"]).success();
    bench.run(&["export", "--format", "csv", "--out", "c", "life.log"]).success();
    let reader = bench.parquet("p/life/half_cycles.parquet");
    let mut csv = csv::Reader::from_path(bench.path("c/life/half_cycles.csv")).unwrap();
    let names: Vec<String> = csv.headers().unwrap().iter().map(str::to_owned).collect();
    let schema = reader.metadata().file_metadata().schema_descr();
    assert_eq!(schema.columns().iter().map(|column| column.name().to_owned()).collect::<Vec<_>>(), names);
    let charge = names.iter().position(|name| name == "charge_ah").unwrap();
    let mut rows = reader.get_row_iter(None).unwrap();
    for record in csv.records().map(Result::unwrap) {
        let row = rows.next().unwrap().unwrap();
        assert_eq!(row.get_double(charge).unwrap(), record[charge].parse::<f64>().unwrap());
        assert_eq!(row.get_string(0).unwrap(), "life");
    }
    assert!(rows.next().is_none());
}

#[test]
fn exported_files_name_their_source() {
    let bench = Bench::new();
    bench.run(&["export", "--out", "out", "life.log"]).success();
    let reader = bench.parquet("out/life/alarms.parquet");
    let said = reader.metadata().file_metadata().key_value_metadata().unwrap();
    let value = |key: &str| said.iter().find(|pair| pair.key == key).and_then(|pair| pair.value.clone()).unwrap();
    assert_eq!(value("packwatch.version"), env!("CARGO_PKG_VERSION"));
    assert_eq!(value("packwatch.start_utc"), "2023-11-14T22:13:20.000000Z");
    assert_eq!((value("packwatch.log").as_str(), value("packwatch.config_sha256").len()), ("life.log", 64));
    let about: Value = serde_json::from_slice(&fs::read(bench.path("out/life/about.json")).unwrap()).unwrap();
    assert_eq!(about["metadata"]["packwatch.log"], "life.log");
}

#[test]
fn failed_log_leaves_no_table_others_continue() {
    let bench = Bench::new();
    fs::write(bench.path("bad.log"), "(1.0) nonsense\n").unwrap();
    let printed = bench.run(&["export", "--strict", "--out", "out", "bad.log", "life.log", "none.log"]).code(1);
    let stderr = String::from_utf8_lossy(&printed.get_output().stderr).into_owned();
    assert!(stderr.contains("bad.log:1:") && stderr.contains("none.log: cannot be read"), "{stderr}");
    assert_eq!(fs::read_dir(bench.path("out/life")).unwrap().count(), 6);
    for name in ["bad", "none"] {
        assert_eq!(fs::read_dir(bench.path("out").join(name)).unwrap().count(), 0, "{name}");
    }
}

#[test]
fn columns_page_matches_repository() {
    let output = Command::cargo_bin("packwatch").unwrap().args(["export", "--columns-page"]).assert().success();
    let page = String::from_utf8(output.get_output().stdout.clone()).unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/src/reference/export.md");
    assert_eq!(
        fs::read_to_string(path).unwrap(),
        page,
        "write it again: packwatch export --columns-page > docs/src/reference/export.md"
    );
}

/// Compares the tables with the output of Python's readers, if these are installed.
#[test]
fn python_readers_agree_with_export() {
    let bench = Bench::new();
    for (format, out) in [("parquet", "p"), ("csv", "c")] {
        bench.run(&["export", "--format", format, "--out", out, "life.log"]).success();
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/parquet_peer.py");
    let run =
        std::process::Command::new("python3").arg(script).args([bench.path("p/life"), bench.path("c/life")]).output();
    let Ok(run) = run else { return println!("skipped: no python3") };
    let stdout = String::from_utf8_lossy(&run.stdout);
    assert!(run.status.success(), "{stdout}{}", String::from_utf8_lossy(&run.stderr));
    println!("{stdout}");
}
