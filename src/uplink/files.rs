//! Reads the settings file, and the files that the settings name: passwords, tokens, certificates.
//!
//! Only regular files of limited size are read. A pipe or a device could block the program, so it gives an error.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// Environment variable with the folder of the systemd unit's credentials (`LoadCredential=`).
const CREDENTIALS: &str = "CREDENTIALS_DIRECTORY";
/// Largest file, bytes. A file with the certificates of all public authorities is several times smaller.
const MAX_BYTES: u64 = 1 << 20;

/// Reads a file.
///
/// # Errors
/// Fails if the path is not a regular file, or if the file cannot be read or is too long. The message names the file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, String> {
    let at = path.display();
    let fault = |error: std::io::Error| format!("{at}: cannot be read: {error}");
    if !std::fs::metadata(path).map_err(fault)?.is_file() {
        return Err(format!("{at}: must be a regular file"));
    }
    let mut bytes = Vec::new();
    File::open(path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes)).map_err(fault)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(format!("{at}: must be at most {MAX_BYTES} bytes"));
    }
    Ok(bytes)
}

/// Reads the secret or the certificate that the key `key` of the settings names. If the unit has a credentials folder,
/// a relative path is relative to this folder.
///
/// # Errors
/// Fails like [`read`]. The message also names the key.
pub(crate) fn read_credential(key: &str, path: &Path) -> Result<Vec<u8>, String> {
    let folder = std::env::var_os(CREDENTIALS).map(PathBuf::from).unwrap_or_default();
    read(&folder.join(path)).map_err(|error| format!("{key}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pipe_folder_missing_and_long_file_are_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let fault = |path: &Path| read(path).unwrap_err();
        for endless in ["/dev/zero", "/dev/tty", "/dev/stdin"] {
            let fault = fault(Path::new(endless));
            assert!(fault.contains("must be a regular file") || fault.contains("os error"), "{fault}");
        }
        assert!(fault(folder.path()).ends_with("must be a regular file"));
        assert!(fault(&folder.path().join("gone")).ends_with("(os error 2)"));
        let long = folder.path().join("long");
        std::fs::write(&long, vec![b'#'; 1 + (1 << 20)]).unwrap();
        assert!(fault(&long).ends_with("must be at most 1048576 bytes"));
        std::fs::write(&long, vec![b'#'; 1 << 20]).unwrap();
        assert_eq!(read(&long).unwrap().len(), 1 << 20);
    }
}
