//! Runs `packwatch replay` as a user does, with the shipped configuration of a measured cell.

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::io::background_file::BackgroundFile;
use packwatch::io::journal;
use packwatch::io::segments::SegmentLimits;

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml")
}

fn replay(args: &[&str]) -> assert_cmd::assert::Assert {
    let mut command = Command::cargo_bin("packwatch").expect("Cargo builds the binary");
    command.arg("replay").arg("-c").arg(config()).args(args).assert()
}

fn log(folder: &Path) -> String {
    let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
    for second in 0..1800 {
        let current_a = if second % 60 < 40 { 2.0 } else { 0.0 };
        let voltage_v = 4.1 - 0.0002 * f64::from(second) - 0.1 * current_a;
        text.push_str(&format!("{second},{current_a},{voltage_v:.4},24.5\n"));
    }
    let path = folder.join("cell.csv");
    fs::write(&path, text).expect("written");
    path.display().to_string()
}

#[test]
fn repeated_replay_gives_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = log(folder.path());
    let results = ["1", "2"].map(|run| {
        let paths =
            ["estimates", "events", "frames", "snapshot"].map(|kind| folder.path().join(format!("{kind}{run}")));
        let [estimates, events, frames, snapshot] = paths.each_ref().map(|path| path.to_str().expect("UTF-8"));
        let files = ["--estimates", estimates, "--events", events, "--frames", frames, "--snapshot", snapshot];
        replay(&[&[log.as_str()], &files[..]].concat()).success();
        paths.map(|path| fs::read(path).expect("the result is written"))
    });
    assert_eq!(results[0], results[1]);
    let rows = String::from_utf8_lossy(&results[0][0]).lines().count();
    assert!((1700..=1801).contains(&rows), "{rows} estimates");
    assert!(!results[0][2].is_empty(), "no frames were sent");
}

#[test]
fn segmented_journal_replays_like_one_file() {
    use std::io::Write as _;
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (drive, plain, split) = (path("drive.log"), path("plain.journal"), path("split.journal"));
    let mut simulate = Command::cargo_bin("packwatch").expect("Cargo builds the binary");
    let paper = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml");
    simulate.args(["simulate", "paper", "-o", &drive, "--cycles", "2", "-c"]).arg(&paper).assert().success();
    let journal = format!("PACKWATCH-JOURNAL 1\n{}", fs::read_to_string(&drive).expect("a log"));
    fs::write(&plain, &journal).expect("written");
    let limits = SegmentLimits::new(1 << 20, 64 << 10).expect("allowed");
    let mut file = BackgroundFile::create_segments(Path::new(&split), journal::HEADER, limits).expect("created");
    journal.as_bytes().chunks(9_000).for_each(|part| file.write_all(part).expect("queued"));
    file.finish().expect("written");
    let segments: Vec<String> =
        (1..).map(|n| format!("{split}.{n:06}.zst")).take_while(|p| Path::new(p).exists()).collect();
    assert!(segments.len() >= 2, "{segments:?}");
    let results = |logs: &[&str], name: &str| {
        let files = ["estimates", "events", "frames"].map(|kind| path(&format!("{kind}-{name}")));
        let mut command = Command::cargo_bin("packwatch").expect("Cargo builds the binary");
        command.args(["replay", "-c"]).arg(&paper).args(logs).args(["--estimates", &files[0], "--events", &files[1]]);
        let printed = stdout_of(&command.args(["--frames", &files[2]]).assert().success());
        (files.map(|file| fs::read(file).expect("written")), printed)
    };
    let (whole, _) = results(&[&plain], "plain");
    let each: Vec<&str> = segments.iter().map(String::as_str).collect();
    assert_eq!(results(&[&split], "split").0, whole);
    assert_eq!(results(&each, "each").0, whole);
    let (late, printed) = results(&each[1..], "late");
    assert!(late != whole && printed.contains("the beginning of the journal is missing, 1 segments"), "{printed}");
}

#[test]
fn summary_is_json_on_request() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = replay(&[&log(folder.path()), "--json"]).success().get_output().stdout.clone();
    let summary: serde_json::Value = serde_json::from_slice(&output).expect("JSON");
    assert_eq!(summary["frames"], 1800);
    assert_eq!(summary["bad_lines"], 0);
    assert!(summary["cells"][0]["soc"].as_f64().is_some_and(|soc| (0.0..=1.0).contains(&soc)), "{summary}");
}

