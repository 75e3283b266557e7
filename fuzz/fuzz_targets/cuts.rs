//! Fuzz target of the entry point `cuts`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("cuts")(data));
