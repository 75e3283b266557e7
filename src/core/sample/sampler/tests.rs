//! Tests scenarios of the whole sample stage. The charge counter has its own tests.

use proptest::prelude::*;

use super::*;
use crate::sample::ContactorConfig;
use crate::sample::Limits;

fn at(seconds: f64) -> Timestamp {
    Timestamp::from_secs(seconds)
}

fn limits(min: f64, max: f64, max_age_s: f64) -> Limits {
    Limits { min, max, max_rate_per_s: None, stuck_after_s: None, max_age_s }
}

fn config() -> SampleConfig {
    SampleConfig {
        voltage_noise_v: 0.005,
        cells: 2,
        voltage_source: VoltageSource::Cells,
        strings: 1,
        current: limits(-10.0, 10.0, 2.0),
        voltage: limits(2.0, 4.5, 5.0),
        temperature: limits(-40.0, 85.0, 30.0),
        reported_soc: None,
        reported_soh: None,
        direction: None,
        contactor: None,
        sensor_of_cell: vec![Some(SensorIndex(0)), None],
        ambient_c: 20.0,
    }
}

const CELL: Channel = Channel::CellVoltage(CellIndex(0));
const SENSOR: Channel = Channel::Temperature(SensorIndex(0));

struct Bench {
    sampler: Sampler,
    changes: Vec<SignalChange>,
}

impl Bench {
    fn new(config: SampleConfig) -> Self {
        Self { sampler: Sampler::new(config), changes: Vec::new() }
    }

    fn give(&mut self, time: f64, channel: Channel, value: Result<f64, Fault>) -> Option<CellSample> {
        self.sampler.handle_reading(at(time), Reading { channel, value }, &mut self.changes)
    }

    fn ok(&mut self, time: f64, channel: Channel, value: f64) -> Option<CellSample> {
        self.give(time, channel, Ok(value))
    }

    fn states(&self) -> Vec<Result<u64, Fault>> {
        self.changes.iter().map(|change| change.state).collect()
    }
}

#[test]
fn sample_carries_values_fresh_at_voltage_time() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, SENSOR, 25.0);
    bench.ok(0.0, Channel::Current, 2.0);
    bench.ok(1.0, Channel::Current, 4.0);
    let sample = bench.ok(1.5, CELL, 3.7).expect("a good voltage gives a sample");
    assert_eq!(sample.charge_as, 5.0, "3 As by the trapezoid plus half a second of 4 A");
    assert_eq!(
        (sample.cell, sample.time, sample.voltage_v, sample.current_a, sample.temperature_c, sample.unmeasured_s),
        (CellIndex(0), at(1.5), 3.7, Some(4.0), Some(25.0), 0.0)
    );
    let other = bench.ok(1.5, Channel::CellVoltage(CellIndex(1)), 3.6).expect("a sample");
    assert_eq!((other.cell, other.temperature_c), (CellIndex(1), None), "cell 1 has no sensor");
}

#[test]
fn open_contactors_force_zero_current_and_charge() {
    let limits = limits(f64::NEG_INFINITY, f64::INFINITY, 10.0);
    let contactor = Some(ContactorConfig { open: vec![0.0, 3.0], limits });
    let mut bench = Bench::new(SampleConfig { contactor, ..config() });
    bench.ok(0.0, Channel::Current, 2.0);
    bench.ok(1.0, Channel::Contactor, 3.0);
    bench.ok(2.0, Channel::Current, 5.0);
    let open = bench.ok(9.0, CELL, 3.7).expect("a sample");
    assert_eq!((open.current_a, open.charge_as, open.offset_s, open.unmeasured_s), (Some(0.0), 2.0, 1.0, 0.0));
    // After a bad reading, the contactors count as open until the last good reading is too old.
    bench.give(9.5, Channel::Contactor, Err(Fault::NotAvailable));
    let late = bench.ok(12.0, CELL, 3.7).expect("a sample");
    assert_eq!(
        (late.current_a, late.unmeasured_s),
        (None, 1.0),
        "contactors unknown, and the current reading is too old"
    );
    bench.ok(13.0, Channel::Contactor, 0.0);
    bench.ok(14.0, Channel::Current, 4.0);
    bench.ok(15.0, Channel::Contactor, 1.0);
    let closed = bench.ok(16.0, CELL, 3.7).expect("a sample");
    assert_eq!((closed.current_a, closed.charge_as, closed.unmeasured_s), (Some(4.0), 6.0, 2.0));
}

