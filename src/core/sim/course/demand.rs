//! Defines the next demand of a course: a current that flows until the next sample, a time asleep, or the end of the
//! course.

/// Next demand of a scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// This cell current flows until the next sample (A), positive = discharge.
    Current(f64),
    /// The vehicle sleeps: no current, no measurements.
    Asleep {
        duration_s: f64,
    },
    Finished,
}
