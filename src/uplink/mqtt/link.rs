//! Runs the link to the broker: reconnects until it is stopped, publishes the current values, and forwards the queue.
//!
//! Input: the daemon's documents and the [`Queue`]. Output: messages with QoS 1. Each connection starts without
//! messages in memory, so it repeats no value of an earlier connection. Current values come from the newest document. A
//! message leaves the queue only after the broker has acknowledged it.
//!
//! After a lost connection or a failed attempt to connect, the link pauses for 1 s. The pause doubles with each further
//! failure, up to `retry_max_s`. If the connection has lasted longer than `retry_max_s`, the pause is 1 s again. A
//! message that the broker rejects does not end the connection. A rejected message of the queue is sent again after
//! `retry_max_s`. Rejected current values are not sent again; the next message has newer values.

use std::convert::Infallible;
use std::fmt;
use std::pin::{Pin, pin};
use std::time::Duration;

use packwatch_host::alarm::Rule;
use packwatch_host::status::document::StatusDocument;
use rumqttc::mqttbytes::QoS;
use rumqttc::{AsyncClient, Event, EventLoop, Packet, PublishNoticeError, PublishOptions};
use serde_json::json;
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, interval_at, sleep, timeout};

use super::message::Message;
use super::queue::{Class, Fill, Queue, QueuedMessage};
use super::settings::MqttSettings;
use super::{OFFLINE, ONLINE, connect, discovery, payload, topic};
use crate::status_stream::Documents;

/// First pause after a lost connection.
const RETRY: Duration = Duration::from_secs(1);
/// Maximum number of unacknowledged messages of each class of the queue; most brokers accept this number.
const WINDOW: usize = 20;
/// Longest wait for an acknowledgement. If a message is not acknowledged within this time, the connection is closed.
const ACKNOWLEDGEMENT: Duration = Duration::from_secs(120);
/// Pause before a failed operation on the queue is tried again.
const QUEUE_RETRY: Duration = Duration::from_secs(5);
/// Longest time for the last messages before disconnecting.
const FAREWELL: Duration = Duration::from_secs(2);

#[derive(Debug, Clone, PartialEq, Eq)]
enum Fault {
    Refused(String),
    Lost(String),
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Refused(text) | Self::Lost(text)) = self;
        f.write_str(text)
    }
}

/// The link.
pub struct Link<'a> {
    /// Settings.
    pub settings: &'a MqttSettings,
    /// Queued messages.
    pub queue: &'a Queue,
    /// The newest document.
    pub documents: Documents,
}

