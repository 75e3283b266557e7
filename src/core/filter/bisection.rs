//! Bisection: finds where a predicate changes from true to false.
//!
//! In: an interval in any unit, and the predicate. Out: the sub-interval in which the predicate changes. For a
//! predicate that is never true, the sub-interval lies at the lower end. For a predicate that is always true, it lies
//! at the upper end.

/// Value at which `is_below` changes from true to false. The error is at most 2^-41 of the interval's width.
pub fn crossing(ends: (f64, f64), is_below: impl Fn(f64) -> bool) -> f64 {
    let (low, high) = bisect(ends, 40, is_below);
    0.5 * (low + high)
}

/// Halves the interval `halvings` times. Keeps the half in which `is_below` changes from true to false.
pub fn bisect(ends: (f64, f64), halvings: u32, is_below: impl Fn(f64) -> bool) -> (f64, f64) {
    (0..halvings).fold(ends, |(low, high), _| {
        let middle = 0.5 * (low + high);
        if is_below(middle) { (middle, high) } else { (low, middle) }
    })
}
