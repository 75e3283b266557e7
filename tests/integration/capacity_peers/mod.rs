//! Compares packwatch's capacity with the estimates of other methods, the peers, from the same swings. The peers are
//! recursive least-squares methods (Plett 2011).
//!
//! A swing is a change of SOC and the charge that caused it. The peers get swings from three sources:
//!
//! - `filter`: the SOC of packwatch's filter at both ends of a half-cycle, with its standard deviation, from the event
//!   `half_cycle`. If only a random part (window) of each record is replayed, the swings have the ends of the swings of
//!   `voltage`.
//! - `voltage`: the SOC at both ends from the inverted open-circuit curve (`swings`). The peer's present capacity
//!   estimate is used only to compute how ageing changes the shape of the curve.
//! - `filter, capacity held`: like `filter`, but the filter keeps a wrong initial capacity and does not learn it.
//!   Only the simulated lives are computed with it.
//!
//! The published capacity of a measured cell is the charge delivered at 2 A, not the capacity between open-circuit
//! voltages. Each peer's capacity is therefore converted with packwatch's calculation of the usable capacity. The
//! conversion uses the same resistance and the same SOC of a full cell for all peers, so that only the capacities
//! differ.
//!
//! `tests/peers/run --only capacity` runs the comparisons, which take minutes, and prints the tables of
//! tests/candidates.md. `tests/all` only tests the peers themselves.

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

/// A peer's capacity at each of the times `times_s`. Each capacity comes from the swings that began before its time.
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
