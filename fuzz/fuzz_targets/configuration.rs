//! Fuzz target of the door `configuration`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("configuration")(data));
