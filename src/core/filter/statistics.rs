//! Statistics of plain numbers.

/// Median of the finite values (the upper of the two middle ones); `None` if there is no finite value.
pub fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    // One allocation: `collect` of a filtered iterator starts small and grows.
    let mut finite = Vec::with_capacity(values.size_hint().1.unwrap_or_default());
    finite.extend(values.filter(|value| value.is_finite()));
    let middle = finite.len() / 2;
    if finite.is_empty() {
        return None;
    }
    Some(*finite.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Least and largest of the values; infinity and minus infinity without one.
pub fn ends(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
}

/// Probability that a standard normal value is below.
pub fn normal_cdf(value: f64) -> f64 {
    probability_below(value, 1.0)
}

/// Probability that a normal value of mean 0 and standard deviation `std` is below `value`.
pub fn probability_below(value: f64, std: f64) -> f64 {
    0.5 * libm::erfc(-value / (std * std::f64::consts::SQRT_2))
}

/// Bell curve of height and width 1: correlation of two places that are `distance` apart, in lengths over which a quantity changes.
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