#[test]
fn magnitude_without_valid_direction_is_unknown_current() {
    let direction = Some(limits(-1.0, 1.0, 2.0));
    let mut bench = Bench::new(SampleConfig { direction, ..config() });
    let current = |bench: &mut Bench, time: f64, magnitude_a: f64| {
        bench.ok(time, Channel::Current, magnitude_a);
        bench.ok(time, CELL, 3.7).expect("a sample").current_a
    };
    assert_eq!(current(&mut bench, 0.0, 2.0), None, "no direction yet");
    bench.ok(1.0, Channel::CurrentDirection, -1.0);
    assert_eq!(current(&mut bench, 1.0, 2.0), Some(-2.0));
    bench.ok(2.0, Channel::CurrentDirection, 1.0);
    assert_eq!(current(&mut bench, 3.0, 1.5), Some(1.5));
    // A magnitude without direction does not replace the last good current.
    bench.give(4.0, Channel::CurrentDirection, Err(Fault::NotAvailable));
    assert_eq!(current(&mut bench, 4.0, 9.0), Some(1.5));
    bench.ok(5.0, Channel::CurrentDirection, 1.0);
    assert_eq!(current(&mut bench, 7.0, 2.5), Some(2.5));
    assert_eq!(current(&mut bench, 7.5, 8.0), Some(2.5), "the direction is too old");
}

#[test]
fn stale_values_are_omitted_and_hole_is_unmeasured() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, SENSOR, 25.0);
    bench.ok(0.0, Channel::Current, 1.0);
    let sample = bench.ok(40.0, CELL, 3.7).expect("a sample");
    assert_eq!((sample.current_a, sample.temperature_c), (None, None));
    assert_eq!((sample.charge_as, sample.unmeasured_s), (2.0, 38.0));
    bench.ok(50.0, Channel::Current, 9.0);
    let sample = bench.ok(51.0, CELL, 3.7).expect("a sample");
    assert_eq!((sample.charge_as, sample.unmeasured_s), (2.0 + 9.0, 48.0));
}

#[test]
fn recorded_glitches_give_no_sample_and_one_report() {
    // The NASA files contain samples of 8.4 V and empty fields.
    let mut bench = Bench::new(config());
    assert!(bench.ok(0.0, CELL, 3.9).is_some());
    assert_eq!(bench.ok(1.0, CELL, 8.393), None);
    assert_eq!(bench.give(2.0, CELL, Err(Fault::NotAvailable)), None);
    assert_eq!(bench.ok(3.0, CELL, f64::NAN), None);
    assert!(bench.ok(4.0, CELL, 3.9).is_some());
    assert_eq!(bench.states(), [Err(Fault::OutOfRange), Ok(3)]);
    assert_eq!(bench.sampler.bad_share(CELL), Some(0.6));
    assert_eq!(bench.sampler.bad_share(CELL), Some(0.6));
}

#[test]
fn bad_current_is_neither_used_nor_integrated() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, Channel::Current, 1.0);
    for (time, bad) in [(0.5, Ok(500.0)), (1.0, Ok(f64::NAN)), (1.2, Err(Fault::ShortFrame))] {
        bench.give(time, Channel::Current, bad);
    }
    bench.ok(2.0, Channel::Current, 1.0);
    let sample = bench.ok(2.0, CELL, 3.7).expect("a sample");
    assert_eq!((sample.charge_as, sample.current_a), (2.0, Some(1.0)));
}

