//! Checks that processing a frame allocates no memory in steady state, in the log reader and in the core with the 96
//! cells of `config/example.toml`. Allocations are permitted in four cases: the first frames (buffers grow),
//! transitions between charge, discharge and rest, events, and the end of a row of the diagnosis (`BLOCKS_OF_A_ROW`).
//!
//! All threads of the process are counted. If a test fails, `dhat-heap.json` shows the allocations.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};

use packwatch::config;
use packwatch::io::candump::{Line, parse_line};
use packwatch::io::csv_log::CsvOptions;
use packwatch::io::log::{LogOptions, LogSource};
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{Monitor, Outputs, Record, RecordKind, TICK_PERIOD_MS};

#[global_allocator]
static ALLOCATOR: dhat::Alloc = dhat::Alloc;

/// If the log has a gap longer than this (s), the replay assumes that the recorder slept. This log has no gap.
const SLEEP_GAP_S: f64 = 30.0;
/// Length of the log (s).
const LOG_S: f64 = 160.0;
/// Length of the warm-up (s). In this time, health frames for all 96 cells are sent.
const WARM_S: f64 = 110.0;
/// The 50 s after the warm-up contain more: 10 currents and 32 other frames every 100 ms.
const MIN_FRAMES: u64 = 20_000;

/// Maximum number of blocks allocated at the end of a row with 96 cells. A row holds the sums of each cell's samples
/// over a few minutes, from which the diagnosis computes its findings.
const BLOCKS_OF_A_ROW: u64 = 64;

/// Each test counts the allocations of the whole process, so they must not run in parallel.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs `work`. No thread may allocate.
fn without_allocating(what: &str, work: impl FnOnce()) {
    allocating_at_most(0, what, work);
}

/// Runs `work`. All threads together may allocate at most `most` blocks.
fn allocating_at_most(most: u64, what: &str, work: impl FnOnce()) {
    let profiler = dhat::Profiler::builder().testing().build();
    work();
    let blocks = dhat::HeapStats::get().total_blocks;
    dhat::assert!(blocks <= most, "{what}: {blocks} blocks allocated");
    drop(profiler);
}

fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/example.toml")
}

fn pack_log(folder: &Path) -> PathBuf {
    let log = folder.join("pack.log");
    let mut simulate = Command::new(env!("CARGO_BIN_EXE_packwatch"));
    simulate.args([
        "simulate",
        "reference",
        "--period",
        "10",
        "--cell-period",
        "100",
        "--duration",
        &LOG_S.to_string(),
    ]);
    simulate.arg("-c").arg(example()).arg("-o").arg(&log).stdout(Stdio::null()).stderr(Stdio::null());
    assert!(simulate.status().expect("packwatch runs").success());
    log
}

fn source(log: &Path) -> LogSource {
    let options = LogOptions {
        interfaces: vec!["can0".to_owned()],
        channels: Vec::new(),
        strict: true,
        csv: CsvOptions::default(),
        encode_row: Box::new(|_, _| 0),
    };
    LogSource::new([log.to_owned()], options)
}

fn next(source: &mut LogSource) -> Option<Record> {
    source.next_record().expect("a good log")
}

fn is_warm(record: &Record, first: &Record) -> bool {
    record.time.since(first.time) >= WARM_S
}

#[test]
fn allocation_is_counted() {
    let _alone = alone();
    let profiler = dhat::Profiler::builder().testing().build();
    let kept = std::thread::spawn(|| vec![0_u8; 1000]).join();
    assert!(
        dhat::HeapStats::get().total_bytes >= 1000,
        "allocations are not counted, so the other tests prove nothing"
    );
    drop((profiler, kept));
}

#[test]
fn log_line_allocates_nothing() {
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a folder");
    let text = std::fs::read(pack_log(folder.path())).expect("a log");
    let mut frames = 0;
    without_allocating("parsing", || {
        for line in text.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
            frames += u64::from(matches!(parse_line(line), Ok(Line::Frame { .. })));
        }
    });
    assert!(frames > MIN_FRAMES, "{frames} frames");
}

#[test]
fn frame_read_from_log_allocates_nothing() {
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a folder");
    let mut source = source(&pack_log(folder.path()));
    let first = next(&mut source).expect("a frame");
    while !is_warm(&next(&mut source).expect("a long log"), &first) {}
    let mut frames = 0;
    without_allocating("reading a log", || {
        // Stop before the end of the file. There the reader does work that occurs only once per file.
        while frames < MIN_FRAMES {
            let record = next(&mut source).expect("a long log");
            frames += u64::from(matches!(record, Record { kind: RecordKind::Frame { .. }, .. }));
        }
    });
}

struct Core {
    monitor: Monitor,
    ticks: Ticks,
    out: Outputs,
    sent: usize,
    events: usize,
}

impl Core {
    fn new() -> Self {
        let config = config::load(&example()).expect("the example is valid");
        let ticks = Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S);
        Self { monitor: Monitor::new(config.monitor), ticks, out: Outputs::default(), sent: 0, events: 0 }
    }

    fn feed(&mut self, record: &Record) {
        self.ticks.advance(record.time);
        while let Some(time) = self.ticks.pop(self.monitor.next_due()) {
            self.handle(&Record::tick(time));
        }
        self.handle(record);
    }

    fn handle(&mut self, record: &Record) {
        self.monitor.handle(record, &mut self.out);
        self.sent += self.out.frames.len();
        self.events += self.out.events.len();
        self.out.clear();
    }
}

#[test]
fn frame_through_core_allocates_nothing() {
    let _alone = alone();
    let folder = tempfile::tempdir().expect("a folder");
    let mut source = source(&pack_log(folder.path()));
    let mut core = Core::new();
    let mut records = Vec::new();
    while let Some(record) = next(&mut source) {
        records.push(record);
    }
    let warm = records.iter().position(|record| is_warm(record, &records[0])).expect("a long log");
    let (before, steady) = records.split_at(warm);
    assert!(steady.len() as u64 > MIN_FRAMES, "{} frames", steady.len());
    before.iter().for_each(|record| core.feed(record));
    (core.sent, core.events) = (0, 0);
    allocating_at_most(BLOCKS_OF_A_ROW, "the core", || steady.iter().for_each(|record| core.feed(record)));
    assert!(core.sent > 500, "{} frames sent: status ten times a second, health, alarms", core.sent);
    assert!(core.monitor.latest().flatten().count() == 96, "every cell must have an estimate");
    assert_eq!(core.events, 0, "a steady part");
}
