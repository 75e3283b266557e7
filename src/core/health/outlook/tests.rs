//! Compares the outlook (energy, time and power that a pack can deliver or take up) with a simulated circuit, and its
//! variances with the errors that cause them.

use super::*;
use crate::cell::Discretisation;
use crate::cell::circuit::{BranchAt, soc_after, terminal_v};
use crate::cell::model::tests::small_model;

const CONFIG: OutlookConfig = OutlookConfig {
    min_temperature_c: None,
    max_temperature_c: None,
    min_voltage_v: None,
    max_voltage_v: None,
    max_discharge_a: None,
    max_charge_a: None,
    taper_current_a: 0.1,
    target_soc: 0.8,
};

fn cell(model: &CellModel, soc: f64) -> CellNow<'_> {
    let exact = |mean: f64| ScalarGaussian { mean, variance: 0.0 };
    CellNow {
        model,
        soc: exact(soc),
        capacity: exact(2.0),
        resistance_ratio: 1.0,
        log_resistance_std: 0.0,
        slow_ratio: 1.0,
        branch_v: [0.0; MAX_BRANCHES],
        temperature: model.temperature_position(0.0),
    }
}

fn loaded(mode: Mode, current_a: f64) -> RecentLoad {
    let mut load = RecentLoad::default();
    (0..100).for_each(|second| load.observe(Timestamp::from_secs(f64::from(second)), mode, Some(current_a), 0.05));
    load
}

fn of_one(cell: CellNow<'_>, load: (Mode, f64)) -> Outlook {
    limited(cell, load, &CONFIG)
}

fn limited(cell: CellNow<'_>, (mode, current_a): (Mode, f64), config: &OutlookConfig) -> Outlook {
    let pack = Structure { series_per_state: 1.0, strings: 1.0, soc: cell.soc.mean, capacity_ah: cell.capacity.mean };
    of_pack(config, (&loaded(mode, current_a), mode), &[cell], &pack).unwrap()
}

/// The circuit at 0 degrees C, simulated in steps of 0.1 s.
struct Circuit<'a> {
    model: &'a CellModel,
    soc: f64,
    branch_v: f64,
}

impl Circuit<'_> {
    fn voltage_v(&self, current_a: f64) -> f64 {
        terminal_v(self.model, &self.model.grid_position(self.soc, 0.0), 1.0, self.branch_v, current_a)
    }

    fn step(&mut self, current_a: f64) -> f64 {
        let branch = BranchAt::new(self.model, 0, &self.model.grid_position(self.soc, 0.0), 1.0);
        self.branch_v = branch.voltage_after(Discretisation::Exact, self.branch_v, current_a, 0.1);
        self.soc = soc_after(self.soc, 0.1 * current_a, 2.0);
        self.voltage_v(current_a)
    }
}

fn near(found: f64, expected: f64, share: f64) {
    assert!((found - expected).abs() <= share * expected.abs(), "{found}, expected {expected}");
}

#[test]
fn remaining_energy_and_time_agree_with_simulated_discharge() {
    let model = CellModel { voltage_min_v: 3.2, ..small_model() };
    for (start, current_a) in [(1.0, 1.0), (0.6, 2.0)] {
        let outlook = of_one(cell(&model, start), (Mode::Discharge, current_a));
        let mut circuit = Circuit { model: &model, soc: start, branch_v: 0.0 };
        let (mut energy_wh, mut seconds) = (0.0, 0.0);
        loop {
            let voltage_v = circuit.step(current_a);
            if voltage_v < 3.2 {
                break;
            }
            (energy_wh, seconds) = (energy_wh + voltage_v * current_a * 0.1 / 3600.0, seconds + 0.1);
        }
        near(outlook.remaining_wh.mean, energy_wh, 0.01);
        near(outlook.to_empty_s.unwrap().mean, seconds, 0.01);
        assert_eq!(outlook.to_full_s, None);
    }
}

