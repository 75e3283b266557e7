//! Compares the kernel with the textbook filter, and a cell in a pack with the same cell alone.

use super::*;
use crate::cell::circuit::{self, BranchAt};
use crate::cell::config::{CapacityState, Discretisation, SigmaPointSettings};
use crate::cell::estimator::tests::config as without_errors;
use crate::cell::estimator::tests::textbook::Textbook;
use crate::cell::model::tests::small_model;
use crate::cell::{AgedOcv, CellModule, PackBank, SensorErrors, Table};
use crate::quantity::CellIndex;

/// Settings in which every constant error of the sensors is larger than 0.
fn config() -> EstimatorConfig {
    let sensor =
        SensorErrors { voltage_offset_v: 0.004, current_offset_a: 0.02, current_gain: 0.005, slow_branch: 0.3 };
    EstimatorConfig { sensor, ..without_errors() }
}

/// A generator of numbers in [0, 1) with a fixed seed.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Simulated cells that drift apart, measured with noise, outliers, gaps and unknown currents.
struct Pack {
    model: CellModel,
    dice: Dice,
    cells: Vec<Truth>,
    current_a: f64,
    temperature_c: f64,
}

struct Truth {
    soc: f64,
    branch_v: [f64; MAX_BRANCHES],
    capacity_ah: f64,
    ratio: f64,
}

impl Pack {
    fn new(model: &CellModel, cells: usize) -> Self {
        let cell = |i: usize| Truth {
            soc: 0.7 + 0.02 * (i as f64).sin(),
            branch_v: [0.0; MAX_BRANCHES],
            capacity_ah: 1.7 + 0.1 * (i as f64).cos(),
            ratio: 1.0 + 0.1 * i as f64,
        };
        let cells = (0..cells).map(cell).collect();
        Self { model: model.clone(), dice: Dice(0x2545_F491_4F6C_DD1D), cells, current_a: 1.0, temperature_c: 20.0 }
    }

    /// The steps at one time. Some cells have no step.
    fn steps(&mut self, time: u32) -> Vec<(usize, CellStep)> {
        let dt_s = if time.is_multiple_of(7) { 0.25 } else { 1.0 };
        let low = self.cells.iter().any(|cell| cell.soc < 0.1);
        let high = self.cells.iter().any(|cell| cell.soc > 0.9);
        self.current_a = match time % 5000 {
            0..600 => 0.0,
            _ if low => -1.0,
            _ if high => 1.0,
            _ if self.current_a == 0.0 => 0.7,
            _ => self.current_a,
        };
        self.temperature_c += 0.2 * (self.dice.roll() - 0.5);
        self.temperature_c = self.temperature_c.clamp(-5.0, 45.0);
        (0..self.cells.len()).filter_map(|cell| self.measure(cell, time, dt_s)).collect()
    }

    fn measure(&mut self, index: usize, time: u32, dt_s: f64) -> Option<(usize, CellStep)> {
        let (current_a, dice) = (self.current_a, &mut self.dice);
        // Cells report at different intervals, and some report twice at the same time.
        let dt_s = match dice.roll() {
            roll if roll < 0.01 => 0.0,
            roll if roll < 0.02 => 0.5 * dt_s,
            _ => dt_s,
        };
        let is_missing = index % 5 == 3 && dice.roll() < 0.01;
        let gap_s = if dice.roll() < 2e-4 { 40.0 } else { 0.0 };
        let temperature_c = self.temperature_c + 0.1 * (index as f64).sin();
        let cell = &mut self.cells[index];
        let position = self.model.grid_position(cell.soc, temperature_c);
        for i in 0..self.model.branches.len() {
            let branch = BranchAt::new(&self.model, i, &position, cell.ratio);
            let moved = branch.voltage_after(Discretisation::Exact, cell.branch_v[i], current_a, dt_s);
            cell.branch_v[i] = branch.voltage_after(Discretisation::Exact, moved, 0.0, gap_s);
        }
        cell.soc = circuit::soc_after(cell.soc, current_a * dt_s, cell.capacity_ah);
        let state = (cell.soc, cell.ratio, cell.capacity_ah);
        let branches_v = cell.branch_v.iter().sum();
        let temperature = self.model.temperature_position(temperature_c);
        let truth_v = circuit::aged_terminal_v(&self.model, state, &temperature, branches_v, current_a);
        let outlier_v = if dice.roll() < 1e-3 { 0.8 } else { 0.0 };
        let lost = time % 4000 > 3900 && index == 1;
        let step = CellStep {
            measured_s: dt_s,
            charge_as: current_a * dt_s,
            offset_s: if current_a == 0.0 { 0.0 } else { dt_s },
            unmeasured_s: gap_s,
            current_a: (dice.roll() > 1e-3).then_some(current_a),
            temperature_c: (index != 2).then_some(temperature_c),
            ambient_c: 22.0,
            voltage_v: truth_v + 0.01 * (dice.roll() - 0.5) + outlier_v + if lost { -1.0 } else { 0.0 },
            is_voltage_frozen: false,
        };
        (!is_missing).then_some((index, step))
    }
}

