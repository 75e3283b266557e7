//! Fuzz target of the entry point `log`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("log")(data));
