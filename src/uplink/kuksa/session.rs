//! Serves one connection to the broker, from opening to closing.
//!
//! Input: settings, status documents of the daemon, the request to stop. Output: values, identified by the ids that the
//! broker gave the signals for this connection. The program reads the list of signals from the broker, claims the right
//! to provide them, and then sends one batch of values for each status document. If the daemon falls silent or this
//! program stops, the program sends a batch that marks every value as unknown, so that no reader mistakes an old value
//! for a current one. If the broker closes the connection or does not answer, the connection ends with a reason.

use std::future::Future;
use std::path::Path;
use std::time::Duration;

use packwatch_host::status::document::StatusDocument;
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until, timeout};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint};
use tonic::{Code, Status, Streaming};

use super::journal::Journal;
use super::messages::{Client, Event, FromBroker, GetProviderValueResponse, PublishValuesRequest};
use super::outgoing::Outbox;
use super::routes::Routes;
use super::settings::KuksaSettings;
use super::signals::STANDARD_BRANCH;
use super::value_requests::ValueRequests;
use crate::files::read_credential;
use crate::status_stream::Documents;

/// Longest wait for the connection and for the answer to each call.
const PATIENCE: Duration = Duration::from_secs(5);
/// Period of pings on an idle connection. If the broker does not answer a ping within [`PATIENCE`], the connection
/// counts as lost. The program therefore notices a lost broker within 15 s.
const PING_PERIOD: Duration = Duration::from_secs(10);
/// Longest wait for the broker to read the last batch.
const FAREWELL: Duration = Duration::from_millis(500);
/// If the broker confirms no batch for this time, the connection is closed, because readers would mistake old values
/// for current ones.
const UNREAD_LIMIT: Duration = Duration::from_secs(30);
const CA_FILE: &str = "kuksa.ca_file";
/// Key of the token's file, for messages.
const TOKEN_FILE: &str = "kuksa.token_file";
/// Longest token, bytes.
const MAX_TOKEN_BYTES: usize = 16 << 10;

/// Serves one connection. Returns `Ok` if the connection ended on request.
///
/// # Errors
/// Fails if the connection could not be opened or has ended; the error is the reason.
pub(crate) async fn run(
    settings: &KuksaSettings,
    documents: &mut Documents,
    stop: &mut watch::Receiver<bool>,
    journal: &mut Journal,
) -> Result<(), String> {
    let mut session = tokio::select! {
        session = Session::open(settings, journal) => session?,
        _ = stop.wait_for(|stop| *stop) => return Ok(()),
    };
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            changed = documents.changed() => {
                if changed.is_err() { break }
                let document = documents.borrow_and_update();
                session.publish(document.as_deref(), journal);
                session.receipts.check(Instant::now())?;
            }
            () = wait_until(session.value_requests.due()) => session.handle_time()?,
            message = session.incoming.message() => match message.map_err(|status| words(&status))? {
                None => return Err("the broker ended the stream".to_owned()),
                Some(message) => session.handle(message, documents.borrow().as_deref(), journal),
            }
        }
    }
    session.withdraw(journal).await;
    Ok(())
}

/// A connection on which the broker has accepted this program's claim to provide the signals.
struct Session {
    routes: Routes,
    outbox: Outbox,
    incoming: Streaming<FromBroker>,
    value_requests: ValueRequests,
    request_id: u32,
    receipts: Receipts,
}

/// Remembers since when the broker has not confirmed a batch. The broker confirms with receipts. `None` = all batches
/// are confirmed.
#[derive(Debug, Default)]
struct Receipts {
    owed_since: Option<Instant>,
}

impl Receipts {
    fn note_sent(&mut self, now: Instant) {
        self.owed_since.get_or_insert(now);
    }

    /// Handles a receipt. The broker must send the next receipt after the next batch.
    fn note_read(&mut self) {
        self.owed_since = None;
    }

    /// Fails if a receipt is overdue: the broker keeps the connection open, but does not read messages or send
    /// receipts. While no batch is unconfirmed, no receipt is due.
    fn check(&self, now: Instant) -> Result<(), String> {
        match self.owed_since {
            Some(since) if now.duration_since(since) > UNREAD_LIMIT => {
                Err(format!("the broker has confirmed no value for {} s", UNREAD_LIMIT.as_secs()))
            }
            _ => Ok(()),
        }
    }
}

