//! Runs whole scenarios in memory.

use super::super::balancing::Balancing;
use super::super::scenario::Scenario;
use super::super::truth::Spread;
use super::super::truth::tests::plain_model;
use super::*;

fn simulation(settings: Settings) -> Simulation {
    Simulation::new(plain_model(settings.pack.capacity_ah), settings, Wiring::single())
}

struct Course {
    moments: u64,
    end_s: f64,
    soc: (f64, f64),
    voltage_v: (f64, f64),
    current_a: (f64, f64),
    longest_gap_s: f64,
    mean_discharge_a: f64,
}

fn run(sim: &mut Simulation) -> Course {
    let outside = (f64::INFINITY, f64::NEG_INFINITY);
    let widen = |range: (f64, f64), x: f64| (range.0.min(x), range.1.max(x));
    let mut c = Course {
        moments: 0,
        end_s: 0.0,
        soc: outside,
        voltage_v: outside,
        current_a: outside,
        longest_gap_s: 0.0,
        mean_discharge_a: 0.0,
    };
    let mut discharges = 0.0;
    while let Some(moment) = sim.advance() {
        c.moments += 1;
        c.longest_gap_s = f64::max(c.longest_gap_s, moment.time.secs() - c.end_s);
        c.end_s = moment.time.secs();
        for (cell, voltage_v) in sim.pack().cells().iter().zip(sim.voltages_v()) {
            c.soc = widen(c.soc, cell.soc);
            c.voltage_v = widen(c.voltage_v, voltage_v);
        }
        c.current_a = widen(c.current_a, moment.current_a);
        if moment.current_a > 0.0 {
            discharges += 1.0;
            c.mean_discharge_a += (moment.current_a - c.mean_discharge_a) / discharges;
        }
    }
    c
}

#[test]
fn paper_scenario_matches_time_and_final_capacity() {
    let mut sim = simulation(Settings::of(Scenario::Paper, 2.6));
    let course = run(&mut sim);
    assert_eq!(sim.pack().cycles(), 47); // the 48th cycle ends at 0.25 Ah and is not completed
    assert!((sim.pack().lowest_capacity_ah() - 0.25).abs() < 1e-9);
    assert!((course.end_s / 2.23e5 - 1.0).abs() < 0.01, "{} s", course.end_s);
    let one_sample = 1.325 / (3600.0 * 0.25);
    assert!(course.soc.0 > 0.3 - 2.0 * one_sample && course.soc.1 < 0.9 + 2.0 * one_sample, "{:?}", course.soc);
    assert_eq!(course.moments, course.end_s as u64 + 1);
}

#[test]
fn reference_scenario_loses_1_ah_per_cycle() {
    let mut sim = simulation(Settings::of(Scenario::Reference, 30.0));
    let course = run(&mut sim);
    assert!((sim.pack().lowest_capacity_ah() - 21.0).abs() < 1e-9);
    assert!(course.soc.0 > 0.299 && course.soc.1 == 1.0, "{:?}", course.soc);
    assert!((course.mean_discharge_a - 15.0).abs() < 1.0, "{} A", course.mean_discharge_a);
    assert!(course.current_a.0 == -15.0 && course.current_a.1 <= 30.0, "{:?}", course.current_a);
}

#[test]
fn random_walk_stays_within_limits_with_reference_cycles() {
    let mut settings = Settings::of(Scenario::RandomWalk, 2.1);
    settings.walk_steps = 60;
    (settings.cycles, settings.duration_s) = (Some(2), Some(100_000.0));
    (settings.current_period_ns, settings.cell_period_ns) = (1_000_000_000, 1_000_000_000);
    let mut sim = simulation(settings);
    let course = run(&mut sim);
    assert_eq!(sim.pack().cycles(), 2);
    assert!(course.voltage_v.0 > 3.19 && course.voltage_v.1 < 4.2 + 1e-9, "{:?}", course.voltage_v);
    assert_eq!(course.current_a, (-4.5, 4.5));
    let walk_s = 2.0 * 60.0 * 300.0;
    assert!(course.end_s > 0.3 * walk_s + 4.0 * 3600.0 && course.end_s < walk_s + 16.0 * 3600.0, "{}", course.end_s);
    assert!(sim.pack().lowest_capacity_ah() < 2.1 && sim.pack().cells()[0].resistance_ratio > 1.0);
}

#[test]
fn ev_day_drives_regenerates_sleeps_and_charges() {
    let mut settings = Settings::of(Scenario::EvDay, 50.0);
    settings.pack.cells = 3;
    let mut sim = simulation(settings);
    let course = run(&mut sim);
    assert_eq!(course.longest_gap_s.round(), 9.5 * 3600.0 - 3300.0); // no sample follows the night
    assert_eq!(sim.pack().cycles(), 1);
    assert!(course.soc.0 > 0.3 && course.soc.1 < 0.88, "{:?}", course.soc);
    assert!(course.current_a.1 > 50.0 && course.current_a.0 < -20.0, "{:?}", course.current_a);
    assert!(course.voltage_v.1 <= 4.2 + 1e-3);
    let awake_s = course.moments as f64 * 0.01;
    assert!((7500.0..12_000.0).contains(&awake_s), "{awake_s}");
}