fn step(bank: &mut EstimatorBank, steps: &[(usize, CellStep)]) {
    steps.iter().for_each(|(cell, step)| bank.add(*cell, step));
    bank.step();
}

fn model(branches: usize) -> CellModel {
    let mut model = small_model();
    let slower = |by: f64| {
        let mut branch = model.branches[0].clone();
        branch.c_farad.values.iter_mut().flatten().for_each(|c_farad| *c_farad *= by);
        branch
    };
    model.branches = [1.0, 7.0, 40.0].into_iter().take(branches).map(slower).collect();
    model
}

/// Maximum differences between bank and textbook filter: of the SOC, and of all other values.
fn differences<const N: usize>(model: &CellModel, config: &EstimatorConfig, rounds: u32) -> (f64, f64) {
    const CELLS: usize = 11;
    let mut bank = EstimatorBank::new(model, config, CELLS);
    let mut textbooks: Vec<_> = (0..CELLS).map(|_| Textbook::<N>::new(config)).collect();
    let mut pack = Pack::new(model, CELLS);
    let (mut soc, mut others, mut accepted, mut rejected, mut resets, mut copied) = (0.0_f64, 0.0_f64, 0, 0, 0, 0);
    for time in 0..rounds {
        let steps = pack.steps(time);
        let before: Vec<_> = (0..CELLS).map(|cell| bank.cell(cell)).collect();
        step(&mut bank, &steps);
        for (cell, step) in &steps {
            let (result, after) = (bank.result(*cell), bank.cell(*cell));
            resets += usize::from(result.reset);
            match textbooks[*cell].step(model, config, step, (&before[*cell], &after, result.reset)) {
                None => copied += 1,
                Some(update) => {
                    assert_eq!(result.update.map(|u| u.accepted), update.map(|u| u.accepted), "{time} {cell}");
                    if let (Some(ours), Some(theirs)) = (result.update, update) {
                        others = others
                            .max((ours.innovation - theirs.innovation).abs())
                            .max((ours.innovation_variance - theirs.innovation_variance).abs())
                            .max((ours.test_ratio - theirs.test_ratio).abs());
                        accepted += usize::from(theirs.accepted);
                        rejected += usize::from(!theirs.accepted);
                    }
                }
            }
            let (of_soc, of_others) = textbooks[*cell].differences(&after);
            (soc, others) = (soc.max(of_soc), others.max(of_others));
        }
        if time % 2500 == 1249 {
            // At the end of a charge or discharge, the learned capacity changes, and the open-circuit curve with it.
            // Both filters must then use the aged curve at every temperature and in every SOC interval.
            for (cell, textbook) in textbooks.iter_mut().enumerate() {
                let mean = model.capacity_ah * (0.95 - 0.02 * cell as f64);
                let curve = ScalarGaussian { mean, ..bank.cell(cell).curve() };
                textbook.set_curve(curve);
                bank.change(cell, |estimator| estimator.memory.curve = curve);
            }
        }
        if time % 2500 == 2499 {
            bank.learn_slow_branches();
            textbooks.iter_mut().enumerate().for_each(|(cell, textbook)| textbook.copy(&bank.cell(cell)));
        }
        let worst_nis = (0..CELLS).map(|cell| bank.mean_nis(cell)).fold(0.0, f64::max);
        assert_eq!(bank.worst_nis(), worst_nis, "{time}");
    }
    assert!(accepted > rounds as usize * 10 && rejected > 0 && resets > 0, "{accepted} {rejected} {resets}");
    assert!(copied < rounds as usize / 100 + 2 * CELLS, "{copied}");
    (soc, others)
}

#[test]
fn kernel_agrees_with_textbook_over_100_000_steps() {
    let agrees = |(soc, others): (f64, f64)| assert!(soc < 1e-9 && others < 1e-8, "{soc} {others}");
    agrees(differences::<4>(&model(1), &config(), 100_000));
    agrees(differences::<5>(&model(2), &config(), 100_000));
    agrees(differences::<6>(&model(3), &config(), 100_000));
}

