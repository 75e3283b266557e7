//! Runs `packwatch fleet` as a user does. The output must not depend on how the fleet is divided into parts. No data
//! may be lost if the program is killed or a log is damaged.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use assert_cmd::Command;
use packwatch::cell::chemistry::ResistanceFactors;
use packwatch::cell::{Chemistry, Label, OwnModel};
use packwatch::filter::ScalarGaussian;
use packwatch::lab::fleet::vehicle::LearnedModel;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;
use serde_json::Value;

const TABLES: [&str; 6] = ["vehicles", "half_cycles", "outlook", "alarms", "use_record", "estimates"];

struct Fleet {
    folder: tempfile::TempDir,
}

impl Fleet {
    /// Simulates the logs of six vehicles. The log of one vehicle is split into three files in a folder. Adds a seventh
    /// vehicle whose log has no frames.
    fn new() -> Self {
        let fleet = Self { folder: tempfile::tempdir().unwrap() };
        fs::create_dir_all(fleet.path("logs/six")).unwrap();
        for (seed, name) in
            ["one.log", "two.log.gz", "three.log", "four.log", "five.log", "six/whole"].iter().enumerate()
        {
            let (out, seed, cycles) = (format!("logs/{name}"), seed.to_string(), (2 + seed % 3).to_string());
            let args = ["simulate", "paper", "--out", &out, "--cycles", &cycles, "--seed", &seed, "--config"];
            fleet.command(&args).arg(config()).assert().success();
        }
        let whole = fs::read_to_string(fleet.path("logs/six/whole")).unwrap();
        let lines: Vec<&str> = whole.lines().collect();
        for (number, part) in lines.chunks(lines.len().div_ceil(3)).enumerate() {
            fs::write(fleet.path(&format!("logs/six/{number}.log")), part.join("\n") + "\n").unwrap();
        }
        fs::write(fleet.path("logs/broken.log"), "no frame\nno frame either\n").unwrap();
        let names = ["six", "one.log", "two.log.gz", "broken.log", "three.log", "four.log", "five.log"];
        let logs = names.map(|name| format!("logs/{name}"));
        fleet.command(&["fleet", "plan", "-o", "fleet.jsonl"]).args(logs).assert().success();
        fleet
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::cargo_bin("packwatch").unwrap();
        command.current_dir(self.folder.path()).args(args);
        command
    }

    /// Replays a part of the fleet and returns the command's output. The exit code must be 1 exactly if a vehicle
    /// failed.
    fn run(&self, out: &str, more: &[&str]) -> String {
        let mut command = self.command(&["fleet", "run", "fleet.jsonl", "--estimates", "60", "-o", out, "-c"]);
        let ran = command.arg(config()).args(more).output().unwrap();
        let printed = String::from_utf8(ran.stdout).unwrap();
        let has_failed = printed.contains("failed: ") || printed.contains("\"failed\"");
        assert_eq!(ran.status.code(), Some(i32::from(has_failed)), "{printed}");
        let error = String::from_utf8(ran.stderr).unwrap();
        assert_eq!(error.contains(" vehicles failed\n"), has_failed, "{error}");
        printed
    }

    fn merged(&self, folders: &[&str], out: &str) -> Vec<Vec<u8>> {
        let mut command = self.command(&["fleet", "merge", "--manifest", "fleet.jsonl", "-o", out]);
        command.args(folders).assert().success();
        TABLES.map(|table| fs::read(self.path(&format!("{out}/{table}.parquet"))).unwrap()).into()
    }

    fn refused(&self, args: &[&str]) -> String {
        let ran = self.command(args).assert().failure();
        String::from_utf8(ran.get_output().stderr.clone()).unwrap()
    }
}

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo.toml")
}

