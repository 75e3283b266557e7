//! Statistics of plain numbers.

/// Median of the finite values, of an even number the upper one; `None` without one.
pub fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut finite: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    let middle = finite.len() / 2;
    if finite.is_empty() {
        return None;
    }
    Some(*finite.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Probability that a standard normal value is below.
pub fn normal_cdf(value: f64) -> f64 {
    0.5 * libm::erfc(-value / std::f64::consts::SQRT_2)
}