#[test]
fn time_to_full_agrees_with_simulated_charge() {
    let model = small_model();
    for (start, current_a) in [(0.2, 1.0), (0.9, 2.0)] {
        let outlook = of_one(cell(&model, start), (Mode::Charge, -current_a));
        let mut circuit = Circuit { model: &model, soc: start, branch_v: 0.0 };
        let (mut held_a, mut energy_wh, mut seconds, mut target_s) = (current_a, 0.0, 0.0, 0.0);
        while held_a > 0.1 {
            let voltage_v = circuit.step(-held_a);
            if voltage_v > 4.2 {
                held_a -= 0.2 * (voltage_v - 4.2) / 0.06;
            }
            (energy_wh, seconds) = (energy_wh + voltage_v * held_a * 0.1 / 3600.0, seconds + 0.1);
            if circuit.soc < 0.8 {
                target_s = seconds;
            }
        }
        near(outlook.to_full_s.unwrap().mean, seconds, 0.03);
        near(outlook.to_full_wh.mean, energy_wh, 0.02);
        near(outlook.to_target_s.unwrap().mean, target_s, 0.03);
        assert_eq!(outlook.to_empty_s, None);
    }
}

#[test]
fn power_reaches_limit_of_voltage_or_current() {
    let model = small_model();
    let outlook = of_one(cell(&model, 0.5), (Mode::Rest, 0.0));
    for (k, for_s) in POWER_S.into_iter().enumerate() {
        for (sign, power, limit_v) in [(1.0, outlook.discharge_w[k], 2.7), (-1.0, outlook.charge_w[k], 4.2)] {
            let mut circuit = Circuit { model: &model, soc: 0.5, branch_v: 0.0 };
            let steps = (0..(10.0 * for_s) as u32).map(|_| circuit.step(sign * power.mean / limit_v));
            near(steps.last().unwrap(), limit_v, 0.005);
        }
    }
    // If the open-circuit curve is steep near empty, the charge drawn in 30 s lowers the voltage more than the
    // resistance does.
    let mut steep = small_model();
    for table in [&mut steep.r0_ohm, &mut steep.branches[0].r_ohm] {
        table.values.iter_mut().flatten().for_each(|ohm| *ohm *= 0.1);
    }
    steep.branches[0].c_farad.values.iter_mut().flatten().for_each(|farad| *farad *= 10.0);
    (steep.voltage_min_v, steep.ocv_v.values[0]) = (2.0, vec![1.8, 3.6, 4.2]);
    let power = of_one(cell(&steep, 0.15), (Mode::Rest, 0.0)).discharge_w[2];
    let mut circuit = Circuit { model: &steep, soc: 0.15, branch_v: 0.0 };
    near((0..300).map(|_| circuit.step(power.mean / 2.0)).last().unwrap(), 2.0, 0.01);
    let config = OutlookConfig { max_discharge_a: Some(2.0), max_charge_a: Some(1.0), ..CONFIG };
    let outlook = limited(cell(&model, 0.5), (Mode::Rest, 0.0), &config);
    let drop = |current_a: f64| {
        let mut circuit = Circuit { model: &model, soc: 0.5, branch_v: 0.0 };
        (0..100).map(|_| circuit.step(current_a)).last().unwrap()
    };
    near(outlook.discharge_w[1].mean, 2.0 * drop(2.0), 0.001);
    near(outlook.charge_w[1].mean, drop(-1.0), 0.001);
}

