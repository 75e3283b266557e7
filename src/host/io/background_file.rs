//! Writes a file on a separate thread, so that a slow disk never delays the daemon's loop.
//!
//! Bytes are collected and sent to the thread in pieces. A piece cannot be sent if the thread failed to write an
//! earlier piece, or if too many pieces wait for a slow disk. Then `write` or `flush` returns an error. The caller
//! stops writing this file and continues without it.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::place::with_suffix;
use super::result_file::name_folder;
use super::segments::{SegmentLimits, SegmentWriter};

/// Number of bytes that are collected before they are sent to the thread. A flush sends the bytes collected so far.
const PIECE_BYTES: usize = 64 * 1024;
/// Maximum number of waiting pieces. They hold 4 MB, which is ten seconds of a full 1 Mbit/s bus.
const MAX_PIECES: usize = 64;

/// Maximum wait for the last bytes when the file is finished. It is half of the time after which systemd kills a
/// service that does not stop.
pub const MAX_FINISH: Duration = Duration::from_secs(5);

/// A file and the thread that writes it.
#[derive(Debug)]
pub struct BackgroundFile {
    piece: Vec<u8>,
    /// Sends pieces to the thread; `None` after the file was finished or has failed.
    pieces: Option<SyncSender<Vec<u8>>>,
    writer: Option<JoinHandle<io::Result<()>>>,
}

impl BackgroundFile {
    /// Creates the file and its thread. A file of an earlier run is renamed to `NAME.1`.
    ///
    /// # Errors
    /// Fails if the earlier file cannot be renamed, or if the file or the thread cannot be created.
    pub fn create(path: &Path) -> io::Result<Self> {
        keep_earlier(path)?;
        let file = File::create(path).map_err(|error| name_folder(path, error))?;
        Self::start(move |queue| write_all(file, queue))
    }

    /// Like [`create`](Self::create), but writes the bytes as segments. Every later segment starts with `header`; the
    /// first segment starts with the caller's bytes, which must begin with `header`.
    ///
    /// # Errors
    /// Fails if the first segment or the thread cannot be created.
    pub fn create_segments(path: &Path, header: &'static str, limits: SegmentLimits) -> io::Result<Self> {
        let segments = SegmentWriter::create(path, header, limits);
        let mut segments = segments.map_err(|error| name_folder(path, error))?;
        Self::start(move |queue| {
            for piece in queue {
                segments.write(&piece)?;
            }
            segments.finish()
        })
    }

    fn start(write: impl FnOnce(&Receiver<Vec<u8>>) -> io::Result<()> + Send + 'static) -> io::Result<Self> {
        let (pieces, queue) = sync_channel(MAX_PIECES);
        let writer = std::thread::Builder::new().name("record".to_owned()).spawn(move || write(&queue))?;
        Ok(Self { piece: Vec::with_capacity(PIECE_BYTES), pieces: Some(pieces), writer: Some(writer) })
    }

    /// Writes the remaining bytes and synchronises the file to disk. Waits for this at most [`MAX_FINISH`].
    ///
    /// # Errors
    /// Fails if the thread could not write or did not finish in time, or if the remaining bytes could not be sent to
    /// it.
    pub fn finish(mut self) -> io::Result<()> {
        let sent = self.send_piece();
        self.join()?;
        sent
    }

    fn send_piece(&mut self) -> io::Result<()> {
        if self.piece.is_empty() {
            return Ok(());
        }
        let piece = std::mem::replace(&mut self.piece, Vec::with_capacity(PIECE_BYTES));
        let Some(pieces) = &self.pieces else { return Err(io::Error::other("file abandoned")) };
        match pieces.try_send(piece) {
            Ok(()) => Ok(()),
            Err(TrySendError::Full(_)) => {
                self.pieces = None;
                Err(io::Error::new(io::ErrorKind::TimedOut, "disk too slow: more than 4 MB wait to be written"))
            }
            Err(TrySendError::Disconnected(_)) => {
                Err(self.join().err().unwrap_or_else(|| io::Error::other("the writing thread has ended")))
            }
        }
    }

    fn join(&mut self) -> io::Result<()> {
        self.pieces = None;
        let Some(writer) = self.writer.take() else { return Ok(()) };
        if !ends_in_time(&writer) {
            let why = "the disk does not respond; the file is incomplete";
            return Err(io::Error::new(io::ErrorKind::TimedOut, why));
        }
        writer.join().unwrap_or_else(|_| Err(io::Error::other("the writing thread panicked")))
    }
}

/// Waits for a thread to end, but at most [`MAX_FINISH`]. Returns whether the thread has ended.
pub fn ends_in_time<T>(thread: &JoinHandle<T>) -> bool {
    let began = Instant::now();
    while !thread.is_finished() {
        if began.elapsed() > MAX_FINISH {
            return false;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    true
}

/// Renames the file of an earlier run to `NAME.1`, because that file may show the cause of a crash.
fn keep_earlier(path: &Path) -> io::Result<()> {
    let Ok(earlier) = std::fs::metadata(path) else { return Ok(()) };
    if !earlier.is_file() || earlier.len() == 0 {
        return Ok(());
    }
    std::fs::rename(path, with_suffix(path, ".1"))
}

impl Write for BackgroundFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.piece.extend_from_slice(bytes);
        if self.piece.len() >= PIECE_BYTES {
            self.send_piece()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.send_piece()
    }
}

fn write_all(mut file: File, queue: &Receiver<Vec<u8>>) -> io::Result<()> {
    for piece in queue {
        file.write_all(&piece)?;
    }
    // Pipes and devices cannot be synchronised (EINVAL), which is not an error.
    file.sync_all().or_else(|error| if error.raw_os_error() == Some(22) { Ok(()) } else { Err(error) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finish_writes_all_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record");
        let mut file = BackgroundFile::create(&path).unwrap();
        let line = [b'x'; 1000];
        for _ in 0..1000 {
            file.write_all(&line).unwrap();
        }
        file.finish().unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 1_000_000);
    }

    #[test]
    fn full_disk_fails_write_or_finish() {
        if let Ok(mut file) = BackgroundFile::create(Path::new("/dev/full")) {
            let early = file.write_all(b"x");
            assert!(early.is_err() || file.finish().is_err());
        }
    }
}
