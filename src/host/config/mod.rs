//! The TOML configuration: as written, then checked; every fault at once, with file, line, key, found and allowed.
//!
//! In: the configuration file, its drop-ins and the files they name (DBC files, cell model). Out: [`Config`], the settings of the other
//! modules, which cannot be wrong; or [`ConfigFaults`], a line per fault.
//!
//! Six layers; each uses only those above it in this table, and nothing uses this file but the rest of the program.
//!
//! | layer | content |
//! | --- | --- |
//! | `document` | the files: drop-ins, merged tables, places of keys, faults |
//! | `schema` | the tables as they are written; every key, declared once |
//! | [`cell_model`] | cell model files, by the same mechanism |
//! | `checks` | what was written to what is meant: signals looked up, what must fit together, settings of the core |
//! | `result` | the checked configuration and the steps that make it |
//! | `description` | the configuration and its keys in words |
//!
//! # How a key is added
//! 1. In `schema/keys`, a line in the table's `section!`: doc comment, name, type, unit, range, presence. In a table that `gives`
//!    the parameters of an algorithm it fills the field of the same name; another field, or one that needs other values,
//!    stands behind `=>` on the same line.
//! 2. In the algorithm, that field.
//! 3. `packwatch check --reference > docs/src/reference/keys.md`; a test compares the two.
//!
//! Reading, default, range check, fault texts, reference and manual page follow from the line. A check that concerns
//! several keys goes into `checks/cross`. A new table needs a line in `schema/tables` too.

pub mod cell_model;
mod checks;
mod description;
mod document;
mod result;
mod schema;

pub use cell_model::{of_label, of_view};
pub(crate) use checks::{Databases, NamedSignal, Pattern, ResolvedSignal, answers, channel_words, input_map};
pub use description::{
    Description, InterfaceUse, OutputUse, SignalUse, command_words, describe, describe_with, manual, reference,
};
pub(crate) use document::TablePlace;
pub use document::{ConfigFaults, ConfigFiles, ReadFile, merged, merged_with};
pub(crate) use result::PartialConfig;
pub use result::{Config, InterfaceConfig, KeySource, StoreConfig, VehicleIdentity, load, load_with};
pub(crate) use schema::RawTables;
pub(crate) use schema::keys::SignalSource;

#[cfg(test)]
mod tests;
