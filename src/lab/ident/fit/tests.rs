//! Tests the fit of a cell model on records that are simulated with known tables, and the rejection of unusable data.

use super::*;
use crate::cell::circuit::BranchAt;
use crate::cell::{CellModel, Discretisation, Thermal};
use crate::ident::MeasuredPart;
use crate::ident::pass::accumulate;
use crate::ident::record::Limits;

const LIMITS: Limits = Limits { voltage_low_v: 1.0, voltage_high_v: 5.0, capacity_ah: 2.0 };
const CAPACITY_AH: f64 = 2.0;

fn scatter(k: usize) -> f64 {
    let x = (k as f64 * 12.9898).sin() * 43758.5453;
    x - x.floor() - 0.5
}

/// Current, sampled at 1 Hz. It changes every 40 s, includes rests, and takes out 1.9 Ah in two hours.
fn currents() -> Vec<f64> {
    let level = |k: usize| match (k / 40) % 5 {
        0 => 0.0,
        1 => 3.0,
        2 => 0.4,
        3 => -0.6,
        _ => 1.9,
    };
    (0..7200).map(|k| level(k) + 0.02 * scatter(k / 40)).collect()
}

/// Simulates a record of `model` at `temperature_c`. The voltage has noise between -`noise_v` and `noise_v`.
fn simulate(model: &CellModel, temperature_c: f64, noise_v: f64, grid: &Grid) -> Record {
    let current_a = currents();
    let time_s: Vec<f64> = (0..current_a.len()).map(|k| k as f64).collect();
    let mut branches_v = vec![0.0; model.branches.len()];
    let (mut soc, mut socs, mut voltage_v) = (1.0, vec![], vec![]);
    for k in 0..current_a.len() {
        let mean_a = if k == 0 { 0.0 } else { 0.5 * (current_a[k] + current_a[k - 1]) };
        soc -= mean_a / 3600.0 / CAPACITY_AH;
        let place = model.grid_position(soc, temperature_c);
        for (i, u) in branches_v.iter_mut().enumerate() {
            let dt_s = if k == 0 { 0.0 } else { 1.0 };
            *u = BranchAt::new(model, i, &place, 1.0).voltage_after(Discretisation::Exact, *u, mean_a, dt_s);
        }
        let sum: f64 = branches_v.iter().sum();
        let clean = crate::cell::circuit::terminal_v(model, &place, 1.0, sum, current_a[k]);
        voltage_v.push(clean + 2.0 * noise_v * scatter(k + 17));
        socs.push(soc);
    }
    let temperature_c = vec![temperature_c; time_s.len()];
    let raw = MeasuredPart { time_s, current_a, voltage_v, temperature_c, soc: socs, ..MeasuredPart::default() };
    Record::prepare(&raw, &[], grid, &LIMITS)
}

fn grid() -> Grid {
    Grid { soc: vec![0.0, 0.1, 0.3, 0.6, 1.0], temperature_c: vec![5.0, 25.0] }
}

fn truth() -> CellModel {
    let grid = grid();
    let theta = truth_theta(&grid);
    let tables = ParameterTables::new(&Layout::new(&grid, 2), &theta);
    let (ocv_v, r0_ohm, branches) = tables.model(grid.soc.len());
    CellModel {
        soc: grid.soc,
        temperature_c: grid.temperature_c,
        ocv_v,
        r0_ohm,
        branches,
        name: "test".into(),
        rated_capacity_ah: CAPACITY_AH,
        capacity_ah: CAPACITY_AH,
        voltage_min_v: 2.7,
        voltage_max_v: 4.2,
        aged_ocv: crate::cell::AgedOcv::default(),
        voltage_error_v: None,
        thermal: Some(Thermal { heat_capacity_j_per_k: 45.0, resistance_k_per_w: 8.0 }),
        spread: None,
    }
}

