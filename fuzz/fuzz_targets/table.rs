//! Fuzz target of the entry point `table`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("table")(data));
