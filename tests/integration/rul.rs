//! Checks forecasts of the remaining useful life on measured lives, on simulated fades of many shapes, and by the
//! Monitor on a simulated life. No parameter was tuned to the simulated fades.
//!
//! `cargo test --test integration rul -- --nocapture` prints the results of `tests/rul.md`.

use std::path::{Path, PathBuf};

use packwatch::config;
use packwatch::health::Axis;
use packwatch::lab::rul::{self, History, HistoryScore, MeasuredCapacity, Threshold};
use packwatch::monitor::EventKind;
use packwatch::quantity::CellIndex;
use packwatch::sim::{Scenario, Settings};

use crate::support::{measured, simulated_cell};

/// Fractions of the life at which forecasts are made.
const AT: [f64; 5] = [0.4, 0.5, 0.6, 0.7, 0.8];
const ALPHA: f64 = 0.2;
/// Allowed coverage of the 90 % interval, over all forecasts.
const COVERAGE: std::ops::RangeInclusive<f64> = 0.80..=0.98;

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn measured_life_forecasts_beat_baselines() {
    let mut scored = Vec::new();
    for (folder, ending, thresholds) in [
        ("nasa_pcoe_aging", "_cycles.csv", &[Threshold::AmpereHours(1.4)][..]),
        ("nasa_randomized", "_reference_capacity.csv", &[Threshold::OfFirst(0.7), Threshold::OfFirst(0.6)]),
    ] {
        let files = std::fs::read_dir(measured::path(folder)).unwrap();
        let mut files: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
        files.sort();
        for file in files.iter().filter(|file| file.to_string_lossy().ends_with(ending)) {
            let history = History::read(file).unwrap();
            let name = file.file_stem().unwrap().to_string_lossy();
            scored.extend(thresholds.iter().map(|&t| rul::score(&history, &name, t, &AT, ALPHA, &|| ())));
        }
    }
    print(&scored);
    let total = rul::total(&scored).unwrap();
    println!("{total:?}");
    assert_eq!(total.refused, 0);
    assert!(COVERAGE.contains(&total.coverage), "{total:?}");
    assert!(total.mean_error < total.straight_mean_error, "{total:?}");
    assert!(total.mean_error < total.double_exponential_mean_error, "{total:?}");
}

/// Uniform numbers in [0, 1): splitmix64.
struct Dice(u64);

