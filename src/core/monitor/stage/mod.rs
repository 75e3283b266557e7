//! The stages: each has its configuration, its state and its own verbs; none knows which stage comes before or after it.

pub(crate) mod alarming;
pub(crate) mod estimation;
pub(crate) mod findings;
pub(crate) mod intake;
pub(crate) mod learning;
pub(crate) mod modelling;
pub(crate) mod publisher;
pub(crate) mod sampling;
pub(crate) mod sending;
pub(crate) mod sleep;
pub(crate) mod statistics;
