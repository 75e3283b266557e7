//! Creates asynchronous runtimes.

use std::io;
use std::os::unix::net::UnixStream;

use nix::libc::EMFILE;
use tokio::runtime::{Builder, Runtime};

/// Maximum number of socket pairs that a runtime opens: one for signals and one for waking, with a copy of each.
const PAIRS: usize = 4;

/// A runtime that runs everything on the calling thread.
///
/// # Errors
/// Fails if the process may not open enough descriptors. Without this check, Tokio would panic.
pub fn new_runtime() -> io::Result<Runtime> {
    check_descriptors()?;
    Builder::new_current_thread().enable_all().build()
}

pub(crate) fn check_descriptors() -> io::Result<()> {
    let pairs: io::Result<Vec<_>> = (0..PAIRS).map(|_| UnixStream::pair()).collect();
    pairs.map(drop).map_err(|error| match error.raw_os_error() {
        Some(EMFILE) => io::Error::other(format!("{error}; raise the limit on open files (ulimit -n, LimitNOFILE=)")),
        _ => error,
    })
}
