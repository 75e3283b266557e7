//! Sends the daemon's status to HTTP clients as server-sent events. One connection to the daemon's stream serves all
//! clients.
//!
//! Input: lines of the stream, one status document each. Output per client: first one event `history` with the last
//! hour, then each document as an event without a name. While the daemon is silent, the client gets the event `gone`
//! instead of documents. A client that is slower than the daemon misses documents. A client that takes no event within
//! [`SILENCE`] is disconnected.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::path::Path;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use http_body_util::Full;
use hyper::body::{Body, Bytes, Frame, SizeHint};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;

use crate::io::connection_slots::Activity;
use crate::quantity::catalogue::Quantity;
use crate::status::STALE;
use crate::status::client::parse;
use crate::status::document::StatusDocument;
use crate::status::stream::{SILENCE, follow};

/// Quantities of the pack in the last hour.
pub(super) const KEPT: [Quantity; 4] = [Quantity::Soc, Quantity::Voltage, Quantity::Current, Quantity::TemperatureMax];
/// Time between two points of the last hour. A picture of the hour is a few hundred pixels wide.
const POINT_PERIOD: Duration = Duration::from_secs(5);
/// Number of points in one hour.
const POINTS: usize = 720;

const DATA: &[u8] = b"data: ";

/// A time (s, on the daemon's clock) and the values of [`KEPT`].
type Point = [Option<f64>; 1 + KEPT.len()];

#[derive(Debug, Clone, Default)]
enum Report {
    #[default]
    Awaited,
    Gone,
    /// The latest document as an event, and the time of its arrival.
    Document(Bytes, Instant),
}

#[derive(Debug, Default)]
pub(super) struct Live {
    report: watch::Sender<Report>,
    hour: RefCell<VecDeque<Point>>,
}

impl Live {
    /// Reads the stream that belongs to the status socket `socket`, for ever.
    pub(super) async fn follow(&self, socket: &Path) {
        let mut kept_at = None;
        let handle = |line: Result<&[u8], &str>| {
            let now = Instant::now();
            let report = match line {
                Err(_) => Report::Gone,
                Ok(line) => {
                    if kept_at.is_none_or(|at| now.duration_since(at) >= POINT_PERIOD) {
                        self.keep(&parse(line)?);
                        kept_at = Some(now);
                    }
                    Report::Document([DATA, line, b"\n"].concat().into(), now)
                }
            };
            self.report.send_replace(report);
            Ok(())
        };
        follow(socket, "--socket", handle).await;
    }

    fn keep(&self, document: &StatusDocument) {
        let mut hour = self.hour.borrow_mut();
        if hour.len() == POINTS {
            hour.pop_front();
        }
        let mut point = [Some(document.time.nanos() as f64 / 1e9); 1 + KEPT.len()];
        for (value, quantity) in point[1..].iter_mut().zip(KEPT) {
            *value = document.pack.values.mean(quantity);
        }
        hour.push_back(point);
    }

    /// The latest document; `None` = the daemon is silent. Waits for the first report.
    pub(super) async fn document(&self) -> Option<StatusDocument> {
        let mut reports = self.report.subscribe();
        let report = reports.wait_for(|report| !matches!(report, Report::Awaited)).await.ok()?.clone();
        match report {
            Report::Document(event, at) if at.elapsed() < STALE => parse(event.get(DATA.len()..)?).ok(),
            _ => None,
        }
    }

    /// Starts a task that sends events to a client until `end`, or until the client stops reading.
    pub(super) fn events(self: &Rc<Self>, activity: Activity, end: Instant) -> AnswerBody {
        // One event is sent while the next one waits.
        let (sender, events) = mpsc::channel(1);
        let live = Rc::clone(self);
        tokio::task::spawn_local(async move {
            let mut reports = live.report.subscribe();
            reports.mark_changed();
            let hour = serde_json::to_string(&*live.hour.borrow()).unwrap_or_default();
            let mut event = Bytes::from(format!("retry: 1000\nevent: history\ndata: {hour}\n\n"));
            while let Ok(Ok(())) = timeout(SILENCE, sender.send(event)).await {
                activity.end_request();
                if Instant::now() > end || reports.changed().await.is_err() {
                    return;
                }
                event = match &*reports.borrow_and_update() {
                    Report::Document(event, _) => event.clone(),
                    Report::Gone => Bytes::from_static(b"event: gone\ndata:\n\n"),
                    Report::Awaited => Bytes::from_static(b":\n\n"),
                };
            }
        });
        AnswerBody::Events(events)
    }
}

pub(super) enum AnswerBody {
    Whole(Full<Bytes>),
    Events(mpsc::Receiver<Bytes>),
}

impl Body for AnswerBody {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        match self.get_mut() {
            Self::Whole(body) => Pin::new(body).poll_frame(context),
            Self::Events(events) => events.poll_recv(context).map(|event| event.map(|event| Ok(Frame::data(event)))),
        }
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(body) => body.size_hint(),
            Self::Events(_) => SizeHint::default(),
        }
    }
}
