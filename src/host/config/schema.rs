//! The tables of the files as they are written: every key once, with its meaning, type, unit, range and default.
//!
//! | file | content |
//! | --- | --- |
//! | `key` | what a key has, how its value is read |
//! | `setting`, `threshold` | types a key may have |
//! | `section` | what a declared table gives |
//! | `reader` | the tables of a document, unknown keys |
//! | `keys` | every key, declared once |
//! | `tables` | every table of the file |

mod key;
pub(crate) mod keys;
mod reader;
mod section;
mod setting;
mod tables;
mod threshold;

pub(crate) use key::{Key, Presence, Setting, TableReader, ValueFault, ValueRange, in_range, typed, within};
pub(crate) use reader::{SchemaReader, did_you_mean};
pub(crate) use section::{Section, SectionInfo, section, table_field};
pub(crate) use tables::{RawTables, SECTIONS};
pub(crate) use threshold::{Level, Threshold};
