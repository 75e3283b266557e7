//! Processes many logs at once. [`whatif`] evaluates the alarms under other settings. [`export`] writes the results as
//! tables. [`vehicles`] writes the same tables for a fleet of vehicles on several machines. [`prior`] combines what the
//! vehicles have learned about their cells.
//!
//! Input: a configuration, and logs in any format that `replay` reads. Each log is replayed separately, except that
//! [`vehicles`] replays all logs of one vehicle together. All cores are used. If a log cannot be replayed, the error is
//! reported and the other logs continue.

pub mod drive;
pub mod export;
pub mod judge;
pub mod prior;
mod track;
pub mod truth;
mod variant_batch;
pub mod variants;
pub mod vehicle;
pub mod vehicles;
pub mod whatif;

pub use drive::{LogAccess, OpenedLog};

use rayon::prelude::*;

use crate::error::LabError;

/// Runs `work` for every item on `jobs` threads (`None` = all cores). Returns the results in the order of the items.
///
/// # Errors
/// The threads cannot be started.
pub fn in_parallel<T: Sync, R: Send>(
    items: &[T],
    jobs: Option<usize>,
    work: impl Fn(usize, &T) -> R + Sync,
) -> Result<Vec<R>, LabError> {
    let threads = jobs.unwrap_or(0).min(items.len().max(1));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|error| LabError::Data(format!("threads cannot be started: {error}")))?;
    // Each thread takes one log at a time, because the lengths of logs differ greatly.
    Ok(pool.install(|| items.par_iter().enumerate().with_max_len(1).map(|(index, item)| work(index, item)).collect()))
}