impl Dice {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Shape of a fade: the lost fraction as a function of the elapsed fraction of the life.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shape {
    Power(f64),
    /// The fade rate changes by the given factor at the given fraction of the life.
    Kink(f64, f64),
}

impl Shape {
    fn lost(self, part: f64) -> f64 {
        match self {
            Self::Power(exponent) => part.powf(exponent),
            Self::Kink(at, factor) => {
                let lost = |part: f64| part.min(at) + factor * (part - at).max(0.0);
                lost(part) / lost(1.0)
            }
        }
    }
}

/// Creates a life of random length in which the cell loses a random share of its capacity. The capacity also has noise
/// and a correlated variation, and recovers after long rests. If the axis is days, the cell also ages during the rests.
fn life(shape: Shape, axis: Axis, dice: &mut Dice) -> (History, f64) {
    let (readings, depth) = (dice.between(40.0, 300.0).floor(), dice.between(0.2, 0.4));
    let days_each = if axis == Axis::Cycles { dice.between(0.15, 0.25) } else { dice.between(2.0, 5.0) };
    let (wander_std, relaxation) = (dice.between(0.002, 0.012), dice.between(4.0, 12.0));
    let (bump, every) = (dice.between(0.01, 0.05), dice.between(25.0, 60.0));
    let kept = (-1.0 / relaxation).exp();
    let (mut wander, mut recovered, mut row, mut rows) = (0.0, 0.0, MeasuredCapacity::default(), Vec::new());
    while row.used < 1.4 * readings * if axis == Axis::Cycles { 1.0 } else { days_each } {
        let unit = if axis == Axis::Cycles { 1.0 } else { days_each };
        wander = kept * wander + wander_std * (1.0 - kept * kept).sqrt() * dice.normal();
        recovered *= kept;
        let capacity = 1.0 - depth * shape.lost(row.used / (readings * unit));
        row.capacity_ah = 2.0 * (capacity + wander + recovered + 0.002 * dice.normal());
        if row.capacity_ah < 0.2 {
            break;
        }
        rows.push(row);
        let rest = if dice.uniform() < 1.0 / every { dice.between(1.0, 6.0) } else { 0.0 };
        recovered += if rest > 0.0 { bump * dice.between(0.4, 1.0) } else { 0.0 };
        row.days += days_each + rest;
        (row.cycles, row.rest_days) = (row.cycles + 1.0, row.rest_days + rest);
        row.used = if axis == Axis::Cycles { row.cycles } else { row.days };
    }
    (History { axis, rows }, 2.0 * (1.0 - depth))
}

#[test]
fn forecast_interval_covers_many_fade_shapes() {
    let shapes = [
        Shape::Power(1.0),
        Shape::Power(0.5),
        Shape::Power(0.75),
        Shape::Power(1.5),
        Shape::Kink(0.4, 0.4),
        Shape::Kink(0.5, 1.7),
    ];
    let (mut dice, mut all) = (Dice(6), Vec::new());
    for shape in shapes {
        for axis in [Axis::Cycles, Axis::Days] {
            let scored: Vec<HistoryScore> = (0..6)
                .map(|_| {
                    let (history, end_ah) = life(shape, axis, &mut dice);
                    rul::score(&history, "simulated", Threshold::AmpereHours(end_ah), &AT, ALPHA, &|| ())
                })
                .collect();
            let total = rul::total(&scored).unwrap();
            println!(
                "{shape:?} {axis:?}: covered {:.2}, alpha {:.2}, error {:.3} (line {:.3}, double exponential {:.3}), refused {} of {}",
                total.coverage,
                total.within_alpha,
                total.mean_error,
                total.straight_mean_error,
                total.double_exponential_mean_error,
                total.refused,
                total.forecasts
            );
            all.extend(scored);
        }
    }
    let total = rul::total(&all).unwrap();
    println!("{total:?}");
    assert!(COVERAGE.contains(&total.coverage), "{total:?}");
    assert!(total.mean_error < total.straight_mean_error, "{total:?}");
    assert!(total.mean_error < total.double_exponential_mean_error, "{total:?}");
}

#[test]
fn on_board_life_is_forecast_from_half_cycles() {
    // The life of `config/paper.toml`, which fades by 0.05 Ah per cycle; each cycle is 60 % of a full cycle. Here it
    // ends at 1.3 Ah, after 26 cycles.
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml");
    let mut config = config::load(&path).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n"))).monitor;
    config.health.end_of_life_ah = 1.3;
    let (mut reported, mut first) = (Vec::new(), None);
    simulated_cell::live(config, Settings::of(Scenario::Paper, 2.6), |_, sim, monitor, events| {
        for event in events {
            let EventKind::RemainingLife {
                cycles: Some(cycles), cycles_low: Some(low), cycles_high: Some(high), ..
            } = event.kind
            else {
                continue;
            };
            // Each cycle moves 0.6 of the present capacity; a full cycle moves the rated capacity.
            let capacity_ah = sim.pack().cells()[0].capacity_ah;
            let truth = (0.6 / 0.05 * (capacity_ah * capacity_ah - 1.3 * 1.3) / (2.0 * 2.6)).max(0.0);
            first.get_or_insert(sim.pack().cycles());
            if truth > 0.0 {
                println!("after {} cycles: {cycles:.1} ({low:.1} to {high:.1}), truth {truth:.1}", sim.pack().cycles());
            }
            assert!(monitor.remaining_life(CellIndex(0)).is_ok());
            reported.push((truth, low, cycles, high));
        }
    });
    assert!(first.is_some_and(|cycles| cycles <= 8), "{first:?}");
    let before_end: Vec<_> = reported.iter().filter(|(truth, ..)| *truth > 0.0).collect();
    let covered = before_end.iter().filter(|(truth, low, _, high)| low <= truth && truth <= high).count();
    let share = covered as f64 / before_end.len() as f64;
    assert!(share >= 0.8, "{share}");
    assert!(reported.last().is_some_and(|&(_, _, cycles, high)| cycles == 0.0 && high == 0.0), "{:?}", reported.last());
}

fn print(scored: &[HistoryScore]) {
    for file in scored {
        println!("{} {:.3} Ah, end {:?}", file.name, file.threshold_ah, file.end_of_life);
        for one in &file.judged {
            println!(
                "  {:2.0} %  truth {:6.1}  {:?}  alpha {}  covered {}  line {:?}  double exponential {:?}",
                100.0 * one.at,
                one.truth,
                one.forecast,
                one.within_alpha,
                one.covered,
                one.straight,
                one.double_exponential
            );
        }
    }
}

/// Writes a file with a linear fade: 0.01 Ah per reading, five days between readings.
fn straight_file(folder: &Path) -> PathBuf {
    let rows = (0..40).map(|n| format!("{},{:.3}\n", 432_000 * n, 2.0 - 0.01 * f64::from(n)));
    let path = folder.join("cell.csv");
    std::fs::write(&path, format!("date,capacity_ah\n{}", rows.collect::<String>())).unwrap();
    path
}

fn command(args: &[&str]) -> assert_cmd::assert::Assert {
    assert_cmd::Command::cargo_bin("packwatch").unwrap().arg("rul").args(args).assert()
}

fn json(args: &[&str]) -> serde_json::Value {
    serde_json::from_slice(&command(args).success().get_output().stdout).unwrap()
}

#[test]
fn command_forecasts_and_reports_unjudged() {
    let folder = tempfile::tempdir().unwrap();
    let file = straight_file(folder.path());
    let file = file.to_str().unwrap();
    let now = json(&[file, "--end-of-life", "1.5,80 %", "--json"]);
    // The capacity is 1.61 Ah and falls by 0.002 Ah per day, so 55 days remain until 1.5 Ah.
    let median = now["forecasts"][0]["remaining"]["days"]["median"].as_f64().unwrap();
    assert!((median - 55.0).abs() < 10.0, "{now}");
    assert_eq!(now["forecasts"][0]["remaining"]["cycles"], serde_json::Value::Null);
    assert_eq!(now["forecasts"][1]["threshold_ah"], 1.6);
    let judged = json(&[file, "--end-of-life", "1.7", "--at", "50,80", "--json"]);
    assert_eq!(judged["files"][0]["end_of_life"], 150.0);
    assert_eq!(judged["total"]["forecasts"], 2);
    assert_eq!(judged["total"]["coverage"], 1.0);
    let text = command(&[file, "--end-of-life", "1.5", "--at", "50"]).success();
    let text = String::from_utf8_lossy(&text.get_output().stdout).into_owned();
    assert!(text.contains("does not stay below 1.500 Ah (least capacity 1.610 Ah): not scored"), "{text}");
}

#[test]
fn command_rejects_unreadable_input_with_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.csv");
    std::fs::write(&path, "date,capacity_ah\n0,2\n5,much\n").unwrap();
    let failed = command(&[path.to_str().unwrap(), "--end-of-life", "1.4"]).failure().code(1);
    let printed = String::from_utf8_lossy(&failed.get_output().stderr).into_owned();
    let wanted = "bad.csv:3: column capacity_ah: found \"much\", must be Ah above 0 or nothing";
    assert!(printed.contains(wanted), "{printed}");
    command(&[path.to_str().unwrap(), "--end-of-life", "120 %"]).failure().code(2);
    let few = folder.path().join("few.csv");
    std::fs::write(&few, "date,capacity_ah\n0,2\n5,1.9\n").unwrap();
    let text = command(&[few.to_str().unwrap(), "--end-of-life", "1.4"]).success();
    let text = String::from_utf8_lossy(&text.get_output().stdout).into_owned();
    assert!(text.contains("no forecast: 2 capacity readings, 3 are needed"), "{text}");
}
