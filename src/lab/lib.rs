//! Offline work on measured files: fit of cell models, scores against truth, remaining useful life, Gaussian
//! processes, reports and plots.

pub use packwatch_core::{alarm, can, cell, filter, health, monitor, quantity, sample, sim};
pub use packwatch_host::{config, io, replay, status, store};
pub use packwatch_regress as regress;

pub mod chart;
mod fields;
pub mod fit;
pub mod fleet;
pub mod gpr;
pub mod ident;
pub mod measured;
pub mod report;
pub mod rul;
pub mod score;
