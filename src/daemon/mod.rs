//! The loops round the core: the live service and the replay of records.

pub mod replay;
