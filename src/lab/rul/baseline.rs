//! Computes baselines for comparison with forecasts of remaining life: a straight line through the last points, and a
//! least-squares double exponential.
//!
//! Input: points of [use, capacity]; use is counted in cycles or days. Output: the use at which the curve first falls
//! below the threshold.

const STEPS: u32 = 20_000;
/// First step of the search, and the step below which the search ends. Exponents have the unit 1 / (use at the last
/// point).
const SEARCH: (f64, f64) = (0.5, 1e-4);
/// Largest magnitude of an exponent, 1 / (use at the last point).
const STEEPEST: f64 = 50.0;

/// Returns where the least-squares line through the last points meets the threshold; `None` = the line does not fall.
pub(super) fn straight(points: &[[f64; 2]], threshold: f64) -> Option<f64> {
    // The line is fitted to the last 30 % of the points, but to at least five.
    let wanted = ((0.3 * points.len() as f64) as usize).max(5);
    let last = &points[points.len().saturating_sub(wanted)..];
    let count = last.len() as f64;
    let [used, capacity] = [0, 1].map(|axis| last.iter().map(|point| point[axis]).sum::<f64>() / count);
    let (mut square, mut product) = (0.0, 0.0);
    for point in last {
        square += (point[0] - used) * (point[0] - used);
        product += (point[0] - used) * (point[1] - capacity);
    }
    let slope = product / square;
    (slope < 0.0).then(|| used + (threshold - capacity) / slope)
}

/// Fits C = a e^(b t) + c e^(d t) and returns the use at which C falls below the threshold. The exponents b and d are
/// searched; the factors a and c follow from a linear fit.
pub(super) fn double_exponential(points: &[[f64; 2]], threshold: f64) -> Option<f64> {
    let scale = points.last()?[0];
    if points.len() < 4 || scale <= 0.0 {
        return None;
    }
    let fit = |exponents: [f64; 2]| linear(points, scale, exponents);
    // Pairs of exponents (b, d) at which searches start. The best result counts.
    let found =
        [[-0.1, 0.5], [-0.2, -2.0], [-0.05, 3.0], [-0.5, 0.05]].into_iter().filter_map(|start| search(start, &fit));
    let (_, [a, c], [b, d]) = found.min_by(|x, y| x.0.total_cmp(&y.0))?;
    let capacity = |used: f64| a * (b * used / scale).exp() + c * (d * used / scale).exp();
    // The curve is searched from 1 to 20 times the use so far.
    let step = 19.0 * scale / f64::from(STEPS);
    (0..=STEPS).map(|index| scale + step * f64::from(index)).find(|&used| capacity(used) < threshold)
}

/// Sum of squared errors, factors `[a, c]`, exponents `[b, d]`.
type ExponentialFit = (f64, [f64; 2], [f64; 2]);

/// Runs a pattern search: moves to the best neighbour and doubles the step, or halves the step if no neighbour is
/// better.
fn search(start: [f64; 2], fit: &dyn Fn([f64; 2]) -> Option<ExponentialFit>) -> Option<ExponentialFit> {
    let neighbours: [[f64; 2]; 8] =
        [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]];
    let (mut best, mut step) = (fit(start)?, SEARCH.0);
    // The limit of 400 iterations stops searches that move slowly along a flat valley.
    for _ in 0..400 {
        if step < SEARCH.1 {
            break;
        }
        let around = neighbours.iter().map(|n| [0, 1].map(|i| (best.2[i] + step * n[i]).clamp(-STEEPEST, STEEPEST)));
        match around.filter_map(fit).min_by(|x, y| x.0.total_cmp(&y.0)) {
            Some(better) if better.0 < best.0 => (best, step) = (better, 2.0 * step),
            _ => step *= 0.5,
        }
    }
    Some(best)
}

/// Returns the best factors for these exponents; `None` = the two exponentials cannot be separated.
fn linear(points: &[[f64; 2]], scale: f64, exponents: [f64; 2]) -> Option<ExponentialFit> {
    let at = |used: f64| exponents.map(|exponent| (exponent * used / scale).exp());
    let (mut xx, mut xy, mut yy, mut xc, mut yc) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for &[used, capacity] in points {
        let [x, y] = at(used);
        xx += x * x;
        xy += x * y;
        yy += y * y;
        xc += x * capacity;
        yc += y * capacity;
    }
    let determinant = xx * yy - xy * xy;
    // If the determinant is this small, both exponentials nearly coincide. The comparison also rejects NaN.
    if !matches!(determinant.partial_cmp(&(1e-12 * xx * yy)), Some(std::cmp::Ordering::Greater)) {
        return None;
    }
    let factors = [(xc * yy - yc * xy) / determinant, (yc * xx - xc * xy) / determinant];
    let squares = points.iter().map(|&[used, capacity]| {
        let [x, y] = at(used);
        let error = capacity - factors[0] * x - factors[1] * y;
        error * error
    });
    Some((squares.sum(), factors, exponents))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_uses_only_the_last_points() {
        let points: Vec<[f64; 2]> =
            (0..20).map(f64::from).map(|t| [t, if t < 10.0 { 9.0 } else { 4.0 - 0.1 * t }]).collect();
        assert!((straight(&points, 1.0).expect("falls") - 30.0).abs() < 1e-9);
        assert_eq!(straight(&[[0.0, 1.0], [1.0, 1.0]], 0.5), None);
    }

    #[test]
    fn double_exponential_is_recovered() {
        let capacity = |t: f64| 2.0 * (-0.003 * t).exp() - 0.01 * (0.02 * t).exp();
        let points: Vec<[f64; 2]> = (0..140).map(f64::from).map(|t| [t, capacity(t)]).collect();
        let crossing = double_exponential(&points, 1.0).expect("falls");
        assert!((capacity(crossing) - 1.0).abs() < 0.02, "{crossing} {}", capacity(crossing));
    }

    #[test]
    fn curve_that_levels_off_never_reaches_the_threshold() {
        let points: Vec<[f64; 2]> = (0..100).map(f64::from).map(|t| [t, 1.5 + 0.5 * (-0.1 * t).exp()]).collect();
        assert_eq!(double_exponential(&points, 1.0), None);
    }
}
