use super::*;

const CELLS: usize = 6;
const SENSORS: usize = 3;

/// A pack of six cells and three sensors, each for two cells. All readings come once a second.
struct Pack {
    watch: ThermalWatch,
    second: u32,
    volts: [f64; CELLS],
    temperatures_c: [f64; SENSORS],
    rate_per_h: Option<f64>,
    least_soc: f64,
    /// Readings arrive every this many seconds.
    every: u32,
}

impl Pack {
    /// Two minutes of rest.
    fn at_rest() -> Self {
        let mut pack = Self {
            watch: ThermalWatch::new(CELLS, SENSORS),
            second: 0,
            volts: [3.7; CELLS],
            temperatures_c: [25.0; SENSORS],
            rate_per_h: Some(0.0),
            least_soc: 0.5,
            every: 1,
        };
        assert_eq!(pack.run(120, |_, _| {}), None);
        pack
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_secs(f64::from(self.second))
    }

    /// Runs for some seconds; `change` changes the pack before each second. Returns the second of the first evidence, its
    /// cell and its value.
    fn run(&mut self, seconds: u32, mut change: impl FnMut(u32, &mut Self)) -> Option<(u32, usize, f64)> {
        for second in 0..seconds {
            change(second, self);
            self.second += 1;
            let (now, least_soc) = (self.now(), self.least_soc);
            if self.second.is_multiple_of(self.every) {
                let mut found = None;
                for (cell, voltage_v) in (0..).map(CellIndex).zip(self.volts) {
                    found = found.or(Some(cell).filter(|cell| self.watch.handle_voltage(now, *cell, voltage_v)));
                }
                for (sensor, temperature_c) in (0..).map(SensorIndex).zip(self.temperatures_c) {
                    let measures = |cell: usize| cell / 2 == sensor.index();
                    let new = self.watch.handle_temperature(now, sensor, temperature_c, self.rate_per_h, measures);
                    found = found.or(new);
                }
                if let Some(cell) = found {
                    let evidence = self.watch.evidence(now, cell, None).unwrap();
                    return Some((second, cell.index(), evidence));
                }
            }
            self.watch.refresh(now, |_| Some(least_soc));
        }
        None
    }
}

#[test]
fn collapse_of_one_voltage_is_found_after_three_seconds() {
    for lasting_v in [2.7, 1.0, 0.0, -0.1] {
        let found = Pack::at_rest().run(60, |second, pack| {
            pack.volts[2] = lasting_v + if second == 0 { 0.3 } else { 0.001 * f64::from(second % 2) };
        });
        let (second, cell, evidence) = found.unwrap();
        assert_eq!((cell, evidence), (2, 1.0), "{lasting_v}");
        assert!((3..=4).contains(&second), "{lasting_v}: {second}");
    }
    let mut pack = Pack::at_rest();
    assert_eq!(pack.run(60, |_, pack| pack.volts[2] = 3.7 * 0.76), None);
}

#[test]
fn fall_that_is_no_collapse_is_not_reported() {
    let mut dead_channel = Pack::at_rest();
    assert_eq!(dead_channel.run(300, |_, pack| pack.volts[2] = 0.0), None, "one value");
    let mut wire = Pack::at_rest();
    let broken = |second: u32, pack: &mut Pack| {
        pack.volts[2] = 1.5 + 0.001 * f64::from(second);
        pack.volts[3] = 7.4 - pack.volts[2];
    };
    assert_eq!(wire.run(300, broken), None, "sense wire");
    let mut load = Pack::at_rest();
    let heavy = |second: u32, pack: &mut Pack| pack.volts = [2.6 + 0.001 * f64::from(second % 7); CELLS];
    assert_eq!(load.run(300, heavy), None, "load of all cells");
    let mut empty = Pack { least_soc: 0.05, ..Pack::at_rest() };
    empty.run(60, |_, _| {});
    assert_eq!(empty.run(300, |second, pack| pack.volts[2] = 2.5 - 0.001 * f64::from(second)), None, "almost empty");
    let mut short = Pack::at_rest();
    let flicker = |second: u32, pack: &mut Pack| pack.volts[2] = if second % 3 == 2 { 3.7 } else { 0.5 };
    assert_eq!(short.run(300, flicker), None, "disturbance of two seconds");
}

#[test]
fn collapse_across_break_is_not_reported() {
    let mut pack = Pack::at_rest();
    pack.watch.interrupt();
    assert_eq!(pack.run(300, |second, pack| pack.volts[2] = 2.5 + 0.001 * f64::from(second % 2)), None);
}

