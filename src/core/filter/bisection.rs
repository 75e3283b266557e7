//! Bisection: finds where a predicate changes from true to false.
//!
//! In: an interval in any unit, and the predicate. Out: the last interval that holds the change: at the lower end if the predicate
//! is never true, at the upper end if it always is.

/// Where `is_below` changes from true to false, to 2^-40 of the interval `ends`.
pub fn crossing(ends: (f64, f64), is_below: impl Fn(f64) -> bool) -> f64 {
    let (low, high) = bisect(ends, 40, is_below);
    0.5 * (low + high)
}

/// Halves the interval `ends` `halvings` times towards the change of `is_below` from true to false.
pub fn bisect(ends: (f64, f64), halvings: u32, is_below: impl Fn(f64) -> bool) -> (f64, f64) {
    (0..halvings).fold(ends, |(low, high), _| {
        let middle = 0.5 * (low + high);
        if is_below(middle) { (middle, high) } else { (low, middle) }
    })
}
