//! Commissioning: finds probable faults in the wiring or the configuration of a pack on a bus.
//!
//! In: a [`Plan`] (the readable parts of the configuration), every frame of every interface with its time, and
//! interface events. If the configuration allows a [`Monitor`](crate::monitor::Monitor), also its estimates. Out: a
//! [`WiringReport`] with findings (each with evidence, reason and the line to change), checks that passed, and checks
//! that were not possible. The observer has its own decoder, which accepts readings of any size. The observer therefore
//! also works with a configuration that the estimator cannot use. Its memory use is bounded.
//!
//! | file | purpose |
//! | --- | --- |
//! | `plan` | expected interfaces, messages and signals |
//! | [`evidence`] | evidence about signals from values, names and bits; also used by `discover` |
//! | `other_current` | statistics of the message with the pack current on other interfaces, if the message also arrives there |
//! | `observer` | [`WiringObserver`]: collects frames, events and estimates |
//! | `judge` | turns everything received into a [`WiringReport`] |
//! | `report` | findings with their evidence, and the lines to change |
//!
//! A finding is an error (estimates will be wrong or missing), a warning (the user should check it) or a note. If a
//! quantity hardly changes, the report does not judge it and says what to do before the next check.

pub mod evidence;
mod judge;
mod observer;
mod other_current;
mod plan;
mod report;

pub use observer::WiringObserver;
pub use plan::{AnswerSource, InterfacePlan, MessagePlan, OutputPlan, PackPlan, Plan, SignalPlan};
pub use report::{Change, Severity, Topic, WiringFinding, WiringReport};