impl Link<'_> {
    /// Connects repeatedly until `stopped` changes, then disconnects cleanly.
    pub async fn run(&self, mut stopped: watch::Receiver<bool>) {
        let most = Duration::from_secs(self.settings.retry_max_s);
        let (mut pause, mut latest) = (RETRY, String::new());
        while !*stopped.borrow() {
            let began = Instant::now();
            let Err(error) = self.connection(&mut stopped).await else { return };
            if began.elapsed() > most {
                (pause, latest) = (RETRY, String::new());
            }
            // Each reason is logged once, not at every attempt.
            if error != latest {
                tracing::warn!(
                    broker = self.broker(),
                    error,
                    waiting = self.queue.fill().messages,
                    "no connection to the broker"
                );
                latest = error;
            }
            tokio::select! {
                () = sleep(pause.min(most)) => {}
                _ = stopped.changed() => {}
            }
            pause = (pause * 2).min(most);
        }
    }

    fn broker(&self) -> String {
        format!("{}:{}", self.settings.host, self.settings.port())
    }

    /// Runs one connection until it fails or `stopped` changes.
    async fn connection(&self, stopped: &mut watch::Receiver<bool>) -> Result<(), String> {
        let (client, mut events) = connect::client(self.settings)?;
        let mut driven = pin!(drive(&mut events));
        // Events and samples are forwarded separately: if the broker rejects one class, the other continues.
        let work = async {
            let (samples, events) = (self.forward(&client, Class::Sample), self.forward(&client, Class::Event));
            tokio::try_join!(self.current(&client), samples, events).map(|_| ())
        };
        tokio::select! {
            error = &mut driven => return Err(error),
            result = work => return result,
            _ = stopped.changed() => {}
        }
        self.farewell(&client, driven).await;
        Ok(())
    }

    /// Publishes `offline`, like the last will, and disconnects.
    async fn farewell(&self, client: &AsyncClient, driven: Pin<&mut impl Future<Output = String>>) {
        let farewell = async {
            publish(client, vec![Message::retained(self.settings.topic(topic::STATUS), OFFLINE)]).await;
            let _ = client.disconnect().await;
            std::future::pending::<()>().await;
        };
        let both = async {
            tokio::select! {
                _ = driven => {}
                () = farewell => {}
            }
        };
        let _ = timeout(FAREWELL, both).await;
        tracing::info!("disconnected");
    }

    /// Publishes the current values every period, and at once when the daemon falls silent or reports again.
    async fn current(&self, client: &AsyncClient) -> Result<Infallible, String> {
        let mut documents = self.documents.clone();
        let period = Duration::from_secs(self.settings.period_s);
        let mut rhythm = interval_at(Instant::now() + period, period);
        rhythm.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut state = PublishedState::default();
        let (mut is_connected, mut refused) = (false, false);
        loop {
            let document = documents.borrow_and_update().clone();
            let is_online = document.is_some();
            let news = state.news(self.settings, document.as_deref(), self.queue.fill());
            let faults: Vec<Fault> = publish(client, news).await.into_iter().filter_map(Result::err).collect();
            if let Some(Fault::Lost(error)) = faults.iter().find(|fault| matches!(fault, Fault::Lost(_))) {
                return Err(error.clone());
            }
            if !std::mem::replace(&mut is_connected, true) {
                tracing::info!(broker = self.broker(), waiting = self.queue.fill().messages, "connected");
            }
            if let Some(fault) = faults.first().filter(|_| !refused) {
                tracing::error!(count = faults.len(), first = %fault, "the broker rejects current values");
                refused = true;
            }
            tokio::select! {
                _ = rhythm.tick() => {}
                changed = documents.wait_for(|document| document.is_some() != is_online) => {
                    // An error cannot occur, because the sender outlives the link.
                    changed.map_err(|error| error.to_string())?;
                }
            }
        }
    }

    /// Sends queued messages of a class, oldest first, and removes acknowledged ones.
    async fn forward(&self, client: &AsyncClient, class: Class) -> Result<Infallible, String> {
        let topic = match class {
            Class::Sample => topic::HISTORY,
            Class::Event => topic::EVENTS,
        };
        let topic = self.settings.topic(topic);
        let mut refused = String::new();
        loop {
            let mut batch = persist("read", || self.queue.oldest(class, WINDOW)).await;
            if batch.is_empty() {
                self.queue.wait().await;
                continue;
            }
            let messages = batch.iter().map(|queued| numbered(&topic, queued)).collect();
            let outcomes = publish(client, messages).await;
            let fault = outcomes.iter().find_map(|outcome| outcome.clone().err());
            let mut is_acknowledged = outcomes.iter().map(Result::is_ok);
            batch.retain(|_| is_acknowledged.next().unwrap_or(false));
            persist("write", || self.queue.remove(&batch)).await;
            match fault {
                None => {}
                Some(Fault::Lost(error)) => return Err(error),
                Some(Fault::Refused(error)) => {
                    if error != refused {
                        tracing::error!(error, "the broker rejects queued messages; retrying");
                        refused = error;
                    }
                    sleep(Duration::from_secs(self.settings.retry_max_s)).await;
                }
            }
        }
    }
}

/// Adds the sequence number to a queued message, so that a reader finds gaps and repetitions.
fn numbered(topic: &str, queued: &QueuedMessage) -> Message {
    let rest = queued.body.strip_prefix('{').unwrap_or_default();
    let text = format!("{{\"sequence\":{},{rest}", queued.sequence);
    Message { topic: topic.to_owned(), text, is_retained: false }
}

/// Retries an operation on the queue until it succeeds.
async fn persist<T>(action: &str, mut attempt: impl FnMut() -> Result<T, String>) -> T {
    let mut has_failed = false;
    loop {
        match attempt() {
            Ok(done) if has_failed => {
                tracing::info!(action, "the queue works again");
                return done;
            }
            Ok(done) => return done,
            Err(error) => {
                if !std::mem::replace(&mut has_failed, true) {
                    tracing::error!(action, error, "the queue cannot be used; retrying");
                }
                sleep(QUEUE_RETRY).await;
            }
        }
    }
}

/// What this connection has published. Apart from the current values, messages are sent only if they have changed.
#[derive(Debug, Default)]
struct PublishedState {
    has_status: bool,
    discovery: Option<(usize, Vec<Rule>, String, String)>,
    topics: Vec<String>,
    is_online: Option<bool>,
    fill: Option<Fill>,
}

