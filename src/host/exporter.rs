//! The exporter serves the daemon's status as metrics over HTTP. The exporter is a separate process, so its faults
//! cannot affect the estimation loop.
//!
//! * `/metrics`: each scrape reads the daemon's status from its socket. If no status arrives within [`STATUS_LIMIT`],
//!   the answer contains only `packwatch_up 0`. Clients that accept OpenMetrics 1.0 receive that format; other clients
//!   receive Prometheus' text format 0.0.4.
//! * `/`: a short page; `/-/healthy`: a liveness check.
//! * At most [`MAX_CONNECTIONS`] connections are open, and [`MAX_PER_ADDRESS`] per client address. A further connection
//!   replaces the one that has been idle longest. If none has been idle for long enough, the further connection is
//!   closed ([`ConnectionSlots`]).
//! * The head of a request may have up to [`MAX_REQUEST_BYTES`] bytes and must arrive within [`HEAD_LIMIT`]. Bodies are
//!   not read.
//! * SIGTERM and SIGINT stop the exporter cleanly.

use std::cell::Cell;
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::pin;
use std::rc::Rc;
use std::time::{Duration, Instant};

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{ACCEPT, ALLOW, CONTENT_TYPE, HeaderMap, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use sd_notify::NotifyState;
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, TcpStream, UnixStream};
use tokio::task::{JoinSet, LocalSet};
use tokio::time::{sleep, timeout};

use super::io::connection_slots::{Activity, ConnectionSlots, SlotLimits};
use super::io::stop::Stop;
use super::service::notify;
use super::status::client::{check_length, explain, parse};
use super::status::document::StatusDocument;
use super::status::metrics::{openmetrics, prometheus_text};

/// Maximum number of connections. This is several times the need of two Prometheus servers and a browser.
const MAX_CONNECTIONS: usize = 16;
/// Maximum number of connections of one address.
const MAX_PER_ADDRESS: usize = 8;
/// Longest head of a request, bytes. This is the smallest limit that hyper supports.
const MAX_REQUEST_BYTES: usize = 8192;
/// Maximum number of headers of a request.
const MAX_HEADERS: usize = 64;
/// Longest wait for the head of a request. A connection that is silent for longer is closed.
const HEAD_LIMIT: Duration = Duration::from_secs(30);
/// Longest life of a connection, so that a slow reader does not keep its slot for ever.
const CONNECTION_LIMIT: Duration = Duration::from_secs(300);
/// Time to finish the current answer when a connection reaches [`CONNECTION_LIMIT`]. By default, Prometheus waits this
/// long for a scrape.
const ANSWER_LIMIT: Duration = Duration::from_secs(10);
/// Longest time to read the daemon's status. This is less than the ten seconds that Prometheus waits for a scrape.
const STATUS_LIMIT: Duration = Duration::from_secs(3);
/// Time to finish the current answers when the exporter stops.
const DRAIN_LIMIT: Duration = Duration::from_secs(1);
/// Pause after a connection could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);

const OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const PROMETHEUS_TEXT: &str = "text/plain; version=0.0.4; charset=utf-8";
const HTML: &str = "text/html; charset=utf-8";
const PLAIN: &str = "text/plain; charset=utf-8";
const PAGE: &str = "<!DOCTYPE html><html lang=\"en\"><head><title>packwatch</title></head><body><h1>packwatch</h1>\
    <p><a href=\"/metrics\">metrics</a></p></body></html>\n";

/// The status socket, and whether the daemon answered the last request.
#[derive(Debug)]
struct StatusSource {
    path: PathBuf,
    is_up: Cell<Option<bool>>,
}

/// Reads the daemon's status from `socket` and serves it on the address `listen`, until a signal stops the exporter.
///
/// # Errors
/// Fails if the address cannot be bound.
pub fn run(listen: SocketAddr, socket: PathBuf) -> Result<(), String> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| format!("cannot start: {error}"))?;
    let source = Rc::new(StatusSource { path: socket, is_up: Cell::new(None) });
    let served = async { serve(TcpListener::bind(listen).await?, source).await };
    let served = LocalSet::new().block_on(&runtime, served);
    served.map_err(|error| {
        format!(
            "{listen}: cannot listen there: {error}; give an address of this computer and a free port with --listen"
        )
    })
}

