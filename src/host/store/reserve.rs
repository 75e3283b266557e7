//! Disk space kept for the moment when the disk is full: a file that is deleted so that learned results and alarms can be
//! stored, and made again when there is room.
//!
//! The space is enough for some fifty commits. States without new rows do not use it: they wait until the disk has room.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Its name in the state folder.
const FILE_NAME: &str = "packwatch.reserve";
/// Its size, bytes: as much as the write-ahead log may take.
const BYTES: usize = 1 << 20;
/// File that shows whether the disk is full, and its size: more than one commit writes.
const PROBE_NAME: &str = "packwatch.probe";
const PROBE_BYTES: usize = 128 << 10;
/// Least time between two attempts to make it.
const PAUSE: Duration = Duration::from_secs(15);

/// The reserve of a folder.
#[derive(Debug)]
pub(super) struct Reserve {
    folder: PathBuf,
    is_there: bool,
    tried: Option<Instant>,
}

impl Reserve {
    /// The reserve of a folder, which need not exist yet.
    pub(super) fn new(folder: &Path) -> Self {
        let is_there = fs::metadata(folder.join(FILE_NAME)).is_ok_and(|file| file.len() == BYTES as u64);
        Self { folder: folder.to_owned(), is_there, tried: None }
    }

    /// Whether there is space to release.
    pub(super) fn is_there(&self) -> bool {
        self.is_there
    }

    /// Makes the file where it is missing, now and then; on a full disk it stays missing.
    pub(super) fn restore(&mut self) {
        if self.is_there || self.tried.is_some_and(|tried| tried.elapsed() < PAUSE) {
            return;
        }
        self.tried = Some(Instant::now());
        self.make();
    }

    /// Makes the file where it is missing.
    pub(super) fn make(&mut self) {
        if self.is_there {
            return;
        }
        let path = self.folder.join(FILE_NAME);
        match write(&path, BYTES) {
            Ok(()) => self.is_there = true,
            Err(error) => {
                // A part of it takes room from others.
                let _ = fs::remove_file(&path);
                tracing::warn!(file = %path.display(), %error, "no reserve for a full disk");
            }
        }
    }

    /// Frees the space if the disk has none; `false` = the disk has room, or there is no reserve to free. SQLite's errors do not say
    /// it: a full disk also fails to open or to enlarge a file.
    pub(super) fn release_if_full(&mut self) -> bool {
        self.is_there && self.is_disk_full() && self.release()
    }

    /// Tries to write as much as a commit does.
    fn is_disk_full(&self) -> bool {
        let path = self.folder.join(PROBE_NAME);
        let written = write(&path, PROBE_BYTES);
        let _ = fs::remove_file(&path);
        written.is_err_and(|error| matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded))
    }

    fn release(&mut self) -> bool {
        if !std::mem::take(&mut self.is_there) {
            return false;
        }
        self.tried = Some(Instant::now());
        let path = self.folder.join(FILE_NAME);
        // Synced: until the deletion is in its journal, a file system does not give the space to another file.
        let freed = File::options().write(true).open(&path).and_then(|file| {
            file.set_len(0)?;
            file.sync_all()
        });
        let freed = freed.and_then(|()| fs::remove_file(&path));
        tracing::warn!(file = %path.display(), freed = freed.is_ok(), "the disk is full: the reserve is used");
        freed.is_ok()
    }
}

/// Writes the file with bytes that no file system stores as a hole.
fn write(path: &Path, bytes: usize) -> io::Result<()> {
    let mut file = File::create(path)?;
    let contents: Vec<u8> = (0..=u8::MAX).cycle().take(bytes).collect();
    file.write_all(&contents)?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reserve_is_made_released_once_and_made_again_later() {
        let folder = tempfile::tempdir().unwrap();
        let mut reserve = Reserve::new(folder.path());
        assert!(!reserve.release(), "nothing to release");
        reserve.restore();
        assert!(reserve.is_there() && Reserve::new(folder.path()).is_there());
        let path = folder.path().join(FILE_NAME);
        assert_eq!(fs::metadata(&path).unwrap().len(), 1 << 20);
        assert!(!reserve.release_if_full(), "the disk has room");
        assert!(reserve.release() && !path.exists());
        assert!(!reserve.release());
        reserve.restore();
        assert!(!reserve.is_there(), "not at once: the disk is full");
        reserve.tried = None;
        reserve.restore();
        assert!(reserve.is_there());
    }
}