#[test]
fn jump_is_rejected_and_lasting_step_accepted() {
    let mut config = config();
    config.voltage.max_rate_per_s = Some(0.1);
    let mut bench = Bench::new(config);
    assert!(bench.ok(0.0, CELL, 3.9).is_some());
    assert!(bench.ok(1.0, CELL, 3.3).is_none(), "one jump");
    assert!(bench.ok(2.0, CELL, 3.9).is_some(), "back at the old level");
    assert!(bench.ok(3.0, CELL, 3.3).is_none());
    assert!(bench.ok(4.0, CELL, 3.31).is_none());
    assert!(bench.ok(5.0, CELL, 3.32).is_some(), "the third reading that agrees");
    assert!(bench.ok(6.0, CELL, 3.33).is_some());
    assert_eq!(bench.states(), [Err(Fault::RateTooHigh), Ok(1), Err(Fault::RateTooHigh), Ok(2)]);
}

#[test]
fn disagreeing_jumps_are_never_accepted() {
    let mut config = config();
    config.voltage.max_rate_per_s = Some(0.01);
    let mut bench = Bench::new(config);
    assert!(bench.ok(0.0, CELL, 3.9).is_some());
    for step in 1..20 {
        let value = if step % 2 == 0 { 3.0 } else { 2.5 };
        assert!(bench.ok(f64::from(step), CELL, value).is_none(), "step {step}");
    }
}

#[test]
fn readings_with_equal_time_have_finite_rate() {
    let mut config = config();
    config.voltage.max_rate_per_s = Some(10.0);
    let mut bench = Bench::new(config);
    assert!(bench.ok(0.0, CELL, 3.900).is_some());
    assert!(bench.ok(0.0, CELL, 3.905).is_some());
}

/// Simulates a current and a voltage once a second. Returns the first second with a rejected voltage.
fn first_stuck_second(current_a: f64, voltage: impl Fn(u32) -> f64) -> Option<u32> {
    let mut config = config();
    config.voltage.stuck_after_s = Some(60.0);
    let mut bench = Bench::new(config);
    (0..600).find(|&second| {
        bench.ok(f64::from(second), Channel::Current, current_a);
        bench.ok(f64::from(second), CELL, voltage(second)).is_none()
    })
}

#[test]
fn voltage_is_stuck_only_if_constant_under_discharge() {
    assert_eq!(first_stuck_second(2.0, |_| 3.7), Some(60));
    assert_eq!(first_stuck_second(0.01, |_| 3.7), None, "rest");
    assert_eq!(first_stuck_second(-2.0, |_| 4.2), None, "constant-voltage charge");
    assert_eq!(first_stuck_second(2.0, |second| 3.7 - 0.001 * f64::from(second / 50)), None, "changes every 50 s");
}

#[test]
fn stuck_signal_recovers_when_it_changes() {
    let mut config = config();
    config.voltage.stuck_after_s = Some(5.0);
    let mut bench = Bench::new(config);
    for second in 0..10 {
        bench.ok(f64::from(second), Channel::Current, 1.0);
        bench.ok(f64::from(second), CELL, 3.7);
    }
    assert!(bench.ok(10.0, CELL, 3.69).is_some());
    assert_eq!(bench.states(), [Err(Fault::Stuck), Ok(5)]);
}

#[test]
fn silent_signals_turn_stale_at_their_own_age() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, Channel::Current, 1.0);
    bench.ok(0.0, CELL, 3.7);
    let mut reported = Vec::new();
    for tenth in 0..=400 {
        let now = f64::from(tenth) / 10.0;
        bench.sampler.poll(at(now), &mut bench.changes);
        reported.extend(bench.changes.drain(..).map(|change| (now, change.channel, change.state)));
    }
    let stale = Err(Fault::Stale);
    let never_heard = Channel::CellVoltage(CellIndex(1));
    assert_eq!(
        reported,
        [(2.1, Channel::Current, stale), (5.1, CELL, stale), (5.1, never_heard, stale), (30.1, SENSOR, stale)]
    );
    assert!(bench.ok(41.0, CELL, 3.7).is_some());
    assert_eq!(bench.states(), [Ok(0)]);
    bench.changes.clear();
    bench.sampler.poll(at(46.5), &mut bench.changes);
    assert_eq!(bench.states(), [stale], "stale again");
}

