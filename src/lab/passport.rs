//! Writes battery passports: the values that a vehicle can determine, in the formats of two standards.
//!
//! A [`Record`] is collected from a store or a replay, and a [`Condition`] is determined from the record. [`passport`]
//! merges the condition's values into the part of the passport that the manufacturer wrote, and checks the result.
//! [`details`] contains standard deviations and definitions, which the standards do not provide for. Unknown values are
//! left out; no default replaces them.

mod condition;
mod document;
mod energy;
mod field;
mod losses;
mod record;
mod shape;
mod standards;

pub use condition::{Condition, Known, Quantity, Terms};
pub use document::{details, passport, template, without_nulls};
pub use field::{Field, Standard};
pub use losses::ReadingLimits;
pub use record::Record;
