//! What a battery loses over its life: half-cycles, capacity, recharge period, usable capacity.

pub mod config;
pub mod drift;
pub mod forecast;
pub mod learner;
pub mod pack;
pub mod recharge;
pub mod transition;
pub mod usable;

pub use config::{
    CapacityConfig, CapacityMethod, HealthConfig, RechargeAlarm, RechargeConfig, TransitionConfig, UsableConfig,
};
pub use forecast::{Axis, Forecast, InsufficientData, Reading, Remaining, RemainingLife, Usage};
pub use learner::{CapacityUpdate, CellEnd, HalfCycle, Learner};
pub use pack::{CellShare, PackState};
pub use recharge::{Charged, RechargeTimer};
pub use transition::{ModeChange, TransitionDetector};
