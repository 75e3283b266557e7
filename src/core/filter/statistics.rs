//! Median, range and normal distribution, for numbers in any unit.

/// Median of the finite values. If there are two middle values, the upper one is returned. `None` if no value is
/// finite.
pub fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    // Allocate once, because collecting a filtered iterator would grow a small buffer repeatedly.
    let mut finite = Vec::with_capacity(values.size_hint().1.unwrap_or_default());
    finite.extend(values.filter(|value| value.is_finite()));
    let middle = finite.len() / 2;
    if finite.is_empty() {
        return None;
    }
    Some(*finite.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Minimum and maximum; infinity and minus infinity without values.
pub fn ends(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
}

/// Probability that a standard normal variable is below `value`.
pub fn normal_cdf(value: f64) -> f64 {
    probability_below(value, 1.0)
}

/// Probability that a normal variable with mean 0 and standard deviation `std` is below `value`.
pub fn probability_below(value: f64, std: f64) -> f64 {
    0.5 * libm::erfc(-value / (std * std::f64::consts::SQRT_2))
}

/// exp(-distance^2 / 2): correlation of a quantity between two points; `distance` in correlation lengths.
pub fn bell(distance: f64) -> f64 {
    libm::exp(-0.5 * distance * distance)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_distribution_has_the_usual_quantiles() {
        for (deviations, probability) in [(0.0, 0.5), (1.644_854, 0.95), (-1.959_964, 0.025)] {
            assert!((probability_below(3.0 * deviations, 3.0) - probability).abs() < 1e-6, "{deviations}");
            assert!((normal_cdf(deviations) - probability).abs() < 1e-6, "{deviations}");
        }
    }
}
