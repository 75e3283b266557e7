//! Estimates against truth.