#[test]
fn merged_tables_are_independent_of_parts() {
    let fleet = Fleet::new();
    let printed = fleet.run("whole", &[]);
    assert!(
        printed.contains("failed: broken: ") && printed.contains("logs/broken.log: contains no record"),
        "{printed}"
    );
    assert!(printed.contains("shard 1 of 1: 6 vehicles replayed, 0 already complete, 1 failed"), "{printed}");
    let whole = fleet.merged(&["whole"], "merged");
    for shard in ["3/4", "1/4", "4/4", "2/4"] {
        fleet.run(&format!("part{}", &shard[..1]), &["--shard", shard, "--jobs", "1"]);
    }
    assert!(whole == fleet.merged(&["part2", "part4", "part1", "part3"], "of_four"), "merged from four parts");

    let table = |name: &str| {
        SerializedFileReader::new(fs::File::open(fleet.path(&format!("merged/{name}.parquet"))).unwrap()).unwrap()
    };
    let rows = table("vehicles").get_row_iter(None).unwrap().map(Result::unwrap).collect::<Vec<_>>();
    let names: Vec<&String> = rows.iter().map(|row| row.get_string(0).unwrap()).collect();
    assert_eq!(names, ["broken", "five", "four", "one", "six", "three", "two"]);
    assert!(
        rows[0].get_string(10).unwrap().contains("contains no record"),
        "one row must give the reason: {}",
        rows[0]
    );
    let half_cycles = table("half_cycles");
    assert_eq!(half_cycles.metadata().num_row_groups(), 6, "one row group for each vehicle with tables");
    let stated: i64 = rows.iter().map(|row| i64::from(row.get_int(5).unwrap())).sum();
    assert_eq!(half_cycles.metadata().file_metadata().num_rows(), stated);

    // The three files of the folder form one life.
    let mut command = fleet.command(&["export", "--period", "60", "--out", "alone", "logs/six/whole", "-c"]);
    command.arg(config()).assert().success();
    let rows_of = |path: &str| {
        let reader = SerializedFileReader::new(fs::File::open(fleet.path(path)).unwrap()).unwrap();
        let rows = reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string());
        rows.map(|row| row.split_once(", ").unwrap().1.to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(rows_of("whole/six/estimates.parquet"), rows_of("alone/whole/estimates.parquet"));
}

#[test]
fn killed_run_continues_and_keeps_complete_vehicles() {
    let fleet = Fleet::new();
    let wanted = {
        fleet.run("whole", &[]);
        fleet.merged(&["whole"], "merged")
    };
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("packwatch"))
        .current_dir(fleet.folder.path())
        .args(["fleet", "run", "fleet.jsonl", "--estimates", "60", "-o", "killed", "--jobs", "1", "-c"])
        .arg(config())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let complete = || {
        let folders = fs::read_dir(fleet.path("killed")).into_iter().flatten().flatten();
        folders.filter(|folder| folder.path().join("vehicle.json").exists()).count()
    };
    let since = Instant::now();
    while complete() < 2 && since.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let before = complete();
    assert!((2..7).contains(&before), "not killed in the middle: {before} complete");
    let missing = fleet.refused(&["fleet", "merge", "killed", "--manifest", "fleet.jsonl", "-o", "early"]);
    assert!(
        missing.contains("of 7 vehicles have not been replayed: ") || missing.contains(": incomplete"),
        "{missing}"
    );

    let printed = fleet.run("killed", &[]);
    let document: Value = serde_json::from_str(&fleet.run("killed", &["--json"])).unwrap();
    let outcomes = document["vehicles"].as_array().unwrap();
    let count = |word: &str| outcomes.iter().filter(|vehicle| vehicle["outcome"] == word).count();
    let kept: usize =
        printed.split(" already complete").next().and_then(|text| text.rsplit(' ').next()?.parse().ok()).unwrap();
    // The count may include the vehicle with the broken log, which is replayed again.
    assert!((before - 1..=before).contains(&kept) && kept > 0, "{before} were complete: {printed}");
    assert_eq!((count("complete"), count("failed")), (6, 1), "a failed vehicle is replayed again");
    assert!(wanted == fleet.merged(&["killed"], "continued"));

    // A changed reading option or a changed log requires a new replay.
    assert!(fleet.run("killed", &["--sleep-gap", "1000"]).contains("6 vehicles replayed, 0 already complete"));
    fs::write(
        fleet.path("fleet.jsonl"),
        fs::read_to_string(fleet.path("fleet.jsonl")).unwrap().replace("\"bytes\":", "\"bytes\":1"),
    )
    .unwrap();
    assert!(fleet.run("killed", &[]).contains("6 vehicles replayed, 0 already complete"));
}

