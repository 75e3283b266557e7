//! Reserves disk space for the time when the disk is full. The reserve is a file, which is shortened step by step so
//! that learned results and alarms can be stored. The reserve is restored when the disk has room again.
//!
//! One step provides room for several commits. A state without new rows does not use the reserve, but waits until the
//! disk has room.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::libc::{O_NOFOLLOW, O_NONBLOCK};

const FILE_NAME: &str = "packwatch.reserve";
/// Size of the file, bytes: the maximum size of the write-ahead log.
const BYTES: usize = 1 << 20;
/// Bytes released at once. This is more than a commit writes, because another program that fills the disk may take some
/// of the space.
const STEP_BYTES: usize = 128 << 10;
/// Name of the file that is written to find out whether the disk is full.
const PROBE_NAME: &str = "packwatch.probe";
/// Minimum time between two attempts to restore the reserve.
const PAUSE: Duration = Duration::from_secs(15);

#[derive(Debug)]
pub(super) struct Reserve {
    folder: PathBuf,
    left: usize,
    tried: Option<Instant>,
}

impl Reserve {
    pub(super) fn new(folder: &Path) -> Self {
        let found = open(&folder.join(FILE_NAME)).and_then(|file| file.metadata()).map_or(0, |file| file.len());
        let left = usize::try_from(found).unwrap_or(BYTES).min(BYTES);
        Self { folder: folder.to_owned(), left, tried: None }
    }

    /// Whether the reserve is unused.
    pub(super) fn is_whole(&self) -> bool {
        self.left == BYTES
    }

    pub(super) fn is_usable(&self) -> bool {
        self.left > 0
    }

    /// Tries to restore the file, at most once per [`PAUSE`]. While the disk is full, the attempt fails.
    pub(super) fn restore(&mut self) {
        if self.is_whole() || self.tried.is_some_and(|tried| tried.elapsed() < PAUSE) {
            return;
        }
        self.tried = Some(Instant::now());
        self.make();
    }

    pub(super) fn make(&mut self) {
        if self.is_whole() {
            return;
        }
        let path = self.folder.join(FILE_NAME);
        if fs::symlink_metadata(&path).is_ok_and(|found| !found.is_file()) {
            // Something that is not a regular file, such as a link, has the reserve's name. Remove it.
            let _ = fs::remove_file(&path);
        }
        let is_missing = !path.exists();
        let opened = if is_missing { File::create_new(&path) } else { open(&path) };
        self.left = if is_missing { 0 } else { self.left };
        let grown = opened.and_then(|file| {
            let grown = write(&file, BYTES - self.left);
            // If the file cannot be extended completely, it gets its old length again. A partly extended file would
            // only take room from other files.
            let kept = grown.as_ref().map_or(Some(self.left), |()| None);
            kept.map_or(Ok(()), |left| file.set_len(left as u64)).and(grown)
        });
        match grown {
            Ok(()) => self.left = BYTES,
            Err(error) => tracing::warn!(file = %path.display(), %error, "reserve for a full disk not created"),
        }
    }

    /// Releases one step if the disk is full. Returns `false` if the disk has room, or if nothing is left to release.
    /// SQLite's errors are not used, because they do not distinguish a full disk from a file that cannot be opened or
    /// extended.
    pub(super) fn release_if_full(&mut self) -> bool {
        self.is_usable() && self.is_disk_full() && self.release()
    }

    fn is_disk_full(&self) -> bool {
        let path = self.folder.join(PROBE_NAME);
        let _ = fs::remove_file(&path);
        let written = File::create_new(&path).and_then(|file| write(&file, STEP_BYTES));
        let _ = fs::remove_file(&path);
        written.is_err_and(|error| matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded))
    }

    fn release(&mut self) -> bool {
        self.left = self.left.saturating_sub(STEP_BYTES);
        self.tried = Some(Instant::now());
        let path = self.folder.join(FILE_NAME);
        // The file is synced, because the space can be given to another file only after the change is in the file
        // system's journal.
        let freed = open(&path).and_then(|file| {
            file.set_len(self.left as u64)?;
            file.sync_all()
        });
        tracing::warn!(file = %path.display(), freed = freed.is_ok(), left = self.left, "disk full: using the reserve");
        freed.is_ok()
    }
}

/// Opens the reserve. Fails if it is not a regular file. Also fails if it is a symbolic link, because the link may
/// lead to a file of another program.
fn open(path: &Path) -> io::Result<File> {
    let file = File::options().append(true).custom_flags(O_NOFOLLOW | O_NONBLOCK).open(path)?;
    let is_file = file.metadata()?.is_file();
    is_file.then_some(file).ok_or_else(|| io::Error::other("not a regular file"))
}

/// Writes bytes that are not all zero. A file system could store zeros as a hole, which takes no space.
fn write(mut file: &File, bytes: usize) -> io::Result<()> {
    let contents: Vec<u8> = (0..=u8::MAX).cycle().take(bytes).collect();
    file.write_all(&contents)?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reserve_is_released_in_steps_and_restored() {
        let folder = tempfile::tempdir().unwrap();
        let mut reserve = Reserve::new(folder.path());
        assert!(!reserve.is_usable() && !reserve.release_if_full(), "nothing to release");
        reserve.make();
        let length = || fs::metadata(folder.path().join(FILE_NAME)).unwrap().len();
        assert!(reserve.is_whole() && Reserve::new(folder.path()).is_whole());
        assert_eq!(length(), 1 << 20);
        assert!(!reserve.release_if_full(), "the disk has room");
        assert!(reserve.release() && reserve.is_usable() && !reserve.is_whole());
        assert_eq!(length(), (1 << 20) - (128 << 10));
        reserve.restore();
        assert!(!reserve.is_whole(), "the reserve is restored only after a pause");
        let mut reserve = Reserve::new(folder.path());
        assert!(reserve.is_usable() && !reserve.is_whole(), "a new start finds the shortened reserve");
        reserve.restore();
        assert!(reserve.is_whole() && length() == 1 << 20);
        (0..8).for_each(|_| assert!(reserve.release()));
        assert!(!reserve.is_usable() && length() == 0);
    }

    #[test]
    fn reserve_and_probe_leave_linked_files_alone() {
        let folder = tempfile::tempdir().unwrap();
        let other = folder.path().join("other");
        fs::write(&other, "of another program").unwrap();
        for name in [FILE_NAME, PROBE_NAME] {
            std::os::unix::fs::symlink(&other, folder.path().join(name)).unwrap();
        }
        let mut reserve = Reserve::new(folder.path());
        assert!(!reserve.is_usable());
        reserve.make();
        assert!(reserve.is_whole() && !reserve.is_disk_full() && reserve.release());
        assert_eq!(fs::read(&other).unwrap(), b"of another program");
    }
}
