//! Runs the workloads (parser, decoder, estimator) whose instructions `tests/instructions` counts.
//!
//! `instructions WORK PASSES` runs one of [`WORKS`] over the same inputs, PASSES times. It prints the number of units
//! (lines, frames or steps) per pass. It also prints the processor's SIMD extensions (such as AVX2), because the
//! estimator selects its code by them. `tests/instructions` counts the instructions of two runs, the second with twice
//! as many passes. The difference between the two counts excludes the start of the program. Without arguments, as under
//! `cargo bench`, the program prints the time of each workload.
#![expect(clippy::print_stdout, reason = "a program whose output is read by tests/instructions")]

use std::hint::black_box;
use std::io::Write;
use std::time::Instant;

use common::{example, reading};
use packwatch_host::can::Frame;
use packwatch_host::can::dbc::Database;
use packwatch_host::can::decode::{Binding, InputMap};
use packwatch_host::can::encode::InputEncoder;
use packwatch_host::cell::{CellModel, EstimatorBank, EstimatorConfig};
use packwatch_host::io::csv_log::CsvOptions;
use packwatch_host::io::log::{Batch, LogOptions, LogSource};
use packwatch_host::monitor::RecordKind;
use packwatch_host::quantity::{BusIndex, CellIndex, Channel};
use tempfile::NamedTempFile;

mod common;

const WORKS: [Named; 7] = [
    ("parse", "candump line of 8 bytes, read and placed in time", parse),
    ("parse_and_decode", "candump line and its 3 signals", parse_and_decode),
    ("decode_page", "frame of 3 cells, one of 32 pages", decode_page),
    ("step_one_branch", "step of one cell, 1 branch", || one_cell(1)),
    ("step_two_branches", "step of one cell, 2 branches", || one_cell(2)),
    ("step_three_branches", "step of one cell, 3 branches", || one_cell(3)),
    ("step_of_96", "step of one cell in a pack of 96, 1 branch", pack),
];

/// Lines, frames or steps per pass.
const UNITS: u32 = 9600;
/// Number of passes that are timed under `cargo bench`.
const TIMED_PASSES: u32 = 200;

type Named = (&'static str, &'static str, fn() -> Work);

/// Runs one pass over the inputs. Returns a result so that the optimiser cannot remove the pass.
type Work = Box<dyn FnMut() -> f64>;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    match arguments.as_slice() {
        [name, passes] => {
            let (_, _, work) = WORKS.iter().find(|(known, _, _)| known == name).expect("WORK is one of WORKS");
            let (mut work, passes) = (work(), passes.parse::<u32>().expect("PASSES is a number"));
            for _ in 0..passes {
                black_box(work());
            }
            println!("{UNITS} {}", features());
        }
        _ => WORKS.iter().for_each(time),
    }
}

