//! Tests the check of the current sensor on simulated loads with known faults.

use super::*;
use crate::quantity::CellIndex;

/// Name of a fault, and the faulty reading (A) for a load (A) and a time (s).
type Fault = (&'static str, fn(f64, u32) -> f64);

const OHM: f64 = 2e-3;
const CELLS: usize = 5;

/// Load of a drive (A): a new level every 10 s.
fn load_a(time_s: u32) -> f64 {
    let level = (time_s / 10).wrapping_mul(2_654_435_761) >> 24;
    f64::from(level) / 2.0 - 30.0
}

/// Noise of a reading (A): 0 to 0.06 A in steps of 0.001 A.
fn noise_a(time_s: u32) -> f64 {
    f64::from(time_s.wrapping_mul(time_s) % 61) / 1000.0
}

/// A sample of every cell. `voltage_v` returns the voltage of a cell.
fn samples(time_s: u32, current_a: Option<f64>, voltage_v: impl Fn(usize) -> f64) -> Vec<CellSample> {
    (0..CELLS)
        .map(|cell| CellSample {
            time: Timestamp::from_secs(f64::from(time_s)),
            cell: CellIndex(cell as u16),
            voltage_v: voltage_v(cell),
            current_a,
            charge_as: 0.0,
            offset_s: 0.0,
            unmeasured_s: 0.0,
            temperature_c: None,
        })
        .collect()
}

fn handle(check: &mut CurrentCheck, samples: &[CellSample]) {
    check.handle(samples.iter().map(|sample| (sample.cell.index(), sample)), 0.001, OHM, 1.0);
}

fn round(check: &mut CurrentCheck, time_s: u32, current_a: Option<f64>, voltage_v: impl Fn(usize) -> f64) {
    handle(check, &samples(time_s, current_a, voltage_v));
}

/// The samples of one round of the drive (one sample of every cell). `measured` returns the reading for the load and
/// the time.
fn drive_samples(time_s: u32, measured: impl Fn(f64, u32) -> Option<f64>) -> Vec<CellSample> {
    let current_a = measured(load_a(time_s), time_s).map(|current_a| current_a + noise_a(time_s));
    samples(time_s, current_a, |cell| 3.7 - 1.2 * OHM * load_a(time_s) + 1e-4 * ((time_s as usize + cell) % 5) as f64)
}

/// Runs a drive of `seconds`, one round every 2 s. Returns the share of rounds in doubt.
fn drive(check: &mut CurrentCheck, seconds: u32, measured: impl Fn(f64, u32) -> Option<f64>) -> f64 {
    let mut doubtful = 0;
    for time_s in (0..seconds).step_by(2) {
        handle(check, &drive_samples(time_s, &measured));
        doubtful += u32::from(check.is_doubtful());
    }
    f64::from(doubtful) / f64::from(seconds / 2)
}

fn share_in_doubt(measured: impl Fn(f64, u32) -> Option<f64>) -> f64 {
    drive(&mut CurrentCheck::default(), 3600, measured)
}

#[test]
fn good_current_is_never_doubted() {
    assert_eq!(share_in_doubt(|load_a, _| Some(load_a)), 0.0);
    // First, a gateway sends the current one round late. Second, the apparent resistance is 2.4 times the model's.
    assert_eq!(share_in_doubt(|_, time_s| Some(load_a(time_s.saturating_sub(2)))), 0.0);
    assert_eq!(share_in_doubt(|load_a, _| Some(0.5 * load_a)), 0.0);
    // One reading in four is lost.
    assert_eq!(share_in_doubt(|load_a, time_s| (time_s % 8 != 0).then_some(load_a)), 0.0);
}

#[test]
fn wrong_current_is_doubted_in_most_of_drive() {
    let faults: [Fault; 5] = [
        ("zero", |_, _| 0.0),
        ("inverted", |load_a, _| -load_a),
        ("late by 20 s", |_, time_s| load_a(time_s.saturating_sub(20))),
        ("overflow", |load_a, _| (load_a + 20.0).rem_euclid(40.0) - 20.0),
        ("without sign", |load_a, _| load_a.abs()),
    ];
    for (name, fault) in faults {
        let share = share_in_doubt(|load_a, time_s| Some(fault(load_a, time_s)));
        assert!(share > 0.85, "{name}: {share}");
    }
}

#[test]
fn noisy_sensor_that_repeats_reading_is_at_limit() {
    let mut check = CurrentCheck::default();
    // If the load exceeds 60 A, the sensor reads exactly 60 A. `drive` adds noise, so the noise is subtracted here.
    let limited = |load_a: f64, time_s: u32| Some(if load_a >= 60.0 { 60.0 - noise_a(time_s) } else { load_a });
    drive(&mut check, 1200, |load_a, _| (load_a < 60.0).then_some(load_a));
    let share = drive(&mut check, 3600, limited);
    assert!(share > 0.5, "{share} {check:?}");
    assert!((check.limit.limits_a[0] - 60.0).abs() < 1e-9, "{:?}", check.limit.limits_a);
}

#[test]
fn quiet_sensor_with_regulated_current_stays_trusted() {
    // A laboratory charges with a constant current. It then holds the voltage, so the current changes. The following
    // discharge has the largest current of the test.
    let charge_then_discharge = |discharge_a: f64| {
        let mut check = CurrentCheck::default();
        for time_s in 0..600 {
            let held_v = 1e-4 * f64::from(time_s % 3);
            let (current_a, voltage_v) = match time_s {
                0..200 => (-50.0, 3.9 + 1e-4 * f64::from(time_s)),
                200..450 => (-20.0 + 100.0 * noise_a(time_s), 4.1 + held_v),
                _ => (discharge_a, 3.9 - 1e-4 * f64::from(time_s)),
            };
            round(&mut check, 2 * time_s, Some(current_a), |_| voltage_v);
        }
        check
    };
    let of_quiet = charge_then_discharge(50.5);
    assert_eq!((of_quiet.limit.limits_a, of_quiet.is_doubtful()), ([0.0; 2], false), "{of_quiet:?}");
    // If charge and discharge stop at the same reading, this reading is the sensor's limit.
    let of_limited = charge_then_discharge(50.0);
    assert!(of_limited.limit.limits_a.contains(&50.0) && of_limited.is_doubtful(), "{of_limited:?}");
}

#[test]
fn doubt_ends_after_explained_steps_and_lasts_longer_each_time() {
    let mut check = CurrentCheck::default();
    drive(&mut check, 600, |load_a, _| Some(load_a));
    let mut shares = Vec::new();
    for _ in 0..3 {
        check.add_evidence(DOUBTFUL + 1.0);
        shares.push(drive(&mut check, 1200, |load_a, _| Some(load_a)));
        assert!(!check.is_doubtful());
    }
    assert!(shares.is_sorted() && shares[0] < 0.1 && shares[2] < 0.5, "{shares:?}");
}

#[test]
fn jump_waits_for_explained_step() {
    let mut check = CurrentCheck::default();
    check.demand_step();
    assert!(!check.is_unconfirmed(), "no step has been judged");
    drive(&mut check, 600, |load_a, _| Some(load_a));
    check.demand_step();
    check.interrupt();
    assert!(check.is_unconfirmed());
    drive(&mut check, 60, |load_a, _| Some(-load_a));
    assert!(check.is_unconfirmed());
    drive(&mut check, 60, |load_a, _| Some(load_a));
    assert!(!check.is_unconfirmed());
}

#[test]
fn unchanged_voltage_is_frozen_if_others_moved() {
    let mut check = CurrentCheck::default();
    drive(&mut check, 600, |load_a, _| Some(load_a));
    let path_v = check.path_v();
    assert!(!check.is_frozen_since(path_v));
    assert!(check.is_frozen_since(path_v - 0.05));
}

#[test]
fn relaxation_after_load_is_not_a_step() {
    let mut check = CurrentCheck::default();
    for k in 0..20_u32 {
        let since_load = k.checked_sub(5).map(f64::from);
        let (voltage_v, current_a) = match since_load {
            None => (3.7 - 0.102, 30.0),
            Some(rounds) => (3.7 - 0.03 * libm::exp(-rounds / 3.0), 0.0),
        };
        round(&mut check, 600 + 2 * k, Some(current_a), |_| voltage_v);
    }
    assert!(!check.is_doubtful(), "{check:?}");
}

#[test]
fn round_that_takes_seconds_is_not_compared() {
    let mut check = CurrentCheck::default();
    for time_s in (0..3600).step_by(4) {
        let mut samples = drive_samples(time_s, |load_a, _| Some(-load_a));
        samples[CELLS - 1].time = Timestamp::from_secs(f64::from(time_s) + 1.1);
        handle(&mut check, &samples);
    }
    assert_eq!((check.is_doubtful(), check.path_v()), (false, 0.0));
}

/// Runs 1800 rounds of a cycle of `cycle_ms`, in which each cell reports `apart_ms` after the previous cell. `is_lost`:
/// whether the sample of a round and a cell is lost. Returns the share of rounds in doubt.
fn spread_drive((cycle_ms, apart_ms): (u32, u32), sign: f64, factor: f64, is_lost: impl Fn(u32, u32) -> bool) -> f64 {
    let (mut check, mut doubtful) = (CurrentCheck::default(), 0);
    for round in 0..1800 {
        for cell in (0..CELLS as u32).filter(|cell| !is_lost(round, *cell)) {
            let ms = round * cycle_ms + cell * apart_ms;
            let time = Timestamp::from_nanos(i64::from(ms) * 1_000_000);
            let load_a = load_a((ms / 1000).max(1));
            let mut sample = samples(0, Some(sign * load_a), |_| 3.7 - factor * OHM * load_a)[cell as usize];
            (sample.time, sample.voltage_v) = (time, sample.voltage_v + 1e-4 * f64::from((round + cell) % 5));
            handle(&mut check, &[sample]);
        }
        doubtful += u32::from(check.is_doubtful());
    }
    f64::from(doubtful) / 1800.0
}

#[test]
fn round_stays_whole_after_lost_sample() {
    for cycle_ms in [200, 500, 1000, 1900] {
        let one_lost = |round: u32, cell: u32| round == 1 && cell == 0;
        let many_lost = |round: u32, cell: u32| (7 * round + 3 * cell).is_multiple_of(23);
        let starts_late = |round: u32, cell: u32| round == 0 && cell < 3;
        let losses: [&dyn Fn(u32, u32) -> bool; 4] = [&|_, _| false, &one_lost, &many_lost, &starts_late];
        for (case, is_lost) in losses.into_iter().enumerate() {
            let share = |sign: f64| spread_drive((cycle_ms, 5), sign, 1.2, is_lost);
            assert_eq!(share(1.0), 0.0, "a good sensor, cycle {cycle_ms} ms, case {case}");
            assert!(share(-1.0) > 0.7, "{}: an inverted sensor, cycle {cycle_ms} ms, case {case}", share(-1.0));
        }
    }
}

#[test]
fn good_current_is_trusted_if_cells_report_over_whole_cycle() {
    for (cycle_ms, apart_ms) in [(500, 100), (900, 180), (2000, 400), (5000, 1000)] {
        for factor in [0.7, 1.2, 2.0] {
            assert_eq!(spread_drive((cycle_ms, apart_ms), 1.0, factor, |_, _| false), 0.0, "{cycle_ms} ms, {factor}");
        }
    }
}

#[test]
fn clock_set_back_between_rounds_is_no_step() {
    let mut check = CurrentCheck::default();
    drive(&mut check, 600, |load_a, _| Some(load_a));
    for k in 0..20_u32 {
        let voltage_v = if k < 10 { 3.7 } else { 4.1 };
        round(&mut check, if k < 10 { 5000 + 2 * k } else { 1000 + 2 * k }, Some(10.0), |_| voltage_v);
    }
    assert!(!check.is_doubtful(), "{check:?}");
}

#[test]
fn jumps_of_most_cells_demand_step() {
    let mut check = CurrentCheck::default();
    drive(&mut check, 600, |load_a, _| Some(load_a));
    for _ in 0..5 {
        check.note_jumps(4, 40);
    }
    assert!(!check.is_unconfirmed(), "20 of 40 cells");
    check.forget_jumps();
    for part in [12, 0, 8, 1] {
        check.note_jumps(part, 40);
    }
    assert!(check.is_unconfirmed(), "21 of 40 cells");
}

#[test]
fn samples_that_arrive_in_parts_make_whole_rounds() {
    let measured: fn(f64, u32) -> Option<f64> = |load_a, time_s| Some(if time_s < 1200 { load_a } else { -load_a });
    let (mut whole, mut in_parts, mut with_gaps) = Default::default();
    let mut doubts = [0, 0];
    for time_s in (0..2400).step_by(2) {
        let samples = drive_samples(time_s, measured);
        handle(&mut whole, &samples);
        samples.chunks(2).for_each(|part| handle(&mut in_parts, part));
        assert_eq!(in_parts, whole, "at {time_s} s");
        // One cell is missing in every third round.
        let missing = (time_s % 3 == 0).then_some(time_s as usize % CELLS);
        let present = samples.iter().enumerate().filter(|(cell, _)| Some(*cell) != missing);
        present.for_each(|(_, sample)| handle(&mut with_gaps, std::slice::from_ref(sample)));
        doubts[usize::from(time_s >= 1200)] += u32::from(with_gaps.is_doubtful());
    }
    assert!(whole.is_doubtful() && with_gaps.is_doubtful());
    assert!(doubts[0] == 0 && doubts[1] > 450, "{doubts:?} of 600 rounds each");
}
