//! Reads, merges and checks the TOML configuration. All faults are reported at once, each with file, line, key, found
//! value and allowed values.
//!
//! In: the configuration file, its drop-ins (files that change single keys of it), and the DBC files and cell models
//! that these files name. Out: [`Config`], which contains consistent settings for the other modules, or
//! [`ConfigFaults`], which contains one line per fault. In this module, to "report" a fault means to add it to the list
//! of faults and to continue.
//!
//! The module has six layers. Each layer uses only the layers listed above it. No layer uses this file.
//!
//! | layer | content |
//! | --- | --- |
//! | `document` | the files: drop-ins, merged tables, positions of keys, faults |
//! | `schema` | the tables as written; every key, declared once |
//! | [`cell_model`] | cell model files, declared the same way |
//! | `checks` | looks up signals, checks keys against each other, makes the settings of the core |
//! | `result` | the checked configuration and the steps that produce it |
//! | `description` | the configuration and its keys in words |
//!
//! # How to add a key
//! 1. In `schema/keys`, add a line to the table's `section!`: doc comment, name, type, unit, range, presence. If the
//!    declaration of the table says that it `gives` the parameters of an algorithm, the key sets the parameter of the
//!    same name. To set a parameter of another name, or to compute its value, write `=> field: value` on the same line.
//! 2. Add the field to the algorithm's parameters.
//! 3. Run `packwatch check --reference > docs/src/reference/keys.md`. A test fails if this page is out of date.
//!
//! The declaration determines how the key is read, its default, its range, its fault messages, and its text in the
//! reference and the manual page. A check that involves several keys belongs in `checks/cross`. A new table also needs
//! a line in `schema/tables`.

pub mod cell_model;
mod checks;
mod description;
mod document;
mod result;
mod schema;

pub use cell_model::{of_label, of_view};
pub(crate) use checks::{Databases, NamedSignal, Pattern, ResolvedSignal, answers, channel_words, input_map, label_of};
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
