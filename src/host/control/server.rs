//! Accepts connections and carries requests to the loop and answers back.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::unix::OwnedWriteHalf;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::protocol::{Answer, Request};
use super::{ControlSetting, MAX_CONNECTIONS, MAX_REQUEST_BYTES, MAX_SILENCE, MODE, standard_path};
use crate::io::unix_socket::{BindError, BoundSocket, SocketFile, bind};

/// Pause after a connection could not be taken (no descriptor left): trying at once would find the same.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);

/// A request on its way to the loop.
#[derive(Debug)]
pub struct Asked {
    /// What.
    pub request: Request,
    /// Where the answer goes.
    pub answer: oneshot::Sender<Answer>,
}

/// The running socket; dropped, it ends, and its file goes.
#[derive(Debug)]
pub struct ControlServer {
    _tasks: JoinSet<()>,
    _file: SocketFile,
}

impl ControlServer {
    /// Opens the socket; what is asked over it goes into `requests`. `None` = there is none, and the log says so.
    ///
    /// # Errors
    /// When another daemon has it, or one that was asked for cannot be made.
    pub async fn start(setting: &ControlSetting, requests: mpsc::Sender<Asked>) -> Result<Option<Self>, String> {
        let (path, is_needed) = match setting {
            ControlSetting::Off => return Ok(None),
            ControlSetting::At(path) => (path.clone(), true),
            ControlSetting::Standard => (standard_path(), false),
        };
        let shown = path.display();
        match bind(&path, MODE).await {
            Ok(bound) => {
                Ok(Some(Self::serve(bound, requests, MAX_SILENCE).map_err(|error| format!("{shown}: {error}"))?))
            }
            Err(BindError::Taken(owner)) => Err(format!(
                "{shown}: {owner} listens there already; stop it, or start this one with --control and another path"
            )),
            Err(BindError::Io(error)) if is_needed => Err(format!("{shown}: {error}")),
            Err(BindError::Io(error)) => {
                tracing::info!(path = %shown, %error, "no control socket; --control says where to make one");
                Ok(None)
            }
        }
    }

    fn serve(bound: BoundSocket, requests: mpsc::Sender<Asked>, max_silence: Duration) -> std::io::Result<Self> {
        // The kernel's own word for who we are, in the same terms as for a peer.
        let own_uid = UnixStream::pair()?.0.peer_cred()?.uid();
        tracing::info!(path = %bound.file.path.display(), "control socket open");
        let mut tasks = JoinSet::new();
        tasks.spawn(accept(bound.listener, Desk { requests, own_uid, max_silence }));
        Ok(Self { _tasks: tasks, _file: bound.file })
    }
}

/// What a connection needs.
#[derive(Debug, Clone)]
struct Desk {
    requests: mpsc::Sender<Asked>,
    own_uid: u32,
    max_silence: Duration,
}

async fn accept(listener: UnixListener, desk: Desk) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!(%error, "connection to the control socket not taken");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        match Arc::clone(&places).try_acquire_owned() {
            Ok(place) => {
                let desk = desk.clone();
                connections.spawn(async move {
                    serve_connection(stream, &desk).await;
                    drop(place);
                });
            }
            Err(_) => refuse(&stream),
        }
    }
}

/// Says so if there is room to say it at once; waits for nobody.
fn refuse(stream: &UnixStream) {
    tracing::warn!(limit = MAX_CONNECTIONS, "connection to the control socket refused: too many at once");
    let error = format!("{MAX_CONNECTIONS} connections are open, more are not taken at once; try again later");
    let _ = stream.try_write(&Answer::Error(error).to_line());
}

async fn serve_connection(stream: UnixStream, desk: &Desk) {
    let peer = match stream.peer_cred() {
        Ok(peer) => peer,
        Err(error) => return tracing::warn!(%error, "a client of the control socket that the kernel does not know"),
    };
    let may_change = peer.uid() == desk.own_uid || peer.uid() == 0;
    let (read, mut write) = stream.into_split();
    let mut reader = BufReader::new(read);
    let mut line = Vec::new();
    loop {
        line.clear();
        // One byte more than allowed tells a line that is too long.
        let mut limited = (&mut reader).take(MAX_REQUEST_BYTES as u64 + 1);
        match timeout(desk.max_silence, limited.read_until(b'\n', &mut line)).await {
            Ok(Ok(0) | Err(_)) => return,
            Ok(Ok(_)) => {}
            Err(_) => {
                let limit = desk.max_silence.as_secs_f64();
                let silent = Answer::Error(format!("no request within {limit} s, the connection is closed"));
                return drop(send(&mut write, silent, desk).await);
            }
        }
        if line.len() > MAX_REQUEST_BYTES {
            let long = format!("a request of more than {MAX_REQUEST_BYTES} bytes, must be a line of at most that many");
            return drop(send(&mut write, Answer::Error(long), desk).await);
        }
        let answer = match Request::parse(&line) {
            Err(fault) => Answer::Error(fault),
            Ok(request) if request.changes_something() && !may_change => Answer::Error(format!(
                "user {} may look, but not change anything: that is for root and user {}",
                peer.uid(),
                desk.own_uid
            )),
            Ok(request) => {
                if request.changes_something() {
                    tracing::info!(uid = peer.uid(), pid = peer.pid(), ?request, "asked over the control socket");
                }
                ask(desk, request).await
            }
        };
        if send(&mut write, answer, desk).await.is_err() {
            return;
        }
    }
}

async fn ask(desk: &Desk, request: Request) -> Answer {
    let (answer, answered) = oneshot::channel();
    let stopping = || Answer::Error("the daemon is stopping".to_owned());
    if desk.requests.send(Asked { request, answer }).await.is_err() {
        return stopping();
    }
    answered.await.unwrap_or_else(|_| stopping())
}

/// Writes an answer; one that is not taken in time ends the connection.
async fn send(write: &mut OwnedWriteHalf, answer: Answer, desk: &Desk) -> std::io::Result<()> {
    // A long list takes milliseconds to write down: not on the thread of the estimation loop.
    let line = tokio::task::spawn_blocking(move || answer.to_line()).await?;
    timeout(desk.max_silence, write.write_all(&line)).await.unwrap_or_else(|late| Err(late.into()))
}

#[cfg(test)]
mod tests;
