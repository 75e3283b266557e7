//! Describes a configuration and its keys in words, for `packwatch check`, the reference page and the manual page.

mod describe;
mod manual;
mod reference;
mod traffic;

pub use describe::{Description, InterfaceUse, SignalUse, describe, describe_with};
pub use manual::manual;
pub use reference::reference;
pub use traffic::{OutputUse, command_words};
