//! HTTP/1.1 server of the exporter and of the uplink.
//!
//! * At most [`MAX_CONNECTIONS`] connections are open, and [`MAX_PER_ADDRESS`] per client address. A further connection
//!   replaces the one that has been idle longest. If none has been idle for long enough, the further connection is
//!   closed ([`ConnectionSlots`]).
//! * The head of a request may have up to [`MAX_REQUEST_BYTES`] bytes and must arrive within [`HEAD_LIMIT`]. Bodies are
//!   not read.

use std::convert::Infallible;
use std::error::Error;
use std::future::Future;
use std::net::IpAddr;
use std::pin::pin;
use std::time::{Duration, Instant};

pub use http_body_util::Full;
pub use hyper::body::{Body, Bytes, Incoming};
use hyper::header::{CACHE_CONTROL, CONTENT_TYPE, HOST, HeaderName, HeaderValue, X_CONTENT_TYPE_OPTIONS};
use hyper::server::conn::http1;
use hyper::service::service_fn;
pub use hyper::{Method, Request, Response, StatusCode, header};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::io::connection_slots::{Activity, ConnectionSlots, SlotLimits};
use super::io::stop::Stop;

/// Maximum number of connections. This is several times the need of two Prometheus servers and a browser.
pub(crate) const MAX_CONNECTIONS: usize = 16;
/// Maximum number of connections of one address.
const MAX_PER_ADDRESS: usize = 8;
/// Longest head of a request, bytes. This is the smallest limit that hyper supports.
const MAX_REQUEST_BYTES: usize = 8192;
const MAX_HEADERS: usize = 64;
/// Longest wait for the head of a request. A connection that is silent for longer is closed.
const HEAD_LIMIT: Duration = Duration::from_secs(30);
/// Longest life of a connection, so that a slow reader does not keep its slot for ever.
const CONNECTION_LIMIT: Duration = Duration::from_secs(300);
/// Time to finish the current answer when a connection reaches [`CONNECTION_LIMIT`]. By default, Prometheus waits this
/// long for a scrape.
const ANSWER_LIMIT: Duration = Duration::from_secs(10);
const DRAIN_LIMIT: Duration = Duration::from_secs(1);
/// Pause after a connection could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);

/// Serves connections until a signal stops the program. Calls `answer` with each request, the activity of its
/// connection, and the time at which the connection must end. Must run in a `LocalSet`.
pub async fn serve<A, F, B>(listener: TcpListener, stop: &mut Stop, answer: A)
where
    A: Fn(Request<Incoming>, Activity, Instant) -> F + Clone + 'static,
    F: Future<Output = Response<B>> + 'static,
    B: Body + 'static,
    B::Error: Into<Box<dyn Error + Send + Sync>>,
{
    let limits =
        SlotLimits { total: MAX_CONNECTIONS, for_root: 0, per_user: MAX_CONNECTIONS, per_client: MAX_PER_ADDRESS };
    let mut places = ConnectionSlots::new(limits);
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
                let task = connections.spawn_local(serve_connection(stream, answer.clone(), activity.clone()));
                places.take(client.ip(), activity, task);
            }
            Err(error) => {
                tracing::warn!(%error, "connection not accepted");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    // The current answers get a short time to finish. Then the remaining connections are closed, because an idle
    // connection would stay open.
    let drained = async { while connections.join_next().await.is_some() {} };
    let _ = timeout(DRAIN_LIMIT, drained).await;
}

async fn serve_connection<A, F, B>(stream: TcpStream, answer: A, activity: Activity)
where
    A: Fn(Request<Incoming>, Activity, Instant) -> F + Clone + 'static,
    F: Future<Output = Response<B>> + 'static,
    B: Body + 'static,
    B::Error: Into<Box<dyn Error + Send + Sync>>,
{
    let end = Instant::now() + CONNECTION_LIMIT;
    let answer = service_fn(move |request| {
        let (answer, activity) = (answer.clone(), activity.clone());
        async move {
            activity.begin_request();
            let answer = answer(request, activity.clone(), end).await;
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

/// Builds an answer that no cache keeps.
pub fn answer_with<B>(status: StatusCode, kind: &'static str, body: B) -> Response<B> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let response = with(response, CONTENT_TYPE, kind);
    with(with(response, CACHE_CONTROL, "no-store"), X_CONTENT_TYPE_OPTIONS, "nosniff")
}

/// Adds a header; leaves it out if the value is not valid.
pub fn with<B>(mut answer: Response<B>, name: HeaderName, value: &str) -> Response<B> {
    if let Ok(value) = HeaderValue::from_str(value) {
        answer.headers_mut().insert(name, value);
    }
    answer
}

/// Whether a request only reads.
pub fn reads<B>(request: &Request<B>) -> bool {
    matches!(*request.method(), Method::GET | Method::HEAD)
}

/// Whether a request names this computer by a numeric address or as `localhost`. Without this check, a foreign web page
/// in a browser on this computer could read the answer, because the page's host name may resolve to this computer (DNS
/// rebinding).
pub fn names_this_computer<B>(request: &Request<B>) -> bool {
    request.headers().get_all(HOST).iter().all(|host| host.to_str().is_ok_and(is_numeric))
}

/// Whether a host with an optional port is a numeric address or `localhost`.
fn is_numeric(host: &str) -> bool {
    let name = host.rsplit_once(':').filter(|(_, port)| port.bytes().all(|byte| byte.is_ascii_digit()));
    let name = name.map_or(host, |(name, _)| name);
    name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}
