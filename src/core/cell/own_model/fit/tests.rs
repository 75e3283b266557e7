//! Tests `moments`: the mean and variance of the capacity. The probability density at a point of the capacity grid is
//! proportional to exp(-cost).

use super::*;

#[test]
fn parabola_gives_moments_of_gaussian() {
    let cost = |k: f64| 0.5 * (k - 4.3) * (k - 4.3) / 1.44;
    let costs: Vec<f64> = (0..11).map(|k| cost(f64::from(k))).collect();
    let least = costs.iter().copied().fold(f64::MAX, f64::min);
    let (mean, variance) = moments(&costs, least);
    assert!((mean - 4.3).abs() < 0.02 && (variance - 1.44).abs() < 0.05, "{mean} {variance}");
}
