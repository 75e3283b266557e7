//! Commissioning: what is probably wrong with the wiring or the configuration of a pack on a bus.
//!
//! In: a [`Plan`] (the configuration, as far as it can be read), every frame of every interface with its time, interface
//! events, and the estimates of a [`Monitor`](crate::monitor::Monitor) if the configuration allows one. Out: a [`WiringReport`]
//! of findings, each with the evidence, the reason and the line to change; of what is in order; and of what could not be
//! judged. A configuration with which no estimator can run is no obstacle: the observer decodes by itself, without the
//! limits on readings. Its memory is bounded however long it listens.
//!
//! | file | purpose |
//! | --- | --- |
//! | `plan` | what is expected |
//! | [`evidence`] | what values, names and bits say about signals; `discover` scores its candidates with it |
//! | `other_current` | the current's message on another interface |
//! | `observer` | [`WiringObserver`]: takes frames |
//! | `judge` | turns everything received into a [`WiringReport`] |
//! | `report` | findings with their evidence, and the lines to change |
//!
//! A finding is an error (estimates will be wrong or missing), a warning (check it) or a note. A quantity that hardly
//! moves is not judged: the report lists it with what to do.

pub mod evidence;
mod judge;
mod observer;
mod other_current;
mod plan;
mod report;

pub use observer::WiringObserver;
pub use plan::{AnswerSource, InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};
pub use report::{Change, Severity, Topic, WiringFinding, WiringReport};
