//! Offline work on measured files: reading them, fitting, scoring against truth, remaining useful life, plots.

pub mod fit;
pub(crate) mod fleet;
pub mod measured;
pub(crate) mod plot;
pub mod rul;
pub mod score;
