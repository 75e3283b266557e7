//! Every key of the configuration file: meaning, type, unit, range and default, once.
//!
//! From these lines come the reading, every fault's "must be", the reference page (`docs/src/reference/keys.md`), the manual page
//! and, in a table that `gives` the parameters of an algorithm, those parameters. How a key is added: see
//! [`config`](super::super).

mod algorithms;
mod choices;
mod input;
mod limits;
mod pack;
mod traffic;

pub(crate) use algorithms::{Capacity, Estimator, Recharge, Transition, Usable};
pub(crate) use choices::{E2eKey, MethodKey, PositiveCurrent, WireOrder};
pub(crate) use input::{
    AnswerSignalKeys, BalancingInput, CellVoltageInput, ContactorInput, CurrentInput, DiagnosticInput, Input,
    PackIdentityInput, PackVoltageInput, ProtectedInput, ReportedSocInput, ReportedSohInput, SignalSource,
    SupplyVoltageInput, TemperatureInput,
};
pub(crate) use limits::{CurrentLimits, TemperatureLimits, VoltageLimits};
pub(crate) use pack::{Alarm, Interface, Pack, PackModule, Store, Vehicle};
pub(crate) use traffic::{
    Authentication, Commands, FrameKeys, J1939, Output, OutputAlarm, OutputDigest, OutputFreshness, OutputHealth,
    OutputReply, OutputStatus, Poll,
};
