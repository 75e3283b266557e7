//! Continuation between runs: restores a monitor from a snapshot or a history, and applies a new configuration.

mod reconfigure;
mod relearn;
mod restore;
