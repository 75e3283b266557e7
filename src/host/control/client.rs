//! Client of the control socket. It sends a request to a running daemon and blocks until the answer arrives.

use std::io::{self, BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;

use super::protocol::{Request, contents};
use super::standard_path;
use crate::io::unix_socket::explain_no_daemon;

/// Longest wait for a list of alarms. A working daemon answers within milliseconds, so a daemon that has not answered
/// by then is hanging.
const PATIENCE: Duration = Duration::from_secs(5);
/// Longest answer, bytes: ten times the size of an answer with 1,000 alarms of 400 bytes each.
const MAX_ANSWER_BYTES: u64 = 4 << 20;

/// A daemon's control socket.
#[derive(Debug, Clone)]
pub struct ControlClient {
    path: PathBuf,
}

impl ControlClient {
    /// A client of the socket at `path`; `None` = the standard path.
    pub fn new(path: Option<&Path>) -> Self {
        Self { path: path.map_or_else(standard_path, Path::to_owned) }
    }

    /// Whether a daemon may be listening. `false` = the socket is missing, or its daemon has ended.
    pub fn is_served(&self) -> bool {
        let absent = [ErrorKind::NotFound, ErrorKind::ConnectionRefused];
        UnixStream::connect(&self.path).map_or_else(|error| !absent.contains(&error.kind()), |_| true)
    }

    /// Sends a request. Returns the answer as a line of JSON.
    ///
    /// # Errors
    /// Fails if no daemon answers. The message names the socket and the next step.
    pub fn ask_line(&self, request: Request) -> Result<Vec<u8>, String> {
        self.exchange(request).map_err(|error| self.explain(request, &error))
    }

    /// Sends a request. Returns the contents of the answer.
    ///
    /// # Errors
    /// Fails if no daemon answers, or if its answer is an error.
    pub fn ask<T: for<'de> Deserialize<'de>>(&self, request: Request) -> Result<T, String> {
        contents(&self.ask_line(request)?)
    }

    fn exchange(&self, request: Request) -> io::Result<Vec<u8>> {
        let mut stream = UnixStream::connect(&self.path)?;
        stream.set_read_timeout(Some(patience(request)))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        // If the daemon has no free slot, it sends an error and closes the connection, so writing may fail. Even then,
        // the error that the daemon sent is read.
        let written = stream.write_all(request.to_line().as_bytes());
        let mut line = Vec::new();
        BufReader::new(stream.take(MAX_ANSWER_BYTES)).read_until(b'\n', &mut line)?;
        if line.last() == Some(&b'\n') {
            return Ok(line);
        }
        written.and(Err(ErrorKind::UnexpectedEof.into()))
    }

    fn explain(&self, request: Request, error: &io::Error) -> String {
        let path = self.path.display();
        match error.kind() {
            ErrorKind::NotFound | ErrorKind::ConnectionRefused => {
                explain_no_daemon(&self.path, "control", &standard_path(), "--control")
            }
            ErrorKind::PermissionDenied => {
                format!("{path}: permission denied; the daemon's own user, its group and root may connect")
            }
            ErrorKind::WouldBlock | ErrorKind::TimedOut => {
                format!("{path}: no answer within {} s", patience(request).as_secs())
            }
            ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe | ErrorKind::ConnectionReset => {
                format!("{path}: the daemon closed the connection without an answer")
            }
            _ => format!("{path}: {error}"),
        }
    }
}

const fn patience(request: Request) -> Duration {
    // A command waits up to 30 s for a slow disk.
    if request.changes_something() { Duration::from_secs(35) } else { PATIENCE }
}
