//! Work over many logs at once: what other settings would have done ([`whatif`]), and tables of what came out
//! ([`export`]).
//!
//! In: a configuration and logs of any form `replay` reads. Each log is replayed by itself, the logs on all cores; a log
//! that fails is told and the others go on. Memory is bounded by what is kept per log, not by its length.

pub mod drive;
pub mod export;
pub mod judge;
mod track;
pub mod truth;
mod variant_batch;
pub mod variants;
pub mod whatif;

pub use drive::{Opened, Reading};

use rayon::prelude::*;

/// Runs `work` for every item on `jobs` threads (`None` = all cores); results in the items' order.
///
/// # Errors
/// When the threads cannot be started.
pub fn in_parallel<T: Sync, R: Send>(
    items: &[T],
    jobs: Option<usize>,
    work: impl Fn(usize, &T) -> R + Sync,
) -> Result<Vec<R>, String> {
    let threads = jobs.unwrap_or(0).min(items.len().max(1));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|error| format!("threads cannot be started: {error}"))?;
    // One by one: logs differ much in length.
    Ok(pool.install(|| items.par_iter().enumerate().with_max_len(1).map(|(index, item)| work(index, item)).collect()))
}