async fn serve(listener: TcpListener, source: Rc<StatusSource>) -> io::Result<()> {
    let mut stop = Stop::new(None)?;
    let address = listener.local_addr()?;
    tracing::info!(%address, socket = %source.path.display(), "exporter listening");
    let status = format!("listening on {address}");
    notify(&[NotifyState::Ready, NotifyState::Status(&status)]);
    let mut places = ConnectionSlots::new(SlotLimits { total: MAX_CONNECTIONS, per_client: MAX_PER_ADDRESS });
    let mut connections = JoinSet::new();
    loop {
        let accepted = tokio::select! {
            () = stop.wait() => break,
            Some(_) = connections.join_next() => continue,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok((_, client)) if !places.make_room(&client.ip(), Instant::now()) => {
                tracing::debug!(%client, "connection closed: too many at once");
            }
            Ok((stream, client)) => {
                let activity = Activity::new();
                let task = connections.spawn_local(serve_connection(stream, Rc::clone(&source), activity.clone()));
                places.take(client.ip(), activity, task);
            }
            Err(error) => {
                tracing::warn!(%error, "connection not accepted");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    notify(&[NotifyState::Stopping]);
    drop(listener);
    // The current answers get a short time to finish. Then the remaining connections are closed, because an idle
    // connection would stay open.
    let drained = async { while connections.join_next().await.is_some() {} };
    let _ = timeout(DRAIN_LIMIT, drained).await;
    tracing::info!("exporter stopped");
    Ok(())
}

async fn serve_connection(stream: TcpStream, source: Rc<StatusSource>, activity: Activity) {
    let answer = service_fn(move |request| {
        let (source, activity) = (Rc::clone(&source), activity.clone());
        async move {
            activity.begin_request();
            let answer = answer(&request, &source).await;
            activity.end_request();
            Ok::<_, Infallible>(answer)
        }
    });
    let mut builder = http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(HEAD_LIMIT);
    builder.max_buf_size(MAX_REQUEST_BYTES).max_headers(MAX_HEADERS);
    let mut connection = pin!(builder.serve_connection(TokioIo::new(stream), answer));
    let ended = match timeout(CONNECTION_LIMIT, connection.as_mut()).await {
        Ok(ended) => ended,
        Err(_) => {
            // The connection finishes its current answer and accepts no further request.
            connection.as_mut().graceful_shutdown();
            timeout(ANSWER_LIMIT, connection).await.unwrap_or(Ok(()))
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%error, "connection ended");
    }
}

type Answer = Response<Full<Bytes>>;

async fn answer(request: &Request<Incoming>, source: &StatusSource) -> Answer {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut refused = respond(StatusCode::METHOD_NOT_ALLOWED, PLAIN, "must be GET or HEAD\n");
        refused.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return refused;
    }
    match request.uri().path() {
        "/metrics" => metrics(request.headers(), source).await,
        "/" => respond(StatusCode::OK, HTML, PAGE),
        "/-/healthy" => respond(StatusCode::OK, PLAIN, "healthy\n"),
        _ => respond(StatusCode::NOT_FOUND, PLAIN, "must be /, /metrics or /-/healthy\n"),
    }
}

fn respond(status: StatusCode, kind: &'static str, text: impl Into<Bytes>) -> Answer {
    let mut response = Response::new(Full::new(text.into()));
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    response
}

async fn metrics(headers: &HeaderMap, source: &StatusSource) -> Answer {
    let text = openmetrics(source.read().await);
    if wants_openmetrics(headers) {
        respond(StatusCode::OK, OPENMETRICS, text)
    } else {
        respond(StatusCode::OK, PROMETHEUS_TEXT, prometheus_text(&text))
    }
}

/// Whether the client accepts OpenMetrics 1.0 with a weight above 0.
fn wants_openmetrics(headers: &HeaderMap) -> bool {
    let values = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok());
    values.flat_map(|value| value.split(',')).any(|range| {
        let mut parts = range.split(';').map(str::trim);
        let is_named = parts.next().is_some_and(|name| name.eq_ignore_ascii_case("application/openmetrics-text"));
        let refuses = |part: &str| match part.split_once('=') {
            Some(("version", version)) => version.trim_matches('"') != "1.0.0",
            Some(("q", weight)) => weight.parse::<f64>().is_ok_and(|weight| weight <= 0.0),
            _ => false,
        };
        is_named && !parts.any(refuses)
    })
}

impl StatusSource {
    /// Reads the daemon's status; `None` = no valid status was received in time. Logs when the daemon starts or stops
    /// answering.
    async fn read(&self) -> Option<StatusDocument> {
        let line = timeout(STATUS_LIMIT, self.line()).await.unwrap_or_else(|late| Err(late.into()));
        let document = line.map_err(|error| explain(&self.path, "--socket", &error)).and_then(|line| parse(&line));
        let was_up = self.is_up.replace(Some(document.is_ok()));
        match &document {
            Ok(_) if was_up != Some(true) => tracing::info!("the daemon reports its status"),
            Err(error) if was_up != Some(false) => tracing::warn!(error, "no status from the daemon"),
            Ok(_) | Err(_) => {}
        }
        document.ok()
    }

    async fn line(&self) -> io::Result<Vec<u8>> {
        let mut stream = UnixStream::connect(&self.path).await?;
        let mut line = Vec::new();
        while line.last() != Some(&b'\n') {
            if stream.read_buf(&mut line).await? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            check_length(line.len())?;
        }
        Ok(line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scrape_displaces_slow_clients() {
        use tokio::io::AsyncWriteExt as _;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let address = listener.local_addr().unwrap();
            let source = StatusSource { path: PathBuf::from("/nonexistent/status.sock"), is_up: Cell::new(None) };
            let server = tokio::task::spawn_local(serve(listener, Rc::new(source)));
            let mut slow = Vec::new();
            for _ in 0..2 * MAX_CONNECTIONS {
                let mut client = TcpStream::connect(address).await.unwrap();
                // The client may already have been rejected.
                let _ = client.write_all(b"GET /met").await;
                slow.push(client);
            }
            sleep(crate::io::connection_slots::GRACE).await;
            let began = Instant::now();
            let mut scrape = TcpStream::connect(address).await.unwrap();
            scrape.write_all(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").await.unwrap();
            let mut answer = String::new();
            scrape.read_to_string(&mut answer).await.unwrap();
            assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("packwatch_up 0"), "{answer}");
            assert!(began.elapsed() < STATUS_LIMIT, "{:?}", began.elapsed());
            server.abort();
        });
    }

    #[test]
    fn openmetrics_is_sent_if_version_1_accepted() {
        for (accept, wanted) in [
            // This is the header of Prometheus 2.42.
            (
                "application/openmetrics-text;version=1.0.0,application/openmetrics-text;version=0.0.1;q=0.75,\
                 text/plain;version=0.0.4;q=0.5,*/*;q=0.1",
                true,
            ),
            ("application/openmetrics-text; version=\"1.0.0\"; charset=utf-8", true),
            ("text/plain;version=0.0.4", false),
            ("application/openmetrics-text;version=0.0.1", false),
            ("application/openmetrics-text;version=1.0.0;q=0", false),
            ("*/*", false),
        ] {
            let mut headers = HeaderMap::new();
            headers.insert(ACCEPT, HeaderValue::from_static(accept));
            assert_eq!(wants_openmetrics(&headers), wanted, "{accept}");
        }
        assert!(!wants_openmetrics(&HeaderMap::new()));
    }
}
