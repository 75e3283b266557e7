//! Opens and reads files that describe something: configurations, DBC files, cell models, states, keys. A pipe or device
//! in their place could block the program or fill its memory, so only regular files of limited size are read.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use nix::libc::O_NONBLOCK;

/// Maximum size of a file, bytes. The DBC of a whole vehicle has 10 MB.
pub const MAX_BYTES: u64 = 64 << 20;

/// Opens a regular file.
///
/// # Errors
/// Fails if the path is not a regular file, or if the file cannot be opened. The error does not name the file.
pub fn open(path: &Path) -> io::Result<File> {
    // Opening a named pipe would otherwise wait for a writer. The flag has no effect on a regular file.
    let file = OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(path)?;
    if file.metadata()?.is_file() { Ok(file) } else { Err(io::Error::other("is not a regular file")) }
}

/// Reads a regular file of at most [`MAX_BYTES`].
///
/// # Errors
/// As [`open`], and if the file is longer.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    let is_too_long = bytes.len() as u64 > MAX_BYTES;
    if is_too_long { Err(io::Error::other(format!("must be at most {MAX_BYTES} bytes"))) } else { Ok(bytes) }
}

/// Reads a regular text file of at most [`MAX_BYTES`].
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
    fn pipe_device_folder_and_long_file_are_rejected() {
        let folder = tempfile::tempdir().expect("a folder");
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("started").success());
        let fault = |path: &Path| read(path).expect_err("rejected").to_string();
        for path in [Path::new("/dev/zero"), &pipe, folder.path()] {
            assert_eq!(fault(path), "is not a regular file", "{}", path.display());
        }
        let long = folder.path().join("long");
        File::create(&long).and_then(|file| file.set_len(MAX_BYTES + 1)).expect("created");
        assert_eq!(fault(&long), "must be at most 67108864 bytes");
    }
}