fn truth_theta(grid: &Grid) -> Vec<f64> {
    let ocv = [3.1, 3.45, 3.62, 3.85, 4.18];
    let shape = [0.5, 0.2, 0.0, 0.02, 0.1];
    let mut theta: Vec<f64> = ocv.iter().map(|v| v - 0.01).chain(ocv).collect();
    let ln_r = |ohm: f64| {
        let of_row = move |t: f64| shape.map(|bend| libm::log(ohm * arrhenius(t)) + bend);
        grid.temperature_c.iter().flat_map(move |&t| of_row(t)).collect::<Vec<f64>>()
    };
    theta.extend(ln_r(0.04));
    for (ohm, tau_s) in [(0.02, 8.0), (0.03, 120.0)] {
        theta.extend(ln_r(ohm));
        theta.extend([libm::log(tau_s); 10]);
    }
    theta
}

fn settings(grid: Grid) -> FitSettings {
    FitSettings {
        grid,
        tau_s: vec![10.0, 150.0],
        voltage_v: (2.5, 4.2),
        ocv: vec![],
        min_slope_v: vec![],
        deviations: PriorDeviations::FREE_OCV,
    }
}

#[test]
fn gradient_agrees_with_finite_differences() {
    let grid = grid();
    let layout = Layout::new(&grid, 2);
    // The temperatures of the rows lie between the grid's two temperatures, so all four corners of a grid cell
    // contribute. The offsets added to `theta` below keep the residuals large.
    let record = {
        let mut record = simulate(&truth(), 25.0, 0.005, &grid);
        for row in &mut record.rows {
            let place = grid.place(row.soc, 5.0 + 20.0 * row.soc);
            row.ocv = grid.ocv_corners(&place);
            (row.resistance, row.tau) = (grid.resistance_corners(&place), grid.tau_corners(&place));
        }
        record
    };
    let start = truth_theta(&grid);
    let theta: Vec<f64> =
        start.iter().enumerate().map(|(k, x)| x + if k < 10 { 0.02 } else { 0.2 } * scatter(k)).collect();
    let prior = Prior::new(&grid, &layout, &start, true, &PriorDeviations::SLOW_TEST);
    let evaluate = |theta: &[f64]| {
        let mut normal = NormalEquations::new(layout.len());
        accumulate(&record, 0.7, &layout, &ParameterTables::new(&layout, theta), None, &mut normal);
        prior.accumulate(theta, &mut normal);
        normal
    };
    let gradient = evaluate(&theta).g;
    for k in 0..layout.len() {
        let step = 1e-5;
        let shifted = |by: f64| {
            let mut moved = theta.clone();
            moved[k] += by;
            evaluate(&moved).cost
        };
        let difference = (shifted(step) - shifted(-step)) / (2.0 * step);
        let scale = gradient[k].abs().max(1.0);
        assert!((difference - gradient[k]).abs() < 2e-3 * scale, "{k}: {difference} {}", gradient[k]);
    }
}

#[test]
fn known_parameters_are_recovered_from_noisy_data() {
    let grid = grid();
    let truth = truth();
    let records: Vec<Record> = [5.0, 25.0].iter().map(|&t| simulate(&truth, t, 0.002, &grid)).collect();
    // Each second has a weight of 10. This is more than for real data, whose errors average out more slowly than white
    // noise.
    let fitted = fit(&settings(grid.clone()), &records, &[10.0, 10.0], |_, _| {}).expect("a fit");
    assert!(fitted.converged && fitted.total.rmse_v < 0.002, "{:?}", fitted.total);
    let expected = truth_theta(&grid);
    let layout = Layout::new(&grid, 2);
    let true_tables = ParameterTables::new(&layout, &expected);
    // Nodes below SOC 0.3 are not checked, because there is little data.
    for node in (0..10).filter(|node| node % 5 >= 2) {
        let ocv_error = fitted.tables.ocv_v[node] - true_tables.ocv_v[node];
        assert!(ocv_error.abs() < 0.015, "OCV node {node}: {ocv_error}");
        let r0 = fitted.tables.r0_ohm[node] / true_tables.r0_ohm[node];
        assert!((r0 - 1.0).abs() < 0.03, "R0 node {node}: {r0}");
        for i in 0..2 {
            let r = fitted.tables.r_ohm[i][node] / true_tables.r_ohm[i][node];
            assert!((r - 1.0).abs() < 0.35, "R{i} node {node}: {r}");
        }
    }
}

