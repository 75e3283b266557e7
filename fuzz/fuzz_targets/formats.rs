//! Fuzz target of the entry point `formats`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("formats")(data));
