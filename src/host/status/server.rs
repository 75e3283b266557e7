//! Runs the thread that serialises documents and sends them to clients. In: drafts (documents that are not serialised
//! yet) from the daemon's loop. Out: lines to clients.

use std::io;
use std::path::PathBuf;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::net::unix::SocketAddr;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

use super::counters::ClientCounts;
use super::document::StatusDocument;
use super::{MAX_SILENCE, MODE, SLOTS, STALE, daemon_path, stream_path};
use crate::io::connection_slots::{Activity, ConnectionSlots, LocalProcess, SlotLimits};
use crate::io::place::PlaceSetting;
use crate::io::runtime::new_runtime;
use crate::io::unix_socket::{BindError, BoundSocket, bind};
use crate::monitor::Event;

/// Pause after a connection could not be accepted. The usual reason is that no descriptor is left. An immediate retry
/// would then fail too.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);
const REFUSAL_LOG_PERIOD: Duration = Duration::from_secs(60);
/// Stack of the thread, bytes. A small stack is enough, because the thread only serialises and waits.
const STACK_BYTES: usize = 512 << 10;

/// A document that has not been serialised yet.
#[derive(Debug)]
pub struct Draft {
    /// The document without its events.
    pub document: StatusDocument,
    /// The events.
    pub events: Vec<Event>,
}

impl Draft {
    /// Serialises the line for the clients.
    pub fn into_line(self) -> serde_json::Result<Vec<u8>> {
        let mut document = self.document;
        document.events = self.events.iter().map(serde_json::to_value).collect::<Result<_, _>>()?;
        let mut line = serde_json::to_vec(&document)?;
        line.push(b'\n');
        Ok(line)
    }
}

#[derive(Debug, Clone)]
struct PublishedLine {
    line: Arc<[u8]>,
    at: Instant,
}

type Latest = watch::Receiver<Option<PublishedLine>>;

/// The running sockets. Dropping this value closes the sockets and deletes their files.
#[derive(Debug)]
pub struct StatusServer {
    /// Channel to the thread; `None` only during the drop.
    drafts: Option<mpsc::Sender<Box<Draft>>>,
    counters: Arc<Mutex<ClientCounts>>,
    thread: Option<JoinHandle<()>>,
}

impl StatusServer {
    /// Opens the sockets. Returns `None` if they cannot be opened (logged).
    ///
    /// # Errors
    /// Fails if another daemon uses the sockets, or if sockets that the user requested cannot be created.
    pub fn start(setting: &PlaceSetting) -> Result<Option<Self>, String> {
        let Some((path, is_needed)) = setting.resolve(|| (daemon_path(), false)) else { return Ok(None) };
        match Self::open(path.clone(), Limits { max_silence: MAX_SILENCE, stale: STALE }) {
            Ok(server) => {
                tracing::info!(path = %path.display(), "status socket open");
                Ok(Some(server))
            }
            Err(error) => error.without_socket(&path, is_needed, "status"),
        }
    }

    fn open(path: PathBuf, limits: Limits) -> Result<Self, BindError> {
        // One draft may wait while another is serialised.
        let (drafts, offered) = mpsc::channel(1);
        let (ready, opened) = sync_channel(1);
        let counters = Arc::<Mutex<ClientCounts>>::default();
        let context = ClientContext { counters: Arc::clone(&counters), limits };
        let builder = std::thread::Builder::new().name("status".to_owned()).stack_size(STACK_BYTES);
        let thread = builder.spawn(move || run(path, context, offered, &ready))?;
        match opened.recv() {
            Ok(Ok(())) => Ok(Self { drafts: Some(drafts), counters, thread: Some(thread) }),
            Ok(Err(error)) => Err(error),
            Err(_) => Err(io::Error::other("the status thread ended").into()),
        }
    }

    /// Offers a draft to the thread without blocking. Returns `false` if the thread is busy and the draft is dropped.
    pub fn offer(&self, draft: Draft) -> bool {
        self.drafts.as_ref().is_some_and(|drafts| drafts.try_send(Box::new(draft)).is_ok())
    }

