//! Runs the scenario of "Battery Predictions for Electronic Prognostics" through the whole core (true cell, sensors,
//! frames of the DBC, Monitor). Checks the errors of each cycle.
//!
//! A cell of 2.6 Ah is cycled between SOC 0.3 and 0.9 with 1 s samples. It fades by 0.05 Ah per cycle to 0.25 Ah.
//! Sensor errors: voltage noise 5 mV; current noise 20 mA, offset 10 mA, gain error 0.5 %. The paper's figures show an
//! |SOC error| of 1 to 5 % during life and about 20 % at the end. The capacity in these figures lags by one event and
//! falls to 2.2 Ah at the first event.
//!
//! To print the table: `cargo test --workspace --test integration paper_scenario -- --nocapture`.

use std::path::Path;

use crate::support::simulated_cell;
use packwatch::config;
use packwatch::monitor::MonitorConfig;
use packwatch::quantity::CellIndex;
use packwatch::sim::{Scenario, Settings};

/// Number of initial cycles in which the filter may still settle.
const SETTLING_CYCLES: usize = 1;
/// Number of cycles until the sensor offset and the fade per cycle are known.
const LEARNING_CYCLES: usize = 3;
/// Largest allowed |SOC error| of any sample. The paper's figures show 0.05, and 0.20 at the end of life.
const MAX_SOC_ERROR: f64 = 0.005;
/// Largest allowed relative |capacity error| at the end of a cycle. The current sensor's gain error alone causes half
/// of it.
const MAX_CAPACITY_ERROR: f64 = 0.01;
/// Minimum fraction of cycles in which the true capacity lies within two stated standard deviations of the estimate.
const MIN_COVERAGE: f64 = 0.90;

#[derive(Debug, Clone, Copy, Default)]
struct Cycle {
    true_ah: f64,
    estimated_ah: f64,
    std_ah: f64,
    max_soc_error: f64,
    soc_square: f64,
    soc_inside: f64,
    samples: f64,
}

impl Cycle {
    fn add(&mut self, soc_error: f64, soc_std: f64) {
        self.max_soc_error = self.max_soc_error.max(soc_error.abs());
        self.soc_square += soc_error * soc_error;
        self.soc_inside += f64::from(u8::from(soc_error.abs() <= 2.0 * soc_std));
        self.samples += 1.0;
    }
}

fn live(config: MonitorConfig, settings: Settings) -> Vec<Cycle> {
    let (mut cycles, mut cycle, mut completed) = (Vec::new(), Cycle::default(), 0);
    simulated_cell::live(config, settings, |_, sim, monitor, _| {
        if sim.pack().cycles() != completed {
            completed = sim.pack().cycles();
            cycles.push(std::mem::take(&mut cycle));
        }
        let truth = sim.pack().cells()[0];
        let capacity = monitor.capacity(CellIndex(0));
        (cycle.true_ah, cycle.estimated_ah, cycle.std_ah) = (truth.capacity_ah, capacity.mean, capacity.std());
        if let Some(estimate) = monitor.latest().next().flatten() {
            cycle.add(estimate.soc - truth.soc, estimate.soc_std);
        }
    });
    cycles.push(cycle);
    cycles
}

fn print(cycles: &[Cycle]) {
    println!("cycle  true Ah  estimated +-   std  error Ah | max |SOC error| %  RMS %  within 2 std %");
    for (i, c) in cycles.iter().enumerate() {
        println!(
            "{:5}  {:7.3}  {:9.3} +- {:5.3}  {:+8.3} | {:17.2}  {:5.2}  {:14.0}",
            i + 1,
            c.true_ah,
            c.estimated_ah,
            c.std_ah,
            c.estimated_ah - c.true_ah,
            100.0 * c.max_soc_error,
            100.0 * (c.soc_square / c.samples).sqrt(),
            100.0 * c.soc_inside / c.samples,
        );
    }
}

#[test]
fn paper_scenario_errors_stay_below_papers() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml");
    let config = config::load(&path).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")));
    let settings = Settings::of(Scenario::Paper, 2.6);
    let cycles = live(config.monitor, settings);
    print(&cycles);
    assert_eq!(cycles.len(), 48);
    let settled = &cycles[SETTLING_CYCLES..];
    for (i, c) in settled.iter().enumerate() {
        let cycle = SETTLING_CYCLES + i + 1;
        assert!(c.max_soc_error <= MAX_SOC_ERROR, "cycle {cycle}: SOC error {}", c.max_soc_error);
        let error = c.estimated_ah / c.true_ah - 1.0;
        assert!(cycle <= LEARNING_CYCLES || error.abs() <= MAX_CAPACITY_ERROR, "cycle {cycle}: capacity error {error}");
    }
    let covered = settled.iter().filter(|c| (c.estimated_ah - c.true_ah).abs() <= 2.0 * c.std_ah).count();
    let share = covered as f64 / settled.len() as f64;
    assert!(share >= MIN_COVERAGE, "{share:.2} of the cycles cover the true capacity");
}
