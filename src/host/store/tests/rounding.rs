//! Tests estimates after a power cut. The estimates are restored from a state file with rounded numbers; the clocks
//! give the age of the state.

use nalgebra::DMatrix;
use serde_json::Value;

use super::*;

/// Writes the state to a file and reads it back.
fn from_the_disk(state: &StateDocument) -> StateDocument {
    let place = tempfile::tempdir().unwrap();
    StateFiles::open(place.path()).0.write(state.clone()).unwrap();
    stored(place.path())
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// Compares the means and the covariance of one filter before and after the state was stored.
fn compare(before: (&Value, &Value), after: (&Value, &Value), what: &str) {
    let [mean, kept_mean] = [before.0, after.0].map(numbers);
    let [covariance, kept] = [before.1, after.1].map(|rows| {
        let flat: Vec<f64> = match rows.pointer("/0/0") {
            Some(_) => rows.as_array().unwrap().iter().flat_map(numbers).collect(),
            None => numbers(rows),
        };
        DMatrix::from_row_slice(mean.len(), mean.len(), &flat)
    });
    for i in 0..mean.len() {
        let std = covariance[(i, i)].sqrt();
        assert!((mean[i] - kept_mean[i]).abs() <= 1e-3 * std, "{what}: mean {i} {} {} of {std}", mean[i], kept_mean[i]);
        for j in 0..mean.len() {
            let room = 1e-6 * std * covariance[(j, j)].sqrt();
            assert!((covariance[(i, j)] - kept[(i, j)]).abs() <= room, "{what}: covariance {i} {j}");
        }
    }
    assert_eq!(kept, kept.transpose(), "{what}");
    // The smallest eigenvalue shows how close the covariance is to a matrix that cannot be factorised. Quantities that
    // are configured not to be learned have no variance and are left out.
    let varied: Vec<usize> = (0..mean.len()).filter(|&i| covariance[(i, i)] > 0.0).collect();
    let scaled = DMatrix::from_fn(varied.len(), varied.len(), |a, b| {
        let (i, j) = (varied[a], varied[b]);
        kept[(i, j)] / (kept[(i, i)] * kept[(j, j)]).sqrt()
    });
    let least = scaled.clone().symmetric_eigenvalues().min();
    assert!(scaled.cholesky().is_some() && least > 1e-5, "{what}: least eigenvalue {least}");
}

#[test]
fn means_and_covariances_survive_power_cut() {
    let taken = |seconds: i64, boottime_s: i64| {
        let snapshot = Box::new(snapshot(Some(seconds), None));
        StateDocument { snapshot, ..document(1, boottime_s, 1_800_000_000 + boottime_s) }
    };
    let now = document(2, 20, 1_800_010_000).stamp;
    for seconds in [660, 1500, 3000, 3660, 5000, 7000] {
        let late = taken(seconds, seconds);
        let back = from_the_disk(&late);
        assert_eq!(back.stamp, late.stamp);
        let [before, after] = [&late, &back].map(|document| serde_json::to_value(&document.snapshot).unwrap());
        let filter = |state: &Value| state["cells"][0]["estimator"].clone();
        let drift = |state: &Value| state["learning"]["learner"]["drift"][0].clone();
        let [a, b] = [filter(&before), filter(&after)];
        compare((&a["mean"], &a["covariance"]), (&b["mean"], &b["covariance"]), &format!("filter at {seconds} s"));
        let [a, b] = [drift(&before), drift(&after)];
        compare((&a["x"], &a["p"]), (&b["x"], &b["p"]), &format!("capacity at {seconds} s"));
        // The state is restored with the age from the clocks.
        let age_s = (10_000 - seconds) as f64;
        let downtime = back.stamp.age(&now, WallClock::Reliable);
        assert_eq!(downtime, Downtime::Seconds(age_s));
        let mut monitor = Monitor::new(config().monitor);
        monitor.restore(*back.snapshot, downtime).unwrap();
        let time = late.snapshot.time.plus_secs(age_s);
        monitor.handle(&Record::tick(time), &mut Outputs::default());
        assert_eq!(monitor.statistics().filter_resets, late_resets(&before));
    }
}

fn late_resets(state: &Value) -> u64 {
    state["statistics"]["filter_resets"].as_u64().unwrap()
}
