//! Offline work on measured files: reading them, fitting, scoring against truth, plots.

pub(crate) mod chart;
pub mod fit;
pub mod measured;
pub mod report;
pub mod score;
