//! The exporter serves the daemon's status over HTTP: metrics, a live page and its events. The exporter is a separate
//! process, so its faults cannot affect the estimation loop.
//!
//! * One connection to the daemon's stream serves all clients ([`Live`]).
//! * `/metrics`: without a recent status, the answer contains only `packwatch_up 0`. Clients that accept OpenMetrics 1.0
//!   receive that format; other clients receive Prometheus' text format 0.0.4.
//! * `/`: the live page; `/events`: its server-sent events; `/-/healthy`: a liveness check.
//! * `/report`: the report of the daemon's store, if this program can make reports.
//! * If the exporter listens on a network address, the page and the events require a token ([`Access`]).
//! * [`http`] limits connections and request heads.
//! * The signals that [`Stop`] handles stop the exporter cleanly.

mod access;
mod live;
mod page;

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Instant;

use hyper::header::{
    ACCEPT, ALLOW, CONTENT_SECURITY_POLICY, HeaderMap, LOCATION, REFERRER_POLICY, SET_COOKIE, WWW_AUTHENTICATE,
};
use sd_notify::NotifyState;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::{LocalSet, spawn_blocking};

use self::access::{Access, Decision};
use self::live::{AnswerBody, Live};
use super::http::{self, Bytes, Full, Incoming, Request, Response, StatusCode, answer_with, reads, with};
use super::io::connection_slots::Activity;
use super::io::runtime::new_runtime;
use super::io::stop::Stop;
use super::service::notify;
use super::status::metrics::{openmetrics, prometheus_text};

const OPENMETRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const PROMETHEUS_TEXT: &str = "text/plain; version=0.0.4; charset=utf-8";
const HTML: &str = "text/html; charset=utf-8";
const PLAIN: &str = "text/plain; charset=utf-8";
const EVENTS: &str = "text/event-stream";
const NO_REPORT: &str = "this program makes no reports: run packwatch report --state DIR on a computer\n";
const NEEDS_TOKEN: &str = "needs the token: open /?token=TOKEN once, or send the header Authorization: Bearer TOKEN\n";
const ONLY_LOCAL: &str = "needs a token unless you open http://127.0.0.1 or http://localhost on this computer: start packwatch \
    exporter with --token-file\n";

/// Makes the report of a store's folder; `None` = this program cannot make reports.
pub type ReportMaker = Option<fn(&Path) -> Result<String, String>>;

/// State that all connections share.
struct Site {
    live: Rc<Live>,
    access: Access,
    page: String,
    report: ReportMaker,
    /// Held while a report is made, so that only one is made at a time.
    report_permit: Arc<Semaphore>,
}

/// Follows the status of the daemon whose status socket is `socket`, and serves this status on the address `listen`
/// until a signal stops the exporter. `token_file` is the file with the token that clients must know.
///
/// # Errors
/// Fails if the token cannot be read, or if the address cannot be bound.
pub fn run(listen: SocketAddr, socket: &Path, token_file: Option<&Path>, report: ReportMaker) -> Result<(), String> {
    let runtime = new_runtime().map_err(|error| format!("cannot start: {error}"))?;
    let access = Access::new(listen.ip(), token_file)?;
    let site = Site::new(access, report);
    let served = async { serve(TcpListener::bind(listen).await?, Rc::new(site), socket.to_owned()).await };
    let served = LocalSet::new().block_on(&runtime, served);
    served.map_err(|error| {
        format!(
            "{listen}: cannot listen there: {error}; give an address of this computer and a free port with --listen"
        )
    })
}

impl Site {
    fn new(access: Access, report: ReportMaker) -> Self {
        let report_permit = Arc::new(Semaphore::new(1));
        Self { live: Rc::default(), access, page: page::template(report.is_some()), report, report_permit }
    }
}

