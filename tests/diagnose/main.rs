//! Measures how well the diagnosis finds faults in simulated packs: healthy packs, and packs with one fault each.
//!
//! `tests/diagnose/run [--quick] [--packs N] [--days N] [--period MS] [--jobs N] [--seed N] [--only WORD] [--list]
//! [--write]`
//!
//! A pack drives, parks with sleeping buses and charges every day (scenario `ev-day`). Each fault begins at a random
//! time between 10 and 35 % of the simulated time, in a random cell or temperature sensor. Every fault is simulated
//! with good, usual and poor sensors, and with three kinds of balancing: none, unreported, and reported by bits that
//! show the bled cells.
//!
//! - `--packs`: total number of packs, at least one per row of the table
//! - `--days`, `--period`, `--jobs`, `--seed`: simulated days per pack; time between two readings, ms; number of
//!   threads; seed of the first pack
//! - `--quick`: one pack per fault, with usual sensors and unreported balancing
//! - `--only WORD`: only faults whose name contains the word; `--only healthy --packs 3000` gives the rate of false
//!   findings
//! - `--list`: prints each unexpected finding with its pack
//! - `--write`: writes `tests/diagnose.md`
#![expect(clippy::print_stdout, clippy::print_stderr, reason = "a program whose output is its table")]

mod finding;
mod pack;
mod score;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use pack::{Case, FirstFinding, PackBalancing, PackSize};
use packwatch_core::monitor::MonitorConfig;
use packwatch_core::sim::{Fault, FaultKind, SensorQuality};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use score::Score;

const SIZES: [PackSize; 2] = [PackSize { cells: 12, capacity_ah: 60.0 }, PackSize { cells: 10, capacity_ah: 5.0 }];
const QUALITIES: [(&str, SensorQuality); 3] =
    [("good", SensorQuality::Good), ("usual", SensorQuality::Usual), ("poor", SensorQuality::Poor)];

const QUICK_QUALITY: usize = 1;

/// Kinds of faults: name, pack size, and fault text with placeholders for two cells (A, B) and a sensor (S).
const FAULTS: [(&str, usize, &str); 21] = [
    ("healthy", 0, ""),
    ("healthy", 1, ""),
    ("leak 1 kohm", 0, "leak:A:1kohm"),
    ("leak 20 mA", 0, "leak:A:20mA"),
    ("leak 20 mA", 1, "leak:A:20mA"),
    ("contact +20 %", 0, "contact:A:+20%"),
    ("contact +20 %", 1, "contact:A:+20%"),
    ("weak -10 %", 0, "weak:A:-10%"),
    ("resistance +20 %", 0, "resistance:A:+20%"),
    ("resistance +20 % in 10 days", 0, "resistance:A:+20%"),
    ("module +15 %", 0, "module:5-8:+15%"),
    ("current offset 2 %", 0, "current-offset:1.2A"),
    ("current gain +5 %", 0, "current-gain:+5%"),
    ("current stuck", 0, "current-stuck"),
    ("voltage offset 30 mV", 0, "voltage-offset:A:30mV"),
    ("voltage stuck", 0, "voltage-stuck:A"),
    ("swap", 0, "swap:A:B"),
    ("double", 0, "double:A:B"),
    ("temperature stuck", 0, "temperature-stuck:S"),
    ("temperature off", 0, "temperature-off:S"),
    ("temperature off", 1, "temperature-off:S"),
];

/// If the name of a fault has this suffix, the fault grows for ten days.
const SLOWLY: &str = " in 10 days";
const SLOW_S: f64 = 10.0 * 86_400.0;
const SLOW_STEPS: u32 = 80;

struct Options {
    packs: usize,
    days: u32,
    period_ms: u32,
    jobs: usize,
    seed: u64,
    only: String,
    is_quick: bool,
    lists: bool,
    writes: bool,
}

