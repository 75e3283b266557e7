//! Reads the files of a configuration: parses and merges their texts, and keeps the positions of keys and the list of
//! faults.
//!
//! | file | content |
//! | --- | --- |
//! | `faults` | the list of faults and their positions |
//! | `source` | the file and its drop-ins |
//! | `merge` | parses and merges the texts |
//! | `text` | writes the merged tables as one TOML text |

mod faults;
mod merge;
mod source;
mod text;

pub use faults::ConfigFaults;
pub(crate) use faults::{Faults, SourceLine, TablePlace};
pub(crate) use merge::Document;
pub use source::{ConfigFiles, ReadFile};
pub(crate) use source::{Sources, beside, meant_file, read_file};
pub use text::{merged, merged_with};