#[test]
fn malformed_line_is_fatal_only_if_strict() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.log");
    let good = |second: u32| format!("({second}.000000) vcan0 100#801A06000000C409\n");
    fs::write(&path, "(1.000000) vcan0 123#1\n".to_owned() + &good(2) + &good(3)).expect("written");
    let path = path.display().to_string();
    let shown = replay(&[&path]).success().get_output().stdout.clone();
    assert!(String::from_utf8_lossy(&shown).contains("a.log:1: column 22: found \"1\""));
    let strict = replay(&[&path, "--strict"]).code(1).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&strict).contains("a.log:1: column 22: found \"1\""));
}

#[test]
fn full_disk_is_an_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = replay(&[&log(folder.path()), "--estimates", "/dev/full"]).code(1).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&error).contains("/dev/full: cannot be written"));
}

#[test]
fn snapshot_beyond_log_fails_without_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let snapshot = folder.path().join("state");
    let snapshot = snapshot.to_str().expect("UTF-8");
    replay(&[&log(folder.path()), "--snapshot", snapshot, "--snapshot-at", "+1e6"]).code(1);
    assert!(!Path::new(snapshot).exists());
}

fn trips(folder: &Path, seconds: [u32; 3]) -> [String; 3] {
    [0, 1, 2].map(|n| {
        let path = folder.join(format!("trip{n}.csv"));
        let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
        for second in 0..seconds[n] {
            text.push_str(&format!("{second},{},{:.4},24.5\n", n + 1, 4.1 - 0.0002 * f64::from(second)));
        }
        fs::write(&path, text).expect("written");
        path.display().to_string()
    })
}

fn stdout_of(assert: &assert_cmd::assert::Assert) -> String {
    String::from_utf8_lossy(&assert.get_output().stdout).into_owned()
}

#[test]
fn each_replays_logs_independently_in_order() {
    let folder = tempfile::tempdir().expect("a folder");
    let logs = trips(folder.path(), [3000, 5, 200]);
    let out = folder.path().join("out").display().to_string();
    let each = ["--each", "--json", "-j", "3", "--estimates", &out, "--events", &out, "--frames", &out];
    let reported = stdout_of(&replay(&[&logs.each_ref().map(String::as_str)[..], &each[..]].concat()).success());
    let reported: Vec<serde_json::Value> =
        reported.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(reported.iter().map(|one| one["name"].as_str().expect("a name")).collect::<Vec<_>>(), logs);
    assert_eq!(reported.iter().map(|one| one["frames"].as_u64()).collect::<Vec<_>>(), [3000, 5, 200].map(Some));
    for (n, log) in logs.iter().enumerate() {
        let alone = ["csv", "jsonl", "log"].map(|kind| folder.path().join(format!("alone.{kind}")));
        let [estimates, events, frames] = alone.each_ref().map(|path| path.to_str().expect("UTF-8"));
        replay(&[log, "--estimates", estimates, "--events", events, "--frames", frames]).success();
        for path in alone {
            let kind = path.extension().expect("one").to_str().expect("UTF-8");
            let each = fs::read(folder.path().join(format!("out/trip{n}.{kind}"))).expect("written");
            assert!(each == fs::read(&path).expect("written"), "trip{n}.{kind}");
        }
    }
}

#[test]
fn failed_log_is_named_and_others_continue() {
    let folder = tempfile::tempdir().expect("a folder");
    let logs = trips(folder.path(), [50, 50, 50]);
    fs::remove_file(&logs[1]).expect("removed");
    let args = [&logs.each_ref().map(String::as_str)[..], &["--each"][..]].concat();
    let result = replay(&args).code(1);
    let error = String::from_utf8_lossy(&result.get_output().stderr).into_owned();
    let failed = format!("{}: cannot be read", logs[1]);
    assert!(error.lines().last().is_some_and(|line| line.starts_with(&failed)), "{error}");
    assert_eq!(error.lines().count(), 3, "one line per table read, and the failed log: {error}");
    let reported = stdout_of(&result);
    let places = logs.each_ref().map(|log| reported.find(log.as_str()).expect("every log is reported"));
    assert!(places.is_sorted(), "{reported}");
    assert_eq!(reported.matches("wall time").count(), 2, "{reported}");
    let json = stdout_of(&replay(&[&args[..], &["--json"][..]].concat()).code(1));
    let second: serde_json::Value = serde_json::from_str(json.lines().nth(1).expect("a line")).expect("JSON");
    assert_eq!((&second["name"], second["error"].is_string()), (&logs[1].as_str().into(), true));
}

