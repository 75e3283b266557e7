//! Tests the thermal watch with simulated readings of a small pack.

use super::*;

const CELLS: usize = 6;
const SENSORS: usize = 3;

/// A pack of six cells and three sensors, each for two cells. Unless a test changes `every`, all readings come once a
/// second.
struct Pack {
    watch: ThermalWatch,
    second: u32,
    volts: [f64; CELLS],
    temperatures_c: [f64; SENSORS],
    rate_per_h: Option<f64>,
    least_soc: f64,
    /// Time between two readings (s).
    every: u32,
    /// Current of each cell relative to the pack's current. In a module of another kind, this factor differs.
    rate_factors: [f64; CELLS],
}

impl Pack {
    /// Creates a pack and simulates two minutes of rest.
    fn at_rest() -> Self {
        let mut pack = Self {
            watch: ThermalWatch::new(CELLS, SENSORS),
            second: 0,
            volts: [3.7; CELLS],
            temperatures_c: [25.0; SENSORS],
            rate_per_h: Some(0.0),
            least_soc: 0.5,
            every: 1,
            rate_factors: [1.0; CELLS],
        };
        assert_eq!(pack.run(120, |_, _| {}), None);
        pack
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_secs(f64::from(self.second))
    }

    /// Simulates some seconds and calls `change` before each second. Returns the second, the cell and the value of the
    /// first evidence of a thermal event.
    fn run(&mut self, seconds: u32, mut change: impl FnMut(u32, &mut Self)) -> Option<(u32, usize, f64)> {
        for second in 0..seconds {
            change(second, self);
            self.second += 1;
            let (now, least_soc) = (self.now(), self.least_soc);
            if self.second.is_multiple_of(self.every) {
                let mut found = None;
                for (cell, voltage_v) in (0..).map(CellIndex).zip(self.volts) {
                    let rate_per_h = || Some(self.rate_per_h? * self.rate_factors[cell.index()]);
                    found = found.or(self.watch.handle_voltage(now, cell, voltage_v, rate_per_h).then_some(cell));
                }
                for (sensor, temperature_c) in (0..).map(SensorIndex).zip(self.temperatures_c) {
                    let measures = |cell: usize| cell / 2 == sensor.index();
                    let new = self.watch.handle_temperature(now, sensor, temperature_c, self.rate_per_h, measures);
                    found = found.or(new);
                }
                if let Some(cell) = found {
                    let evidence = self.watch.evidence_of(now, cell);
                    return Some((second, cell.index(), evidence));
                }
            }
            let rate_per_h = |cell: usize| Some(self.rate_per_h? * self.rate_factors[cell]);
            self.watch.refresh(now, rate_per_h, |_| Some(least_soc));
        }
        None
    }
}

#[test]
fn collapse_of_one_voltage_is_found_after_three_seconds() {
    // A collapse may begin at any time between two refreshes of the reference voltages.
    for (lasting_v, wait) in [(2.7, 0), (1.0, 7), (0.0, 15), (-0.1, 29)] {
        let mut pack = Pack::at_rest();
        pack.run(wait, |_, _| {});
        let found = pack.run(60, |second, pack| pack.volts[2] = lasting_v + 0.001 * f64::from(second % 2));
        assert_eq!(found, Some((3, 2, 1.0)), "{lasting_v} {wait}");
    }
    assert_eq!(Pack::at_rest().run(60, |_, pack| pack.volts[2] = 3.7 * 0.76), None);
}

