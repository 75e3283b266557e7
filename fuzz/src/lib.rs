//! Fuzzers of packwatch: every input of the program as a function of bytes.

pub mod doors;
