//! Tests two properties of the whole core. A restored monitor behaves as if it had never stopped. Ticks before the time
//! that `next_due` returns have no effect, so the caller may omit them. The inputs are the cell of `config/paper.toml`,
//! and a pack of 96 cells whose voltages come in many frames. Outputs are compared bit for bit.

use std::path::Path;

use packwatch::can::encode::InputEncoder;
use packwatch::config;
use packwatch::monitor::{
    Downtime, EventKind, Monitor, MonitorConfig, Outputs, Record, RecordKind, Snapshot, TICK_PERIOD_MS,
};
use packwatch::quantity::Timestamp;
use packwatch::sim::{Scenario, Settings, Simulation, Wiring};

fn load(file: &str) -> MonitorConfig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(file);
    config::load(&path).unwrap_or_else(|faults| panic!("{}", faults.0.join("\n"))).monitor
}

/// The cell of `paper.toml` for two and a half cycles. The first half-cycle crosses the alarm threshold.
fn paper() -> (MonitorConfig, Vec<Record>) {
    let mut config = load("paper.toml");
    config.rules[0].threshold = 2.6;
    let settings = Settings { duration_s: Some(20_000.0), ..Settings::of(Scenario::Paper, 2.6) };
    let records = stream(&config, settings, Wiring::single());
    (config, records)
}

/// A drive of 96 cells: 20 minutes, one sample per second.
fn pack() -> (MonitorConfig, Vec<Record>) {
    let config = load("example.toml");
    let capacity_ah = config.model.capacity_ah;
    let settings = Settings {
        duration_s: Some(1200.0),
        current_period_ns: 100_000_000,
        cell_period_ns: 1_000_000_000,
        ..Settings::of(Scenario::EvDay, capacity_ah)
    };
    let strings = config.sample.strings;
    let sensors = config.sample.sensor_of_cell.iter().flatten().map(|s| s.index() + 1).max().unwrap_or(0);
    let wiring = Wiring { strings, temperature_at: vec![None; sensors] };
    let records = stream(&config, settings, wiring);
    (config, records)
}

/// The simulator's frames and all ticks. Simultaneous frames are spread over a few milliseconds, as on a bus.
fn stream(config: &MonitorConfig, settings: Settings, wiring: Wiring) -> Vec<Record> {
    let mut sim = Simulation::new(config.model.clone(), settings, wiring);
    let encoder = InputEncoder::new(&config.input);
    let period_ns = i64::from(TICK_PERIOD_MS) * 1_000_000;
    let (mut records, mut frames, mut next_tick) = (Vec::new(), Vec::new(), 0);
    while let Some(moment) = sim.advance() {
        frames.clear();
        encoder.encode(sim.readings(), &mut frames);
        for (nth, (bus, frame)) in (0..).zip(&frames) {
            let time = moment.time.plus_nanos(nth * 230_000);
            while next_tick < time.nanos() {
                records.push(Record::tick(Timestamp::from_nanos(next_tick)));
                next_tick += period_ns;
            }
            records.push(Record::frame(time, *bus, frame));
        }
    }
    records
}

/// Frames, events and estimates for one input, as text.
fn outputs(monitor: &mut Monitor, record: &Record, out: &mut Outputs) -> [String; 3] {
    out.clear();
    monitor.handle(record, out);
    let text = |empty: bool, text: &dyn Fn() -> String| if empty { String::new() } else { text() };
    [
        text(out.estimates.is_empty(), &|| format!("{:?}", out.estimates)),
        text(out.events.is_empty(), &|| format!("{:?}", out.events)),
        text(out.frames.is_empty(), &|| format!("{:?}", out.frames)),
    ]
}

fn outputs_with_estimates() -> Outputs {
    Outputs { want_estimates: true, ..Outputs::default() }
}

fn draws(seed: u64, limit: usize) -> impl Iterator<Item = usize> {
    let mut state = seed;
    std::iter::repeat_with(move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        usize::try_from(state % limit as u64).expect("below limit")
    })
}

const WHAT: [&str; 3] = ["estimates", "events", "frames"];

