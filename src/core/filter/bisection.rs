//! Bisection: where a yes turns into a no.
//!
//! In: an interval in any unit, and the question. Out: the last interval that holds the place. A question that is never
//! answered by yes gives the lower end; one that always is, the upper.

/// Halves the interval `ends` again and again towards the place where `is_below` turns false; the nearest end if it never
/// does.
pub fn bisect(ends: (f64, f64), halvings: u32, is_below: impl Fn(f64) -> bool) -> (f64, f64) {
    (0..halvings).fold(ends, |(low, high), _| {
        let middle = 0.5 * (low + high);
        if is_below(middle) { (middle, high) } else { (low, middle) }
    })
}