#[test]
fn kernel_agrees_with_textbook_for_all_settings() {
    let plain = model(2);
    let aged = {
        let aged_ocv = AgedOcv::of_shift(0.6, &plain.soc, plain.capacity_ah, &plain.ocv_v.values);
        CellModel { aged_ocv, ..plain.clone() }
    };
    let own_error =
        CellModel { voltage_error_v: Some(Table { values: vec![vec![0.01, 0.004, 0.02]; 2] }), ..plain.clone() };
    let one_temperature = {
        let mut model = model(1);
        let one = |table: &mut Table| table.values.truncate(1);
        model.temperature_c.truncate(1);
        [&mut model.ocv_v, &mut model.r0_ohm].into_iter().for_each(one);
        model.branches.iter_mut().flat_map(|b| [&mut b.r_ohm, &mut b.c_farad]).for_each(one);
        model
    };
    let held = EstimatorConfig { capacity_state: CapacityState::Held, ..config() };
    let euler = EstimatorConfig { discretisation: Discretisation::Euler, ..config() };
    let spread = EstimatorConfig { points: SigmaPointSettings { alpha: 0.3, beta: 1.0, kappa: 2.0 }, ..config() };
    let cases = [
        (&aged, config()),
        (&own_error, config()),
        (&one_temperature, config()),
        (&plain, held),
        (&plain, euler),
        (&plain, spread),
        (&plain, without_errors()),
    ];
    for (case, (model, config)) in cases.into_iter().enumerate() {
        let (soc, others) = match model.branches.len() {
            1 => differences::<4>(model, &config, 6000),
            _ => differences::<5>(model, &config, 6000),
        };
        assert!(soc < 1e-9 && others < 1e-8, "case {case}: {soc} {others}");
    }
}

#[test]
fn estimate_is_independent_of_other_cells() {
    let (model, config) = (model(1), config());
    let mut together = EstimatorBank::new(&model, &config, 11);
    let mut alone: Vec<_> = (0..11).map(|_| EstimatorBank::new(&model, &config, 1)).collect();
    let mut pack = Pack::new(&model, 11);
    for time in 0..3000 {
        let steps = pack.steps(time);
        // The steps are made in two batches, the second in reverse order.
        let (first, second) = steps.split_at(steps.len() / 3);
        step(&mut together, first);
        step(&mut together, &second.iter().rev().copied().collect::<Vec<_>>());
        for (cell, own) in steps {
            step(&mut alone[cell], &[(0, own)]);
            assert_eq!(together.cell(cell).snapshot(), alone[cell].cell(0).snapshot(), "{time} {cell}");
            assert_eq!(together.result(cell), alone[cell].result(0));
        }
    }
}

#[test]
fn evicted_isotherm_is_computed_again() {
    let (model, config) = (model(1), config());
    let mut together = EstimatorBank::new(&model, &config, 2);
    let mut alone = EstimatorBank::new(&model, &config, 1);
    let mut pack = Pack::new(&model, 2);
    let mut socs = Vec::new();
    for time in 0..4500 {
        // One cell keeps its temperature. The other passes through more temperatures than the cache holds.
        let at = |cell: usize| if cell == 0 { 20.0 } else { 0.01 * f64::from(time) };
        let mut steps = pack.steps(time);
        steps.iter_mut().for_each(|(cell, step)| step.temperature_c = Some(at(*cell)));
        step(&mut together, &steps);
        step(&mut alone, &steps[..1]);
        assert_eq!(together.cell(0).snapshot(), alone.cell(0).snapshot(), "{time}");
        socs.push(alone.soc(0).expect("started").mean);
    }
    assert!(socs.iter().any(|soc| *soc > 0.55) && socs.iter().any(|soc| *soc < 0.45));
}

#[test]
fn bank_returns_stored_estimator_unchanged() {
    let (model, config) = (model(3), config());
    let mut bank = EstimatorBank::new(&model, &config, 9);
    let mut pack = Pack::new(&model, 9);
    (0..50).for_each(|time| step(&mut bank, &pack.steps(time)));
    let before = bank.cell(4).snapshot();
    let other = bank.cell(7);
    bank.put(4, &other);
    assert_eq!(bank.cell(4).snapshot(), other.snapshot());
    assert_ne!(bank.cell(4).snapshot(), before);
    bank.change(4, |estimator| estimator.hold_capacity(1.23));
    assert_eq!((bank.cell(4).capacity().mean, bank.cell(7).capacity()), (1.23, other.capacity()));
    bank.put(4, &CellEstimator::new(&config));
    assert_eq!((bank.soc(4), bank.cell(4).capacity().mean), (None, config.initial.capacity_ah));
}

