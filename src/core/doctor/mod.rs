//! Commissioning: what is probably wrong with the wiring or the configuration of a pack on a bus.
//!
//! In: a [`Plan`] (what the configuration says, as far as it can be read), every frame of every interface with its time,
//! interface events, and the estimates of a [`Monitor`](crate::monitor::Monitor) where the configuration lets one run.
//! Out: a [`Report`] of findings, each with what was seen, why that points to its cause, and the line to change; of what
//! was fine; and of what could not be judged. Works with a configuration so wrong that no estimator can run: it decodes
//! by itself, without the limits a reading must keep, and remembers a bounded amount however long it listens.
//!
//! | file | what |
//! | --- | --- |
//! | `plan` | what is expected |
//! | `series` | one signal: counts, periods, extent, roughness, and the same bits read otherwise |
//! | `link` | how the voltages follow the current: steps, steady runs, rests |
//! | `watch` | [`Doctor`]: takes frames |
//! | `judge` | everything seen to a [`Report`] |
//!
//! A finding is an error (estimates will be wrong or missing) or a warning (look at it); a note is neither. What hardly
//! moves is not judged: it is told as such, with what to do for it.

mod judge;
mod link;
mod plan;
mod report;
mod series;
mod watch;

pub use plan::{Ages, InterfacePlan, MessagePlan, OutputPlan, Plan, SignalPlan};
pub use report::{Change, Finding, Report, Severity, Topic};
pub use watch::Doctor;
