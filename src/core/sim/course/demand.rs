//! Defines the demand of a simulated scenario: a current, a sleep, or the end.

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// This cell current (A) flows until the next sample; positive = discharge.
    Current(f64),
    /// The vehicle sleeps, without current and measurements.
    Asleep {
        duration_s: f64,
    },
    Finished,
}
