//! `packwatch export` as its user runs it: the tables hold what a replay tells, and are whole or not there.
#![cfg(feature = "lab")]
#![expect(clippy::unwrap_used, reason = "helpers of tests: a missing piece is a failed test")]

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    /// A simulated life of three cycles.
    fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.run(&["simulate", "paper", "--out", "life.log", "--cycles", "3"]).success();
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

    fn parquet(&self, name: &str) -> SerializedFileReader<fs::File> {
        SerializedFileReader::new(fs::File::open(self.path(name)).unwrap()).unwrap()
    }
}

#[test]
fn estimates_are_those_of_a_replay() {
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
fn the_period_thins_estimates_and_nothing_else() {
    let bench = Bench::new();
    for (out, period) in [("all", "0"), ("thin", "60")] {
        bench.run(&["export", "--period", period, "--out", out, "life.log"]).success();
    }
    let rows = |name: &str| bench.parquet(name).metadata().file_metadata().num_rows();
    let (all, thin) = (rows("all/life/estimates.parquet"), rows("thin/life/estimates.parquet"));
    assert!((all / 60..=all / 60 + 1).contains(&thin), "{thin} of {all}");
    assert_eq!(rows("all/life/half_cycles.parquet"), rows("thin/life/half_cycles.parquet"));
    assert!(rows("all/life/half_cycles.parquet") >= 5);
}

#[test]
fn csv_and_parquet_hold_the_same() {
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
fn files_say_where_they_come_from() {
    let bench = Bench::new();
    bench.run(&["export", "--out", "out", "life.log"]).success();
    let reader = bench.parquet("out/life/alarms.parquet");
    let said = reader.metadata().file_metadata().key_value_metadata().unwrap();
    let value = |key: &str| said.iter().find(|pair| pair.key == key).and_then(|pair| pair.value.clone()).unwrap();
    assert_eq!(value("packwatch.version"), env!("CARGO_PKG_VERSION"));
    assert_eq!(value("packwatch.start_utc"), "2023-11-14T22:13:20.000000Z");
    assert_eq!((value("packwatch.log").as_str(), value("packwatch.config_sha256").len()), ("life.log", 64));
    let about: serde_json::Value =
        serde_json::from_slice(&fs::read(bench.path("out/life/about.json")).unwrap()).unwrap();
    assert_eq!(about["metadata"]["packwatch.log"], "life.log");
}

#[test]
fn a_log_that_fails_leaves_no_table_and_the_others_go_on() {
    let bench = Bench::new();
    fs::write(bench.path("bad.log"), "(1.0) nonsense\n").unwrap();
    let told = bench.run(&["export", "--strict", "--out", "out", "bad.log", "life.log", "none.log"]).code(1);
    let stderr = String::from_utf8_lossy(&told.get_output().stderr).into_owned();
    assert!(stderr.contains("bad.log:1:") && stderr.contains("none.log: cannot be read"), "{stderr}");
    assert_eq!(fs::read_dir(bench.path("out/life")).unwrap().count(), 4);
    for name in ["bad", "none"] {
        assert_eq!(fs::read_dir(bench.path("out").join(name)).unwrap().count(), 0, "{name}");
    }
}

#[test]
fn the_page_about_the_columns_is_the_one_in_the_repository() {
    let output = Command::cargo_bin("packwatch").unwrap().args(["export", "--columns-page"]).assert().success();
    let page = String::from_utf8(output.get_output().stdout.clone()).unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/EXPORT.md");
    assert_eq!(
        fs::read_to_string(path).unwrap(),
        page,
        "write it anew: packwatch export --columns-page > config/EXPORT.md"
    );
}

/// Python's readers as peers, where one is installed.
#[test]
fn other_readers_agree() {
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
