//! Tests the text forms of faults, and their effects on true state and readings.

use super::super::truth::tests::{plain_model, plain_settings};
use super::super::{Balancing, Moment, Scenario, SensorQuality, Sensors, Settings, Simulation, Wiring};
use super::*;
use crate::quantity::{Channel, Timestamp};

fn fault(text: &str) -> Fault {
    text.parse().unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// Four equal cells with ideal sensors, at 1.325 A in both directions. Temperature sensor 1 is on cell 1.
fn settings() -> Settings {
    let mut settings = Settings::of(Scenario::Paper, 2.6);
    settings.pack = crate::sim::PackSettings { cells: 4, ..plain_settings() };
    settings.sensors = Sensors::default();
    settings.duration_s = Some(3000.0);
    settings
}

fn simulation(faults: &[&str]) -> Simulation {
    let faults: Vec<Fault> = faults.iter().map(|text| fault(text)).collect();
    Simulation::new(plain_model(2.6), settings(), Wiring::single()).with_faults(&faults)
}

fn reading(sim: &Simulation, channel: Channel) -> f64 {
    sim.readings().iter().find(|(of, _)| *of == channel).and_then(|(_, value)| *value).unwrap_or(f64::NAN)
}

fn at_s(seconds: i64) -> Timestamp {
    Timestamp::from_nanos(seconds * 1_000_000_000)
}

fn voltage_v(sim: &Simulation, cell: u16) -> f64 {
    reading(sim, Channel::CellVoltage(CellIndex(cell)))
}

fn compare(faults: &[&str], mut each: impl FnMut(Moment, &Simulation, &Simulation)) -> (Simulation, Simulation) {
    let (mut faulty, mut healthy) = (simulation(faults), simulation(&[]));
    while let Some((moment, _)) = faulty.advance().zip(healthy.advance()) {
        each(moment, &faulty, &healthy);
    }
    (faulty, healthy)
}

#[test]
fn every_kind_parses_with_units_and_start() {
    let cell = CellIndex(6);
    for (text, kind, from_s) in [
        ("leak:7:20mA@day3", FaultKind::Leak { cell, leak: Leak::Current(0.02) }, 3.0 * 86_400.0),
        ("leak:7:1kohm@3d", FaultKind::Leak { cell, leak: Leak::Resistance(1000.0) }, 3.0 * 86_400.0),
        ("leak:7:1.5A", FaultKind::Leak { cell, leak: Leak::Current(1.5) }, 0.0),
        ("contact:7:0.5mohm@12h", FaultKind::Contact { cell, resistance: ContactResistance::Ohm(0.0005) }, 43_200.0),
        ("contact:7:+50%@900s", FaultKind::Contact { cell, resistance: ContactResistance::OfCell(0.5) }, 900.0),
        ("weak:7:-10%", FaultKind::Weak { cell, change: -0.1 }, 0.0),
        ("resistance:7:+20%", FaultKind::Resistance { cell, change: 0.2 }, 0.0),
        ("module:1-7:+15%", FaultKind::Module { first: CellIndex(0), last: cell, change: 0.15 }, 0.0),
        ("current-offset:-50mA", FaultKind::CurrentOffset(-0.05), 0.0),
        ("current-gain:+1%", FaultKind::CurrentGain(0.01), 0.0),
        ("current-stuck", FaultKind::CurrentStuck, 0.0),
        ("voltage-offset:7:10mV", FaultKind::VoltageOffset { cell, offset_v: 0.01 }, 0.0),
        ("voltage-stuck:7", FaultKind::VoltageStuck { cell }, 0.0),
        ("swap:1:7", FaultKind::Swap(CellIndex(0), cell), 0.0),
        ("double:1:7", FaultKind::Double { shown: CellIndex(0), hidden: cell }, 0.0),
        ("temperature-stuck:1", FaultKind::TemperatureStuck(SensorIndex(0)), 0.0),
        ("temperature-off:2", FaultKind::TemperatureOff(SensorIndex(1)), 0.0),
    ] {
        assert_eq!(fault(text), Fault { kind, from_s }, "{text}");
    }
}

#[test]
fn malformed_fault_error_states_found_and_allowed() {
    for (text, says) in [
        ("leek:7:20mA", "fault = leek:7:20mA, must be leak:CELL:20mA, "),
        ("leak:7", "fault = leak:7, must be "),
        ("leak:0:20mA", "cell = 0, must be a number from 1 to 1024"),
        ("leak:7:20", "leak = 20, must be a current above 0 to 100 A, such as 20mA, or a resistance"),
        ("leak:7:-20mA", "leak = -20mA"),
        ("leak:7:0ohm", "leak = 0ohm"),
        ("contact:7:2ohm", "contact resistance = 2ohm, must be a resistance above 0 to 1 ohm"),
        ("contact:7:-20%", "contact resistance = -20%"),
        ("weak:7:-95%", "change of capacity = -95%, must be -90% to +900%"),
        ("resistance:7:nan%", "change of resistance = nan%"),
        ("module:7:+15%", "cells of the module = 7, must be FIRST-LAST"),
        ("module:7-3:+15%", "cells of the module = 7-3, must be FIRST-LAST, with FIRST not above LAST"),
        ("current-offset:0A", "current offset = 0A, must be a number in mA or A, not 0, at most 1000 A"),
        ("voltage-offset:7:10", "voltage offset = 10, must be a number in mV or V"),
        ("swap:3:3", "second cell = 3, must be different from the first cell"),
        ("temperature-off:x", "temperature sensor = x"),
        ("current-stuck@yesterday", "start of the fault = yesterday, must be day3, 3d, 12h or 900s"),
        ("current-stuck@-1d", "start of the fault = -1d"),
    ] {
        let message = text.parse::<Fault>().expect_err(text).to_string();
        assert!(message.contains(says), "{text}: {message}");
    }
}

#[test]
fn fault_of_missing_cell_or_sensor_is_rejected() {
    let refusal = |text: &str| fault(text).kind.check(4, 1).err().map(|error| error.to_string());
    assert_eq!(refusal("leak:5:20mA").as_deref(), Some("cell = 5, must be 1 to 4"));
    assert_eq!(refusal("module:3-6:+15%").as_deref(), Some("cell = 6, must be 1 to 4"));
    assert_eq!(refusal("double:1:5").as_deref(), Some("cell = 5, must be 1 to 4"));
    assert_eq!(refusal("temperature-off:2").as_deref(), Some("temperature sensor = 2, must be 1 to 1"));
    assert_eq!(refusal("swap:1:4"), None);
}

#[test]
fn leak_discharges_only_its_cell_from_its_start() {
    let (faulty, healthy) = compare(&["leak:2:20mA@1000s", "leak:3:100ohm@1000s"], |_, _, _| {});
    let lost_ah = |i: usize| (healthy.pack().cells()[i].soc - faulty.pack().cells()[i].soc) * 2.6;
    assert!((lost_ah(1) - 0.02 * 2000.0 / 3600.0).abs() < 2e-5, "{}", lost_ah(1));
    let volts = lost_ah(2) * 3600.0 / 2000.0 * 100.0;
    assert!((3.4..4.2).contains(&volts), "{volts} V");
    assert_eq!((lost_ah(0), lost_ah(3)), (0.0, 0.0));
    assert!(faulty.pack().leaks_a().nth(1) == Some(0.02));
}

#[test]
fn leak_discharges_cell_while_buses_sleep() {
    let mut settings = Settings::of(Scenario::EvDay, 2.6);
    settings.pack = crate::sim::PackSettings { cells: 2, ..plain_settings() };
    (settings.current_period_ns, settings.cell_period_ns) = (1_000_000_000, 1_000_000_000);
    let mut sim = Simulation::new(plain_model(2.6), settings, Wiring::single()).with_faults(&[fault("leak:2:10mA@2h")]);
    let mut end_s = 0.0;
    while let Some(moment) = sim.advance() {
        end_s = moment.time.secs();
    }
    let cells = sim.pack().cells();
    // The simulation ends with a night, in which nothing is sampled.
    assert!(end_s < 80_000.0);
    assert!(
        ((cells[0].soc - cells[1].soc) * 2.6 - 0.01 * 22.0).abs() < 1e-3,
        "{}",
        (cells[0].soc - cells[1].soc) * 2.6
    );
}

#[test]
fn contact_resistance_lowers_only_measured_voltage() {
    let (faulty, healthy) = compare(&["contact:2:4mohm@1000s", "contact:3:+20%"], |moment, faulty, healthy| {
        let drop_v = |cell| voltage_v(healthy, cell) - voltage_v(faulty, cell);
        let ohm = if moment.time >= at_s(1000) { 0.004 } else { 0.0 };
        assert!((drop_v(1) - moment.current_a * ohm).abs() < 1e-12);
        assert!((drop_v(2) - moment.current_a * 0.2 * 0.03).abs() < 1e-12);
        assert_eq!(drop_v(0), 0.0);
        let pack_drop_v = reading(healthy, Channel::PackVoltage) - reading(faulty, Channel::PackVoltage);
        assert!((pack_drop_v - drop_v(1) - drop_v(2)).abs() < 1e-12);
    });
    assert_eq!(faulty.pack().cells()[1].soc, healthy.pack().cells()[1].soc);
}

#[test]
fn weak_and_resistive_cells_keep_their_soc() {
    let (mut before, mut at) = ([0.0; 4], [0.0; 4]);
    let (faulty, _) = compare(&["weak:2:-10%@1000s", "resistance:3:+20%@1000s"], |moment, faulty, _| {
        let into = if moment.time < at_s(1000) { &mut before } else { &mut at };
        if moment.time <= at_s(1000) {
            *into = [0, 1, 2, 3].map(|i| faulty.pack().cells()[i].soc);
        }
    });
    let cells = faulty.pack().cells();
    assert!((cells[1].capacity_ah - 2.34).abs() < 1e-12 && cells[0].capacity_ah == 2.6);
    assert!((cells[2].resistance_ratio - 1.2).abs() < 1e-12 && cells[1].resistance_ratio == 1.0);
    // The two states are one step (1 s) apart.
    assert!((before[1] - at[1] - (before[0] - at[0])).abs() < 1e-12);
}

#[test]
fn replaced_module_has_new_cells_of_equal_soc() {
    let faults = ["leak:2:500mA", "resistance:3:+50%", "module:2-3:+15%@2000s"];
    let (faulty, healthy) = compare(&faults, |_, _, _| {});
    let cells = faulty.pack().cells();
    for cell in &cells[1..=2] {
        assert!((cell.capacity_ah - 2.6 * 1.15).abs() < 1e-12);
        assert_eq!((cell.resistance_ratio, cell.leak, cell.soc), (1.0, None, cells[1].soc));
    }
    assert_eq!(cells[3], healthy.pack().cells()[3]);
    // The new module starts with the mean SOC of the old module, so it lacks half of the leaked charge. Its SOC then
    // falls more slowly, because it has 15 % more capacity.
    let missing = healthy.pack().cells()[3].soc - cells[1].soc;
    let moved = 1.325 * 1000.0 / 3600.0 / 2.6;
    let expected = 0.5 * 0.5 * 2000.0 / 3600.0 / 2.6 - moved * (1.0 - 1.0 / 1.15);
    assert!((missing - expected).abs() < 1e-3, "{missing} {expected}");
}

#[test]
fn current_sensor_faults_add_offset_and_gain() {
    compare(&["current-offset:50mA@100s", "current-gain:-2%@200s"], |moment, faulty, _| {
        let offset_a = if moment.time >= at_s(100) { 0.05 } else { 0.0 };
        let gain = if moment.time >= at_s(200) { -0.02 } else { 0.0 };
        let expected_a = moment.current_a * (1.0 + gain) + offset_a;
        assert!((reading(faulty, Channel::Current) - expected_a).abs() < 1e-12);
        assert_eq!(faulty.voltages_v().count(), 4);
    });
}

#[test]
fn stuck_channels_keep_their_value_while_truth_changes() {
    let faults = ["current-stuck@500s", "voltage-stuck:2@500s", "temperature-stuck:1@500s"];
    let channels = [Channel::Current, Channel::CellVoltage(CellIndex(1)), Channel::Temperature(SensorIndex(0))];
    let mut frozen = [f64::NAN; 3];
    let (faulty, healthy) = compare(&faults, |moment, faulty, healthy| {
        if moment.time <= at_s(500) {
            frozen = channels.map(|channel| reading(healthy, channel));
        }
        assert_eq!(
            channels.map(|channel| reading(faulty, channel)),
            if moment.time < at_s(500) { channels.map(|c| reading(healthy, c)) } else { frozen }
        );
        assert_eq!(voltage_v(faulty, 0), voltage_v(healthy, 0));
    });
    assert_eq!(faulty.pack().cells(), healthy.pack().cells());
    assert_ne!(voltage_v(&healthy, 1), frozen[1]);
    assert_ne!(reading(&healthy, Channel::Temperature(SensorIndex(0))), frozen[2]);
}

#[test]
fn voltage_channel_faults_leave_pack_voltage_unchanged() {
    let distinct = "weak:1:-20%";
    let with = |text: &str, expected: fn([f64; 4]) -> [f64; 4]| {
        let (mut faulty, mut healthy) =
            (simulation(&[distinct, "leak:2:2A", text]), simulation(&[distinct, "leak:2:2A"]));
        let read = |sim: &Simulation| [0, 1, 2, 3].map(|cell| voltage_v(sim, cell));
        while faulty.advance().is_some() && healthy.advance().is_some() {
            let (found, wanted) = (read(&faulty), expected(read(&healthy)));
            assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-12), "{text}: {found:?} {wanted:?}");
            assert_eq!(reading(&faulty, Channel::PackVoltage), reading(&healthy, Channel::PackVoltage));
        }
    };
    with("voltage-offset:2:-10mV", |[a, b, c, d]| [a, b - 0.01, c, d]);
    with("swap:1:2", |[a, b, c, d]| [b, a, c, d]);
    with("double:1:3", |[a, b, _, d]| [a, b, a, d]);
}

