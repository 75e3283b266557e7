//! Cell model files: TOML to a checked [`CellModel`](crate::cell::CellModel), with every fault at once.
//!
//! A model is refused unless breakpoints rise strictly, SOC runs from 0 to 1, the open-circuit voltage rises
//! strictly with SOC at every temperature, tables have no hole, and resistances, capacitances and capacities
//! are positive.
//!
//! | file | content |
//! | --- | --- |
//! | `keys` | every key of the file |
//! | `read` | the file read and checked |
//! | `source` | where a model comes from |
//! | `label` | the model of a label, and what was learned from it |
//! | `write` | a model as a file |
//! | `library` | the files in the usual folders |

mod keys;
mod label;
pub mod library;
mod read;
mod source;
mod write;

pub(crate) use keys::SECTIONS;
pub use label::{of_label, of_view};
pub(crate) use read::load_with;
pub use read::{load, load_sourced};
pub use source::{KnownBy, LearnedFrom, MeasuredRange, ModelSource, SourcedModel, state_words};
pub use write::text;
