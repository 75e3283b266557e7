//! Helpers shared by several test modules.

pub(crate) mod config_texts;
pub(crate) mod dice;
pub(crate) mod measured;
pub(crate) mod oracle;
pub(crate) mod rig;
pub(crate) mod simulated_cell;
pub(crate) mod window;
