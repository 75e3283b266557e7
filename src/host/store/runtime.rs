//! Writes the state to the runtime folder every second, so that a crash of the daemon (not of the computer) loses at
//! most one second.
//!
//! The folder is in memory and exists until the computer restarts (systemd keeps it over restarts of the service). A
//! separate thread writes the latest state, so that the state does not wait for a slow disk.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::state_files::StateDocument;

pub(super) const FILE_NAME: &str = "state.json";

#[derive(Debug)]
pub(super) struct RuntimeState {
    latest: Arc<Mutex<Option<StateDocument>>>,
    /// Signals to the thread that a state is waiting; `None` only during the drop.
    wake: Option<SyncSender<()>>,
    writer: Option<JoinHandle<()>>,
}

impl RuntimeState {
    pub(super) fn start(path: PathBuf) -> std::io::Result<Self> {
        let (latest, (wake, woken)) = (Arc::default(), sync_channel(1));
        let theirs = Arc::clone(&latest);
        let thread = std::thread::Builder::new().name("state".to_owned());
        let writer = thread.spawn(move || write_all(&path, &theirs, &woken))?;
        Ok(Self { latest, wake: Some(wake), writer: Some(writer) })
    }

    /// Queues the latest state. It replaces a state that is still waiting.
    pub(super) fn put(&self, document: StateDocument) {
        *self.latest.lock().unwrap_or_else(PoisonError::into_inner) = Some(document);
        let _ = self.wake.as_ref().map(|wake| wake.try_send(()));
    }
}

impl Drop for RuntimeState {
    fn drop(&mut self) {
        self.wake = None;
        // The folder is in memory, so the thread ends within milliseconds.
        let _ = self.writer.take().map(JoinHandle::join);
    }
}

fn write_all(path: &Path, latest: &Mutex<Option<StateDocument>>, woken: &Receiver<()>) {
    let mut failing = false;
    for () in woken {
        let document = latest.lock().unwrap_or_else(PoisonError::into_inner).take();
        let written = document.map_or(Ok(()), |document| document.write_json(path));
        if let Err(error) = &written
            && !failing
        {
            tracing::warn!(path = %path.display(), %error, "runtime state not written");
        }
        failing = written.is_err();
    }
}
