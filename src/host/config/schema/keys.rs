//! Declares every key of the configuration file once, with meaning, type, unit, range and default.
//! [`config`](super::super) explains how to add a key.

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