#[test]
fn each_rejects_unsuitable_options_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let [log, other, _] = trips(folder.path(), [5, 5, 5]);
    let refused = |args: &[&str], code: i32| {
        let result = replay(&[&[log.as_str(), "--each"], args].concat()).code(code);
        String::from_utf8_lossy(&result.get_output().stderr).into_owned()
    };
    for (option, value) in
        [("--to", "vcan0"), ("--speed", "2"), ("--snapshot", "x"), ("--restore", "x"), ("--state", "x")]
    {
        assert!(refused(&[option, value], 2).contains(option), "{option}");
    }
    assert!(refused(&["-"], 1).contains("standard input"));
    assert!(refused(&["--events", "-"], 1).contains("give a folder"));
    assert!(refused(&[&log], 1).contains("named twice"));
    let inner = folder.path().join("inner");
    fs::create_dir(&inner).expect("made");
    let same_name = inner.join("trip0.log").display().to_string();
    fs::write(&same_name, "").expect("written");
    let out = folder.path().join("out").display().to_string();
    assert!(refused(&[&same_name, "--events", &out], 1).contains("would replace those of"));
    let onto_itself = refused(&["--estimates", &folder.path().display().to_string()], 1);
    assert!(onto_itself.contains("is an input, must not be the output too"), "{onto_itself}");
    assert!(stdout_of(&replay(&[&log, &other, "-j", "2"]).code(2)).is_empty(), "--jobs requires --each");
}

#[test]
fn until_stops_reading_at_its_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.log");
    let line = |n: u32| format!("({:010}.000000) vcan0 100#801A06{:02X}0000C409\n", 1_700_000_000 + n, n % 7);
    fs::write(&path, (0..500).map(line).collect::<String>()).expect("written");
    let path = path.display().to_string();
    let output = stdout_of(&replay(&[&path, "--json", "--until", "+99"]).success());
    let summary: serde_json::Value = serde_json::from_str(&output).expect("JSON");
    assert_eq!((&summary["lines"], &summary["last_s"]), (&101.into(), &1_700_000_099.0.into()));
}

#[test]
fn batched_replay_equals_record_by_record() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = fs::read_to_string(log(folder.path())).expect("readable");
    let mut rows: Vec<String> = text.lines().map(str::to_owned).collect();
    // A gap while the recorder was asleep, then a slightly older row, then a much older row.
    rows.extend([4000, 4001, 3999, 4002, 4003, 900, 901, 902].map(|second| format!("{second},2.0,3.6,24.5")));
    let path = folder.path().join("holes.csv");
    fs::write(&path, rows.join("\n")).expect("written");
    // If `--until` is far beyond the log's end, replay reads record by record.
    let results = [&[][..], &["--until", "+1000000"][..]].map(|one_by_one| {
        let paths = ["estimates", "events", "frames", "snapshot"].map(|kind| folder.path().join(kind));
        let [estimates, events, frames, snapshot] = paths.each_ref().map(|path| path.to_str().expect("UTF-8"));
        let files = ["--estimates", estimates, "--events", events, "--frames", frames, "--snapshot", snapshot];
        let args = [&[path.to_str().expect("UTF-8"), "--json"], &files[..], one_by_one].concat();
        let mut summary: serde_json::Value = serde_json::from_str(&stdout_of(&replay(&args).success())).expect("JSON");
        let of_this_run = ["wall_s", "times_real_time", "frames_per_s", "cell_steps_per_s", "peak_memory_kib"];
        for key in of_this_run {
            summary.as_object_mut().expect("an object").remove(key).expect("reported");
        }
        (summary, paths.map(|path| fs::read(path).expect("result written")))
    });
    assert_eq!(results[0], results[1]);
    let events = &results[0].0["events"];
    assert!(events["gap"].as_u64() >= Some(2) && events["time_backwards"].as_u64() >= Some(1), "{events}");
}
