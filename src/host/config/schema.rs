//! Declares the tables and keys of the files. Every key is declared once, with meaning, type, unit, range and default.
//!
//! | file | content |
//! | --- | --- |
//! | `key` | the properties of a key, and how the value of a key is read |
//! | `setting`, `threshold` | the types of keys |
//! | `section` | declares tables |
//! | `reader` | reads the tables of a document and reports unknown keys |
//! | `keys` | every key |
//! | `tables` | every table of the file |

mod key;
pub(crate) mod keys;
mod reader;
mod section;
mod setting;
mod tables;
mod threshold;

pub(crate) use key::{Key, Presence, Setting, TableReader, ValueFault, ValueRange, in_range, typed, within};
pub(crate) use reader::{SchemaReader, did_you_mean, nearest};
pub(crate) use section::{Section, SectionInfo, section, table_field};
pub(crate) use tables::{RawTables, SECTIONS};
pub(crate) use threshold::{Level, Threshold};
