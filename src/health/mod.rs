//! What a battery loses over its life: half-cycles, capacity, recharge period, usable capacity.
pub mod config;
pub use config::{CapacityConfig, CapacityMethod, HealthConfig, RechargeConfig, TransitionConfig, UsableConfig};
