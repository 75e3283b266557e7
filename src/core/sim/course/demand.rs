//! What a course demands: a current until the next sample, sleep, or the end.

/// Next demand of a scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// This cell current flows until the next sample, A, positive = discharge.
    Current(f64),
    /// The vehicle sleeps: no current, no measurements.
    Asleep {
        duration_s: f64,
    },
    Finished,
}