#[test]
fn concurrent_runs_on_same_vehicles_are_safe() {
    let fleet = Fleet::new();
    fleet.run("whole", &[]);
    let wanted = fleet.merged(&["whole"], "merged");
    let start = || {
        let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("packwatch"));
        command.current_dir(fleet.folder.path()).stdout(Stdio::piped());
        command
            .args(["fleet", "run", "fleet.jsonl", "--estimates", "60", "-o", "twice", "--jobs", "1", "-c"])
            .arg(config());
        command.spawn().unwrap()
    };
    let printed: String = [start(), start()]
        .into_iter()
        .map(|child| String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap())
        .collect();
    assert_eq!(printed.matches(" 1 failed").count(), 2, "only the broken log may fail: {printed}");
    assert!(wanted == fleet.merged(&["twice"], "of_two"));
}

#[test]
fn damaged_table_is_named() {
    let fleet = Fleet::new();
    fleet.run("out", &[]);
    fs::write(fleet.path("out/one/alarms.parquet"), "PAR1 is not enough PAR1").unwrap();
    let error = fleet.refused(&["fleet", "merge", "out", "-o", "merged"]);
    assert!(
        error.contains("out/one/alarms.parquet: cannot be read") && error.contains("replay the vehicle again"),
        "{error}"
    );
    assert!(!fleet.path("merged/vehicles.parquet").exists());
}

#[test]
fn inconsistent_parts_are_not_merged() {
    let fleet = Fleet::new();
    fleet.run("first", &["--shard", "1/2"]);
    let merge = |folders: &[&str]| fleet.refused(&[&["fleet", "merge", "-o", "merged"], folders].concat());
    assert!(merge(&["logs"]).contains("logs/six: incomplete"), "{}", merge(&["logs"]));
    assert!(merge(&["nowhere"]).contains("nowhere: cannot be read"));
    let mut command = fleet.command(&["fleet", "run", "fleet.jsonl", "--shard", "2/2", "-o", "second", "-c"]);
    command.arg(config()).output().unwrap();
    let error = merge(&["first", "second"]);
    assert!(error.contains("unlike others: run it again") && error.contains("estimate"), "{error}");
    assert!(!fleet.path("merged").exists());

    let manifest = fs::read_to_string(fleet.path("fleet.jsonl")).unwrap();
    fs::write(fleet.path("fleet.jsonl"), manifest.lines().next().unwrap()).unwrap();
    let error = fleet.refused(&["fleet", "merge", "first", "--manifest", "fleet.jsonl", "-o", "merged"]);
    assert!(
        error.contains("of 1 vehicles have not been replayed: broken")
            || error.contains("vehicles are not in the manifest: "),
        "{error}"
    );
    let error = fleet.refused(&["fleet", "run", "fleet.jsonl", "--shard", "3/2", "-o", "x", "-c", "demo.toml"]);
    assert!(error.contains("must be I/N, I from 1 to N"), "{error}");
}

#[test]
fn vehicle_specific_configuration_is_used() {
    let fleet = Fleet::new();
    let text = fs::read_to_string(fleet.path("fleet.jsonl")).unwrap();
    let own = text.replace("{\"vehicle\":\"one\",", "{\"vehicle\":\"one\",\"config\":\"missing.toml\",");
    fs::write(fleet.path("fleet.jsonl"), &own).unwrap();
    let printed = fleet.run("out", &[]);
    assert!(printed.contains("failed: one: missing.toml"), "{printed}");
    assert!(printed.contains("5 vehicles replayed, 0 already complete, 2 failed"), "{printed}");
    fs::write(fleet.path("fleet.jsonl"), own.replace("missing.toml", config().to_str().unwrap())).unwrap();
    assert!(fleet.run("out", &[]).contains("1 vehicles replayed, 5 already complete, 1 failed"));
}

/// A model as a vehicle could learn it: the label's curve with another capacity.
fn learned(label: &Label, capacity_ah: f64) -> LearnedModel {
    let prior = label.prior().unwrap();
    let (modes_v, rest_v) = prior.curve.modes_v();
    let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
    let own = OwnModel {
        curve_v: array(&prior.curve.mean_v),
        modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
        rest_v: array(&rest_v),
        factors: ResistanceFactors::default(),
        drop_std: [0.1; 4],
        cold_sag_v: ScalarGaussian::from_std(0.015, 0.015),
        capacity: ScalarGaussian::from_std(capacity_ah, 0.02 * capacity_ah),
        residual_v: 0.005,
    };
    LearnedModel { label: *label, own, has_prior: false }
}

