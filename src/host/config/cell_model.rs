//! Cell model files: reads TOML into a checked [`CellModel`](crate::cell::CellModel) and reports every fault at once.
//!
//! A model is accepted only if its tables are complete, breakpoints increase strictly and SOC runs from 0 to 1. The
//! open-circuit voltage must increase strictly with SOC at every temperature. Resistances, capacitances and capacities
//! must be positive.
//!
//! | file | content |
//! | --- | --- |
//! | `keys` | every key of the file |
//! | `read` | reads and checks the file |
//! | `source` | the origin of a model |
//! | `label` | the model made from a label, and the model learned on board |
//! | `write` | writes a model as a file |
//! | `library` | the model files in the usual folders |

mod keys;
mod label;
pub mod library;
mod read;
mod source;
mod write;

pub(crate) use keys::SECTIONS;
pub use label::{of_fleet, of_label, of_view};
pub(crate) use read::load_with;
pub use read::{load, load_sourced};
pub use source::{KnownBy, LearnedFrom, MeasuredRange, ModelSource, SourcedModel, state_words};
pub use write::text;
