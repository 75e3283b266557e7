//! Battery ageing: half-cycles, capacity, recharge period, usable capacity, remaining life.
//!
//! In: currents (A), samples and estimates of the cells. Out: one [`HalfCycle`] and one [`CapacityUpdate`] per cell and
//! half-cycle, values of the pack, recharge periods (s), usable capacity (Ah), [`Forecast`]s and the [`UseRecord`].
//! Stored states are checked before they are used. A half-cycle without an estimated SOC gives no capacity.

pub mod config;
pub mod drift;
mod end_errors;
pub mod forecast;
mod half_cycle;
pub mod learner;
pub mod offset;
pub mod outlook;
pub mod pack;
pub mod recharge;
mod span;
pub mod transition;
pub mod usable;
pub mod use_record;

pub use config::{
    CapacityConfig, CapacityMethod, HealthConfig, RechargeAlarm, RechargeConfig, TransitionConfig, UsableConfig,
};
pub use forecast::{Axis, CapacityReading, Forecast, InsufficientData, Remaining, RemainingLife, Usage};
pub use half_cycle::HalfCycle;
pub use learner::{CapacityUpdate, Learner, Lesson};
pub use outlook::{OutlookConfig, RecentLoad};
pub use pack::{CellShare, PackState};
pub use recharge::{ChargeRecord, RechargeTimer};
pub use transition::{ModeChange, TransitionDetector};
pub use use_record::{UseCounter, UseLimits, UseRecord, UseSample};