/// Returns the SIMD extensions of this processor that select the estimator's code at run time.
fn features() -> String {
    #[cfg(target_arch = "x86_64")]
    let found = [
        ("avx2", std::is_x86_feature_detected!("avx2")),
        ("fma", std::is_x86_feature_detected!("fma")),
        ("avx512f", std::is_x86_feature_detected!("avx512f")),
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let found: [(&str, bool); 0] = [];
    found.iter().filter(|(_, has)| *has).fold(std::env::consts::ARCH.to_owned(), |all, (name, _)| all + " " + name)
}

fn time((name, unit, work): &Named) {
    let mut work = work();
    let mut took_ns: Vec<f64> = (0..TIMED_PASSES)
        .map(|_| {
            let start = Instant::now();
            black_box(work());
            start.elapsed().as_secs_f64() * 1e9 / f64::from(UNITS)
        })
        .collect();
    took_ns.sort_by(f64::total_cmp);
    println!("{name:20} {:8.1} ns median per {unit}", took_ns[took_ns.len() / 2]);
}

/// Writes a candump log with one message of three signals, one frame per millisecond.
fn log() -> NamedTempFile {
    let line = |n: u64| {
        let data = n.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        format!("(17000{:05}.{:06}) can0 100#{data:016X}\n", n / 1000, n % 1000 * 1000)
    };
    let mut log = NamedTempFile::new().expect("a temporary file");
    (0..u64::from(UNITS)).for_each(|n| log.write_all(line(n).as_bytes()).expect("a writable file"));
    log
}

fn parse() -> Work {
    let log = log();
    Box::new(move || {
        let mut sum = 0.0;
        each_frame(&log, |_, frame| sum += f64::from(frame.data()[0]));
        sum
    })
}

fn parse_and_decode() -> Work {
    let (log, map) = (log(), bind(include_str!("../config/measured.dbc"), |_| true));
    Box::new(move || {
        let mut sum = 0.0;
        each_frame(&log, |bus, frame| map.decode(bus, frame, |reading| sum += reading.value.unwrap_or(0.0)));
        sum
    })
}

/// Calls `take` for each frame of a log. As in `replay`, the lines are read and parsed, and each frame gets its time.
fn each_frame(log: &NamedTempFile, mut take: impl FnMut(BusIndex, &Frame)) {
    let options = LogOptions {
        interfaces: vec!["can0".to_owned()],
        channels: Vec::new(),
        strict: true,
        csv: CsvOptions::default(),
        encode_row: Box::new(|_, _| 0),
    };
    let mut source = LogSource::new([log.path().to_owned()], options);
    let mut batch = Batch::new(Batch::MAX);
    while source.next_batch(&mut batch).expect("the log is valid") {
        for record in batch.records() {
            let RecordKind::Frame { bus, frame } = &record.kind else { panic!("frames alone") };
            take(*bus, frame);
        }
    }
}

/// Binds the wanted signals of a DBC, each to a separate channel.
fn bind(dbc: &str, wanted: fn(&str) -> bool) -> InputMap {
    let database = Database::parse(dbc).expect("the shipped DBC parses");
    let signals =
        database.messages.iter().flat_map(|message| message.signals.iter().map(move |signal| (message, signal)));
    let wanted = (0..).zip(signals.filter(|(_, signal)| wanted(&signal.name)));
    let binding =
        |(n, (message, signal))| Binding::new(BusIndex(0), message, signal, Channel::CellVoltage(CellIndex(n)));
    InputMap::new(wanted.map(|of| binding(of).expect("its layout is valid")).collect())
}

fn decode_page() -> Work {
    let map = bind(include_str!("../config/pack96.dbc"), |name| name.starts_with("CellVoltage"));
    let values: Vec<_> = (0..96).map(|n| (Channel::CellVoltage(CellIndex(n)), Some(3.7))).collect();
    let mut pages = Vec::new();
    InputEncoder::new(&map).encode(&values, &mut pages);
    let rounds = UNITS as usize / pages.len();
    Box::new(move || {
        let mut sum = 0.0;
        for (bus, frame) in pages.iter().cycle().take(rounds * pages.len()) {
            map.decode(*bus, black_box(frame), |reading| sum += reading.value.unwrap_or(0.0));
        }
        sum
    })
}

/// Returns the cell model of `config/example.toml`, with 1 to 3 equal RC branches, and the estimator's settings.
fn cell(branches: usize) -> (CellModel, EstimatorConfig) {
    let monitor = example().monitor;
    let mut model = monitor.model;
    model.branches = vec![model.branches[0].clone(); branches];
    (model, monitor.estimator)
}

fn one_cell(branches: usize) -> Work {
    steps(branches, 1)
}

fn pack() -> Work {
    steps(1, 96)
}

fn steps(branches: usize, cells: usize) -> Work {
    let (model, config) = cell(branches);
    let mut pack = EstimatorBank::new(&model, &config, cells);
    let mut k = 0;
    Box::new(move || {
        for _ in 0..UNITS as usize / cells {
            k += 1;
            (0..cells).for_each(|cell| pack.add(cell, black_box(&reading(k, cell))));
            pack.step();
        }
        pack.soc(0).map_or(0.0, |soc| soc.mean)
    })
}