#[test]
fn prior_of_fleet_is_reproducible_and_configures_vehicle() {
    let fleet = Fleet { folder: tempfile::tempdir().unwrap() };
    let (nmc, nca) = (Label::usual(Chemistry::Nmc811Graphite, 2.6), Label::usual(Chemistry::NcaGraphite, 2.9));
    let write = |folder: &str, models: &[LearnedModel]| {
        fs::create_dir_all(fleet.path(folder)).unwrap();
        let lines = models.iter().map(|model| serde_json::to_string(model).unwrap() + "\n").collect::<String>();
        fs::write(fleet.path(folder).join("models.jsonl"), lines).unwrap();
    };
    let models = [2.3, 2.4, 2.5, 2.4].map(|capacity_ah| learned(&nmc, capacity_ah));
    write("none", &[]);
    write("two", &models[..2]);
    // The last vehicle started from a prior. It must not count, because its model repeats the prior.
    let repeated = LearnedModel { has_prior: true, ..learned(&nmc, 2.5) };
    write("tables", &[&models[..], &[learned(&nca, 2.8), repeated]].concat());
    for (args, wanted) in [
        (&["none"][..], "no vehicle has a suitable model (vehicles with a model: none)"),
        (&["two"], "2 vehicles have a model of nmc811-graphite 2.6 Ah, 2.5 to 4.2 V, must be at least 3"),
        (
            &["tables"],
            "several labels, choose one by chemistry and rated capacity: nmc811-graphite 2.6 Ah, 2.5 to 4.2 V: 4; nca",
        ),
        (&["missing"], "missing/models.jsonl: "),
    ] {
        let said = fleet.refused(&[&["fleet", "prior"], args].concat());
        assert!(said.contains(wanted), "{args:?}: {said}");
    }
    let args = ["fleet", "prior", "tables", "--chemistry", "nmc811-graphite", "-o"];
    for out in ["one.toml", "two.toml"] {
        let ran = fleet.command(&args).arg(out).assert().success();
        let said = String::from_utf8(ran.get_output().stdout.clone()).unwrap();
        assert!(said.contains(": 4 vehicles, nmc811-graphite 2.6 Ah, 2.5 to 4.2 V; capacity 2.400 ± "), "{said}");
    }
    let text = fs::read_to_string(fleet.path("one.toml")).unwrap();
    assert!(text == fs::read_to_string(fleet.path("two.toml")).unwrap(), "the same fleet gives the same bytes");

    // A vehicle can start from the file. A file for another label or a damaged file is rejected.
    let configure = |rated_ah: f64, prior: &str| {
        let cell = format!("chemistry = \"nmc811-graphite\"\nrated_capacity_ah = {rated_ah}\nprior = \"{prior}\"");
        let demo = fs::read_to_string(config()).unwrap();
        let demo = demo.replace("cell_model = \"cells/example_nmc_2600.toml\"", &cell);
        let dbc = config().with_file_name("measured.dbc");
        fs::write(fleet.path("car.toml"), demo.replace("measured.dbc", dbc.to_str().unwrap())).unwrap();
    };
    configure(2.6, "one.toml");
    fleet.command(&["check", "car.toml"]).assert().success();
    fs::write(fleet.path("damaged.toml"), text.replace("[mean.capacity]\nmean = ", "[mean.capacity]\nmean = -"))
        .unwrap();
    fs::write(fleet.path("list.toml"), "names = []").unwrap();
    for (rated_ah, prior, wanted) in [
        (
            2.5,
            "one.toml",
            "was made for nmc811-graphite 2.6 Ah, 2.5 to 4.2 V, but [pack] describes nmc811-graphite 2.5 Ah",
        ),
        (2.6, "damaged.toml", "the capacity of a learned model is -2.4"),
        (2.6, "list.toml", "must be a file of `packwatch fleet prior`: list.toml: unknown field `names`"),
        (2.6, "missing.toml", "must be a file of `packwatch fleet prior`: missing.toml: No such file"),
    ] {
        configure(rated_ah, prior);
        let said = fleet.refused(&["check", "car.toml"]);
        assert!(said.contains("pack.prior = ") && said.contains(wanted), "{prior}: {said}");
    }
}