/// Compares an uninterrupted monitor with monitors restored at `splits`. Returns a line for the first difference of
/// each kind.
fn differences(config: &MonitorConfig, records: &[Record], splits: &[usize], away: Downtime) -> Vec<String> {
    let mut found = Vec::new();
    for &split in splits {
        let (mut whole, mut out) = (Monitor::new(config.clone()), outputs_with_estimates());
        for record in &records[..split] {
            out.clear();
            whole.handle(record, &mut out);
        }
        let text = serde_json::to_string(&whole.snapshot()).expect("a snapshot serialises to JSON");
        let snapshot: Snapshot = serde_json::from_str(&text).expect("reads back");
        let mut restored = Monitor::new(config.clone());
        restored.restore(snapshot, away).expect("fits");
        let mut reported = [false; 3];
        for (nth, record) in (0..).zip(&records[split..]) {
            let expected = outputs(&mut whole, record, &mut out);
            let got = outputs(&mut restored, record, &mut out);
            for kind in 0..3 {
                if expected[kind] != got[kind] && !reported[kind] {
                    reported[kind] = true;
                    found.push(format!(
                        "split {split} (t = {} s), {} differ {nth} inputs later at {} s\n  whole    {:.300}\n  restored {:.300}",
                        records[split - 1].time.secs(), WHAT[kind], record.time.secs(), expected[kind], got[kind],
                    ));
                }
            }
        }
        if whole.alarms().snapshot() != restored.alarms().snapshot() {
            found.push(format!("split {split}: alarm states differ at the end"));
        }
        if whole.pack() != restored.pack()
            || whole.recharge_period_s() != restored.recharge_period_s()
            || whole.normalised_recharge_period() != restored.normalised_recharge_period()
        {
            found.push(format!("split {split}: the pack's values or a recharge period differ at the end"));
        }
    }
    found
}

/// Random splits. If `same_stamp`, each split lies between two inputs of equal time, so that no time passes.
fn splits(records: &[Record], count: usize, same_stamp: bool) -> Vec<usize> {
    draws(0x9E37_79B9_7F4A_7C15, records.len() - 2)
        .map(|k| k + 1)
        .filter(|&k| !same_stamp || records[k].time == records[k - 1].time)
        .take(count)
        .collect()
}

fn assert_same(found: &[String]) {
    assert!(found.is_empty(), "{} differences\n{}", found.len(), found.join("\n"));
}

/// If `frames`, returns only the differences of frames, otherwise only the other differences. Frames also depend on the
/// transmission schedule.
fn results(found: Vec<String>, frames: bool) -> Vec<String> {
    found.into_iter().filter(|line| line.contains("frames differ") == frames).collect()
}

#[test]
fn restored_cell_estimates_match_uninterrupted_run() {
    let (config, records) = paper();
    assert_same(&results(differences(&config, &records, &splits(&records, 6, false), Downtime::AsStamped), false));
}

#[test]
fn cell_restored_at_once_matches_uninterrupted_run() {
    let (config, records) = paper();
    assert_same(&results(differences(&config, &records, &splits(&records, 3, true), Downtime::Seconds(0.0)), false));
}

#[test]
fn restored_cell_learns_from_ended_mode() {
    let (config, records) = paper();
    let (mut monitor, mut out) = (Monitor::new(config.clone()), Outputs::default());
    let reported = records.iter().position(|record| {
        out.clear();
        monitor.handle(record, &mut out);
        out.events.iter().any(|event| matches!(event.kind, EventKind::HalfCycle { .. }))
    });
    let split = reported.expect("a half-cycle");
    assert_same(&results(differences(&config, &records, &[split], Downtime::AsStamped), false));
}

#[test]
fn restored_pack_estimates_match_uninterrupted_run() {
    let (config, records) = pack();
    assert_same(&results(differences(&config, &records, &splits(&records, 4, false), Downtime::AsStamped), false));
}

#[test]
fn restored_cell_frames_match_uninterrupted_run() {
    let (config, records) = paper();
    let mut found = differences(&config, &records, &splits(&records, 3, false), Downtime::AsStamped);
    found.extend(differences(&config, &records, &splits(&records, 2, true), Downtime::Seconds(0.0)));
    assert_same(&results(found, true));
}

#[test]
fn restored_pack_frames_match_uninterrupted_run() {
    let (config, records) = pack();
    assert_same(&results(differences(&config, &records, &splits(&records, 4, false), Downtime::AsStamped), true));
}

