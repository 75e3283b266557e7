//! Determines the course of the current: a scenario's next demand, given the pack's true state.

mod cycle;
mod demand;
mod drive;
mod walk;

use super::noise::{Noise, Stream};
use super::scenario::{Scenario, Settings};
use super::truth::Pack;
use cycle::CycleCourse;
pub(super) use demand::Demand;
use drive::DayCourse;
use walk::WalkCourse;

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

    /// The demand for the next `dt_s` seconds. At the end of a cycle, applies the ageing per cycle to the pack.
    pub(crate) fn next(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        match self {
            Self::Cycle(course) => course.next(pack, dt_s),
            Self::Walk(course) => course.next(pack, dt_s),
            Self::Day(course) => course.next(pack, dt_s),
        }
    }
}
