//! Commissioning: what is probably wrong with the wiring or the configuration of a pack on a bus.
//!
//! In: a [`Plan`] (the configuration, as far as it can be read), every frame of every interface with its time, interface
//! events, and the estimates of a [`Monitor`](crate::monitor::Monitor) if the configuration allows one. Out: a [`Report`]
//! of findings, each with the evidence, the reason and the line to change; of what is in order; and of what could not be
//! judged. A configuration with which no estimator can run is no obstacle: the doctor decodes by itself, without the
//! limits on readings. Its memory is bounded however long it listens.
//!
//! | file | purpose |
//! | --- | --- |
//! | `plan` | what is expected |
//! | `series` | one signal: counts, periods, extent, roughness, and the same bits read with another layout |
//! | `loss` | frames missing from a cyclic signal |
//! | `equal_cells` | cells that always have the same voltage |
//! | `other_current` | the current's message on another interface |
//! | `response` | how the voltages follow the current: steps, steady runs, rests |
//! | `watch` | [`Doctor`]: takes frames |
//! | `judge` | turns everything received into a [`Report`] |
//!
//! A finding is an error (estimates will be wrong or missing), a warning (check it) or a note. A quantity that hardly
//! moves is not judged: the report lists it with what to do.

mod equal_cells;
mod judge;
mod loss;
mod other_current;
mod plan;
mod report;
mod response;
mod series;
mod watch;

pub use plan::{AnswerSource, InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};
pub use report::{Change, Finding, Report, Severity, Topic};
pub use watch::Doctor;