#[test]
fn ocv_rises_where_the_data_fall() {
    let grid = grid();
    let mut records = vec![simulate(&truth(), 25.0, 0.0, &grid)];
    for row in &mut records[0].rows {
        // This removes almost the whole rise of the open-circuit curve above SOC 0.6, which is 0.825 V per unit of SOC.
        row.voltage_v -= 0.8 * (row.soc - 0.6).max(0.0);
    }
    let fitted = fit(&settings(grid), &records, &[1.0], |_, _| {}).expect("a fit");
    for row in fitted.tables.ocv_v.chunks(5) {
        assert!(row.windows(2).all(|pair| pair[1] > pair[0]), "{row:?}");
    }
}

#[test]
fn nodes_without_data_follow_arrhenius_and_are_reported() {
    let grid = Grid { temperature_c: vec![-15.0, 5.0, 25.0], ..grid() };
    let records = vec![simulate(&truth(), 25.0, 0.001, &grid)];
    let fitted = fit(&settings(grid), &records, &[1.0], |_, _| {}).expect("a fit");
    let unsupported = fitted.unsupported();
    assert!(unsupported.contains(&(-15.0, 0.6)) && unsupported.contains(&(5.0, 0.6)), "{unsupported:?}");
    assert!(!unsupported.contains(&(25.0, 0.6)), "{unsupported:?}");
    let ratio = fitted.tables.r0_ohm[3] / fitted.tables.r0_ohm[13];
    let arrhenius = arrhenius(-15.0) / arrhenius(25.0);
    assert!((ratio / arrhenius - 1.0).abs() < 0.1, "{ratio} {arrhenius}");
    assert!((fitted.tables.ocv_v[3] - fitted.tables.ocv_v[13]).abs() < 0.005);
}

#[test]
fn slow_test_correction_fades_without_drives() {
    let grid = grid();
    let curve = |temperature_c: f64, offset_v: f64| OcvCurve {
        temperature_c,
        soc: grid.soc.clone(),
        voltage_v: truth().ocv_v.values[1].iter().map(|v| v + offset_v).collect(),
    };
    let ocv = vec![curve(5.0, 0.0), curve(25.0, 0.05)];
    let settings = FitSettings { ocv, deviations: PriorDeviations::SLOW_TEST, ..settings(grid.clone()) };
    let fitted = fit(&settings, &[simulate(&truth(), 25.0, 0.001, &grid)], &[1.0], |_, _| {}).expect("a fit");
    let correction = |node: usize, curve: usize| fitted.tables.ocv_v[node] - settings.ocv[curve].voltage_v[3];
    let (driven, undriven) = (correction(8, 1), correction(3, 0));
    assert!((-0.06..-0.03).contains(&driven), "{driven}");
    assert!(undriven.abs() < 0.8 * driven.abs() && undriven < 0.0, "{undriven} of {driven}");
}

#[test]
fn too_few_rows_or_constant_current_is_rejected() {
    let grid = grid();
    let mut record = simulate(&truth(), 25.0, 0.0, &grid);
    record.rows.truncate(20);
    let refused = fit(&settings(grid.clone()), &[record], &[1.0], |_, _| {}).expect_err("too few");
    assert!(refused.contains("rows can be judged, at least 50 are needed"), "{refused}");
    let mut record = simulate(&truth(), 25.0, 0.0, &grid);
    record.rows.iter_mut().for_each(|row| (row.current_a, row.mean_current_a) = (1.0, 1.0));
    let refused = fit(&settings(grid), &[record], &[1.0], |_, _| {}).expect_err("no steps");
    assert_eq!(refused, NO_EXCITATION);
}

#[test]
fn nan_in_a_slow_test_is_rejected() {
    let grid = grid();
    let record = simulate(&truth(), 25.0, 0.0, &grid);
    let curve = OcvCurve { temperature_c: 25.0, soc: vec![0.0, 1.0], voltage_v: vec![3.0, f64::NAN] };
    let settings = FitSettings { ocv: vec![curve], ..settings(grid) };
    let refused = fit(&settings, &[record], &[1.0], |_, _| {}).expect_err("a NaN");
    assert_eq!(refused, NOT_FINITE);
}