#[test]
fn other_falls_raise_no_event() {
    let rest = Pack::at_rest;
    let moving = |second: u32| 0.001 * f64::from(second % 7);
    assert_eq!(rest().run(300, |_, pack| pack.volts[2] = 0.0), None, "dead channel");
    let wire = |second: u32, pack: &mut Pack| {
        pack.volts[2] = 1.5 + moving(second);
        pack.volts[3] = 7.4 - pack.volts[2];
    };
    assert_eq!(rest().run(300, wire), None, "sense wire");
    let clamped = |second: u32, pack: &mut Pack| {
        pack.volts[2] = 0.1 + moving(second);
        pack.volts[3] = 5.0;
    };
    assert_eq!(rest().run(300, clamped), None, "sense wire, channel at its limit");
    let refused = |second: u32, pack: &mut Pack| {
        pack.volts[2] = 0.1 + moving(second);
        pack.volts[3] = f64::NAN;
    };
    assert_eq!(rest().run(100, refused), None, "sense wire, channel without readings");
    assert_eq!(rest().run(300, |second, pack| pack.volts = [2.6 + moving(second); CELLS]), None, "all cells");
    let half = |second: u32, pack: &mut Pack| pack.volts[..4].fill(2.6 + moving(second));
    assert_eq!(rest().run(300, half), None, "most cells");
    let mut empty = Pack { least_soc: 0.05, ..rest() };
    empty.run(60, |_, _| {});
    assert_eq!(empty.run(300, |second, pack| pack.volts[2] = 2.5 + moving(second)), None, "almost empty");
    let flicker = |second: u32, pack: &mut Pack| pack.volts[2] = if second % 3 == 2 { 3.7 } else { 0.5 };
    assert_eq!(rest().run(300, flicker), None, "disturbance of two seconds");
    // A bad contact of 5 mohm at a cell of 126 Ah, with a discharge current of 2 C (252 A).
    let contact = |second: u32, pack: &mut Pack| {
        pack.rate_per_h = Some(2.0);
        pack.volts = [3.6; CELLS];
        pack.volts[2] = 1.8 + moving(second);
    };
    assert_eq!(rest().run(300, contact), None, "contact under load");
    let both = |second: u32, pack: &mut Pack| {
        contact(second, pack);
        pack.volts[2] = 1.5 + moving(second);
    };
    assert!(rest().run(300, both).is_some(), "collapse under load");
    let mut charge = Pack { rate_per_h: Some(-3.0), volts: [4.0; CELLS], ..rest() };
    charge.run(100, |_, _| {});
    charge.rate_factors[2] = 3.0;
    charge.run(60, |_, _| {});
    assert!(charge.run(60, |second, pack| pack.volts[2] = 2.5 + moving(second)).is_some(), "collapse in a fast charge");
}

#[test]
fn return_from_wrong_high_voltage_raises_no_event() {
    for (wrong_v, seconds) in [(6.5, 1), (5.0, 40), (5.0, 100)] {
        for wait in 0..30 {
            let mut pack = Pack::at_rest();
            pack.run(wait, |_, _| {});
            assert_eq!(pack.run(seconds, |_, pack| pack.volts[5] = wrong_v), None);
            let back = |second: u32, pack: &mut Pack| pack.volts[5] = 3.7 + 0.001 * f64::from(second % 2);
            assert_eq!(pack.run(200, back), None, "{wrong_v} V for {seconds} s, {wait}");
        }
    }
    let mut frozen = Pack { volts: [4.15; CELLS], ..Pack::at_rest() };
    frozen.run(300, |_, _| {});
    frozen.run(600, |_, pack| pack.volts.iter_mut().for_each(|volts| *volts -= 0.00175));
    frozen.volts[5] = 4.15;
    frozen.run(300, |_, _| {});
    assert_eq!(frozen.run(300, |second, pack| pack.volts[5] = 3.1 + 0.001 * f64::from(second % 2)), None);
}

#[test]
fn first_minute_after_break_is_not_judged_by_voltage() {
    let mut pack = Pack::at_rest();
    pack.watch.interrupt();
    assert_eq!(pack.run(300, |second, pack| pack.volts[2] = 2.5 + 0.001 * f64::from(second % 2)), None);
}

#[test]
fn slow_readings_show_collapse_at_every_phase() {
    for every in [5, 10, 20, 30] {
        for wait in 0..every {
            let mut pack = Pack { every, ..Pack::at_rest() };
            pack.run(120 + wait, |_, _| {});
            let found = pack.run(200, |second, pack| pack.volts[5] = 2.0 - 0.001 * f64::from(second));
            let (second, cell, _) = found.unwrap_or_else(|| panic!("every {every} s, {wait}"));
            assert!(cell == 5 && second < 3 * every, "every {every} s, {wait}: {second}");
        }
    }
}

#[test]
fn fast_rise_of_temperature_is_found() {
    // A rise of all sensors also counts, because no current explains it.
    for all in [false, true] {
        let found = Pack::at_rest().run(60, |_, pack| {
            pack.temperatures_c[1] += 1.2;
            if all {
                pack.temperatures_c = [pack.temperatures_c[1]; SENSORS];
            }
        });
        let (second, cell, evidence) = found.unwrap();
        assert!((4..12).contains(&second) && evidence == 2.0, "{second} {evidence}");
        assert_eq!(cell / 2, if all { 0 } else { 1 });
    }
    assert_eq!(Pack::at_rest().run(300, |_, pack| pack.temperatures_c = pack.temperatures_c.map(|it| it + 0.7)), None);
}

#[test]
fn sensor_ahead_of_others_is_found() {
    let found = Pack::at_rest().run(300, |_, pack| pack.temperatures_c[1] += 0.12);
    assert_eq!(found.map(|(_, cell, evidence)| (cell / 2, evidence)), Some((1, 2.0)));
    assert!((90..120).contains(&found.unwrap().0), "{found:?}");
    // A slower rise, or a rise together with the other sensors, is not an event.
    for (own, others) in [(0.06, 0.0), (0.12, 0.1)] {
        let found = Pack::at_rest().run(600, |_, pack| {
            pack.temperatures_c = [others, own, others].map(|rate| rate * f64::from(pack.second - 120) + 25.0);
        });
        assert_eq!(found, None, "{own} {others}");
    }
}

