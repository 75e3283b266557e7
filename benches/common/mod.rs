//! Provides inputs for several benches: the configuration of the example pack, and readings of its cells.

use packwatch_host::cell::CellStep;
use packwatch_host::config::{self, Config};

/// Loads `config/example.toml`.
pub(crate) fn example() -> Config {
    let path = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/example.toml"));
    config::load(path).unwrap_or_else(|faults| panic!("{faults:?}"))
}

/// Returns reading `k` of a cell. There are ten readings a second, and the current reverses every 30 s. Each cell's
/// voltage is 0.5 mV above that of the previous cell. Groups of eight cells share a temperature.
pub(crate) fn reading(k: u32, cell: usize) -> CellStep {
    let current_a = if k % 600 < 300 { 1.0 } else { -1.0 };
    CellStep {
        measured_s: 0.1,
        charge_as: 0.1 * current_a,
        offset_s: 0.1,
        unmeasured_s: 0.0,
        current_a: Some(current_a),
        temperature_c: Some(25.0 + (cell / 8) as f64),
        ambient_c: 25.0,
        voltage_v: 3.7 - 0.05 * current_a + 0.0005 * cell as f64,
        is_voltage_frozen: false,
    }
}
