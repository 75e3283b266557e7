//! Linear interpolation between breakpoints in rising order. At least two breakpoints are required.

/// Returns the interval that contains `x`, and the position of `x` in it: 0 at the lower breakpoint, 1 at the upper.
/// For `x` outside the breakpoints, returns the nearest interval and a position below 0 or above 1.
pub fn locate(breakpoints: &[f64], x: f64) -> (usize, f64) {
    let last = breakpoints.len() - 2;
    let i = breakpoints[1..=last].iter().take_while(|&&b| x >= b).count();
    (i, (x - breakpoints[i]) / (breakpoints[i + 1] - breakpoints[i]))
}

/// Like [`locate`], but the position is limited to 0 to 1.
pub fn locate_clamped(breakpoints: &[f64], x: f64) -> (usize, f64) {
    let (i, along) = locate(breakpoints, x);
    (i, along.clamp(0.0, 1.0))
}

/// Value at the position `along` (0 to 1) in the interval `i`.
#[inline]
pub fn between(y: &[f64], i: usize, along: f64) -> f64 {
    y[i] + along * (y[i + 1] - y[i])
}

/// Interpolates linearly between the points (`x`, `y`). Outside the breakpoints, returns the value at the nearest
/// breakpoint.
pub fn interpolate(x: &[f64], y: &[f64], at: f64) -> f64 {
    let (i, along) = locate_clamped(x, at);
    between(y, i, along)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolation_is_linear_and_constant_outside() {
        let (x, y) = ([0.0, 1.0, 3.0], [10.0, 20.0, 0.0]);
        let found = [-1.0, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0].map(|at| interpolate(&x, &y, at));
        assert_eq!(found, [10.0, 10.0, 15.0, 20.0, 10.0, 0.0, 0.0]);
        assert_eq!((locate(&x, -1.0), locate(&x, 5.0)), ((0, -1.0), (1, 2.0)));
    }
}