impl PublishedState {
    /// Returns the messages to send now: the values, whether the daemon is online, the fill of the queue, whether this
    /// program is online, and the discovery messages if the entities have changed. Because of this order, no reader
    /// mistakes values of an earlier connection for current values.
    fn news(&mut self, settings: &MqttSettings, document: Option<&StatusDocument>, fill: Fill) -> Vec<Message> {
        let retained = |name: &str, text: String| Message::retained(settings.topic(name), text);
        let mut news = Vec::new();
        if let Some(document) = document {
            news.push(retained(topic::INFO, payload::info(document).to_string()));
            news.push(retained(topic::CELLS, payload::spec_data(document).to_string()));
        }
        if self.is_online.replace(document.is_some()) != Some(document.is_some()) {
            let word = if document.is_some() { ONLINE } else { OFFLINE };
            news.push(retained(topic::DAEMON, word.to_owned()));
        }
        if self.fill.replace(fill) != Some(fill) {
            news.push(retained(topic::UPLINK, uplink(fill)));
        }
        if !std::mem::replace(&mut self.has_status, true) {
            news.push(retained(topic::STATUS, ONLINE.to_owned()));
        }
        if let Some(document) = document.filter(|_| settings.discovery.enabled) {
            news.extend(self.discovery(settings, document));
        }
        news
    }

    fn discovery(&mut self, settings: &MqttSettings, document: &StatusDocument) -> Vec<Message> {
        let (vehicle, version) = (document.vehicle.to_string(), document.program_version.clone());
        let shape = (document.cells.len(), document.alarms.rules.clone(), vehicle, version);
        if self.discovery.as_ref() == Some(&shape) {
            return Vec::new();
        }
        self.discovery = Some(shape);
        let mut messages = discovery::messages(settings, document);
        let topics: Vec<String> = messages.iter().map(|message| message.topic.clone()).collect();
        let gone = std::mem::take(&mut self.topics).into_iter().filter(|topic| !topics.contains(topic));
        messages.extend(gone.map(|topic| Message::retained(topic, "")));
        self.topics = topics;
        messages
    }
}

/// Returns the fill of the queue as JSON.
fn uplink(fill: Fill) -> String {
    json!({
        "queue_messages": fill.messages,
        "queue_bytes": fill.bytes,
        "dropped_samples": fill.dropped_samples,
        "dropped_events": fill.dropped_events,
        "missed_events": fill.missed_events,
    })
    .to_string()
}

/// Drives the connection until it fails; returns the reason.
async fn drive(events: &mut EventLoop) -> String {
    loop {
        match events.poll().await {
            Ok(Event::Incoming(Packet::Disconnect(packet))) => {
                return format!("the broker disconnected: {:?}", packet.reason_code);
            }
            Ok(_) => {}
            Err(error) => return connect::explain(&error),
        }
    }
}

/// Publishes messages with QoS 1 in order; returns the result of each.
async fn publish(client: &AsyncClient, messages: Vec<Message>) -> Vec<Result<(), Fault>> {
    let late = || Fault::Lost(format!("no acknowledgement within {ACKNOWLEDGEMENT:?}"));
    let mut notices = Vec::with_capacity(messages.len());
    for Message { topic, text, is_retained } in messages {
        let options = PublishOptions::new(QoS::AtLeastOnce).retain(is_retained);
        let notice = timeout(ACKNOWLEDGEMENT, client.publish_tracked(topic.clone(), text, options)).await;
        let notice = notice
            .map_err(|_| late())
            .and_then(|notice| notice.map_err(|error| Fault::Lost(format!("{topic}: {error}"))));
        let is_lost = notice.is_err();
        notices.push((topic, notice));
        if is_lost {
            break;
        }
    }
    let mut outcomes = Vec::with_capacity(notices.len());
    for (topic, notice) in notices {
        let outcome = match notice {
            Err(fault) => Err(fault),
            Ok(notice) => match timeout(ACKNOWLEDGEMENT, notice.wait_completion_async()).await {
                Err(_) => Err(late()),
                Ok(completion) => completion.map(|_| ()).map_err(|error| match error {
                    PublishNoticeError::V5PubAck(reason) => {
                        Fault::Refused(format!("{topic}: the broker rejects the message: {reason:?}"))
                    }
                    other => Fault::Lost(format!("{topic}: {other}")),
                }),
            },
        };
        let is_lost = matches!(outcome, Err(Fault::Lost(_)));
        outcomes.push(outcome);
        if is_lost {
            break;
        }
    }
    outcomes
}

#[cfg(test)]
mod tests;