#[test]
fn silence_counts_all_readings() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, CELL, 3.7);
    bench.ok(0.0, Channel::Current, 1.0);
    bench.ok(0.0, Channel::CellVoltage(CellIndex(1)), 3.7);
    bench.ok(4.0, CELL, 9.9);
    bench.ok(9.0, SENSOR, 25.0);
    bench.ok(9.0, Channel::Current, 1.0);
    let now = at(10.0);
    assert_eq!(bench.sampler.silence_s(CELL, now), Some(6.0));
    assert_eq!(bench.sampler.silence_s(Channel::CellVoltage(CellIndex(1)), now), Some(10.0));
    assert_eq!(bench.sampler.silence_s(Channel::PackVoltage, now), None);
}

#[test]
fn gap_is_not_integrated_and_ends_freshness() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, SENSOR, 25.0);
    bench.ok(0.0, Channel::Current, 3.0);
    let before = bench.ok(1.0, CELL, 3.7).expect("a sample");
    bench.sampler.handle_gap(at(1.0));
    let after = bench.ok(1.0, CELL, 4.1).expect("a sample");
    assert_eq!((after.charge_as, after.unmeasured_s), (before.charge_as, before.unmeasured_s));
    assert_eq!((after.current_a, after.temperature_c), (None, None));
}

#[test]
fn strings_share_current_and_cells_share_total_voltage() {
    let mut config = config();
    config.cells = 1;
    config.strings = 2;
    config.voltage_source = VoltageSource::PackTotal { series: 96 };
    let mut bench = Bench::new(config);
    bench.ok(0.0, Channel::Current, 8.0);
    bench.ok(1.0, Channel::Current, 8.0);
    let sample = bench.ok(1.0, Channel::PackVoltage, 96.0 * 3.5).expect("a sample");
    assert_eq!((sample.voltage_v, sample.current_a, sample.charge_as), (3.5, Some(4.0), 4.0));
    assert_eq!(bench.sampler.pack_current_a(at(1.0)), Some(8.0));
    assert_eq!(bench.sampler.counted(at(1.0)), (4.0, 0.0));
    assert!(bench.ok(2.0, Channel::PackVoltage, 900.0).is_none(), "9.4 V per cell");
}

#[test]
fn unused_readings_are_counted() {
    let mut bench = Bench::new(config());
    for channel in [Channel::PackVoltage, Channel::CellVoltage(CellIndex(2)), Channel::Temperature(SensorIndex(1))] {
        assert!(bench.ok(0.0, channel, 3.7).is_none());
    }
    assert_eq!(bench.sampler.reading_counts().unused, 3);
    assert_eq!(bench.changes, []);
}

#[test]
fn backward_time_counts_as_latest_time() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, Channel::Current, 1.0);
    bench.ok(2.0, Channel::Current, 1.0);
    let sample = bench.ok(1.0, CELL, 3.7).expect("a sample");
    assert_eq!((sample.time, sample.charge_as), (at(2.0), 2.0));
}

#[test]
fn restored_sampler_counts_downtime_as_unmeasured() {
    let mut bench = Bench::new(config());
    bench.ok(0.0, Channel::Current, 1.0);
    bench.ok(1.0, CELL, 3.7);
    let text = serde_json::to_string(&bench.sampler.snapshot()).expect("serialises");
    let mut state: SamplerState = serde_json::from_str(&text).expect("reads back");
    assert_eq!(state, bench.sampler.snapshot());
    state.rebase(1_000_000_000_000);
    let mut restored = Bench::new(config());
    restored.sampler.restore(state.clone());
    restored.ok(1100.0, Channel::Current, 1.0);
    let sample = restored.ok(1100.0, CELL, 3.7).expect("a sample");
    assert_eq!((sample.charge_as, sample.unmeasured_s), (2.0, 98.0));
    let other = Sampler::new(SampleConfig { cells: 3, ..config() });
    assert!(!other.fits(&state));
}

