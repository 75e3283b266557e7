//! The stages of the data path. Each stage has its configuration, its state and its methods, and does not depend on
//! later stages.

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