    /// Counts of clients since the start.
    pub fn clients(&self) -> ClientCounts {
        *self.counters.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for StatusServer {
    fn drop(&mut self) {
        // Closing the channel ends the thread, which does not wait for clients.
        self.drafts = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the status thread has panicked");
        }
    }
}

/// Time limits, which are shorter in tests.
#[derive(Debug, Clone, Copy)]
struct Limits {
    max_silence: Duration,
    stale: Duration,
}

#[derive(Debug, Clone)]
struct ClientContext {
    counters: Arc<Mutex<ClientCounts>>,
    limits: Limits,
}

impl ClientContext {
    fn count(&self, note: impl FnOnce(&mut ClientCounts)) {
        note(&mut self.counters.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// Runs the thread.
fn run(
    path: PathBuf,
    context: ClientContext,
    drafts: mpsc::Receiver<Box<Draft>>,
    ready: &SyncSender<Result<(), BindError>>,
) {
    let runtime = new_runtime();
    let served = runtime.map_err(BindError::Io).and_then(|runtime| {
        runtime.block_on(async {
            let once = bind(&path, MODE).await?;
            let stream = bind(&stream_path(&path), MODE).await?;
            let _ = ready.send(Ok(()));
            serve([once, stream], &context, drafts).await;
            Ok(())
        })
    });
    if let Err(error) = served {
        let _ = ready.send(Err(error));
    }
}

/// Serves until the daemon's loop closes the channel of drafts.
async fn serve([once, stream]: [BoundSocket; 2], context: &ClientContext, mut drafts: mpsc::Receiver<Box<Draft>>) {
    let (published, latest) = watch::channel(None);
    let mut clients =
        Clients { tasks: JoinSet::new(), slots: ConnectionSlots::new(SLOTS), refusals: RefusalLog::default() };
    loop {
        tokio::select! {
            biased;
            draft = drafts.recv() => match draft {
                Some(draft) => publish(*draft, &published),
                None => return,
            },
            Some(_) = clients.tasks.join_next() => {}
            accepted = once.listener.accept() => {
                clients.admit(accepted, context, |client| serve_once(client, context.clone(), latest.clone())).await;
            }
            accepted = stream.listener.accept() => {
                clients.admit(accepted, context, |client| serve_stream(client, context.clone(), latest.clone())).await;
            }
        }
        context.count(|counts| counts.connected = clients.tasks.len() as u64);
    }
}

fn publish(draft: Draft, published: &watch::Sender<Option<PublishedLine>>) {
    match draft.into_line() {
        Ok(line) => drop(published.send_replace(Some(PublishedLine { line: line.into(), at: Instant::now() }))),
        Err(error) => tracing::error!(%error, "status document not serialised"),
    }
}

/// The number of clients rejected since the last log line.
#[derive(Debug, Default)]
struct RefusalLog {
    unreported: u64,
    reported: Option<Instant>,
}

impl RefusalLog {
    fn note(&mut self) {
        self.unreported += 1;
        if self.reported.is_none_or(|reported| reported.elapsed() >= REFUSAL_LOG_PERIOD) {
            let SlotLimits { total, per_user, per_client, .. } = SLOTS;
            tracing::warn!(
                clients = self.unreported,
                per_client,
                per_user,
                total,
                "status clients rejected: too many at once"
            );
            (self.unreported, self.reported) = (0, Some(Instant::now()));
        }
    }
}

struct Clients {
    tasks: JoinSet<()>,
    slots: ConnectionSlots<LocalProcess>,
    refusals: RefusalLog,
}

impl Clients {
    async fn admit<S: Future<Output = ()> + Send + 'static>(
        &mut self,
        accepted: io::Result<(UnixStream, SocketAddr)>,
        context: &ClientContext,
        serve: impl FnOnce(UnixStream) -> S,
    ) {
        let identified = accepted.and_then(|(stream, _)| Ok((LocalProcess::from(&stream.peer_cred()?), stream)));
        match identified {
            Err(error) => {
                tracing::warn!(%error, "connection to the status socket not accepted");
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
            Ok((client, stream)) if self.slots.make_room(&client, std::time::Instant::now()) => {
                context.count(|counts| counts.served += 1);
                // A client that reads is never idle, because it always waits for the next document.
                let activity = Activity::new();
                activity.begin_request();
                self.slots.take(client, activity, self.tasks.spawn(serve(stream)));
            }
            Ok(_) => {
                context.count(|counts| counts.refused += 1);
                self.refusals.note();
            }
        }
    }
}

async fn serve_once(mut client: UnixStream, context: ClientContext, mut latest: Latest) {
    let fresh =
        latest.wait_for(|published| published.as_ref().is_some_and(|it| it.at.elapsed() < context.limits.stale));
    let line = match timeout(context.limits.max_silence, fresh).await {
        Ok(Ok(published)) => published.as_ref().map(|published| Arc::clone(&published.line)),
        // The daemon's loop does not publish documents any more.
        Ok(Err(_)) | Err(_) => None,
    };
    if let Some(line) = line {
        send_line(&mut client, &line, &context).await;
    }
}

/// Sends the latest document if it is fresh, then every document that is published. A slow client misses some
/// documents.
async fn serve_stream(mut client: UnixStream, context: ClientContext, mut latest: Latest) {
    while latest.changed().await.is_ok() {
        let fresh =
            latest.borrow_and_update().clone().filter(|published| published.at.elapsed() < context.limits.stale);
        let line = fresh.map(|published| published.line);
        if let Some(line) = line
            && !send_line(&mut client, &line, &context).await
        {
            return;
        }
    }
}

/// Writes a line. Returns `false` if the client has closed the connection, or if the client must be dropped because it
/// did not read in time.
async fn send_line(client: &mut UnixStream, line: &[u8], context: &ClientContext) -> bool {
    match timeout(context.limits.max_silence, client.write_all(line)).await {
        Ok(written) => written.is_ok(),
        Err(_) => {
            context.count(|counts| counts.dropped += 1);
            false
        }
    }
}

#[cfg(test)]
mod tests;
