//! The thread that writes documents down and serves them. In: drafts from the loop. Out: bytes to clients.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

use super::document::{Clients, Document};
use super::{MAX_CLIENTS, MAX_SILENCE, MODE, STALE, standard_path, stream_path};
use crate::io::unix_socket::{BindError, BoundSocket, SocketSetting, bind};
use crate::monitor::Event;

/// Pause after a connection could not be taken (no descriptor left): trying at once would find the same.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);
/// Refusals are told in the log this often.
const TELL_PERIOD: Duration = Duration::from_secs(60);
/// Stack of the thread, bytes: it serialises and waits.
const STACK_BYTES: usize = 512 << 10;

/// A document that is not written down yet.
#[derive(Debug)]
pub struct Draft {
    /// All but the events.
    pub document: Document,
    /// The events.
    pub events: Vec<Event>,
}

impl Draft {
    /// The line a client gets.
    pub fn into_line(self) -> serde_json::Result<Vec<u8>> {
        let mut document = self.document;
        document.events = self.events.iter().map(serde_json::to_value).collect::<Result<_, _>>()?;
        let mut line = serde_json::to_vec(&document)?;
        line.push(b'\n');
        Ok(line)
    }
}

/// What became of clients; written by the thread, read by the loop.
#[derive(Debug, Default)]
pub(super) struct ClientCounters {
    connected: AtomicU64,
    served: AtomicU64,
    refused: AtomicU64,
    dropped: AtomicU64,
}

impl ClientCounters {
    fn document(&self) -> Clients {
        let of = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Clients {
            connected: of(&self.connected),
            served: of(&self.served),
            refused: of(&self.refused),
            dropped: of(&self.dropped),
        }
    }
}

/// A document written down, and when that was.
#[derive(Debug, Clone)]
struct Published {
    line: Arc<[u8]>,
    at: Instant,
}

type Latest = watch::Receiver<Option<Published>>;

/// The running sockets; dropped, they end, and their files go.
#[derive(Debug)]
pub struct StatusServer {
    /// `None` only while it is dropped.
    drafts: Option<mpsc::Sender<Box<Draft>>>,
    counters: Arc<ClientCounters>,
    thread: Option<JoinHandle<()>>,
}

impl StatusServer {
    /// Opens the sockets. `None` = there are none, and the log says so.
    ///
    /// # Errors
    /// When another daemon has them, or one that was asked for cannot be made.
    pub fn start(setting: &SocketSetting) -> Result<Option<Self>, String> {
        let (path, is_needed) = match setting {
            SocketSetting::Off => return Ok(None),
            SocketSetting::At(path) => (path.clone(), true),
            SocketSetting::Standard => (standard_path(), false),
        };
        let shown = path.display().to_string();
        match Self::open(path, Limits { max_silence: MAX_SILENCE, stale: STALE }) {
            Ok(server) => {
                tracing::info!(path = shown, "status socket open");
                Ok(Some(server))
            }
            Err(BindError::Taken(owner)) => Err(format!(
                "{shown}: {owner} listens there already; stop it, or start this one with --status and another path"
            )),
            Err(BindError::Io(error)) if is_needed => Err(format!("{shown}: {error}")),
            Err(BindError::Io(error)) => {
                tracing::info!(path = shown, %error, "no status socket; --status says where to make one");
                Ok(None)
            }
        }
    }

    fn open(path: PathBuf, limits: Limits) -> Result<Self, BindError> {
        // One waits while another is written down.
        let (drafts, offered) = mpsc::channel(1);
        let (ready, opened) = sync_channel(1);
        let counters = Arc::new(ClientCounters::default());
        let desk = Desk { counters: Arc::clone(&counters), limits };
        let builder = std::thread::Builder::new().name("status".to_owned()).stack_size(STACK_BYTES);
        let thread = builder.spawn(move || run(path, desk, offered, &ready))?;
        match opened.recv() {
            Ok(Ok(())) => Ok(Self { drafts: Some(drafts), counters, thread: Some(thread) }),
            Ok(Err(error)) => Err(error),
            Err(_) => Err(io::Error::other("the status thread ended").into()),
        }
    }

    /// Hands a draft over; `false` = the thread is still busy, and nobody waits for it.
    pub fn offer(&self, draft: Draft) -> bool {
        self.drafts.as_ref().is_some_and(|drafts| drafts.try_send(Box::new(draft)).is_ok())
    }

    /// What became of clients so far.
    pub fn clients(&self) -> Clients {
        self.counters.document()
    }
}

impl Drop for StatusServer {
    fn drop(&mut self) {
        // The end of the drafts ends the thread; it waits for no client.
        self.drafts = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the status thread had failed");
        }
    }
}

/// Time limits; tests have shorter ones.
#[derive(Debug, Clone, Copy)]
struct Limits {
    max_silence: Duration,
    stale: Duration,
}

