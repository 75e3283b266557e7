//! Tests the detection of a second sender with simulated senders: steady, jittering, faster, slower, doubled.

use super::*;

const BUS: BusIndex = BusIndex(0);
const ID: CanId = CanId::Standard(0x100);

/// Simulates senders with period (ms), start and end (s), and jitter (fraction of the period).
fn run(rates: &mut SecondSenders, senders: &[(f64, f64, f64, f64)]) -> Vec<(f64, bool)> {
    let mut times: Vec<(i64, usize)> = Vec::new();
    let mut noise = 0x2545_F491_u64;
    for (number, &(period_ms, from_s, to_s, jitter)) in senders.iter().enumerate() {
        let mut at_ms = from_s * 1000.0 + 0.37 * period_ms;
        while at_ms < to_s * 1000.0 {
            noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let late = jitter * period_ms * ((noise >> 33) as f64 / f64::from(1_u32 << 31));
            times.push((((at_ms + late) * 1e6) as i64, number));
            at_ms += period_ms;
        }
    }
    times.sort_unstable();
    let mut found = Vec::new();
    for (nanos, number) in times {
        let now = Timestamp::from_nanos(nanos);
        rates.handle(now, BUS, ID);
        rates.note_current(BUS, ID, if number == 0 { 10.0 } else { -90.0 }, 2.0);
        rates.poll(now);
        found.extend(rates.changes.drain(..).map(|change| (now.secs(), change.active)));
    }
    found
}

fn watched(cycle_s: Option<f64>) -> SecondSenders {
    SecondSenders::new([(BUS, ID, cycle_s)])
}

#[test]
fn second_sender_is_found_within_five_seconds() {
    for (first_ms, second_ms) in [(10.0, 1.0), (100.0, 1.0), (100.0, 10.0), (100.0, 100.0), (10.0, 10.0), (20.0, 30.0)]
    {
        let found = run(&mut watched(None), &[(first_ms, 0.0, 120.0, 0.05), (second_ms, 60.0, 90.0, 0.05)]);
        let [(begun_s, true), (ended_s, false)] = found[..] else { panic!("{first_ms} {second_ms}: {found:?}") };
        assert!(begun_s > 60.0 && begun_s < 65.0, "{first_ms} {second_ms}: {begun_s}");
        assert!(ended_s > 90.0 && ended_s < 103.0, "{first_ms} {second_ms}: {ended_s}");
    }
}

#[test]
fn known_cycle_time_finds_second_sender_at_start() {
    let found = run(&mut watched(Some(0.1)), &[(100.0, 0.0, 20.0, 0.0), (5.0, 2.0, 20.0, 0.0)]);
    assert!(matches!(found[..], [(at_s, true)] if at_s < 7.0), "{found:?}");
}

#[test]
fn jitter_or_new_cycle_is_not_second_sender() {
    for jitter in [0.0, 0.3] {
        let waking = [(100.0, 0.0, 60.0, jitter), (10.0, 60.0, 120.0, jitter)];
        let mut rates = watched(None);
        // A single sender changes its period.
        let mut found = Vec::new();
        for (period_ms, from_s, to_s, jitter) in waking {
            found.extend(run(&mut rates, &[(period_ms, from_s, to_s, jitter)]));
        }
        assert_eq!(found, [], "{jitter}");
        assert_eq!(run(&mut watched(Some(0.01)), &[(10.0, 0.0, 60.0, jitter)]), []);
        assert_eq!(run(&mut watched(Some(0.1)), &[(10.0, 0.0, 60.0, jitter)]), [], "a wrong DBC");
    }
}

#[test]
fn stored_rate_finds_second_sender_after_restart() {
    let mut before = watched(None);
    assert_eq!(run(&mut before, &[(100.0, 0.0, 60.0, 0.05)]), []);
    let mut after = watched(None);
    after.restore(&before.snapshot());
    after.restart();
    let found = run(&mut after, &[(100.0, 100.0, 120.0, 0.05), (10.0, 100.0, 120.0, 0.05)]);
    assert!(matches!(found[..], [(at_s, true)] if at_s < 105.0), "{found:?}");
}
