//! Feeds profiles with known times and events to the counter and checks its counts: limits, rest, half-cycles, gaps,
//! restarts.

use super::*;

const LIMITS: UseLimits = UseLimits {
    temperature_c: [Some(0.0), Some(45.0)],
    voltage_v: [Some(3.0), Some(4.2)],
    current_a: [Some(-4.0), None],
    max_age_s: [0.0; 3],
    rest_a: 0.1,
    rated_ah: 2.0,
};

/// A cell at rest at 25 degrees C and half charge.
const REST: UseSample = UseSample {
    temperature_c: Some(SensorRange { lowest: 25.0, highest: 25.0, is_whole: true }),
    voltage_v: Some(SensorRange { lowest: 3.7, highest: 3.7, is_whole: true }),
    current_a: Some(0.0),
    soc: Some(0.5),
    is_charging: false,
};

/// A counter and its clock, in tenths of a second.
#[derive(Default)]
struct Bench {
    counter: UseCounter,
    tenth: u32,
}

impl Bench {
    fn new() -> Self {
        let mut bench = Self::default();
        bench.counter.observe(Timestamp::default(), &LIMITS, &REST);
        bench
    }

    /// Observes the sample every 0.1 s for `seconds`.
    fn run(&mut self, seconds: u32, sample: &UseSample) -> UseRecord {
        for _ in 0..10 * seconds {
            self.tenth += 1;
            self.counter.observe(Timestamp::from_secs(f64::from(self.tenth) / 10.0), &LIMITS, sample);
        }
        *self.counter.record()
    }

    fn skip(&mut self, seconds: u32) {
        self.tenth += 10 * seconds;
    }
}

fn close<const N: usize>(found: [f64; N], expected: [f64; N]) {
    assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}, not {expected:?}");
}

fn range(lowest: f64, highest: f64, is_whole: bool) -> Option<SensorRange> {
    Some(SensorRange { lowest, highest, is_whole })
}

#[test]
fn time_beyond_each_limit_is_counted_with_extremes() {
    let mut bench = Bench::new();
    bench.run(100, &UseSample { temperature_c: range(-5.0, 20.0, true), is_charging: true, ..REST });
    bench.run(50, &UseSample { temperature_c: range(20.0, 50.0, true), ..REST });
    bench.run(30, &UseSample { voltage_v: range(2.9, 4.21, true), ..REST });
    let record = bench.run(20, &UseSample { current_a: Some(-5.0), ..REST });
    let UseRecord { temperature_c, voltage_v, current_a, .. } = record;
    let of = |side: LimitUse| [side.known_s, side.beyond_s, side.beyond_charging_s, side.events as f64];
    close(of(temperature_c.below), [200.0, 100.0, 100.0, 1.0]);
    close(of(temperature_c.above), [200.0, 50.0, 0.0, 1.0]);
    close(of(voltage_v.below), [200.0, 30.0, 0.0, 1.0]);
    close(of(voltage_v.above), [200.0, 0.0, 0.0, 0.0]);
    close(of(current_a.below), [200.0, 20.0, 0.0, 1.0]);
    close(of(current_a.above), [0.0; 4]);
    assert_eq!((temperature_c.lowest, temperature_c.highest), (Some(-5.0), Some(50.0)));
    assert_eq!((voltage_v.lowest, voltage_v.highest), (Some(2.9), Some(4.21)));
    assert_eq!(record.events(), 4);
}

#[test]
fn event_needs_1_s_beyond_and_ends_after_10_s_within() {
    let mut bench = Bench::new();
    let hot = UseSample { temperature_c: range(50.0, 50.0, true), ..REST };
    let mut events = |seconds: u32, sample: &UseSample| bench.run(seconds, sample).temperature_c.above.events;
    assert_eq!(events(3, &hot), 1);
    assert_eq!(events(5, &REST), 1);
    assert_eq!(events(60, &hot), 1, "5 s within the limit do not end the event");
    assert_eq!(events(11, &REST), 1);
    assert_eq!(events(3, &hot), 2);
    events(11, &REST);
    bench.tenth += 1;
    bench.counter.observe(Timestamp::from_secs(f64::from(bench.tenth) / 10.0), &LIMITS, &hot);
    assert_eq!(bench.run(11, &REST).temperature_c.above.events, 2, "a single reading is not an event");
}

#[test]
fn unknown_values_count_as_unknown_never_as_within() {
    let mut bench = Bench::new();
    bench.run(10, &UseSample::default());
    let partly = UseSample { temperature_c: range(20.0, 30.0, false), ..REST };
    let record = bench.run(20, &partly);
    let beyond = bench.run(5, &UseSample { temperature_c: range(20.0, 50.0, false), ..REST });
    let UseRecord { temperature_c, voltage_v, current_a, c_rate, rest, .. } = record;
    close(
        [temperature_c.unknown_s, voltage_v.unknown_s, current_a.unknown_s, rest.unknown_s],
        [30.0, 10.0, 10.0, 10.0],
    );
    close([temperature_c.below.known_s, temperature_c.above.known_s, voltage_v.above.known_s], [0.0, 0.0, 20.0]);
    close([c_rate.rest_s, rest.known_s], [20.0, 20.0]);
    close([beyond.temperature_c.above.beyond_s, beyond.temperature_c.below.known_s], [5.0, 0.0]);
}

