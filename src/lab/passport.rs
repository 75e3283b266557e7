//! Battery passports: the part that a vehicle knows, in the forms of two standards.
//!
//! A [`Record`] is collected from a store or a replay; a [`Condition`] is determined from it; [`passport`] merges its values with
//! the manufacturer's part and checks the result. [`details`] has standard deviations and definitions, for which the standards have
//! no members. A value that is not known is absent; no default takes its place. Nothing here reads a clock: the same inputs give
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