#[test]
fn weakest_and_fullest_cell_limit_pack() {
    let model = small_model();
    let mut cells = [cell(&model, 0.5); 4];
    (cells[1].soc.mean, cells[2].soc.mean, cells[3].resistance_ratio) = (0.2, 0.9, 0.5_f64.exp());
    let pack = Structure { series_per_state: 1.0, strings: 2.0, soc: 0.5, capacity_ah: 0.6 };
    let charge = loaded(Mode::Charge, -0.5);
    let outlook = of_pack(&CONFIG, (&charge, Mode::Charge), &cells, &pack).unwrap();
    let one = of_one(cells[2], (Mode::Charge, -0.5));
    assert_eq!(outlook.to_full_s, one.to_full_s);
    assert_eq!(outlook.limiting_cells, [CellIndex(1), CellIndex(2)]);
    // Expected: 0.4 Ah from each of four cells in two strings, at C/2. The open-circuit voltage is about 3.0 + 1.2 SOC.
    near(outlook.remaining_wh.mean, 2.0 * 0.4 * (3.48 + 3.12 + 3.96 + 3.48 - 4.0 * 0.1), 0.03);
    // A cell with a high resistance is empty first, although it contains more charge.
    cells[3].resistance_ratio = 3.0_f64.exp();
    let weak = of_pack(&CONFIG, (&charge, Mode::Charge), &cells, &pack).unwrap();
    assert!(weak.remaining_wh.mean < 0.7 * outlook.remaining_wh.mean, "{weak:?}");
    // The pack cannot reach the target, because its fullest cell is full first.
    let far = OutlookConfig { target_soc: 1.0, max_voltage_v: Some(4.15), ..CONFIG };
    let times = of_pack(&far, (&charge, Mode::Charge), &cells, &pack).unwrap();
    assert!(times.to_full_s.is_some() && times.to_target_s.is_none(), "{times:?}");
}

#[test]
fn each_error_widens_what_depends_on_it() {
    let model = small_model();
    let exact = cell(&model, 0.6);
    let of = |change: fn(&mut CellNow<'_>)| {
        let mut cell = exact;
        change(&mut cell);
        of_one(cell, (Mode::Discharge, 1.0))
    };
    let known = of(|_| {});
    // Only the future load is uncertain. At 1 A, 1.2 Ah flow through 0.08 to 0.12 ohm. A load that is a third larger
    // loses a third more energy in this resistance.
    near(known.remaining_wh.std(), LOG_LOAD_STD.exp_m1() * 1.2 * 0.095, 0.08);
    near(known.to_empty_s.unwrap().std(), LOG_LOAD_STD.exp_m1() * 1.2 * 3600.0, 0.01);
    assert!(known.discharge_w.iter().chain(&known.charge_w).all(|power| power.variance == 0.0));
    let more = |widened: &Outlook| (widened.remaining_wh.variance - known.remaining_wh.variance).sqrt();
    near(more(&of(|cell| cell.soc.variance = square(0.02))), 0.02 * 2.0 * (3.0 + 1.2 * 0.6), 0.05);
    near(more(&of(|cell| cell.capacity.variance = square(0.1))), 0.05 * known.remaining_wh.mean, 0.05);
    let by_resistance = of(|cell| cell.log_resistance_std = 0.1);
    near(by_resistance.discharge_w[1].std(), 0.1 * known.discharge_w[1].mean, 0.15);
    // At an SOC of 0, the true SOC can only be higher.
    let empty = of(|cell| (cell.soc.mean, cell.soc.variance) = (0.0, square(0.02)));
    near(empty.remaining_wh.std(), 0.02 * 2.0 * 2.9, 0.05);
}

#[test]
fn charge_counts_after_minute_and_ends_at_weak_charger() {
    let model = small_model();
    let pack = Structure { series_per_state: 1.0, strings: 1.0, soc: 0.5, capacity_ah: 2.0 };
    let time_s = |seconds: u32, current_a: f64| {
        let mut load = RecentLoad::default();
        (0..=seconds).for_each(|second| {
            load.observe(Timestamp::from_secs(f64::from(second)), Mode::Charge, Some(-current_a), 0.01);
        });
        of_pack(&CONFIG, (&load, Mode::Charge), &[cell(&model, 0.5)], &pack).unwrap().to_full_s
    };
    assert_eq!(time_s(59, 1.0), None, "braking");
    // The charger is weaker than the taper current of 0.1 A, so the charge ends when the cell reaches its highest
    // voltage.
    near(time_s(60, 0.05).unwrap().mean, 3600.0 * (1.0 - 0.05 * 0.08 / 1.2 / 2.0) / 0.05, 0.01);
}

