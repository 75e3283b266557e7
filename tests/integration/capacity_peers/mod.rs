//! Compares packwatch's capacity with recursive total least squares (Plett 2011) on the same swings.
//!
//! A swing is a change of SOC and the charge that caused it. The peers get swings from three sources:
//!
//! - `filter`: the filter's SOC at both ends, with its standard deviation, from the event `half_cycle`. In windows (a
//!   random part of each record), the ends are the same as for `voltage`.
//! - `voltage`: the SOC at both ends from the inverted open-circuit curve (`swings`). The peer's present capacity
//!   estimate is used only to compute how ageing changes the shape of the curve.
//! - `filter, capacity held`: the filter's SOC, counted with the wrong initial capacity.
//!
//! The published capacity of a measured cell is the charge delivered at 2 A, not the capacity between open-circuit
//! voltages. packwatch's calculation of the usable capacity therefore converts each peer's capacity. It uses the same
//! resistance and the same full SOC for all peers, so that only the capacities differ.
//!
//! `cargo test --workspace --test integration capacity_peers -- --nocapture` prints the tables of tests/candidates.md.

mod least_squares;
mod measured;
mod simulated;
mod swings;
use packwatch::cell::CellModel;
use packwatch::filter::ScalarGaussian;
use packwatch::health::CapacityConfig;

use least_squares::{Method, Peer, Swing};
use swings::VoltageSwing;

/// The peers: name, method and memory factor. No memory factor is best for every life, so each method has several.
const PEERS: [(&str, Method, f64); 11] = [
    ("WLS   gamma 0.95", Method::Wls, 0.95),
    ("WLS   gamma 0.50", Method::Wls, 0.5),
    ("WLS   gamma 0.20", Method::Wls, 0.2),
    ("TLS   gamma 0.95", Method::Tls, 0.95),
    ("TLS   gamma 0.50", Method::Tls, 0.5),
    ("TLS   gamma 0.20", Method::Tls, 0.2),
    ("AWTLS gamma 0.99", Method::Awtls, 0.99),
    ("AWTLS gamma 0.95", Method::Awtls, 0.95),
    ("AWTLS gamma 0.80", Method::Awtls, 0.8),
    ("AWTLS gamma 0.50", Method::Awtls, 0.5),
    ("AWTLS gamma 0.20", Method::Awtls, 0.2),
];

#[derive(Debug, Clone, Copy)]
enum Source {
    Filter(Swing),
    Voltage(VoltageSwing),
}

/// A peer's capacity at each of `times_s`, from the swings that began before that time.
fn follow(
    model: &CellModel,
    config: &CapacityConfig,
    (method, gamma): (Method, f64),
    start: ScalarGaussian,
    swings: &[(f64, Source)],
    times_s: impl Iterator<Item = f64>,
) -> Vec<ScalarGaussian> {
    let mut peer = Peer::new(method, gamma, start);
    let mut swings = swings.iter().peekable();
    let mut capacities = Vec::new();
    for time_s in times_s {
        while let Some((_, source)) = swings.next_if(|(begun_s, _)| *begun_s < time_s) {
            let swing = match source {
                Source::Filter(swing) => *swing,
                Source::Voltage(weighed) => weighed.swing(model, config, peer.capacity().mean),
            };
            // A flat or wrong curve can give a swing with the wrong sign. No method can use such a swing.
            if swing.x > 0.0 {
                peer.take(&swing);
            }
        }
        capacities.push(peer.capacity());
    }
    capacities
}

/// Mean absolute error, and share of the true values that lie in the 95 % interval.
#[derive(Debug, Clone, Copy)]
struct Score {
    mean_absolute: f64,
    covered: f64,
}

fn score(pairs: impl Iterator<Item = (ScalarGaussian, f64)>) -> Score {
    let (mut count, mut sum, mut covered) = (0.0, 0.0, 0.0);
    for (belief, truth) in pairs {
        let error = (belief.mean - truth).abs();
        count += 1.0;
        sum += error;
        covered += f64::from(u8::from(error < 1.96 * belief.std()));
    }
    Score { mean_absolute: sum / count, covered: covered / count }
}
