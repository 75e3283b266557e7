//! Opens and deletes Unix sockets and their files. If the file of a socket exists and the daemon that created it has
//! ended, the file is replaced. If that daemon still runs, opening fails. [`explain_no_daemon`] is the message for a
//! client that finds no daemon.

use std::fs::Permissions;
use std::io::{self, ErrorKind};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::net::{UnixListener, UnixStream};
use tokio::time::timeout;

use super::place::first_folder;
use super::result_file::name_folder;

/// The folder of the service, and of a daemon that root starts from a shell.
const STANDARD_FOLDER: &str = "/run/packwatch";

/// Default folder of a daemon's sockets: the folder that systemd created, else the user's own folder (never for root),
/// else `/run/packwatch`.
pub fn runtime_folder() -> PathBuf {
    let is_root = || std::fs::metadata("/proc/self").is_ok_and(|process| process.uid() == 0);
    let own = || own_folder().filter(|_| !is_root());
    first_folder("RUNTIME_DIRECTORY").or_else(own).unwrap_or_else(|| PathBuf::from(STANDARD_FOLDER))
}

/// Default folder of the sockets for clients: the folder that systemd created, else the folder of the service. If the
/// folder of the service does not exist, but the user's own folder does, the default is the user's own folder.
pub fn client_folder() -> PathBuf {
    let standard = PathBuf::from(STANDARD_FOLDER);
    let own = || own_folder().filter(|own| !standard.exists() && own.exists());
    first_folder("RUNTIME_DIRECTORY").or_else(own).unwrap_or(standard)
}

fn own_folder() -> Option<PathBuf> {
    Some(first_folder("XDG_RUNTIME_DIR")?.join("packwatch"))
}

/// Explains that no daemon listens at `path`, and names the next step. `socket` is "status" or "control"; `standard` is
/// the default path of this socket. `setting` is the option or the key with which the user chooses the path.
pub fn explain_no_daemon(path: &Path, socket: &str, standard: &Path, setting: &str) -> String {
    let shown = path.display();
    if let Some(file) = other_file(path) {
        return format!("{shown}: is {file}, must be the {socket} socket of a daemon; give its path with {setting}");
    }
    let option = if path == standard { String::new() } else { format!(" --{socket} {shown}") };
    format!(
        "{shown}: no daemon listens there; start one with \"packwatch run -c FILE{option}\", or give the path of its \
         {socket} socket with {setting}"
    )
}

fn other_file(path: &Path) -> Option<&'static str> {
    let kind = std::fs::metadata(path).ok()?.file_type();
    match (kind.is_socket(), kind.is_file(), kind.is_dir()) {
        (true, ..) => None,
        (_, true, _) => Some("a regular file"),
        (.., true) => Some("a folder"),
        _ => Some("not a socket"),
    }
}

/// Creates the folder of `path` if it is the default folder and systemd has not created it. If this fails, the bind
/// also fails and reports an error.
fn make_default_folder(path: &Path) {
    let Some(folder) = path.parent().filter(|folder| *folder == runtime_folder()) else { return };
    if first_folder("RUNTIME_DIRECTORY").is_none() && std::fs::create_dir(folder).is_ok() {
        // Other users may list this folder. The modes of the sockets decide who may connect.
        let _ = std::fs::set_permissions(folder, Permissions::from_mode(0o755));
    }
}

/// A bound socket and its file, which is removed on drop.
#[derive(Debug)]
pub struct BoundSocket {
    pub listener: UnixListener,
    pub file: SocketFile,
}

/// The file of a bound socket.
#[derive(Debug)]
pub struct SocketFile {
    pub path: PathBuf,
    inode: (u64, u64),
}

/// Why the socket was not opened.
#[derive(Debug)]
pub enum BindError {
    /// Another daemon uses the path.
    Taken(String),
    /// The socket cannot be created.
    Io(io::Error),
}

impl From<io::Error> for BindError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl BindError {
    /// Decides whether the daemon continues without this socket. If it continues, logs the reason and returns `None`.
    /// `option` is the name of the command-line option that sets the socket's path.
    ///
    /// # Errors
    /// Fails if another daemon uses the socket, or if the socket is required (`is_needed`).
    pub fn without_socket<T>(self, path: &Path, is_needed: bool, option: &str) -> Result<Option<T>, String> {
        let shown = path.display();
        match self {
            Self::Taken(owner) => Err(format!(
                "{shown}: already in use by {owner}; stop that process, or choose another path with --{option}"
            )),
            Self::Io(error) if is_needed => {
                Err(format!("{shown}: the {option} socket cannot be created: {}", name_folder(path, error)))
            }
            Self::Io(error) => {
                tracing::info!(path = %shown, %error, "no {option} socket; choose its path with --{option}");
                Ok(None)
            }
        }
    }
}

/// Binds a socket at `path`. The file mode `mode` decides who may connect.
pub async fn bind(path: &Path, mode: u32) -> Result<BoundSocket, BindError> {
    make_default_folder(path);
    remove_stale(path).await?;
    let listener = UnixListener::bind(path)?;
    std::fs::set_permissions(path, Permissions::from_mode(mode))?;
    let file = SocketFile { path: path.to_owned(), inode: inode(path)? };
    Ok(BoundSocket { listener, file })
}

/// Removes the socket of a daemon that has ended. If the daemon still runs, fails and keeps the socket.
async fn remove_stale(path: &Path) -> Result<(), BindError> {
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error.into()),
        Ok(found) if !found.file_type().is_socket() => {
            return Err(io::Error::new(ErrorKind::AlreadyExists, "exists and is not a socket").into());
        }
        Ok(_) => {}
    }
    // A suspended daemon does not accept connections, and its queue may be full, so the wait is limited.
    match timeout(Duration::from_secs(1), UnixStream::connect(path)).await {
        Ok(Err(error)) if error.kind() == ErrorKind::ConnectionRefused => Ok(std::fs::remove_file(path)?),
        Ok(Err(error)) if error.kind() == ErrorKind::NotFound => Ok(()),
        Ok(Err(error)) => Err(error.into()),
        Ok(Ok(stream)) => Err(BindError::Taken(owner(&stream))),
        Err(_) => Err(BindError::Taken("a process that does not respond".to_owned())),
    }
}

fn owner(stream: &UnixStream) -> String {
    match stream.peer_cred() {
        Ok(who) => {
            let process = who.pid().map_or_else(|| "a process".to_owned(), |pid| format!("process {pid}"));
            format!("{process} of user {}", who.uid())
        }
        Err(_) => "another process".to_owned(),
    }
}

fn inode(path: &Path) -> io::Result<(u64, u64)> {
    std::fs::symlink_metadata(path).map(|found| (found.dev(), found.ino()))
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // Another daemon may have created its own socket at this path.
        if inode(&self.path).is_ok_and(|found| found == self.inode)
            && let Err(error) = std::fs::remove_file(&self.path)
        {
            tracing::warn!(path = %self.path.display(), %error, "socket not removed");
        }
        // The default folder is removed with its last socket, unless systemd created it.
        if let Some(folder) = self.path.parent().filter(|folder| *folder == runtime_folder())
            && first_folder("RUNTIME_DIRECTORY").is_none()
        {
            let _ = std::fs::remove_dir(folder);
        }
    }
}