impl Session {
    async fn open(settings: &KuksaSettings, journal: &mut Journal) -> Result<Self, String> {
        // These files are read at each connection, because certificates and tokens are renewed.
        let (endpoint, token) = (endpoint(settings)?, token(settings.token_file.as_deref())?);
        let mut client = Client::new(connect(&endpoint).await?, token);
        let mut metadata = call("ListMetadata", list(&mut client, STANDARD_BRANCH)).await?;
        if !settings.branch.starts_with(&format!("{STANDARD_BRANCH}.")) {
            metadata.extend(call("ListMetadata", list(&mut client, &settings.branch)).await?);
        }
        let (routes, skipped) = Routes::resolve(&metadata, &settings.branch, settings.recorded_from_new);
        journal.note_skipped(skipped);
        if routes.len() == 0 {
            return Err(format!("the broker has no signal of {STANDARD_BRANCH} that this program provides"));
        }
        let (outbox, messages) = Outbox::open(routes.claim());
        let mut incoming = call("OpenProviderStream", client.open_provider_stream(messages)).await?;
        call("ProvideSignalRequest", accepted(&mut incoming)).await?;
        journal.note_connected(&settings.address, routes.len());
        Ok(Self {
            routes,
            outbox,
            incoming,
            value_requests: ValueRequests::default(),
            request_id: 0,
            receipts: Receipts::default(),
        })
    }

    /// Sends a value of every signal. Without a document, all values are unknown.
    fn publish(&mut self, document: Option<&StatusDocument>, journal: &mut Journal) {
        let points = self.routes.points(document);
        journal.note_published(&points);
        self.request_id = self.request_id.wrapping_add(1);
        self.value_requests.note_batch(self.request_id);
        self.receipts.note_sent(Instant::now());
        self.outbox.publish(PublishValuesRequest { request_id: self.request_id, data_points: points.by_id });
    }

    fn handle(&mut self, message: FromBroker, document: Option<&StatusDocument>, journal: &mut Journal) {
        let now = Instant::now();
        match message.event {
            Some(Event::Asked(request)) => journal.note_unanswered(u64::from(!self.value_requests.ask(request, now))),
            Some(Event::Provided(_)) => {
                self.receipts.note_read();
                self.value_requests.note_read(self.outbox.acknowledge());
            }
            Some(Event::Rejected(rejected)) => {
                for (id, rejection) in &rejected.status {
                    journal.note_rejected(self.routes.name(*id).unwrap_or("an unknown id"), &rejection.message);
                }
            }
            None => {}
        }
        let (requests, expired) = self.value_requests.take(now);
        journal.note_unanswered(expired);
        for (_, request) in requests {
            let entries = self.routes.points_of(&request.signal_ids, document).by_id;
            let answer = GetProviderValueResponse { request_id: request.request_id, entries };
            journal.note_unanswered(u64::from(!self.outbox.answer(answer)));
        }
    }

    /// Handles the time limits of answers to the broker. If it is still unknown whether the broker has read the latest
    /// answer, sends a message that the broker must confirm.
    fn handle_time(&mut self) -> Result<(), String> {
        if self.value_requests.handle_time(Instant::now())? && !self.outbox.check() {
            return Err("the broker reads no answers".to_owned());
        }
        Ok(())
    }

    /// Sends a batch that marks every value as unknown, and gives the broker time to read this batch.
    async fn withdraw(mut self, journal: &mut Journal) {
        self.publish(None, journal);
        drop(self.outbox);
        let until_end = async { while let Ok(Some(_)) = self.incoming.message().await {} };
        // Waits at most [`FAREWELL`], because the broker may keep the connection open. This time is enough for the
        // broker to read all messages.
        let _ = timeout(FAREWELL, until_end).await;
    }
}

/// Waits until `time`; `None` = waits forever.
async fn wait_until(time: Option<Instant>) {
    match time {
        Some(time) => sleep_until(time).await,
        None => std::future::pending().await,
    }
}

