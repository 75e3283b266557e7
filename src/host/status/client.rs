//! Client of the status socket. It reads one status document and waits for it at most [`PATIENCE`].

use std::io::{self, ErrorKind, Read};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::document::{StatusDocument, VERSION};
use super::{MAX_SILENCE, standard_path};
use crate::io::unix_socket::explain_no_daemon;

/// Longest wait for a document. It is one second longer than the daemon itself waits for a new document.
pub const PATIENCE: Duration = Duration::from_secs(1 + MAX_SILENCE.as_secs());
/// Longest document, bytes. A document with 1,024 cells and as many alarms takes less than 1 MB.
pub const MAX_DOCUMENT_BYTES: usize = 8 << 20;

/// A daemon's status socket.
#[derive(Debug, Clone)]
pub struct StatusClient {
    /// Path of the socket.
    pub path: PathBuf,
}

impl StatusClient {
    /// A client of the socket at `path`; `None` = the standard path.
    pub fn new(path: Option<&Path>) -> Self {
        Self { path: path.map_or_else(standard_path, Path::to_owned) }
    }

    /// Reads the document as a line of JSON.
    ///
    /// # Errors
    /// Fails if no daemon sends the document. The message names the socket and the next step.
    pub fn line(&self) -> Result<Vec<u8>, String> {
        self.read(PATIENCE).map_err(|error| explain(&self.path, "--socket", &error))
    }

    fn read(&self, patience: Duration) -> io::Result<Vec<u8>> {
        let end = Instant::now() + patience;
        let mut stream = UnixStream::connect(&self.path)?;
        let (mut line, mut part) = (Vec::new(), [0; 16 << 10]);
        while line.last() != Some(&b'\n') {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(ErrorKind::TimedOut.into());
            }
            stream.set_read_timeout(Some(left))?;
            match stream.read(&mut part)? {
                0 => return Err(ErrorKind::UnexpectedEof.into()),
                count => line.extend_from_slice(&part[..count]),
            }
            check_length(line.len())?;
        }
        Ok(line)
    }
}

/// Rejects a document that is too long.
pub fn check_length(bytes: usize) -> io::Result<()> {
    if bytes <= MAX_DOCUMENT_BYTES {
        return Ok(());
    }
    Err(io::Error::new(
        ErrorKind::InvalidData,
        format!("document too long, must be at most {MAX_DOCUMENT_BYTES} bytes"),
    ))
}

/// Explains why no document was received, and names the next step. `setting` is the option or the key with which the
/// user chooses the status socket `path`.
pub fn explain(path: &Path, setting: &str, error: &io::Error) -> String {
    let shown = path.display();
    match error.kind() {
        ErrorKind::NotFound | ErrorKind::ConnectionRefused => {
            explain_no_daemon(path, "status", &standard_path(), setting)
        }
        ErrorKind::PermissionDenied => format!("{shown}: only root may read the service's folder; try sudo"),
        ErrorKind::WouldBlock | ErrorKind::TimedOut => format!("{shown}: the daemon sent no status in time"),
        ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset => {
            format!("{shown}: the daemon has no fresh status, or too many clients; try again")
        }
        _ => format!("{shown}: {error}"),
    }
}

/// Parses a document.
///
/// # Errors
/// Fails if the line is not a status document, or if the document has another version.
pub fn parse(line: &[u8]) -> Result<StatusDocument, String> {
    #[derive(Deserialize)]
    struct Versioned {
        version: u32,
    }
    let Versioned { version } =
        serde_json::from_slice(line).map_err(|error| format!("not a status document: {error}"))?;
    if version != VERSION {
        return Err(format!(
            "status document has version {version}, must be {VERSION}: use the daemon's packwatch version"
        ));
    }
    serde_json::from_slice(line).map_err(|error| format!("status document: {error}"))
}
