//! Fuzzers of packwatch: every door through which something enters the program, as a function of bytes.

pub mod doors;