#[test]
fn heat_of_current_is_deducted() {
    // The current is four times the rated capacity per hour. It explains an initial rise of 1.6 degrees C/s, a total
    // rise of 80 degrees C, and a difference of 16 degrees C between the sensors.
    let mut pack = Pack { rate_per_h: Some(-4.0), ..Pack::at_rest() };
    let mut warmer = |_, pack: &mut Pack| {
        pack.temperatures_c = pack.temperatures_c.map(|it| it + 0.05 * (105.0 - it).clamp(0.0, 32.0));
        pack.temperatures_c[1] = 25.0 + 1.15 * (pack.temperatures_c[0] - 25.0);
    };
    assert_eq!(pack.run(120, &mut warmer), None);
    assert!(Pack::at_rest().run(120, &mut warmer).is_some(), "the same without a current");
}

#[test]
fn disturbed_temperature_raises_no_event() {
    type Readings = (&'static str, fn(u32) -> f64);
    let cases: [Readings; 10] = [
        ("return from a failure", |second| if second < 30 { -40.0 } else { 25.0 - 65.0 * decay(second - 30, 5.0) }),
        ("slow return", |second| if second < 30 { -40.0 } else { 25.0 - 65.0 * decay(second - 30, 20.0) }),
        (
            "return from a long failure",
            |second| {
                if second < 300 { -40.0 } else { 25.0 - 65.0 * decay(second - 300, 5.0) }
            },
        ),
        ("noise", |second| (25.0 + 2.0 * noise(second)).round()),
        ("jump with a slow rise", |second| 25.0 + f64::from(second.min(10) / 10) * 7.0 + 0.05 * f64::from(second)),
        ("one jump", |second| if second < 10 { 25.0 } else { 215.0 }),
        ("flicker", |second| if second.is_multiple_of(3) { 215.0 } else { 25.0 }),
        ("two jumps", |second| 25.0 + 60.0 * f64::from(second.min(20) / 10)),
        ("steps of one degree", |second| 25.0 + f64::from(second / 20)),
        ("not a number", |second| if second < 10 { 25.0 } else { f64::NAN }),
    ];
    for (name, temperature_c) in cases {
        let found = Pack::at_rest().run(400, |second, pack| pack.temperatures_c[0] = temperature_c(second));
        assert_eq!(found, None, "{name}");
    }
}

fn decay(second: u32, tau_s: f64) -> f64 {
    libm::exp(-f64::from(second) / tau_s)
}

/// Pseudo-random value between -1 and 1.
fn noise(second: u32) -> f64 {
    f64::from(second.wrapping_mul(2_654_435_761) >> 16) / 32_768.0 - 1.0
}

#[test]
fn sensor_that_returns_from_failure_raises_no_event() {
    // The loops vary the offset of the sensors (degrees C), the number of failing sensors, the duration of the
    // failure (s) and the time constant of the recovery (s).
    for offset_c in [-2.0, 0.0, 2.0, 5.0] {
        for failing in [1, SENSORS] {
            for (failure_s, tau_s) in
                [(5, 3.0), (5, 30.0), (30, 10.0), (100, 1.0), (150, 30.0), (600, 5.0), (600, 30.0)]
            {
                let fails = |second: u32, pack: &mut Pack| {
                    let back = if second < failure_s { 0.0 } else { 1.0 - decay(second - failure_s, tau_s) };
                    pack.temperatures_c[0] = (-40.0 + (65.0 + offset_c) * back).round();
                    pack.temperatures_c[1..failing].fill((-40.0 + 65.0 * back).round());
                };
                let mut pack = Pack::at_rest();
                pack.temperatures_c[0] += offset_c;
                pack.run(200, |_, _| {});
                let found = pack.run(1200, fails);
                assert_eq!(found, None, "{offset_c} degrees C, {failing} sensors, {failure_s} s, {tau_s} s");
                // After the recovery, the sensor is watched again.
                assert!(pack.run(60, |_, pack| pack.temperatures_c[0] += 2.0).is_some());
            }
        }
    }
}

#[test]
fn disturbance_does_not_hide_later_rise() {
    let mut pack = Pack::at_rest();
    for disturbed_c in [215.0, 1e308, -40.0] {
        pack.run(1, |_, pack| pack.temperatures_c[0] = disturbed_c);
        assert_eq!(pack.run(100, |_, pack| pack.temperatures_c[0] = 25.0), None, "{disturbed_c}");
    }
    assert!(pack.run(60, |_, pack| pack.temperatures_c[0] += 2.0).is_some());
}

#[test]
fn sensor_that_failed_before_start_raises_no_event() {
    let mut pack = Pack::at_rest();
    pack.watch.interrupt();
    let back = |second: u32, pack: &mut Pack| {
        pack.temperatures_c[0] = if second < 300 { -40.0 } else { 24.0 - 64.0 * decay(second - 300, 10.0) };
    };
    assert_eq!(pack.run(600, back), None);
}

#[test]
fn silent_sensor_is_judged_again_after_minute() {
    let mut pack = Pack::at_rest();
    pack.every = u32::MAX;
    pack.run(300, |_, _| {});
    pack.every = 1;
    let back = |second: u32, pack: &mut Pack| pack.temperatures_c = [25.0 - 65.0 * decay(second, 20.0); SENSORS];
    assert_eq!(pack.run(300, back), None);
    assert!(pack.run(60, |_, pack| pack.temperatures_c[0] += 2.0).is_some());
}

#[test]
fn filter_of_sensor_settles_after_break() {
    for tau_s in [1.0, 3.0, 10.0] {
        let mut pack = Pack::at_rest();
        pack.watch.interrupt();
        let settling =
            |second: u32, pack: &mut Pack| pack.temperatures_c = [25.0 - 65.0 * decay(second, tau_s); SENSORS];
        assert_eq!(pack.run(300, settling), None, "{tau_s}");
    }
}

#[test]
fn heat_does_not_depend_on_rate_of_readings() {
    let heat_after = |per_s: u32| {
        let mut watch = ThermalWatch::new(1, 1);
        for step in 0..120 * per_s {
            let (second, rate) = (f64::from(step) / f64::from(per_s), if step < 60 * per_s { 6.0 } else { 0.0 });
            watch.handle_temperature(Timestamp::from_secs(second), SensorIndex(0), 25.0, Some(rate), |_| true);
        }
        watch.sensors[0].heat
    };
    let slow = heat_after(1);
    assert!(slow > 5.0, "{slow}");
    for per_s in [10, 50] {
        assert!((heat_after(per_s) / slow - 1.0).abs() < 0.05, "{per_s}: {} {slow}", heat_after(per_s));
    }
}

#[test]
fn fallen_cell_of_sensor_is_named() {
    let found = Pack::at_rest().run(60, |_, pack| {
        pack.temperatures_c[1] += 2.0;
        pack.volts[3] -= 0.05;
    });
    assert_eq!(found.map(|(_, cell, _)| cell), Some(3));
}

#[test]
fn evidence_ends_and_is_unknown_without_readings() {
    let mut pack = Pack::at_rest();
    let value = |pack: &Pack, cell: usize, sensor: Option<u16>| {
        let sensors = [sensor.map(SensorIndex); CELLS];
        pack.watch.evidence(pack.now(), &sensors).nth(cell).unwrap().1
    };
    assert_eq!(value(&pack, 2, None), Some(0.0));
    pack.run(60, |second, pack| pack.volts[2] = 2.0 + 0.001 * f64::from(second)).unwrap();
    assert_eq!(value(&pack, 2, None), Some(1.0));
    pack.run(300, |second, pack| pack.volts[2] = 2.0 + 0.001 * f64::from(second));
    assert_eq!(value(&pack, 2, None), Some(0.0));
    // A cell that may be almost empty is judged by its temperature alone.
    pack.least_soc = 0.05;
    pack.run(60, |_, _| {});
    assert_eq!((value(&pack, 2, None), value(&pack, 2, Some(1))), (None, Some(0.0)));
    pack.least_soc = 0.5;
    pack.every = u32::MAX;
    pack.run(300, |_, _| {});
    assert_eq!((value(&pack, 2, None), value(&pack, 2, Some(1))), (None, None));
}

#[test]
fn impossible_state_is_rejected() {
    let pack = Pack::at_rest();
    pack.watch.check().unwrap();
    let broken: [fn(&mut ThermalWatch); 4] = [
        |watch| watch.cells[0].latest = Some((Timestamp::ZERO, f64::NAN)),
        |watch| watch.falling = 3,
        |watch| watch.sensors[0].fast.0.extend([(Timestamp::ZERO, 1.0); 2]),
        |watch| watch.cells[0].references[0].as_mut().unwrap().rate_per_h = Some(f64::INFINITY),
    ];
    for (number, change) in broken.iter().enumerate() {
        let mut watch = pack.watch.clone();
        change(&mut watch);
        assert!(watch.check().is_err(), "{number}");
    }
}

#[test]
fn clock_that_goes_back_gives_no_event() {
    let mut pack = Pack::at_rest();
    pack.second = 10;
    assert_eq!(pack.run(300, |_, _| {}), None);
    pack.second += 200;
    pack.run(100, |_, _| {});
    assert!(pack.run(60, |_, pack| pack.temperatures_c[0] += 2.0).is_some());
}