#[test]
fn detached_temperature_sensor_reads_ambient() {
    let mut warmest_c = 25.0;
    compare(&["temperature-off:1@500s"], |moment, faulty, healthy| {
        let channel = Channel::Temperature(SensorIndex(0));
        let expected_c = if moment.time < at_s(500) { reading(healthy, channel) } else { 25.0 };
        assert_eq!(reading(faulty, channel), expected_c);
        warmest_c = f64::max(warmest_c, reading(healthy, channel));
    });
    assert!(warmest_c > 25.2, "{warmest_c}");
}

#[test]
fn balancing_bleeds_fuller_cells_only_at_night() {
    let mut settings = Settings::of(Scenario::EvDay, 60.0);
    settings.pack = crate::sim::PackSettings { cells: 4, capacity_ah: 60.0, ..plain_settings() };
    (settings.current_period_ns, settings.cell_period_ns) = (1_000_000_000, 1_000_000_000);
    settings.duration_s = Some(6.0 * 86_400.0);
    let run = |is_balancing| {
        let mut sim =
            Simulation::new(plain_model(60.0), settings, Wiring::single()).with_faults(&[fault("leak:2:20mA")]);
        if is_balancing {
            sim = sim.with_balancing(Balancing::usual(60.0));
        }
        while let Some(moment) = sim.advance() {
            let bleeding: Vec<bool> = (0..4).map(|cell| sim.pack().bleeding(CellIndex(cell))).collect();
            assert!(!bleeding[1] && bleeding[0] == bleeding[2] && bleeding[2] == bleeding[3], "{bleeding:?}");
            assert!(!bleeding[0] || is_balancing && moment.current_a <= 0.0 || sim.pack().cells()[0].bleed_a == 0.06);
        }
        sim.pack().highest_soc() - sim.pack().lowest_soc()
    };
    let (without, with) = (run(false), run(true));
    assert!((without - 0.02 * 144.0 / 60.0).abs() < 1e-3, "{without}");
    assert!(with < 0.5 * without, "{with} {without}");
}

#[test]
fn sensor_quality_limits_errors_and_quantises_readings() {
    let mut settings = settings();
    settings.pack.cells = 400;
    settings.sensors = Sensors::of_quality(SensorQuality::Usual);
    settings.duration_s = Some(20.0);
    let mut sim = Simulation::new(plain_model(2.6), settings, Wiring::single());
    let mut errors_v = vec![0.0; 400];
    while sim.advance().is_some() {
        let truth_v: Vec<f64> = sim.voltages_v().collect();
        for (cell, error_v) in (0..).zip(&mut errors_v) {
            let read_v = voltage_v(&sim, cell);
            assert!((read_v * 1000.0 - (read_v * 1000.0).round()).abs() < 1e-6);
            *error_v += (read_v - truth_v[usize::from(cell)]) / 20.0;
        }
    }
    let rms_v = (errors_v.iter().map(|v| v * v).sum::<f64>() / 400.0).sqrt();
    assert!((0.004..0.0055).contains(&rms_v), "{rms_v}"); // the limit of 2 sigma reduces 5 mV by the factor 0.96
    assert!(errors_v.iter().all(|v| v.abs() < 0.0115));
}