#[test]
fn sleeping_bms_reports_bits_while_bleeding() {
    let mut settings = Settings::of(Scenario::EvDay, 50.0);
    settings.pack.cells = 3;
    settings.pack.spread = Spread { soc: 0.05, ..Spread::default() };
    (settings.cycles, settings.duration_s) = (Some(2), Some(100_000.0));
    (settings.current_period_ns, settings.cell_period_ns) = (1_000_000_000, 1_000_000_000);
    let mut nights = 0;
    // With some seeds, the car stops on the drive home. This stop counts as the rest after the charge, so no cell is
    // bled at night. Therefore, several seeds are simulated.
    for seed in 1..=20 {
        settings.seed = seed;
        let run = |has_bits: bool| {
            let sim = simulation(settings).with_balancing(Balancing { bleed_a: 0.5, ..Balancing::usual(50.0) });
            let mut sim = if has_bits { sim.with_balancing_bits() } else { sim };
            let mut asleep: Vec<(f64, bool)> = Vec::new();
            while let Some(moment) = sim.advance() {
                if let [(Channel::Balancing(_), _), .., (Channel::Balancing(_), _)] = sim.readings() {
                    assert!(sim.voltages_v().eq(sim.pack().voltages_v(0.0)), "no current flows");
                    asleep.push((moment.time.secs(), sim.readings().iter().any(|(_, bit)| *bit == Some(1.0))));
                }
            }
            (asleep, sim.pack().cells().to_vec())
        };
        let ((asleep, with), (none, without)) = (run(true), run(false));
        assert!(none.is_empty() && with == without, "the bits must not change the simulation");
        for pair in asleep.windows(2) {
            let [(before_s, was_bled), (after_s, _)] = pair else { unreachable!() };
            assert!(
                if *was_bled { (after_s - before_s - 60.0).abs() < 1.0 } else { after_s - before_s > 3600.0 },
                "{pair:?}"
            );
        }
        nights += asleep.iter().filter(|(_, is_bled)| !is_bled).count();
    }
    assert!(nights > 0, "the BMS must bleed a cell during at least one sleep");
}

#[test]
fn cells_step_at_own_period_with_mean_current() {
    let mut settings = Settings::of(Scenario::EvDay, 50.0);
    settings.pack.cells = 1;
    settings.pack.spread = Default::default();
    settings.duration_s = Some(60.0);
    let mut sim = simulation(settings);
    let (mut charge_as, mut cell_samples, mut samples) = (0.0, 0, 0);
    while let Some(moment) = sim.advance() {
        if moment.cells_sampled {
            let moved = (0.85 - sim.pack().cells()[0].soc) * 3600.0 * sim.pack().cells()[0].capacity_ah;
            assert!((moved - charge_as).abs() < 0.01 + 1e-4 * charge_as.abs());
            cell_samples += 1;
        }
        assert_eq!(sim.readings().len(), if moment.cells_sampled { 4 } else { 1 });
        charge_as += moment.current_a * 0.01;
        samples += 1;
    }
    assert_eq!((samples, cell_samples), (6000, 600));
}

#[test]
fn readings_repeat_for_same_seed_only() {
    let readings = |seed| {
        let mut settings = Settings::of(Scenario::Reference, 30.0);
        (settings.seed, settings.duration_s) = (seed, Some(500.0));
        let mut sim = simulation(settings);
        let mut all = Vec::new();
        while sim.advance().is_some() {
            all.extend(sim.readings().iter().map(|(channel, value)| (*channel, value.map(f64::to_bits))));
        }
        all
    };
    assert_eq!(readings(4), readings(4));
    assert_ne!(readings(4), readings(5));
}

#[test]
fn scenarios_scale_with_the_cell() {
    let settings = Settings::of(Scenario::Paper, 5.2);
    assert_eq!(settings.pack.ageing.capacity_loss_ah_per_cycle, 0.1);
    let mut sim = simulation(settings);
    assert_eq!(sim.advance().map(|m| m.current_a), Some(2.65));
}

#[test]
fn pack_current_scales_and_pack_voltage_sums() {
    let mut settings = Settings::of(Scenario::Paper, 2.6);
    settings.pack.cells = 4;
    settings.sensors = Default::default();
    let wiring = Wiring { strings: 3, temperature_at: vec![None] };
    let mut sim = Simulation::new(plain_model(2.6), settings, wiring);
    sim.advance();
    let of = |channel| sim.readings().iter().find(|(c, _)| *c == channel).and_then(|(_, v)| *v);
    assert_eq!(of(Channel::Current), Some(3.0 * 1.325));
    assert_eq!(of(Channel::Temperature(SensorIndex(0))), Some(25.0));
    let total: f64 = (0..4).filter_map(|i| of(Channel::CellVoltage(CellIndex(i)))).sum();
    assert!((of(Channel::PackVoltage).unwrap_or(0.0) - total).abs() < 1e-12);
}