#[test]
fn c_rates_are_binned_by_direction() {
    let mut bench = Bench::new();
    for (seconds, current_a) in [(7, 0.05), (10, 0.5), (20, 1.5), (30, 5.0), (40, 9.0), (5, -1.0), (6, -6.0)] {
        bench.run(seconds, &UseSample { current_a: Some(current_a), ..REST });
    }
    let c_rate = bench.counter.record().c_rate;
    close([c_rate.rest_s], [7.0]);
    close(c_rate.discharge_s, [10.0, 20.0, 0.0, 30.0, 40.0]);
    close(c_rate.charge_s, [5.0, 0.0, 0.0, 6.0, 0.0]);
}

#[test]
fn half_cycles_are_counted_by_depth_and_speed() {
    let half = |mode, charge_ah, mean_current_a| HalfCycle {
        mode,
        charge_ah,
        swing: None,
        end_soc: None,
        ends: None,
        duration_s: 3600.0,
        mean_current_a,
        mean_temperature_c: None,
    };
    let mut counter = UseCounter::default();
    let mut count = |cells: &[HalfCycle]| counter.count_half_cycle(cells.iter().map(|half| (half, 2.0)));
    count(&[half(Mode::Discharge, 0.3, 0.3), half(Mode::Discharge, 0.5, 0.5)]);
    count(&[half(Mode::Discharge, 2.5, 2.5)]);
    count(&[half(Mode::Charge, 1.0, -1.9)]);
    count(&[half(Mode::Charge, 1.0, -2.1)]);
    count(&[]);
    let expected = HalfCycleUse { discharges: [0, 0, 1, 0, 0, 0, 0, 0, 0, 1], charges: 2, fast_charges: 1, unknown: 1 };
    assert_eq!(counter.record().half_cycles, expected);
}

#[test]
fn rest_at_high_soc_includes_gaps_only_if_parked() {
    let (full, driven) = (UseSample { soc: Some(0.95), ..REST }, UseSample { current_a: Some(5.0), ..REST });
    let mut bench = Bench::new();
    let mut rest = |seconds, sample: &UseSample, gap_s| {
        let RestUse { known_s, above_80_s, above_90_s, unknown_s } = bench.run(seconds, sample).rest;
        bench.skip(gap_s);
        [known_s, above_80_s, above_90_s, unknown_s]
    };
    close(rest(10, &full, 3600), [10.0, 10.0, 10.0, 0.0]);
    // The first SOC after the gap arrives later. For the gap, the lower of the SOC values before and after it counts.
    close(rest(1, &UseSample::default(), 0), [10.0, 10.0, 10.0, 0.9]);
    let parked = UseSample { soc: Some(0.9), ..REST };
    close(rest(10, &parked, 3600), [3620.1, 3620.1, 10.0, 0.9]);
    close(rest(10, &UseSample { soc: Some(0.7), ..REST }, 0), [3630.0, 3620.1, 10.0, 0.9]);
    // A gap after a load does not count as rest.
    rest(1, &driven, 3600);
    close(rest(10, &full, 0), [3639.9, 3630.0, 19.9, 0.9]);
}

#[test]
fn gaps_do_not_count_as_time_beyond_limits() {
    let hot = UseSample { temperature_c: range(50.0, 50.0, true), soc: Some(0.95), ..REST };
    let mut bench = Bench::new();
    bench.run(10, &hot);
    bench.skip(1000);
    bench.run(10, &hot);
    bench.counter.interrupt();
    bench.skip(1000);
    let record = bench.run(10, &hot);
    close([record.temperature_c.above.beyond_s, record.rest.above_90_s], [29.8, 1029.9]);
    // The counter moves to the clock of another run.
    bench.counter.rebase(-3_000_000_000);
    bench.counter.observe(Timestamp::default(), &LIMITS, &hot);
    close([bench.counter.record().temperature_c.above.beyond_s], [29.8]);
}

#[test]
fn stored_counter_round_trips_and_damage_is_found() {
    let mut bench = Bench::new();
    bench.run(3, &UseSample { temperature_c: range(50.0, 50.0, true), ..REST });
    let mut stored = serde_json::to_value(bench.counter).unwrap();
    assert_eq!(serde_json::from_value::<UseCounter>(stored.clone()).unwrap(), bench.counter);
    assert_eq!(bench.counter.check(), Ok(()));
    stored["record"]["c_rate"]["charge_s"][2] = (-1.0).into();
    assert!(serde_json::from_value::<UseCounter>(stored).unwrap().check().is_err());
}

#[test]
fn single_reading_is_no_event() {
    let limits = UseLimits { max_age_s: [5.0; 3], ..LIMITS };
    let hot = UseSample { temperature_c: range(90.0, 90.0, true), ..REST };
    let mut counter = UseCounter::default();
    let mut observe = |tenths: std::ops::Range<u32>, sample: &UseSample| {
        for tenth in tenths {
            counter.observe(Timestamp::from_secs(f64::from(tenth) / 10.0), &limits, sample);
        }
        counter.record().temperature_c.above
    };
    observe(0..10, &REST);
    // A reading that comes every 5 s is valid for 5 s.
    let LimitUse { beyond_s, events, .. } = observe(10..60, &hot);
    assert!((beyond_s - 5.0).abs() < 0.2 && events == 0, "{beyond_s} s, {events} events");
    assert_eq!(observe(60..110, &hot).events, 1, "two readings");
}

#[test]
fn time_without_limit_is_unknown() {
    let unlimited = UseLimits { temperature_c: [None; 2], ..LIMITS };
    let mut counter = UseCounter::default();
    for second in 0..=150 {
        let limits = if second <= 100 { &unlimited } else { &LIMITS };
        counter.observe(Timestamp::from_secs(f64::from(second)), limits, &REST);
    }
    let record = counter.record();
    close([record.unknown_s(&record.temperature_c.above), record.unknown_s(&record.voltage_v.above)], [100.0, 0.0]);
}
