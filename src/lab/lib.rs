//! Works offline on measured files, logs and stores: fits cell models, scores estimates against a known truth,
//! forecasts remaining life, applies Gaussian processes, imports and discovers signals, evaluates fleets, and writes
//! reports, passports and plots.

pub use packwatch_core::{alarm, can, cell, cell_faults, filter, health, monitor, quantity, sample, sim, wiring};
pub use packwatch_host::{config, io, replay, status, store};
pub use packwatch_regress as regress;

mod capacity_table;
pub mod cell_fault_pictures;
pub mod chart;
pub mod discover;
pub mod error;
mod fields;
pub mod fit;
pub mod fleet;
pub mod gpr;
pub mod ident;
pub mod import;
pub mod measured;
pub mod model_pictures;
pub mod pack_view;
pub mod passport;
pub mod report;
pub mod rul;
pub mod score;
pub mod single_cell;

pub use packwatch_host::io::result_file::write_file;

/// Returns a file name without the ending of its compression (`.gz` or `.zst`).
fn without_compression(name: &str) -> &str {
    [".gz", ".zst"].iter().find_map(|ending| name.strip_suffix(ending)).unwrap_or(name)
}

/// Half the width of the 95 % interval of a normal distribution, in standard deviations.
const OF_95: f64 = 1.96;
