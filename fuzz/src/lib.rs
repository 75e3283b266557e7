//! Fuzzers of packwatch: one entry point for each input of the program.

pub mod doors;
