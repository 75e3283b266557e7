//! Server of the control socket: accepts connections, passes requests to the daemon's loop and returns the answers.

use std::time::{Duration, Instant};

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::unix::{OwnedWriteHalf, UCred};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::protocol::{Answer, Request};
use super::{MAX_REQUEST_BYTES, MAX_SILENCE, MODE, SLOTS, daemon_path};
use crate::io::connection_slots::{Activity, ConnectionSlots, LocalProcess, SlotLimits};
use crate::io::event_log::command_words;
use crate::io::place::PlaceSetting;
use crate::io::unix_socket::{BoundSocket, SocketFile, bind};

/// Pause after a connection could not be accepted because the process has no free file descriptor. An immediate retry
/// would fail too.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);

/// A request that waits for the daemon's loop.
#[derive(Debug)]
pub struct PendingRequest {
    /// The request.
    pub request: Request,
    /// The channel to which the loop sends the answer.
    pub answer: oneshot::Sender<Answer>,
}

/// The running socket. When this value is dropped, the socket is closed and its file is deleted.
#[derive(Debug)]
pub struct ControlServer {
    _tasks: JoinSet<()>,
    _file: SocketFile,
}

impl ControlServer {
    /// Opens the socket and sends the received requests to `requests`. Returns `None` if the socket is switched off, or
    /// if the default socket cannot be opened (logged).
    ///
    /// # Errors
    /// Fails if another daemon uses the socket, or if the socket at a path given by the user cannot be opened.
    pub async fn start(setting: &PlaceSetting, requests: mpsc::Sender<PendingRequest>) -> Result<Option<Self>, String> {
        let Some((path, is_needed)) = setting.resolve(|| (daemon_path(), false)) else { return Ok(None) };
        match bind(&path, MODE).await {
            Ok(bound) => {
                let server = Self::serve(bound, requests, MAX_SILENCE);
                server.map(Some).map_err(|error| format!("{}: {error}", path.display()))
            }
            Err(error) => error.without_socket(&path, is_needed, "control"),
        }
    }

    fn serve(
        bound: BoundSocket,
        requests: mpsc::Sender<PendingRequest>,
        max_silence: Duration,
    ) -> std::io::Result<Self> {
        // The daemon's own user, as the kernel would report it for a client.
        let own_uid = UnixStream::pair()?.0.peer_cred()?.uid();
        tracing::info!(path = %bound.file.path.display(), "control socket open");
        let mut tasks = JoinSet::new();
        tasks.spawn(accept(bound.listener, ConnectionContext { requests, own_uid, max_silence }));
        Ok(Self { _tasks: tasks, _file: bound.file })
    }
}

/// State shared by all connections.
#[derive(Debug, Clone)]
struct ConnectionContext {
    requests: mpsc::Sender<PendingRequest>,
    own_uid: u32,
    max_silence: Duration,
}

async fn accept(listener: UnixListener, context: ConnectionContext) {
    let mut places = ConnectionSlots::new(SLOTS);
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!(%error, "connection to the control socket not accepted");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let peer = match stream.peer_cred() {
            Ok(peer) => peer,
            Err(error) => {
                tracing::warn!(%error, "the kernel does not identify a client of the control socket");
                continue;
            }
        };
        let client = LocalProcess::from(&peer);
        if !places.make_room(&client, Instant::now()) {
            refuse(&stream);
            continue;
        }
        let (context, activity) = (context.clone(), Activity::new());
        let of_task = activity.clone();
        let task = connections.spawn(async move { serve_connection(stream, peer, &context, &of_task).await });
        places.take(client, activity, task);
    }
}

/// Rejects a connection. The reason is sent only if sending does not block.
fn refuse(stream: &UnixStream) {
    let SlotLimits { total, per_user, per_client, .. } = SLOTS;
    let error = format!(
        "too many connections: at most {per_client} of one process, {per_user} of one user, {total} in total; try again \
         later"
    );
    tracing::warn!(error, "connection to the control socket rejected");
    let _ = stream.try_write(&Answer::Error(error).to_line());
}

async fn serve_connection(stream: UnixStream, peer: UCred, context: &ConnectionContext, activity: &Activity) {
    let may_change = peer.uid() == context.own_uid || peer.uid() == 0;
    let (read, mut write) = stream.into_split();
    let mut reader = BufReader::new(read);
    let mut line = Vec::new();
    loop {
        line.clear();
        // One byte more than allowed is read, to detect a line that is too long.
        let mut limited = (&mut reader).take(MAX_REQUEST_BYTES as u64 + 1);
        match timeout(context.max_silence, limited.read_until(b'\n', &mut line)).await {
            Ok(Ok(0) | Err(_)) => return,
            Ok(Ok(_)) => {}
            Err(_) => {
                let limit = context.max_silence.as_secs_f64();
                let silent = Answer::Error(format!("no request within {limit} s, connection closed"));
                return drop(send(&mut write, silent, context).await);
            }
        }
        if line.len() > MAX_REQUEST_BYTES {
            let long = format!("request too long, must be a line of at most {MAX_REQUEST_BYTES} bytes");
            return drop(send(&mut write, Answer::Error(long), context).await);
        }
        let answer = match Request::parse(&line) {
            Err(fault) => Answer::Error(fault),
            Ok(request) if request.changes_something() && !may_change => Answer::Error(format!(
                "user {} may read but not change anything; only root and user {} may",
                peer.uid(),
                context.own_uid
            )),
            Ok(request) => {
                if let Request::Command(command) = &request {
                    let command = command_words(command);
                    tracing::info!(uid = peer.uid(), pid = peer.pid(), command, "command over the control socket");
                }
                activity.begin_request();
                let answer = ask(context, request).await;
                activity.end_request();
                answer
            }
        };
        if send(&mut write, answer, context).await.is_err() {
            return;
        }
    }
}

async fn ask(context: &ConnectionContext, request: Request) -> Answer {
    let (answer, answered) = oneshot::channel();
    let stopping = || Answer::Error("the daemon is stopping".to_owned());
    if context.requests.send(PendingRequest { request, answer }).await.is_err() {
        return stopping();
    }
    answered.await.unwrap_or_else(|_| stopping())
}

/// Writes an answer. Returns an error, which ends the connection, if the write fails or the client does not read in
/// time.
async fn send(write: &mut OwnedWriteHalf, answer: Answer, context: &ConnectionContext) -> std::io::Result<()> {
    // Serialising a long list takes milliseconds, so it does not run on the loop's thread.
    let line = tokio::task::spawn_blocking(move || answer.to_line()).await?;
    timeout(context.max_silence, write.write_all(&line)).await.unwrap_or_else(|late| Err(late.into()))
}

#[cfg(test)]
mod tests;