impl Options {
    fn parse() -> Result<Self, String> {
        let only = String::new();
        let (is_quick, lists, writes) = (false, false, false);
        let mut options =
            Self { packs: 120, days: 30, period_ms: 1000, jobs: 2, seed: 1, only, is_quick, lists, writes };
        let mut arguments = std::env::args().skip(1);
        while let Some(name) = arguments.next() {
            let mut number = || arguments.next().and_then(|text| text.parse::<u32>().ok()).filter(|n| *n > 0);
            let missing = || format!("{name}: must be followed by a number above 0");
            match name.as_str() {
                "--packs" => options.packs = number().ok_or_else(missing)? as usize,
                "--days" => options.days = number().ok_or_else(missing)?,
                "--period" => options.period_ms = number().ok_or_else(missing)?,
                "--jobs" => options.jobs = number().ok_or_else(missing)? as usize,
                "--seed" => options.seed = u64::from(number().ok_or_else(missing)?),
                "--only" => options.only = arguments.next().ok_or("--only: must be followed by a word")?,
                "--quick" => (options.is_quick, options.packs) = (true, 1),
                "--list" => options.lists = true,
                "--write" => options.writes = true,
                _ => {
                    return Err(format!(
                        "{name}, must be --quick, --packs, --days, --period, --jobs, --seed, --only, --list or --write"
                    ));
                }
            }
        }
        Ok(options)
    }
}

fn main() -> Result<(), String> {
    let options = Options::parse()?;
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    let mut configs = Vec::new();
    for size in SIZES {
        configs.push(pack::configuration(folder.path(), size)?);
    }
    let cases = cases(&options)?;
    let started = Instant::now();
    let scores = run_all(&cases, &configs, &options);
    let wall_s = started.elapsed().as_secs_f64();
    let text = table(&scores, &options);
    print!("{text}");
    let months = cases.len() as f64 * f64::from(options.days) / 30.0;
    let per_month = cpu_s().map_or_else(|| "unknown".to_owned(), |cpu_s| format!("{:.2}", cpu_s / months));
    eprintln!(
        "{} packs, {wall_s:.0} s on {} threads, {per_month} CPU seconds per pack-month",
        cases.len(),
        options.jobs
    );
    if options.writes {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/diagnose.md");
        std::fs::write(&path, text).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    Ok(())
}

/// CPU time of this process (s), which does not depend on the load of the machine.
fn cpu_s() -> Option<f64> {
    const TICKS_PER_S: f64 = 100.0; // USER_HZ of Linux
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |index: usize| fields.get(index).and_then(|text| text.parse::<f64>().ok());
    Some((ticks(11)? + ticks(12)?) / TICKS_PER_S)
}

/// A row of the table: index in `FAULTS`, index in `QUALITIES`, balancing. The table is sorted in this order.
type Row = (usize, usize, PackBalancing);

fn cases(options: &Options) -> Result<Vec<(Row, Case)>, String> {
    let mut rows = Vec::new();
    for f in (0..FAULTS.len()).filter(|f| FAULTS[*f].0.contains(&options.only)) {
        let all = (0..QUALITIES.len()).flat_map(|q| PackBalancing::ALL.map(|balancing| (f, q, balancing)));
        let is_wanted = |row: &Row| !options.is_quick || *row == (f, QUICK_QUALITY, PackBalancing::On);
        rows.extend(all.filter(is_wanted));
    }
    let each = options.packs.div_ceil(rows.len().max(1)).max(1);
    let mut cases = Vec::new();
    for i in 0..each {
        for row @ (f, q, balancing) in rows.iter().copied() {
            let (name, size, text) = FAULTS[f];
            // Use the same seeds in every row. Rows of equal pack size then differ only in fault, sensors and
            // balancing.
            let seed = options.seed + i as u64;
            let (size, quality, days) = (SIZES[size], QUALITIES[q].1, options.days);
            let fault = fault_of(text, size, seed, days)?;
            let faults = if name.ends_with(SLOWLY) { slowly(fault) } else { fault.into_iter().collect() };
            cases.push((row, Case { size, quality, balancing, faults, seed, days, period_ms: options.period_ms }));
        }
    }
    Ok(cases)
}

/// Splits a resistance fault into small steps of growth. Returns no steps for any other fault.
fn slowly(fault: Option<Fault>) -> Vec<Fault> {
    let Some(Fault { kind: FaultKind::Resistance { cell, change }, from_s }) = fault else { return Vec::new() };
    let change = (1.0 + change).powf(1.0 / f64::from(SLOW_STEPS)) - 1.0;
    let step = |i| Fault {
        kind: FaultKind::Resistance { cell, change },
        from_s: from_s + f64::from(i) * SLOW_S / f64::from(SLOW_STEPS),
    };
    (0..SLOW_STEPS).map(step).collect()
}

fn fault_of(text: &str, size: PackSize, seed: u64, days: u32) -> Result<Option<Fault>, String> {
    if text.is_empty() {
        return Ok(None);
    }
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let mut below = |n: u32| dice.next_u32() % n;
    let cells = u32::from(size.cells);
    let (a, step, sensor) =
        (below(cells), 1 + below(cells - 1), below(u32::from(size.cells.div_ceil(pack::CELLS_PER_SENSOR))));
    let hours = 24 * days / 10 + below((24 * days).div_ceil(4)); // 10 to 35 % of the simulated time
    let places = [("A", a), ("B", (a + step) % cells), ("S", sensor)];
    let text = places
        .iter()
        .fold(text.to_owned(), |text, (place, n)| text.replace(&format!(":{place}"), &format!(":{}", n + 1)));
    format!("{text}@{hours}h").parse().map(Some).map_err(|error| format!("{text}: {error}"))
}

fn run_all(cases: &[(Row, Case)], configs: &[MonitorConfig], options: &Options) -> BTreeMap<Row, Score> {
    let (next, scores) = (AtomicUsize::new(0), Mutex::new(BTreeMap::<Row, Score>::new()));
    std::thread::scope(|scope| {
        for _ in 0..options.jobs {
            scope.spawn(|| {
                while let Some((row, case)) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let seen = case.run(&configs[FAULTS[row.0].1]);
                    if options.lists {
                        list(*row, case, &seen);
                    }
                    if let Ok(mut scores) = scores.lock() {
                        scores.entry(*row).or_default().add(case, &seen);
                    }
                }
            });
        }
    });
    scores.into_inner().unwrap_or_default()
}

