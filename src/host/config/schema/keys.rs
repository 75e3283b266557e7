//! Every key of the configuration file, declared once with meaning, type, unit, range and default.
//!
//! These declarations drive the reading, every fault's "must be", the reference page (`docs/src/reference/keys.md`), the
//! manual page and, in a table that `gives` the parameters of an algorithm, those parameters. How to add a key: see
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
