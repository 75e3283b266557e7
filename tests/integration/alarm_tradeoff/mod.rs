//! Compares two kinds of alarm rules on simulated lives. With `when = "mean"`, the alarm is raised if the estimated
//! mean is beyond the threshold. With `when = { probability = p }`, it is raised if the true value is beyond the
//! threshold with at least the probability p. Reports the lead time (from the alarm to the end of life) and the false
//! alarms.
//!
//! Each life simulates a cell with its own fade and sensors with their own errors. The simulated frames run through the
//! whole Monitor. Every rule then evaluates the Monitor's capacity estimates. The Monitor itself also has three of the
//! rules configured, and must raise their alarms at the same half-cycles.
//!
//! A test run simulates a few lives. The whole study has 200 ageing and 100 healthy lives, each with three sensor sets.
//! It takes some minutes and writes `tests/alarm_tradeoff.md`:
//! `PACKWATCH_WRITE_TRADEOFF=1 cargo test --workspace --test integration alarm_tradeoff -- --nocapture`

mod calibration;
mod dice;
mod judged;
mod life;
mod report;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use judged::{CANDIDATES, HALF, MEAN, MONITORED, P95, judge};
use life::{Kind, Life, SENSOR_SETS, SensorSet};

/// Ageing lives per sensor set in the whole study.
const LIVES: usize = 200;
/// Healthy lives per sensor set in the whole study.
const HEALTHY: usize = 100;
/// The n-th ageing life has the seed `AGEING_SEED + n`, the n-th healthy life has `HEALTHY_SEED + n`.
const AGEING_SEED: u64 = 1_000;
const HEALTHY_SEED: u64 = 5_000;
/// Numbers of ageing and healthy lives in an ordinary test run.
const QUICK: (usize, usize) = (6, 3);

const WRITE: &str = "PACKWATCH_WRITE_TRADEOFF";

struct Fleet {
    set: &'static SensorSet,
    ageing: Vec<Life>,
    healthy: Vec<Life>,
}

impl Fleet {
    fn live(set: &'static SensorSet, ageing: usize, healthy: usize) -> Self {
        let config = life::configuration(set);
        let lives = in_parallel(ageing + healthy, |n| match n.checked_sub(ageing) {
            None => life::live(&config, set, Kind::Ageing, AGEING_SEED + n as u64),
            Some(n) => life::live(&config, set, Kind::Healthy, HEALTHY_SEED + n as u64),
        });
        let healthy = lives[ageing..].to_vec();
        Self { set, ageing: lives[..ageing].to_vec(), healthy }
    }

    fn all(&self) -> impl Iterator<Item = &Life> {
        self.ageing.iter().chain(&self.healthy)
    }

    fn check(&self) {
        assert!(
            self.ageing.iter().all(|life| life.crossing.is_some() && life.end.is_some()),
            "every ageing cell crosses the threshold and reaches its end"
        );
        assert!(self.healthy.iter().all(|life| life.crossing.is_none()), "a healthy cell crossed the threshold");
        for life in self.all() {
            for (severity, rule) in MONITORED.into_iter().enumerate() {
                let reported: Vec<_> =
                    life.evaluations.iter().map(|evaluation| evaluation.reported[severity]).collect();
                assert_eq!(
                    reported,
                    judged::changes(&CANDIDATES[rule], life),
                    "the Monitor's own rule {}",
                    CANDIDATES[rule].name
                );
            }
            let firsts =
                CANDIDATES.map(|rule| judge(&rule, life).first.map_or(f64::INFINITY, |evaluation| evaluation.cycle));
            assert_eq!(firsts[HALF], firsts[MEAN], "p = 0.5 must equal the mean rule");
            let by_level: Vec<f64> =
                firsts.iter().zip(&CANDIDATES).filter(|(_, rule)| rule.debounce_events == 1).map(|(f, _)| *f).collect();
            assert!(by_level.is_sorted(), "a higher probability was reached earlier: {by_level:?}");
        }
    }
}

/// Runs `work(0..count)` on all processors. Returns the results in order.
fn in_parallel<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let (next, done) = (AtomicUsize::new(0), Mutex::new(Vec::with_capacity(count)));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..threads.min(count) {
            scope.spawn(|| {
                loop {
                    let n = next.fetch_add(1, Ordering::Relaxed);
                    if n >= count {
                        break;
                    }
                    let result = work(n);
                    done.lock().expect("no thread panics while it holds this lock").push((n, result));
                }
            });
        }
    });
    let mut done = done.into_inner().expect("no thread panics while it holds this lock");
    done.sort_by_key(|(n, _)| *n);
    done.into_iter().map(|(_, result)| result).collect()
}

#[test]
fn higher_probability_raises_later_with_fewer_false_alarms() {
    let fleet = Fleet::live(&SENSOR_SETS[1], QUICK.0, QUICK.1);
    fleet.check();
    let early = |rule: usize| fleet.ageing.iter().filter(|life| judge(&CANDIDATES[rule], life).is_false(0.0)).count();
    let (eager, sure) = (early(0), early(P95));
    println!("{}", report::rules_table(&fleet));
    assert!(eager > sure, "early raises: {eager} at p = 0.05, {sure} at p = 0.95");
    for life in &fleet.ageing {
        assert!(judge(&CANDIDATES[MEAN], life).in_time(life).is_some(), "the mean rule misses a life");
    }
    for life in &fleet.healthy {
        assert!(judge(&CANDIDATES[P95], life).first.is_none(), "p = 0.95 raises for a healthy cell");
    }
}

#[test]
fn whole_study_is_written_on_request() {
    if std::env::var_os(WRITE).is_none() {
        println!("skipped: {WRITE} is not set");
        return;
    }
    let fleets: Vec<Fleet> = SENSOR_SETS.iter().map(|set| Fleet::live(set, LIVES, HEALTHY)).collect();
    let text = report::document(&fleets);
    println!("{text}");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/alarm_tradeoff.md");
    std::fs::write(&path, text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    fleets.iter().for_each(Fleet::check);
}
