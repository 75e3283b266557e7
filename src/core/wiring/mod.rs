//! Commissioning: finds probable faults in the wiring or the configuration of a pack on a bus.
//!
//! In: a [`Plan`] (the readable parts of the configuration), every frame of every interface with its time, interface
//! events, and the estimates of a [`Monitor`](crate::monitor::Monitor) if the configuration allows one. Out: a
//! [`WiringReport`] with findings (each with evidence, reason and the line to change), checks that passed, and checks
//! that were not possible. The observer decodes by itself and without the limits on readings, so it also works with a
//! configuration that no estimator can run with. Its memory is bounded however long it listens.
//!
//! | file | purpose |
//! | --- | --- |
//! | `plan` | expected interfaces, messages and signals |
//! | [`evidence`] | evidence about signals from values, names and bits; `discover` also scores its candidates with it |
//! | `other_current` | the current's message on another interface |
//! | `observer` | [`WiringObserver`]: collects frames, events and estimates |
//! | `judge` | turns everything received into a [`WiringReport`] |
//! | `report` | findings with their evidence, and the lines to change |
//!
//! A finding is an error (estimates will be wrong or missing), a warning (to be checked) or a note. A quantity that
//! hardly moves is not judged: the report says what to do so that it can be.

pub mod evidence;
mod judge;
mod observer;
mod other_current;
mod plan;
mod report;

pub use observer::WiringObserver;
pub use plan::{AnswerSource, InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};
pub use report::{Change, Severity, Topic, WiringFinding, WiringReport};
