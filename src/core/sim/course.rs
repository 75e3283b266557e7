//! The course of the current: what the scenario asks of the pack next, from the pack's true state.
//!
//! Each course is asked once per current sample and answers with the current that flows until the next one.

mod cycle;
mod drive;
mod walk;

use super::noise::{Noise, Stream};
use super::scenario::{Scenario, Settings};
use super::truth::Pack;
use cycle::CycleCourse;
use drive::DayCourse;
use walk::WalkCourse;

/// What happens next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Demand {
    /// This cell current flows until the next sample, A, positive = discharge.
    Current(f64),
    /// The vehicle sleeps: no current, nobody measures.
    Asleep {
        /// For how long, s.
        duration_s: f64,
    },
    /// The scenario is over.
    Finished,
}

/// The course of one scenario.
#[derive(Debug, Clone)]
pub(crate) enum Course {
    Cycle(CycleCourse),
    Walk(WalkCourse),
    Day(DayCourse),
}

impl Course {
    pub(crate) fn new(settings: &Settings) -> Self {
        let noise = Noise::new(settings.seed, Stream::Course);
        let scale = settings.pack.capacity_ah / settings.scenario.nominal_ah();
        match settings.scenario {
            Scenario::Paper => Self::Cycle(CycleCourse::paper(settings, scale)),
            Scenario::Reference => Self::Cycle(CycleCourse::reference(settings, scale, noise)),
            Scenario::RandomWalk => Self::Walk(WalkCourse::new(settings, scale, noise)),
            Scenario::EvDay => Self::Day(DayCourse::new(settings.pack.capacity_ah, noise)),
        }
    }

    /// The demand for the next `dt_s` seconds. Tells the pack when a cycle is complete.
    pub(crate) fn next(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        match self {
            Self::Cycle(course) => course.next(pack, dt_s),
            Self::Walk(course) => course.next(pack, dt_s),
            Self::Day(course) => course.next(pack, dt_s),
        }
    }
}
