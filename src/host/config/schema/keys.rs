//! Declares every key of the configuration file once, with meaning, type, unit, range and default.
//!
//! A declaration determines how a key is read and checked. It also gives the text of the key in fault messages ("must
//! be"), in the reference page (`docs/src/reference/keys.md`) and in the manual page. If a table `gives` the parameters
//! of an algorithm, its declaration also builds these parameters. [`config`](super::super) explains how to add a key.

mod algorithms;
mod choices;
mod input;
mod limits;
mod pack;
mod traffic;

pub(crate) use algorithms::{Capacity, Estimator, Outlook, Recharge, Transition, Usable};
pub(crate) use choices::{E2eKey, MethodKey, PositiveCurrent, SourceAddress, WireOrder};
pub(crate) use input::{
    AnswerSignalKeys, BalancingInput, CellVoltageInput, ContactorInput, CurrentInput, CurrentSign, DiagnosticInput,
    Input, PackIdentityInput, PackVoltageInput, ProtectedInput, ReportedSocInput, ReportedSohInput, SignalSource,
    SupplyVoltageInput, TemperatureInput,
};
pub(crate) use limits::{CurrentLimits, TemperatureLimits, VoltageLimits};
pub(crate) use pack::{Alarm, Interface, Pack, PackModule, Store, Vehicle};
pub(crate) use traffic::{
    Authentication, Commands, FrameKeys, J1939, Output, OutputAlarm, OutputDigest, OutputFreshness, OutputHealth,
    OutputReply, OutputStatus, Poll,
};