/// What every client needs.
#[derive(Debug, Clone)]
struct Desk {
    counters: Arc<ClientCounters>,
    limits: Limits,
}

/// The thread.
fn run(path: PathBuf, desk: Desk, drafts: mpsc::Receiver<Box<Draft>>, ready: &SyncSender<Result<(), BindError>>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let served = runtime.map_err(BindError::Io).and_then(|runtime| {
        runtime.block_on(async {
            let once = bind(&path, MODE).await?;
            let stream = bind(&stream_path(&path), MODE).await?;
            let _ = ready.send(Ok(()));
            serve([once, stream], &desk, drafts).await;
            Ok(())
        })
    });
    if let Err(error) = served {
        let _ = ready.send(Err(error));
    }
}

/// Until the loop has gone.
async fn serve([once, stream]: [BoundSocket; 2], desk: &Desk, mut drafts: mpsc::Receiver<Box<Draft>>) {
    let (published, latest) = watch::channel(None);
    let mut clients = JoinSet::new();
    let mut refusals = Refusals::default();
    loop {
        tokio::select! {
            biased;
            draft = drafts.recv() => match draft {
                Some(draft) => publish(*draft, &published),
                None => return,
            },
            Some(_) = clients.join_next() => {}
            accepted = once.listener.accept() => {
                if let Some(client) = admit(accepted.map(|(client, _)| client), clients.len(), desk, &mut refusals).await {
                    clients.spawn(serve_once(client, desk.clone(), latest.clone()));
                }
            }
            accepted = stream.listener.accept() => {
                if let Some(client) = admit(accepted.map(|(client, _)| client), clients.len(), desk, &mut refusals).await {
                    clients.spawn(serve_stream(client, desk.clone(), latest.clone()));
                }
            }
        }
        desk.counters.connected.store(clients.len() as u64, Ordering::Relaxed);
    }
}

fn publish(draft: Draft, published: &watch::Sender<Option<Published>>) {
    match draft.into_line() {
        Ok(line) => drop(published.send_replace(Some(Published { line: line.into(), at: Instant::now() }))),
        Err(error) => tracing::error!(%error, "status document not written"),
    }
}

/// Refusals since the log was last told.
#[derive(Debug, Default)]
struct Refusals {
    untold: u64,
    told: Option<Instant>,
}

impl Refusals {
    fn note(&mut self) {
        self.untold += 1;
        if self.told.is_none_or(|told| told.elapsed() >= TELL_PERIOD) {
            tracing::warn!(clients = self.untold, limit = MAX_CLIENTS, "status clients turned away: too many at once");
            (self.untold, self.told) = (0, Some(Instant::now()));
        }
    }
}

/// The client, when there is room.
async fn admit(
    accepted: io::Result<UnixStream>,
    connected: usize,
    desk: &Desk,
    refusals: &mut Refusals,
) -> Option<UnixStream> {
    match accepted {
        Err(error) => {
            tracing::warn!(%error, "connection to the status socket not taken");
            tokio::time::sleep(ACCEPT_PAUSE).await;
            None
        }
        Ok(_) if connected >= MAX_CLIENTS => {
            desk.counters.refused.fetch_add(1, Ordering::Relaxed);
            refusals.note();
            None
        }
        Ok(client) => {
            desk.counters.served.fetch_add(1, Ordering::Relaxed);
            Some(client)
        }
    }
}

/// One fresh document.
async fn serve_once(mut client: UnixStream, desk: Desk, mut latest: Latest) {
    let fresh = latest.wait_for(|published| published.as_ref().is_some_and(|it| it.at.elapsed() < desk.limits.stale));
    let line = match timeout(desk.limits.max_silence, fresh).await {
        Ok(Ok(published)) => published.as_ref().map(|published| Arc::clone(&published.line)),
        // The loop makes none, or has gone.
        Ok(Err(_)) | Err(_) => None,
    };
    if let Some(line) = line {
        tell(&mut client, &line, &desk).await;
    }
}

/// Every document from here on; one that is slow misses some.
async fn serve_stream(mut client: UnixStream, desk: Desk, mut latest: Latest) {
    while latest.changed().await.is_ok() {
        let fresh = latest.borrow_and_update().clone().filter(|published| published.at.elapsed() < desk.limits.stale);
        let line = fresh.map(|published| published.line);
        if let Some(line) = line
            && !tell(&mut client, &line, &desk).await
        {
            return;
        }
    }
}

/// Writes a line; `false` = the client has gone, or was dropped because it did not take it in time.
async fn tell(client: &mut UnixStream, line: &[u8], desk: &Desk) -> bool {
    match timeout(desk.limits.max_silence, client.write_all(line)).await {
        Ok(written) => written.is_ok(),
        Err(_) => {
            desk.counters.dropped.fetch_add(1, Ordering::Relaxed);
            false
        }
    }
}

#[cfg(test)]
mod tests;
