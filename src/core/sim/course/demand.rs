//! Defines what a simulated scenario demands next: a current until the next sample, a sleep of the vehicle, or the end
//! of the scenario.

/// What a scenario demands next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// This cell current (A) flows until the next sample; positive = discharge.
    Current(f64),
    /// The vehicle sleeps: no current, no measurements.
    Asleep {
        duration_s: f64,
    },
    Finished,
}
