//! Fuzz target of the entry point `cell_model`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| packwatch_fuzz::doors::door("cell_model")(data));