/// Prints the unexpected findings: findings of another kind than the simulated fault, and all findings before the fault
/// began.
fn list((f, q, balancing): Row, case: &Case, seen: &[FirstFinding]) {
    let (from_s, kind) =
        case.fault().map_or((f64::INFINITY, None), |fault| (fault.from_s, finding::kind_of(&fault.kind)));
    for FirstFinding { at_s, found, .. } in seen.iter().filter(|it| it.at_s < from_s || Some(it.found.kind) != kind) {
        let (name, size, quality) = (FAULTS[f].0, SIZES[FAULTS[f].1].cells, QUALITIES[q].0);
        let (day, fault_day) = (at_s / 86_400.0, from_s / 86_400.0);
        eprintln!(
            "{name} (day {fault_day:.2}), {size} cells, {quality}, balancing {}, seed {}, day {day:.2}: {found}",
            balancing.name(),
            case.seed
        );
    }
}

fn table(scores: &BTreeMap<Row, Score>, options: &Options) -> String {
    let days = options.days;
    let mut text = format!(
        "# Diagnosis of simulated packs\n\nWritten by `tests/diagnose/run --write`. Each pack runs for {days} days.\n\n\
         | column | meaning |\n| --- | --- |\n\
         | found | right kind and right cell |\n\
         | in one drive | found before the second drive with the fault began |\n\
         | median, 90 % | delay within which that share of the row's packs was found, in days from the start of the fault; `-` if fewer were found |\n\
         | wrong cell | right kind, but only on other cells |\n\
         | wrong kind | another kind, in addition or instead |\n\
         | false | findings per pack-month without a fault; in brackets the upper 95 % limit of that rate |\n\n\
         A finding that recurs counts once. The rows are not independent samples: all rows use the same packs with different \
         faults. The packs' true cells follow the monitor's cell model exactly, unlike real cells.\n\n\
         | fault | pack | sensors | balancing | packs | found | in one drive | median | 90 % | wrong cell | wrong kind | any finding | false |\n\
         | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
    );
    for ((f, q, balancing), score) in scores {
        let (name, size, _) = FAULTS[*f];
        let PackSize { cells, capacity_ah } = SIZES[size];
        let (quality, balancing) = (QUALITIES[*q].0, balancing.name());
        let _ = writeln!(text, "| {name} | {cells} x {capacity_ah} Ah | {quality} | {balancing} | {} |", score.row());
    }
    text
}
