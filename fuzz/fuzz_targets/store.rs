//! Fuzz target of the entry point `store`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("store")(data));
