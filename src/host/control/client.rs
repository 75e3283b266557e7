//! The other end: asks a running daemon, waits for its answer. Blocking; for commands of people.

use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;

use super::protocol::{Request, contents};
use super::standard_path;

/// How long a daemon may take: it answers between two ticks, so one that needs longer hangs.
const PATIENCE: Duration = Duration::from_secs(5);
/// Longest answer, bytes: a thousand alarms of 400 bytes, ten times over.
const MAX_ANSWER_BYTES: u64 = 4 << 20;

/// A daemon's control socket.
#[derive(Debug, Clone)]
pub struct ControlClient {
    path: PathBuf,
}

impl ControlClient {
    /// At `path`; `None` = where a daemon makes it when nobody says where.
    pub fn new(path: Option<&Path>) -> Self {
        Self { path: path.map_or_else(standard_path, Path::to_owned) }
    }

    /// Whether somebody listens there, or may: only a missing or forsaken socket says no.
    pub fn is_served(&self) -> bool {
        let nobody = [ErrorKind::NotFound, ErrorKind::ConnectionRefused];
        UnixStream::connect(&self.path).map_or_else(|error| !nobody.contains(&error.kind()), |_| true)
    }

    /// Asks; returns the answer's line as it came.
    ///
    /// # Errors
    /// When nobody answers: which socket, and what to do.
    pub fn ask_line(&self, request: Request) -> Result<Vec<u8>, String> {
        self.exchange(request).map_err(|error| self.explain(&error))
    }

    /// Asks; returns what the answer contains.
    ///
    /// # Errors
    /// When nobody answers, and what the daemon answers instead.
    pub fn ask<T: for<'de> Deserialize<'de>>(&self, request: Request) -> Result<T, String> {
        contents(&self.ask_line(request)?)
    }

    fn exchange(&self, request: Request) -> io::Result<Vec<u8>> {
        let mut stream = UnixStream::connect(&self.path)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        // A daemon that has no place for us may have answered and gone already.
        let written = stream.write_all(request.to_line().as_bytes());
        let mut line = Vec::new();
        BufReader::new(stream.take(MAX_ANSWER_BYTES)).read_until(b'\n', &mut line)?;
        if line.last() == Some(&b'\n') {
            return Ok(line);
        }
        written.and(Err(ErrorKind::UnexpectedEof.into()))
    }

    fn explain(&self, error: &io::Error) -> String {
        let path = self.path.display();
        match error.kind() {
            ErrorKind::NotFound | ErrorKind::ConnectionRefused => format!(
                "{path}: no daemon listens there; start one with \"packwatch run -c FILE --control {path}\", or say with \
                 --control where it listens"
            ),
            ErrorKind::PermissionDenied => {
                format!("{path}: permission denied; the daemon's own user, its group and root may connect")
            }
            ErrorKind::WouldBlock | ErrorKind::TimedOut => {
                format!("{path}: no answer within {} s", PATIENCE.as_secs())
            }
            ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe | ErrorKind::ConnectionReset => {
                format!("{path}: the daemon closed the connection without an answer")
            }
            _ => format!("{path}: {error}"),
        }
    }
}
