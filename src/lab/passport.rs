//! Battery passports: the part that a vehicle knows, in the forms of two standards.
//!
//! A [`Record`] is collected from a store or a replay, and a [`Condition`] is determined from it. [`passport`] merges its values with
//! the manufacturer's part and checks the result. [`details`] contains standard deviations and definitions, for which the standards have
//! no members. An unknown value is absent; no default replaces it. Nothing here reads a clock, so the same inputs give
//! the same bytes.

mod condition;
mod document;
mod energy;
mod field;
mod losses;
mod record;
mod shape;
mod standards;

pub use condition::{Condition, Known, Quantity, Terms};
pub use document::{details, passport};
pub use field::{Field, Standard};
pub use losses::ReadingLimits;
pub use record::Record;
