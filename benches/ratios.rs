//! Speed of a pack's estimator relative to the plain form of the same filter. Both are timed alternately in one run, so
//! that other load on the machine affects both. Prints the medians of the rounds.
#![expect(clippy::print_stdout, reason = "the printed table is the result")]

use std::hint::black_box;
use std::time::Instant;

use common::{example, reading};
use packwatch_host::cell::{CellEstimator, EstimatorBank};
use packwatch_host::config::Config;

mod common;

/// Number of rounds. Each round times every form once.
const ROUNDS: usize = 15;
/// Steps of all cells per round.
const STEPS: u32 = 2000;
const CELLS: usize = 96;

fn main() {
    // `cargo test` also runs the benches; one round then suffices.
    let rounds = if std::env::args().any(|argument| argument == "--bench") { ROUNDS } else { 1 };
    let mut plain = Plain::new(1);
    let mut plain_pack = Plain::new(CELLS);
    let mut single = Bank::new(1);
    let mut pack = Bank::new(CELLS);
    let mut times = [const { Vec::new() }; 4];
    for _ in 0..rounds {
        times[0].push(time(|k| plain.step(k)));
        times[1].push(time(|k| plain_pack.step(k)) / CELLS as f64);
        times[2].push(time(|k| single.step(k)));
        times[3].push(time(|k| pack.step(k)) / CELLS as f64);
    }
    let [plain_ns, plain_pack_ns, single_ns, pack_ns] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    println!("estimator step, 4 states, tables of 14 SOC x 3 temperatures ({rounds} rounds, medians)");
    println!("form                                  ns/step  vs. plain  limit");
    println!("plain nalgebra, one cell            {plain_ns:>9.1}       1.00");
    println!("plain nalgebra, one of 96           {plain_pack_ns:>9.1}       {:.2}", plain_pack_ns / plain_ns);
    println!("bank, one cell                      {single_ns:>9.1}       {:.3}  0.5", single_ns / plain_ns);
    println!("bank, one of 96                     {pack_ns:>9.1}       {:.3}  0.14", pack_ns / plain_ns);
}

/// Nanoseconds per call.
fn time(mut step: impl FnMut(u32)) -> f64 {
    let started = Instant::now();
    (0..STEPS).for_each(&mut step);
    started.elapsed().as_secs_f64() * 1e9 / f64::from(STEPS)
}

struct Plain {
    config: Config,
    cells: Vec<CellEstimator>,
}

impl Plain {
    fn new(cells: usize) -> Self {
        let config = example();
        Self { cells: vec![CellEstimator::new(&config.monitor.estimator); cells], config }
    }

    fn step(&mut self, k: u32) {
        for (cell, estimator) in self.cells.iter_mut().enumerate() {
            black_box(estimator.step(&self.config.monitor.model, &self.config.monitor.estimator, &reading(k, cell)));
        }
    }
}

struct Bank {
    bank: EstimatorBank,
    cells: usize,
}

impl Bank {
    fn new(cells: usize) -> Self {
        let config = example().monitor;
        Self { bank: EstimatorBank::new(&config.model, &config.estimator, cells), cells }
    }

    fn step(&mut self, k: u32) {
        (0..self.cells).for_each(|cell| self.bank.add(cell, black_box(&reading(k, cell))));
        self.bank.step();
        black_box(self.bank.result(0));
    }
}