#[test]
fn recent_load_contains_changing_current_without_mode() {
    let mut load = RecentLoad::default();
    for second in 0..600 {
        let current_a = if second % 2 == 0 { 5.0 } else { -3.0 };
        load.observe(Timestamp::from_secs(f64::from(second)), Mode::Unknown, Some(current_a), 0.05);
    }
    let found = load.discharge.load().unwrap();
    near(found.mean_a, 1.0, 0.02);
    near(found.mean_square_a2, 17.0, 0.02);
    assert!(found.peak_a > 4.9);
    // A load that moves hardly any net charge does not count as known. Noise before the first mode does not count as
    // load.
    let mut balanced = RecentLoad::default();
    for second in 0..600 {
        let current_a = if second % 2 == 0 { 5.0 } else { -4.8 };
        balanced.observe(Timestamp::from_secs(f64::from(second)), Mode::Unknown, Some(current_a), 0.05);
    }
    assert_eq!(balanced.discharge.load(), None);
    let mut noise = RecentLoad::default();
    (0..9).for_each(|n| noise.observe(Timestamp::from_secs(f64::from(n)), Mode::Unknown, Some(0.02), 0.05));
    assert_eq!(noise.discharge.load(), None);
    // The first current after a sleep is not averaged over the sleep.
    let before = load;
    load.interrupt();
    load.observe(Timestamp::from_secs(640.0), Mode::Unknown, Some(100.0), 0.05);
    assert_eq!(load.discharge, before.discharge);
    // Rest does not count as load, and a gap is not averaged.
    load.observe(Timestamp::from_secs(5000.0), Mode::Rest, Some(0.01), 0.05);
    load.observe(Timestamp::from_secs(5001.0), Mode::Rest, Some(0.01), 0.05);
    assert_eq!(load.discharge.load(), Some(found));
    assert_eq!(load.charger_a(Mode::Charge), None);
}

#[test]
fn energy_health_counts_lost_capacity_and_resistance_at_any_temperature() {
    let model = small_model();
    let health = |capacity_ah: f64, log_ratio: f64, temperature_c: f64| {
        let mut cell = CellNow { temperature: model.temperature_position(temperature_c), ..cell(&model, 0.5) };
        (cell.capacity.mean, cell.resistance_ratio) = (capacity_ah, log_ratio.exp());
        energy_health(&CONFIG, &cell).mean
    };
    near(health(2.0, 0.0, 0.0), 1.0, 1e-9);
    near(health(1.6, 0.0, 0.0), 0.8, 0.01);
    assert_eq!(health(1.6, 0.5, 0.0), health(1.6, 0.5, 40.0));
    assert!(health(2.0, 1.0, 0.0) < 0.98);
}

#[test]
fn outlook_at_limits_of_state_is_finite() {
    let model = small_model();
    for soc in [0.0, 1e-9, 0.5, 1.0] {
        for log_ratio in [-20.0, 0.0, 8.0] {
            let mut state = cell(&model, soc);
            (state.resistance_ratio, state.soc.variance) = (f64::exp(log_ratio), 0.1);
            for mode in [(Mode::Charge, -1.0), (Mode::Discharge, 1.0), (Mode::Rest, 0.0)] {
                let outlook = of_one(state, mode);
                let times = [outlook.to_empty_s, outlook.to_full_s, outlook.to_target_s].into_iter().flatten();
                let values = times.chain([outlook.remaining_wh, outlook.to_full_wh]);
                for value in values.chain(outlook.discharge_w).chain(outlook.charge_w) {
                    assert!(value.mean >= 0.0 && value.mean.is_finite() && value.variance >= 0.0, "{value:?}");
                }
            }
        }
    }
}
