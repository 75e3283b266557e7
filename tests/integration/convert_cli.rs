//! Runs `packwatch convert` as a user does. Every format must keep the frames, and estimates must become topics.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use assert_cmd::assert::Assert;

struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().unwrap() };
        bench.run(&["simulate", "-c", &bench.config(), "paper", "--out", "life.log", "--cycles", "1"]).success();
        bench
    }

    fn config(&self) -> String {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo.toml").display().to_string()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn run(&self, args: &[&str]) -> Assert {
        Command::cargo_bin("packwatch").unwrap().current_dir(self.folder.path()).args(args).assert()
    }

    fn convert(&self, from: &str, to: &str) -> Assert {
        self.run(&["convert", from, to])
    }

    fn topics(&self, name: &str) -> BTreeMap<String, usize> {
        let bytes = fs::read(self.path(name)).unwrap();
        let mut topics = BTreeMap::new();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            serde_json::from_slice::<serde_json::Value>(&message.data).expect("a JSON message");
            *topics.entry(message.channel.topic.clone()).or_default() += 1;
        }
        topics
    }
}

#[test]
fn frames_survive_each_format() {
    let bench = Bench::new();
    // MF4 stores interface numbers instead of names, so give the interface a name that contains a number.
    bench.run(&["convert", "--channel", "demo=can0", "life.log", "e.log"]).success();
    bench.convert("e.log", "a.mf4").success();
    bench.convert("a.mf4", "b.log.gz").success();
    bench.convert("b.log.gz", "c.log.zst").success();
    bench.convert("c.log.zst", "d.log").success();
    assert_eq!(fs::read(bench.path("d.log")).unwrap(), fs::read(bench.path("e.log")).unwrap());
    let frames =
        fs::read_to_string(bench.path("life.log")).unwrap().lines().filter(|line| line.starts_with('(')).count();
    bench.convert("life.log", "f.mcap").success();
    let topics = bench.topics("f.mcap");
    assert!(topics.keys().all(|topic| topic.starts_with("/can/")), "{topics:?}");
    assert!(frames > 1000 && topics.values().sum::<usize>() == frames, "{topics:?}, {frames} frames");
}

#[test]
fn configuration_adds_estimates_of_each_cell() {
    let bench = Bench::new();
    bench.run(&["convert", "-c", &bench.config(), "life.log", "a.mcap"]).success();
    bench.run(&["replay", "-c", &bench.config(), "--estimates", "e.csv", "life.log"]).success();
    let rows = fs::read_to_string(bench.path("e.csv")).unwrap().lines().count() - 1;
    let topics = bench.topics("a.mcap");
    let estimates: usize =
        topics.iter().filter(|(topic, _)| topic.starts_with("/cells/")).map(|(_, count)| count).sum();
    assert!(rows > 0 && estimates == rows, "{topics:?}, {rows} rows");
}

#[test]
fn existing_output_is_replaced_only_with_force() {
    let bench = Bench::new();
    fs::write(bench.path("a.mf4"), "old").unwrap();
    let error = bench.convert("life.log", "a.mf4").code(1).get_output().stderr.clone();
    assert_eq!(String::from_utf8_lossy(&error), "a.mf4: exists; --force replaces it\n");
    assert_eq!(fs::read(bench.path("a.mf4")).unwrap(), b"old");
    bench.run(&["convert", "--force", "life.log", "a.mf4"]).success();
    assert!(fs::read(bench.path("a.mf4")).unwrap().starts_with(b"MDF     4.10"));
}

#[test]
fn log_without_frames_writes_nothing() {
    let bench = Bench::new();
    fs::write(bench.path("empty.log"), "nothing here\n").unwrap();
    let error = bench.convert("empty.log", "a.mcap").code(1).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&error).contains("empty.log: no CAN frame, nothing is written"));
    assert!(!bench.path("a.mcap").exists());
    bench.convert("life.log", "a.txt").code(1);
}
