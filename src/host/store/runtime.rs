//! Writes the state to the runtime folder every second, so that a crash of the daemon alone loses at most a second.
//!
//! The folder is in memory and lives as long as the boot (systemd keeps it over restarts of the service). A separate
//! thread writes the latest state, so that a slow disk elsewhere does not delay it.

use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::document::StateDocument;

/// Name of the file.
pub(super) const FILE_NAME: &str = "state.json";

/// Writes the state of the second.
#[derive(Debug)]
pub(super) struct RuntimeState {
    shared: Arc<Shared>,
    writer: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    next: Mutex<PendingDocument>,
    wake: Condvar,
}

#[derive(Debug, Default)]
struct PendingDocument {
    document: Option<StateDocument>,
    stop: bool,
}

impl RuntimeState {
    /// Starts the thread that writes `path`.
    pub(super) fn start(path: PathBuf) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let theirs = Arc::clone(&shared);
        let writer = std::thread::Builder::new().name("state".to_owned()).spawn(move || write_all(&path, &theirs))?;
        Ok(Self { shared, writer: Some(writer) })
    }

    /// Queues the latest state; it replaces one that still waits.
    pub(super) fn put(&self, document: StateDocument) {
        self.shared.next.lock().unwrap_or_else(PoisonError::into_inner).document = Some(document);
        self.shared.wake.notify_one();
    }
}

impl Drop for RuntimeState {
    fn drop(&mut self) {
        self.shared.next.lock().unwrap_or_else(PoisonError::into_inner).stop = true;
        self.shared.wake.notify_one();
        // The folder is in memory: the thread ends within milliseconds.
        let _ = self.writer.take().map(JoinHandle::join);
    }
}

fn write_all(path: &std::path::Path, shared: &Shared) {
    let mut failing = false;
    loop {
        let next = shared.next.lock().unwrap_or_else(PoisonError::into_inner);
        let mut next = shared
            .wake
            .wait_while(next, |next| next.document.is_none() && !next.stop)
            .unwrap_or_else(PoisonError::into_inner);
        let Some(document) = next.document.take() else { return };
        drop(next);
        match document.write(path) {
            Ok(()) => failing = false,
            Err(error) if !failing => {
                failing = true;
                tracing::warn!(path = %path.display(), %error, "state of the second not written");
            }
            Err(_) => {}
        }
    }
}
