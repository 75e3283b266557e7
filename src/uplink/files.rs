//! Reads files that the settings name: settings, passwords, tokens, certificates.
//!
//! Promises: nothing but a file of bounded size is read. A pipe or a device, which would hold up the program or never end, is a fault.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// Folder of the unit's credentials (`LoadCredential=`).
const CREDENTIALS: &str = "CREDENTIALS_DIRECTORY";
/// Longest file, bytes: a hundred times what a person writes, and ten times the certificates of all authorities.
const MAX_BYTES: u64 = 1 << 20;

/// Reads a file.
///
/// # Errors
/// With its name: when it is none, cannot be read, or is too long.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, String> {
    let at = path.display();
    let fault = |error: std::io::Error| format!("{at}: {error}");
    if !std::fs::metadata(path).map_err(fault)?.is_file() {
        return Err(format!("{at}: must be a file"));
    }
    let mut bytes = Vec::new();
    File::open(path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes)).map_err(fault)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(format!("{at}: must be at most {MAX_BYTES} bytes"));
    }
    Ok(bytes)
}

/// Reads a secret or a certificate; a relative path is below the unit's credentials, if there are any.
///
/// # Errors
/// As [`read`].
pub(crate) fn read_credential(path: &Path) -> Result<Vec<u8>, String> {
    let folder = std::env::var_os(CREDENTIALS).map(PathBuf::from).unwrap_or_default();
    read(&folder.join(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_of_bounded_size_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let fault = |path: &Path| read(path).unwrap_err();
        for endless in ["/dev/zero", "/dev/tty", "/dev/stdin"] {
            let fault = fault(Path::new(endless));
            assert!(fault.contains("must be a file") || fault.contains("os error"), "{fault}");
        }
        assert!(fault(folder.path()).ends_with("must be a file"));
        assert!(fault(&folder.path().join("gone")).ends_with("(os error 2)"));
        let long = folder.path().join("long");
        std::fs::write(&long, vec![b'#'; 1 + (1 << 20)]).unwrap();
        assert!(fault(&long).ends_with("must be at most 1048576 bytes"));
        std::fs::write(&long, vec![b'#'; 1 << 20]).unwrap();
        assert_eq!(read(&long).unwrap().len(), 1 << 20);
    }
}
