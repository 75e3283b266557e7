//! The capacity of `packwatch` beside recursive total least squares (Plett 2011) on the same swings.
//!
//! Sources of swings for the peers: `filter`, the filter's own SOC at both ends (event `half_cycle`, with its deviation; in
//! windows the same ends as below); `voltage`, both ends by inversion of the open-circuit curve (`swings`); `filter, capacity
//! held`, the filter's SOC counted throughout with the wrong capacity it was started with. The second leans on the
//! capacity in use only for the curve's change of shape.
//! Measured lives publish what 2 A delivers, not the capacity between open-circuit voltages, so each peer's capacity goes
//! through the product's own usable capacity (same resistance, same full SOC): only the capacities differ.
//! `cargo test --release --test integration capacity_peers -- --nocapture` prints the tables of tests/candidates.md.

mod least_squares;
mod measured;
mod simulated;
mod swings;
use packwatch::cell::CellModel;
use packwatch::filter::ScalarGaussian;
use packwatch::health::CapacityConfig;

use least_squares::{Method, Peer, Swing};
use swings::Weighed;

/// Peers by name: none of these memories is the best on every life, so several of each are shown.
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

/// A swing of either source, and when it began.
#[derive(Debug, Clone, Copy)]
enum Source {
    Filter(Swing),
    Voltage(Weighed),
}

/// Each peer's capacity at each time asked for, from the swings begun before it.
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
            // A swing against its charge is what a flat or wrong curve makes of one end; no method can use it.
            if swing.x > 0.0 {
                peer.take(&swing);
            }
        }
        capacities.push(peer.capacity());
    }
    capacities
}

/// Mean absolute error and share covered by the 95 % interval.
#[derive(Debug, Clone, Copy)]
struct Score {
    mean_absolute: f64,
    covered: f64,
}

/// Of (estimate, truth).
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
