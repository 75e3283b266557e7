//! The other end of the status socket: one document, blocking, within a bounded time.

use std::io::{self, ErrorKind, Read};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::document::{Document, VERSION};
use super::{MAX_SILENCE, standard_path};

/// A second longer than a daemon waits for a fresh document.
pub const PATIENCE: Duration = Duration::from_secs(1 + MAX_SILENCE.as_secs());
/// Longest document, bytes: 1,024 cells and as many alarms are under 1 MB.
pub const MAX_DOCUMENT_BYTES: usize = 8 << 20;

/// A daemon's status socket.
#[derive(Debug, Clone)]
pub struct StatusClient {
    /// Where.
    pub path: PathBuf,
}

impl StatusClient {
    /// At `path`; `None` = where a daemon makes it when nobody says where.
    pub fn new(path: Option<&Path>) -> Self {
        Self { path: path.map_or_else(standard_path, Path::to_owned) }
    }

    /// The document as it came, a line of JSON.
    ///
    /// # Errors
    /// When nobody tells it: which socket, and what to do.
    pub fn line(&self) -> Result<Vec<u8>, String> {
        self.read(PATIENCE).map_err(|error| explain(&self.path, &error))
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

/// An error for a document that does not end.
pub fn check_length(bytes: usize) -> io::Result<()> {
    if bytes <= MAX_DOCUMENT_BYTES {
        return Ok(());
    }
    Err(io::Error::new(ErrorKind::InvalidData, format!("a document of more than {MAX_DOCUMENT_BYTES} bytes")))
}

/// Why there is no document, for people.
pub fn explain(path: &Path, error: &io::Error) -> String {
    let path = path.display();
    match error.kind() {
        ErrorKind::NotFound | ErrorKind::ConnectionRefused => format!(
            "{path}: no daemon listens there; start one with \"packwatch run -c FILE --status {path}\", or say with \
             --socket where it listens"
        ),
        ErrorKind::PermissionDenied => format!("{path}: only root may look into the service's folder; try sudo"),
        ErrorKind::WouldBlock | ErrorKind::TimedOut => format!("{path}: no document in time"),
        ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset => {
            format!("{path}: the daemon has no document that is fresh, or too many clients")
        }
        _ => format!("{path}: {error}"),
    }
}

/// Reads a document.
///
/// # Errors
/// When it is none, or one of another version.
pub fn parse(line: &[u8]) -> Result<Document, String> {
    #[derive(Deserialize)]
    struct Versioned {
        version: u32,
    }
    let Versioned { version } = serde_json::from_slice(line).map_err(|error| format!("no status document: {error}"))?;
    if version != VERSION {
        return Err(format!("status document of version {version}, this program reads {VERSION}"));
    }
    serde_json::from_slice(line).map_err(|error| format!("status document: {error}"))
}
