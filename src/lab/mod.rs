//! Offline work on measured files: reading them, fitting, scoring against truth, remaining useful life, Gaussian
//! processes, plots.

pub(crate) mod chart;
pub mod fit;
pub(crate) mod fleet;
pub mod gpr;
pub mod measured;
pub mod report;
pub mod rul;
pub mod score;
