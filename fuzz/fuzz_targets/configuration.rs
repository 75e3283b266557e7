//! Fuzz target of the entry point `configuration`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("configuration")(data));
