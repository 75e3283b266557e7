//! Fuzz target of the entry point `snapshot`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("snapshot")(data));
