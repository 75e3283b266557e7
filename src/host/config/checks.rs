//! Converts the parsed tables to settings: looks up signals in the DBC files, and checks keys that depend on each
//! other.
//!
//! | file | content |
//! | --- | --- |
//! | `pattern`, `answers`, `signals` | look up signals in the DBC files and diagnostic answers |
//! | `cross`, `alarm`, `cells` | keys that depend on each other, and the cell models |
//! | `input_tables` | checks that work even on faulty tables |
//! | `plausible` | values that are allowed but implausible |
//! | `protect`, `output`, `commands`, `j1939`, `polling` | frames that are checked, sent or requested |
//! | `monitor` | the settings of the core |

mod alarm;
mod answers;
pub(crate) mod cells;
mod commands;
pub(crate) mod cross;
pub(crate) mod input_tables;
mod j1939;
pub(crate) mod monitor;
mod output;
mod pattern;
pub(crate) mod plausible;
mod polling;
pub(crate) mod protect;
pub(crate) mod signals;

pub(crate) use cells::label as label_of;
pub(crate) use pattern::Pattern;
pub(crate) use polling::answers;
pub(crate) use signals::{Databases, NamedSignal, ResolvedSignal, channel_words, input_map, ranges};