/// Waits for the broker's acceptance of the claim.
async fn accepted(incoming: &mut Streaming<FromBroker>) -> Result<(), Status> {
    loop {
        match incoming.message().await?.map(|message| message.event) {
            Some(Some(Event::Provided(_))) => return Ok(()),
            Some(_) => {}
            None => return Err(Status::aborted("the broker ended the stream")),
        }
    }
}

/// Lists the metadata of `root` and of every signal below it. The list is empty if the broker does not know `root`.
async fn list(client: &mut Client, root: &str) -> Result<Vec<super::messages::Metadata>, Status> {
    match client.list_metadata(root).await {
        Err(status) if status.code() == Code::NotFound => Ok(Vec::new()),
        other => other,
    }
}

async fn call<T>(name: &str, answer: impl Future<Output = Result<T, Status>>) -> Result<T, String> {
    match timeout(PATIENCE, answer).await {
        Ok(result) => result.map_err(|status| format!("{name}: {}", words(&status))),
        Err(_) => Err(format!("{name}: no answer within {} s", PATIENCE.as_secs())),
    }
}

fn words(status: &Status) -> String {
    let message = status.message();
    if message.is_empty() { status.code().description().to_owned() } else { format!("{:?}: {message}", status.code()) }
}

fn endpoint(settings: &KuksaSettings) -> Result<Endpoint, String> {
    let at = &settings.address;
    let mut endpoint = Endpoint::from_shared(at.clone()).map_err(|error| format!("{at}: {error}"))?;
    if let Some(file) = &settings.ca_file {
        let pem = read_credential(CA_FILE, file)?;
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem));
        if let Some(name) = &settings.server_name {
            tls = tls.domain_name(name);
        }
        endpoint =
            endpoint.tls_config(tls).map_err(|error| format!("{CA_FILE}: {}: {}", file.display(), causes(&error)))?;
    }
    let endpoint = endpoint.connect_timeout(PATIENCE).http2_keep_alive_interval(PING_PERIOD);
    Ok(endpoint.keep_alive_timeout(PATIENCE).keep_alive_while_idle(true))
}

async fn connect(endpoint: &Endpoint) -> Result<Channel, String> {
    match timeout(PATIENCE, endpoint.connect()).await {
        Ok(channel) => channel.map_err(|error| causes(&error)),
        Err(_) => Err(format!("no connection within {} s", PATIENCE.as_secs())),
    }
}

/// Describes an error and its causes; omits repeated texts.
fn causes(error: &dyn std::error::Error) -> String {
    let mut texts = vec![error.to_string()];
    let mut next = error.source();
    while let Some(cause) = next {
        let text = cause.to_string();
        if texts.last() != Some(&text) {
            texts.push(text);
        }
        next = cause.source();
    }
    texts.join(": ")
}

/// Builds the header with the token of `file`.
fn token(file: Option<&Path>) -> Result<Option<MetadataValue<Ascii>>, String> {
    let Some(file) = file else { return Ok(None) };
    let at = format!("{TOKEN_FILE}: {}", file.display());
    let text = String::from_utf8(read_credential(TOKEN_FILE, file)?).map_err(|error| format!("{at}: {error}"))?;
    let token = text.trim();
    if token.is_empty() || token.len() > MAX_TOKEN_BYTES {
        return Err(format!("{at}: the token has {} bytes, must be 1 to {MAX_TOKEN_BYTES}", token.len()));
    }
    let mut header: MetadataValue<Ascii> = format!("Bearer {token}")
        .parse()
        .map_err(|_| format!("{at}: the token has characters that are not allowed in an HTTP header"))?;
    header.set_sensitive(true);
    Ok(Some(header))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_receipts_end_connection_but_idle_does_not() {
        let begin = Instant::now();
        let at = |seconds: u64| begin + Duration::from_secs(seconds);
        let mut receipts = Receipts::default();
        // The daemon does not run, so the program sends nothing for an hour. Then it sends a batch.
        receipts.note_sent(at(3600));
        assert_eq!(receipts.check(at(3600)), Ok(()));
        receipts.note_read();
        assert_eq!(receipts.check(at(7200)), Ok(()));
        (7200..=7230).for_each(|second| receipts.note_sent(at(second)));
        assert_eq!(receipts.check(at(7230)), Ok(()));
        assert_eq!(receipts.check(at(7231)), Err("the broker has confirmed no value for 30 s".to_owned()));
    }
}