/// In a pack with two kinds of cells, each kind has the same estimates, bit for bit, as in a separate bank.
#[test]
fn mixed_modules_match_separate_banks() {
    let (model, other) = (small_model(), CellModel { capacity_ah: 3.0, ..small_model() });
    let config = config();
    let other_config =
        EstimatorConfig { initial: crate::cell::InitialState { capacity_ah: 3.0, ..config.initial }, ..config };
    let in_module = [CellIndex(1), CellIndex(4), CellIndex(5)];
    let module =
        CellModule { cells: in_module.to_vec(), model: other.clone(), estimator: other_config, is_given: true };
    let mut mixed = PackBank::new(&model, &config, 8, &[module]);
    let mut own = EstimatorBank::new(&model, &config, 5);
    let mut foreign = EstimatorBank::new(&other, &other_config, 3);
    assert_eq!(mixed.own_cells(), [0, 2, 3, 6, 7]);
    let mut pack = Pack::new(&model, 8);
    for time in 0..4000 {
        for (cell, step) in pack.steps(time) {
            mixed.add(cell, &step);
            match in_module.iter().position(|it| it.index() == cell) {
                Some(at) => foreign.add(at, &step),
                None => own.add(mixed.own_cells().iter().position(|&it| it == cell).unwrap(), &step),
            }
        }
        mixed.step();
        own.step();
        foreign.step();
    }
    for (bank, cells) in [(&own, vec![0, 2, 3, 6, 7]), (&foreign, vec![1, 4, 5])] {
        for (at, cell) in cells.into_iter().enumerate() {
            assert!(bank.is_started(at));
            assert_eq!(mixed.cell(cell).snapshot(), bank.cell(at).snapshot(), "cell {cell}");
            assert_eq!((mixed.soc(cell), mixed.model(cell)), (bank.soc(at), bank.model()));
        }
    }
    let [(a, b), (c, d)] = [own.offset_evidence(), foreign.offset_evidence()];
    let (information, score) = mixed.offset_evidence();
    assert!((information - (5.0 * a + 3.0 * c) / 8.0).abs() <= 1e-12 * information, "{information}");
    assert!((score - (5.0 * b + 3.0 * d) / 8.0).abs() <= 1e-9 * score.abs(), "{score}");
    let [low, high] =
        [f64::min, f64::max].map(|pick| (0..8).map(|it| mixed.soc(it).unwrap().mean).reduce(pick).unwrap());
    assert_eq!(mixed.extremes().map(|(lowest, highest)| (lowest.mean, highest.mean)), Some((low, high)));
}

#[test]
fn contradicting_reading_widens_soc_next_to_flat_part() {
    let mut model = small_model();
    model.soc = vec![0.0, 0.1, 0.9, 0.96, 1.0];
    model.ocv_v.values = vec![vec![3.15, 3.3, 3.31, 3.34, 3.46]; 2];
    let resistances = model.branches.iter_mut().flat_map(|branch| [&mut branch.r_ohm, &mut branch.c_farad]);
    resistances.chain([&mut model.r0_ohm]).for_each(|table| {
        table.values.iter_mut().for_each(|row| *row = vec![row[1]; 5]);
    });
    let mut bank = EstimatorBank::new(&model, &config(), 1);
    let rest = |voltage_v: f64| CellStep {
        measured_s: 10.0,
        charge_as: 0.0,
        offset_s: 10.0,
        unmeasured_s: 0.0,
        current_a: Some(0.0),
        temperature_c: Some(25.0),
        ambient_c: 25.0,
        voltage_v,
        is_voltage_frozen: false,
    };
    (0..300).for_each(|_| step(&mut bank, &[(0, rest(3.37))]));
    let before = bank.soc(0).expect("started").std();
    step(&mut bank, &[(0, rest(3.30))]);
    let update = bank.result(0).update.expect("updated");
    assert!(update.accepted && update.innovation < -0.02, "{update:?}");
    assert_eq!(bank.cell(0).memory.innovation_v, update.innovation);
    let after = bank.soc(0).expect("started").std();
    assert!(after > 2.0 * before, "{before} {after}");
}
