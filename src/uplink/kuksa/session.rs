//! One connection to the broker, from its metadata to its end.
//!
//! In: settings, documents, the request to stop. Out: values by the ids of this connection. Order: ListMetadata, claim, then a batch
//! for each document; without a document (the daemon is silent, or this program stops) a batch without values, so that no reader
//! takes an old value for a present one. Ends with a reason when the broker ends it or does not answer.

use std::future::Future;
use std::path::Path;
use std::time::Duration;

use packwatch_host::status::document::StatusDocument;
use tokio::sync::watch;
use tokio::time::{Instant, timeout};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint};
use tonic::{Code, Status, Streaming};

use super::journal::Journal;
use super::messages::{Client, Event, FromBroker, GetProviderValueResponse, PublishValuesRequest};
use super::outgoing::Outbox;
use super::routes::Routes;
use super::settings::KuksaSettings;
use super::signals::STANDARD_BRANCH;
use crate::files::read_credential;
use crate::status_stream::Documents;

/// Longest wait for the connection, and for the answer to each call.
const PATIENCE: Duration = Duration::from_secs(5);
/// Pings of an idle connection: together with [`PATIENCE`], a broker that is gone is noticed within 15 s.
const PING_PERIOD: Duration = Duration::from_secs(10);
/// Longest wait for the broker to read the last batch.
const FAREWELL: Duration = Duration::from_millis(500);
/// Longest token, bytes.
const MAX_TOKEN_BYTES: usize = 16 << 10;

/// Serves one connection. `Ok` = ended as asked.
///
/// # Errors
/// Why it could not be made, or why it ended.
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
                session.publish(document.as_deref(), journal)?;
            }
            message = session.incoming.message() => match message.map_err(|status| words(&status))? {
                None => return Err("the broker ended the stream".to_owned()),
                Some(message) => session.handle(message, documents.borrow().as_deref(), journal),
            }
        }
    }
    session.withdraw(journal).await;
    Ok(())
}

/// A connection whose claim the broker has accepted.
struct Session {
    routes: Routes,
    outbox: Outbox,
    incoming: Streaming<FromBroker>,
    request_id: u32,
}

impl Session {
    async fn open(settings: &KuksaSettings, journal: &mut Journal) -> Result<Self, String> {
        // Read at each connection: certificates and tokens are renewed.
        let (endpoint, token) = (endpoint(settings)?, token(settings.token_file.as_deref())?);
        let mut client = Client::new(connect(&endpoint).await?, token);
        let mut metadata = call("ListMetadata", list(&mut client, STANDARD_BRANCH)).await?;
        if !settings.branch.starts_with(&format!("{STANDARD_BRANCH}.")) {
            metadata.extend(call("ListMetadata", list(&mut client, &settings.branch)).await?);
        }
        let (routes, skipped) = Routes::resolve(&metadata, &settings.branch);
        journal.note_skipped(skipped);
        if routes.len() == 0 {
            return Err(format!("the broker has no signal of {STANDARD_BRANCH} that this program provides"));
        }
        let (outbox, messages) = Outbox::open(routes.claim());
        let mut incoming = call("OpenProviderStream", client.open_provider_stream(messages)).await?;
        call("ProvideSignalRequest", accepted(&mut incoming)).await?;
        journal.note_connected(&settings.address, routes.len());
        Ok(Self { routes, outbox, incoming, request_id: 0 })
    }

    /// Sends a value of every signal; without a document, that there is none.
    fn publish(&mut self, document: Option<&StatusDocument>, journal: &mut Journal) -> Result<(), String> {
        let points = self.routes.points(document);
        journal.note_published(&points);
        self.request_id = self.request_id.wrapping_add(1);
        let batch = PublishValuesRequest { request_id: self.request_id, data_points: points.by_id };
        self.outbox.publish(batch, Instant::now())
    }

    fn handle(&mut self, message: FromBroker, document: Option<&StatusDocument>, journal: &mut Journal) {
        match message.event {
            Some(Event::Asked(question)) => {
                let entries = self.routes.points_of(&question.signal_ids, document).by_id;
                let answer = GetProviderValueResponse { request_id: question.request_id, entries };
                journal.note_unanswered(u64::from(!self.outbox.answer(answer)));
            }
            Some(Event::Rejected(rejected)) => {
                for (id, rejection) in &rejected.status {
                    journal.note_rejected(self.routes.name(*id).unwrap_or("an unknown id"), &rejection.message);
                }
            }
            Some(Event::Provided(_)) | None => {}
        }
    }

    /// Withdraws every value, and waits until the broker has had time to read that.
    async fn withdraw(mut self, journal: &mut Journal) {
        // The connection ends either way.
        let _ = self.publish(None, journal);
        drop(self.outbox);
        let until_end = async { while let Ok(Some(_)) = self.incoming.message().await {} };
        // A broker that keeps its side open has read everything by then.
        let _ = timeout(FAREWELL, until_end).await;
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

/// Metadata at and below `root`; none when the broker does not have it.
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
        let pem = read_credential(file)?;
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem));
        if let Some(name) = &settings.server_name {
            tls = tls.domain_name(name);
        }
        endpoint = endpoint.tls_config(tls).map_err(|error| format!("{}: {}", file.display(), causes(&error)))?;
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

/// An error and what caused it, each text once.
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

/// The header that carries the token of `file`.
fn token(file: Option<&Path>) -> Result<Option<MetadataValue<Ascii>>, String> {
    let Some(file) = file else { return Ok(None) };
    let at = file.display();
    let text = String::from_utf8(read_credential(file)?).map_err(|error| format!("{at}: {error}"))?;
    let token = text.trim();
    if token.is_empty() || token.len() > MAX_TOKEN_BYTES {
        return Err(format!("{at}: a token of {} bytes, must be 1 to {MAX_TOKEN_BYTES}", token.len()));
    }
    let mut header: MetadataValue<Ascii> = format!("Bearer {token}")
        .parse()
        .map_err(|_| format!("{at}: the token has characters that a header cannot hold"))?;
    header.set_sensitive(true);
    Ok(Some(header))
}