async fn serve(listener: TcpListener, site: Rc<Site>, socket: PathBuf) -> io::Result<()> {
    let mut stop = Stop::new(None)?;
    let address = listener.local_addr()?;
    tracing::info!(%address, socket = %socket.display(), "exporter listening");
    if !site.access.has_page() {
        tracing::warn!("serving only metrics: the page needs --token-file on an address of a network");
    }
    let status = format!("listening on {address}");
    notify(&[NotifyState::Ready, NotifyState::Status(&status)]);
    let live = Rc::clone(&site.live);
    let follower = tokio::task::spawn_local(async move { live.follow(&socket).await });
    let answer = move |request: Request<Incoming>, activity: Activity, end| {
        let site = Rc::clone(&site);
        async move { answer(&request, &site, &activity, end).await }
    };
    http::serve(listener, &mut stop, answer).await;
    notify(&[NotifyState::Stopping]);
    follower.abort();
    tracing::info!("exporter stopped");
    Ok(())
}

type Answer = Response<AnswerBody>;

async fn answer(request: &Request<Incoming>, site: &Site, activity: &Activity, end: Instant) -> Answer {
    if !reads(request) {
        let refused = respond(StatusCode::METHOD_NOT_ALLOWED, PLAIN, "must be GET or HEAD\n");
        return with(refused, ALLOW, "GET, HEAD");
    }
    let path = request.uri().path();
    match site.access.decide(request) {
        Decision::Allowed => {}
        Decision::SetCookie(cookie) => {
            let moved = respond(StatusCode::SEE_OTHER, PLAIN, "the token is accepted\n");
            // A path that begins with two slashes would redirect to another host.
            let own = format!("/{}", path.trim_start_matches('/'));
            return with(with(moved, LOCATION, &own), SET_COOKIE, &cookie);
        }
        Decision::NeedsToken => {
            let refused = respond(StatusCode::UNAUTHORIZED, PLAIN, NEEDS_TOKEN);
            return with(refused, WWW_AUTHENTICATE, "Bearer");
        }
        Decision::OnlyLocal => return respond(StatusCode::FORBIDDEN, PLAIN, ONLY_LOCAL),
    }
    match path {
        "/metrics" => metrics(request.headers(), &site.live).await,
        "/" => {
            let (page, policy) = page::answer(&site.page);
            let answer = with(respond(StatusCode::OK, HTML, page), CONTENT_SECURITY_POLICY, &policy);
            with(answer, REFERRER_POLICY, "no-referrer")
        }
        "/events" => answer_with(StatusCode::OK, EVENTS, site.live.events(activity.clone(), end)),
        "/report" => report(site).await,
        "/-/healthy" => respond(StatusCode::OK, PLAIN, "healthy\n"),
        _ => respond(StatusCode::NOT_FOUND, PLAIN, "must be /, /events, /report, /metrics or /-/healthy\n"),
    }
}

fn respond(status: StatusCode, kind: &'static str, text: impl Into<Bytes>) -> Answer {
    answer_with(status, kind, AnswerBody::Whole(Full::new(text.into())))
}

async fn report(site: &Site) -> Answer {
    let Some(make) = site.report else { return respond(StatusCode::NOT_FOUND, PLAIN, NO_REPORT) };
    let store = site.live.document().await.and_then(|document| document.store);
    let folder = store.filter(|store| !store.path.is_empty()).map(|store| PathBuf::from(store.path));
    let Some(folder) = folder else { return respond(StatusCode::NOT_FOUND, PLAIN, "no daemon with a store answers\n") };
    let Ok(permit) = Arc::clone(&site.report_permit).acquire_owned().await else {
        return respond(StatusCode::SERVICE_UNAVAILABLE, PLAIN, "the exporter stops\n");
    };
    let made = spawn_blocking(move || {
        let _permit = permit;
        make(&folder)
    });
    match made.await {
        Ok(Ok(page)) => respond(StatusCode::OK, HTML, page),
        Ok(Err(error)) => respond(StatusCode::INTERNAL_SERVER_ERROR, PLAIN, error + "\n"),
        Err(error) => respond(StatusCode::INTERNAL_SERVER_ERROR, PLAIN, format!("no report: {error}\n")),
    }
}

async fn metrics(headers: &HeaderMap, live: &Live) -> Answer {
    let text = openmetrics(live.document().await);
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

#[cfg(test)]
mod tests;