#[test]
fn slow_readings_show_collapse() {
    let mut pack = Pack { every: 10, ..Pack::at_rest() };
    pack.run(120, |_, _| {});
    let found = pack.run(120, |second, pack| pack.volts[5] = 2.0 - 0.001 * f64::from(second));
    assert_eq!(found.map(|(_, cell, _)| cell), Some(5));
    assert!(found.unwrap().0 <= 30, "{found:?}");
}

#[test]
fn fast_rise_of_temperature_is_found() {
    // A rise of all sensors counts too, because no current explains it.
    for all in [false, true] {
        let found = Pack::at_rest().run(60, |_, pack| {
            pack.temperatures_c[1] += 1.2;
            if all {
                pack.temperatures_c = [pack.temperatures_c[1]; SENSORS];
            }
        });
        let (second, cell, evidence) = found.unwrap();
        assert!((3..9).contains(&second) && evidence == 2.0, "{second} {evidence}");
        assert_eq!(cell / 2, if all { 0 } else { 1 });
    }
    assert_eq!(Pack::at_rest().run(300, |_, pack| pack.temperatures_c = pack.temperatures_c.map(|it| it + 0.7)), None);
}

#[test]
fn sensor_ahead_of_others_is_found() {
    let found = Pack::at_rest().run(300, |_, pack| pack.temperatures_c[1] += 0.12);
    assert_eq!(found.map(|(_, cell, evidence)| (cell / 2, evidence)), Some((1, 2.0)));
    assert!((80..120).contains(&found.unwrap().0), "{found:?}");
    // Slower, or together with the others, is no event.
    for (own, others) in [(0.06, 0.0), (0.12, 0.1)] {
        let found = Pack::at_rest().run(600, |_, pack| {
            pack.temperatures_c = [others, own, others].map(|rate| rate * f64::from(pack.second - 120) + 25.0);
        });
        assert_eq!(found, None, "{own} {others}");
    }
}

#[test]
fn heat_of_current_is_deducted() {
    // 4 C: 1.6 degrees C/s at first, 80 in all, 16 between the sensors.
    let mut pack = Pack { rate_per_h: Some(-4.0), ..Pack::at_rest() };
    let mut warmer = |_, pack: &mut Pack| {
        pack.temperatures_c = pack.temperatures_c.map(|it| it + 0.05 * (105.0 - it).max(0.0).min(32.0));
        pack.temperatures_c[1] = 25.0 + 1.15 * (pack.temperatures_c[0] - 25.0);
    };
    assert_eq!(pack.run(120, &mut warmer), None);
    pack.rate_per_h = Some(0.0);
    pack.run(600, |_, _| {});
    pack.temperatures_c = [25.0; SENSORS];
    pack.run(300, |_, _| {});
    assert!(pack.run(120, &mut warmer).is_some(), "the same without a current");
}

#[test]
fn readings_that_are_no_rise_are_not_reported() {
    let cases: [(&str, fn(u32) -> f64); 6] = [
        ("jump with a slow rise", |second| 25.0 + f64::from(second.min(10) / 10) * 7.0 + 0.05 * f64::from(second)),
        ("one jump", |second| if second < 10 { 25.0 } else { 215.0 }),
        ("flicker", |second| if second.is_multiple_of(3) { 215.0 } else { 25.0 }),
        ("two jumps", |second| 25.0 + 60.0 * f64::from(second.min(20) / 10)),
        ("steps of one degree", |second| 25.0 + f64::from(second / 20)),
        ("not a number", |second| if second < 10 { 25.0 } else { f64::NAN }),
    ];
    for (name, temperature_c) in cases {
        let found = Pack::at_rest().run(200, |second, pack| pack.temperatures_c[0] = temperature_c(second));
        assert_eq!(found, None, "{name}");
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
    let cell = CellIndex(2);
    assert_eq!(pack.watch.evidence(pack.now(), cell, None), Some(0.0));
    pack.run(60, |second, pack| pack.volts[2] = 2.0 + 0.001 * f64::from(second)).unwrap();
    pack.run(200, |second, pack| pack.volts[2] = 2.0 + 0.001 * f64::from(second));
    assert_eq!(pack.watch.evidence(pack.now(), cell, None), Some(0.0));
    let later = pack.now().plus_secs(300.0);
    for at in [100.0, 200.0, 300.0] {
        pack.watch.refresh(pack.now().plus_secs(at), |_| None);
    }
    assert_eq!(pack.watch.evidence(later, cell, Some(SensorIndex(1))), None);
    assert_eq!(pack.watch.evidence(later, CellIndex(99), None), None);
}

#[test]
fn clock_that_goes_back_gives_no_event() {
    let mut pack = Pack::at_rest();
    pack.second = 10;
    assert_eq!(pack.run(300, |_, _| {}), None);
    let found = pack.run(60, |_, pack| pack.temperatures_c[0] += 2.0);
    assert!(found.is_some());
}
