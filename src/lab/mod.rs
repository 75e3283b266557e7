//! Offline work on measured files: reading them, fitting, scoring against truth, plots.

pub mod fit;
pub mod measured;
pub(crate) mod plot;
pub mod score;
