//! Opens and reads files of limited size: configurations, DBC files, cell models, states and keys.
//!
//! At most [`MAX_BYTES`] are read, and only from regular files and from pipes (`<(command)` in a shell), because a
//! device could fill the memory. A pipe without data does not block the program for ever.

use std::fs::{File, FileType, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::{FileTypeExt as _, OpenOptionsExt as _};
use std::path::Path;
use std::time::Duration;

use nix::libc::{EISDIR, O_NONBLOCK};

/// Maximum size of a file, bytes. The DBC of a whole vehicle has 10 MB.
pub const MAX_BYTES: u64 = 64 << 20;

const PIPE_LIMIT: Duration = Duration::from_secs(10);
const PIPE_RETRY: Duration = Duration::from_millis(10);

/// Opens a regular file.
///
/// # Errors
/// Fails if the path is not a regular file, or if the file cannot be opened. The error does not name the file.
pub fn open(path: &Path) -> io::Result<File> {
    let file = open_any(path)?;
    let kind = file.metadata()?.file_type();
    if kind.is_file() { Ok(file) } else { Err(unreadable(kind)) }
}

/// The error for a path that is not a regular file.
fn unreadable(kind: FileType) -> io::Error {
    if kind.is_dir() { io::Error::from_raw_os_error(EISDIR) } else { io::Error::other("is not a regular file") }
}

/// Opens a file of any kind without waiting.
fn open_any(path: &Path) -> io::Result<File> {
    // Opening a named pipe would otherwise wait for a writer. The flag has no effect on a regular file.
    OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(path)
}

/// Reads a regular file or a pipe of at most [`MAX_BYTES`].
///
/// # Errors
/// As [`read_up_to`].
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    read_up_to(path, MAX_BYTES)
}

/// Reads a regular file or a pipe of at most `max_bytes`.
///
/// # Errors
/// Fails if the path is a folder or a device, if it cannot be read, if it has more bytes, or if the writer of a pipe
/// sends no data for 10 s. A pipe without a writer is empty.
pub fn read_up_to(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let file = open_any(path)?;
    let kind = file.metadata()?.file_type();
    if !kind.is_file() && !kind.is_fifo() {
        return Err(unreadable(kind));
    }
    let (mut bytes, mut rest) = (Vec::new(), file.take(max_bytes + 1));
    let (mut waited, mut before) = (Duration::ZERO, 0);
    while let Err(error) = rest.read_to_end(&mut bytes) {
        if error.kind() != io::ErrorKind::WouldBlock {
            return Err(error);
        }
        waited = if bytes.len() > before { Duration::ZERO } else { waited + PIPE_RETRY };
        if waited > PIPE_LIMIT {
            return Err(io::Error::other(format!("no data from the pipe for {} s", PIPE_LIMIT.as_secs())));
        }
        before = bytes.len();
        std::thread::sleep(PIPE_RETRY);
    }
    let is_too_long = bytes.len() as u64 > max_bytes;
    if is_too_long { Err(io::Error::other(format!("must be at most {max_bytes} bytes"))) } else { Ok(bytes) }
}

/// Reads a text file or a pipe of at most [`MAX_BYTES`].
///
/// # Errors
/// As [`read`], and if the file is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read(path)?).map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn device_folder_and_long_file_are_rejected() {
        let folder = tempfile::tempdir().expect("a folder");
        let fault = |path: &Path| read(path).expect_err("rejected").to_string();
        assert_eq!(fault(Path::new("/dev/zero")), "is not a regular file");
        assert_eq!(fault(folder.path()), "Is a directory (os error 21)");
        let long = folder.path().join("long");
        File::create(&long).and_then(|file| file.set_len(MAX_BYTES + 1)).expect("created");
        assert_eq!(fault(&long), "must be at most 67108864 bytes");
    }

    #[test]
    fn pipe_is_read_by_read_and_refused_by_open() {
        let folder = tempfile::tempdir().expect("a folder");
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("started").success());
        assert_eq!(read(&pipe).expect("no writer"), b"");
        let mut writer = std::process::Command::new("sh");
        // The shell also reads, so that opening does not wait. The text comes in two parts.
        writer.args(["-c", "exec 3<>\"$0\"; echo ready; printf one >&3; sleep 0.1; printf two >&3; sleep 0.2"]);
        let mut writer = writer.arg(&pipe).stdout(std::process::Stdio::piped()).spawn().expect("started");
        let mut ready = [0; 5];
        writer.stdout.take().expect("piped").read_exact(&mut ready).expect("ready");
        assert_eq!(read(&pipe).expect("read"), b"onetwo");
        writer.wait().expect("ended");
        assert_eq!(open(&pipe).expect_err("rejected").to_string(), "is not a regular file");
    }
}