/// Compares a run without reload with a run that reloads its configuration at every split. The reloads alternate
/// between the configuration changed by `edit` and the original configuration. Returns a line for the first difference
/// of each kind, except for the event that reports the reload.
fn reload_differences(
    config: &MonitorConfig,
    records: &[Record],
    splits: &[usize],
    edit: impl Fn(&mut MonitorConfig),
) -> Vec<String> {
    let (mut whole, mut reloaded) = (Monitor::new(config.clone()), Monitor::new(config.clone()));
    let (mut out_whole, mut out_reloaded) = (outputs_with_estimates(), outputs_with_estimates());
    let (mut found, mut reported, mut is_edited) = (Vec::new(), [false; 3], false);
    for (nth, record) in records.iter().enumerate() {
        if splits.contains(&nth) {
            let mut other = config.clone();
            is_edited = !is_edited;
            if is_edited {
                edit(&mut other);
            }
            let done =
                reloaded.reconfigure(other, record.time, &mut out_reloaded).expect("the configuration is accepted");
            assert_eq!(done.alarms_ended, 0);
        }
        let expected = outputs(&mut whole, record, &mut out_whole);
        let got = outputs(&mut reloaded, record, &mut out_reloaded);
        for kind in 0..3 {
            if expected[kind] != got[kind] && !reported[kind] {
                reported[kind] = true;
                let (what, at_s) = (WHAT[kind], record.time.secs());
                found.push(format!("{what} differ at {at_s} s\n  {:.300}\n  {:.300}", expected[kind], got[kind]));
            }
        }
    }
    let end = |monitor: &Monitor| serde_json::to_value(monitor.snapshot()).expect("a document");
    if end(&whole) != end(&reloaded) {
        found.push("the states at the end differ".to_owned());
    }
    found
}

#[test]
fn reload_of_same_configuration_changes_nothing() {
    for (config, records) in [paper(), pack()] {
        assert_same(&reload_differences(&config, &records, &splits(&records, 20, false), |_| {}));
    }
}

#[test]
fn reload_of_thresholds_changes_no_estimate() {
    for (config, records) in [paper(), pack()] {
        let found = reload_differences(&config, &records, &splits(&records, 20, false), |config| {
            config.rules.iter_mut().for_each(|rule| rule.threshold = rule.clear);
            config.flood.max_frames_per_s = config.flood.max_frames_per_s.saturating_add(2000);
            config.output.as_mut().expect("sends").status_period_s *= 10.0;
        });
        assert!(found.iter().any(|line| line.starts_with("frames")), "the edit must change the frames");
        assert_same(&found.into_iter().filter(|line| line.starts_with("estimates")).collect::<Vec<_>>());
    }
}

/// Compares a run with all ticks and a run with only the ticks at `next_due`. Frames and events must be equal, in
/// order.
fn assert_early_ticks_have_no_effect(config: &MonitorConfig, records: &[Record]) {
    let (mut all, mut few) = (Monitor::new(config.clone()), Monitor::new(config.clone()));
    let (mut out_all, mut out_few) = (outputs_with_estimates(), outputs_with_estimates());
    let (mut given, mut skipped) = (0_u32, 0_u32);
    for (nth, record) in (0..).zip(records) {
        let expected = outputs(&mut all, record, &mut out_all);
        let cares = few.next_due().is_none_or(|due| record.time >= due);
        if record.kind == RecordKind::Tick && !cares {
            skipped += 1;
            assert_eq!(expected, [const { String::new() }; 3], "input {nth}: a tick that was not due had an effect");
            continue;
        }
        given += 1;
        let got = outputs(&mut few, record, &mut out_few);
        assert_eq!(expected, got, "input {nth} at {} s", record.time.secs());
    }
    assert!(skipped > given, "the test must omit most ticks, omitted {skipped} of {}", skipped + given);
}

#[test]
fn early_ticks_have_no_effect_on_cell() {
    let (config, records) = paper();
    assert_early_ticks_have_no_effect(&config, &records);
}

#[test]
fn early_ticks_have_no_effect_on_pack() {
    let (config, records) = pack();
    assert_early_ticks_have_no_effect(&config, &records);
}

fn edited(edit: impl Fn(f64, Record) -> Option<Record>) -> (MonitorConfig, Vec<Record>) {
    let (config, records) = paper();
    let records = records.into_iter().filter_map(|record| edit(record.time.secs(), record)).collect();
    (config, records)
}

#[test]
fn early_ticks_have_no_effect_on_silent_sensor() {
    let silent = |time_s: f64| (3000.0..3120.0).contains(&time_s);
    let (config, records) = edited(|time_s, record| {
        (!(silent(time_s) && matches!(record.kind, RecordKind::Frame { .. }))).then_some(record)
    });
    assert_early_ticks_have_no_effect(&config, &records);
}

#[test]
fn early_ticks_have_no_effect_over_sleep() {
    // The sleep starts between two due ticks, so one of the runs omits the last tick before the sleep.
    let (config, records) = edited(|time_s, record| (!(5000.035..8600.0).contains(&time_s)).then_some(record));
    assert_early_ticks_have_no_effect(&config, &records);
}

#[test]
fn early_ticks_have_no_effect_on_clock_step() {
    let (config, records) = edited(|time_s, record| {
        let back_s = if time_s >= 12_000.0 { -20.0 } else { 0.0 };
        Some(Record { time: record.time.plus_secs(back_s), ..record })
    });
    assert_early_ticks_have_no_effect(&config, &records);
}