#[test]
fn contactor_signal_may_be_added_or_removed_on_restore() {
    let limits = config().voltage;
    let with = || SampleConfig { contactor: Some(ContactorConfig { open: vec![0.0], limits }), ..config() };
    let mut bench = Bench::new(config());
    bench.ok(0.0, Channel::Current, 1.0);
    let mut restored = Bench::new(with());
    assert!(restored.sampler.fits(&bench.sampler.snapshot()));
    restored.sampler.restore(bench.sampler.snapshot());
    restored.ok(1.0, Channel::Contactor, 0.0);
    assert!(!Sampler::new(config()).fits(&restored.sampler.snapshot()));
    let mut state = restored.sampler.snapshot();
    state.signals.pop();
    let mut without = Bench::new(config());
    without.sampler.restore(state);
    without.ok(1.5, Channel::Current, 1.0);
    let sample = without.ok(2.0, CELL, 3.7).expect("a sample");
    assert_eq!(sample.current_a, Some(1.0));
}

#[test]
fn every_channel_has_its_own_slot() {
    let mut config = config();
    config.cells = 1024;
    config.sensor_of_cell = (0..1024).map(|cell| Some(SensorIndex(cell / 12))).collect();
    let sampler = Sampler::new(config);
    let slots: Vec<_> = sampler.channels().iter().map(|&channel| sampler.slot(channel)).collect();
    assert_eq!(slots.len(), 1 + 86 + 1024);
    assert!(slots.iter().enumerate().all(|(slot, found)| *found == Some(slot)));
}

/// A random reading, usually a plausible cell voltage.
fn reading() -> impl Strategy<Value = (Channel, Result<f64, Fault>)> {
    let volts = prop_oneof![
        8 => (0_i32..30).prop_map(|step| Ok(3.6 + 0.002 * f64::from(step))),
        1 => prop::sample::select(vec![Ok(f64::NAN), Ok(1.0), Ok(9.0), Ok(4.2), Err(Fault::NotAvailable)]),
    ];
    let cell = (0_u16..4).prop_map(|cell| Channel::CellVoltage(CellIndex(cell)));
    prop_oneof![
        8 => (cell, volts),
        1 => (-5.0..8.0).prop_map(|current_a| (Channel::Current, Ok(current_a))),
        1 => (20.0..30.0).prop_map(|celsius| (SENSOR, Ok(celsius))),
        1 => Just((Channel::PackVoltage, Ok(3.7))),
    ]
}

proptest! {
    #[test]
    fn bad_signal_count_agrees_with_signals(
        readings in prop::collection::vec((reading(), 0_i32..80), 1..100),
    ) {
        let mut bench = Bench::new(config());
        let mut tenths = 0;
        for ((channel, value), step) in readings {
            tenths += step;
            bench.give(f64::from(tenths) / 10.0, channel, value);
            bench.sampler.poll(at(f64::from(tenths) / 10.0 + 0.05), &mut bench.changes);
            let bad = bench.sampler.state.signals.iter().filter(|signal| signal.is_bad()).count();
            prop_assert_eq!((bench.sampler.bad_signals, bench.sampler.any_lost()), (bad, bad > 0));
            let now = at(f64::from(tenths) / 10.0);
            let voltages = &bench.sampler.state.signals[1 + bench.sampler.sensors..][..bench.sampler.voltages];
            let fresh = voltages.iter().all(|signal| signal.fresh(now, &bench.sampler.config.voltage).is_some());
            prop_assert_eq!(bench.sampler.voltages_fresh(now), fresh);
            let mut restored = Sampler::new(config());
            restored.restore(bench.sampler.snapshot());
            restored.handle_gap(at(f64::from(tenths)));
            restored.reconfigure(&config());
            prop_assert_eq!(restored.bad_signals, bad);
        }
    }
}
