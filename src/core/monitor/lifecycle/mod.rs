//! From one run to the next: how a monitor continues from a snapshot or from a history, and how it takes another configuration.

mod reconfigure;
mod relearn;
mod restore;
