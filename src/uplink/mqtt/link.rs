//! The link to the broker: connects for ever, publishes current values, and forwards the queue.
//!
//! In: the daemon's documents and the [`Queue`]. Out: messages with QoS 1. Each connection starts with nothing in memory, so no value of an
//! earlier one is repeated: current values are those of the newest document, and a message leaves the queue only after the broker
//! acknowledged it. After a lost connection the pause doubles up to `retry_max_s`.

use std::convert::Infallible;
use std::pin::{Pin, pin};
use std::time::Duration;

use packwatch_host::alarm::Rule;
use packwatch_host::status::document::StatusDocument;
use rumqttc::mqttbytes::QoS;
use rumqttc::{AsyncClient, Event, EventLoop, Packet, PublishNoticeError, PublishOptions};
use serde_json::json;
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

use super::queue::{Class, Fill, Queue, Stored};
use super::settings::MqttSettings;
use super::{OFFLINE, ONLINE, connect, discovery, payload, topic};
use crate::status_stream::Documents;

/// First pause after a lost connection.
const RETRY: Duration = Duration::from_secs(1);
/// Messages of the queue that are on their way at once: what most brokers accept.
const WINDOW: usize = 20;
/// Longest wait for the acknowledgement of messages: a connection that lives and acknowledges nothing ends then.
const ACKNOWLEDGEMENT: Duration = Duration::from_secs(120);
/// Time to say farewell to the broker.
const FAREWELL: Duration = Duration::from_secs(2);

/// A message to the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Its topic.
    pub topic: String,
    /// Its text; empty and retained = the retained message is removed.
    pub text: String,
    /// Whether the broker keeps it for later readers.
    pub is_retained: bool,
}

impl Message {
    /// A message that the broker keeps.
    pub fn retained(topic: String, text: impl Into<String>) -> Self {
        Self { topic, text: text.into(), is_retained: true }
    }
}

/// Why messages were not published.
#[derive(Debug, PartialEq, Eq)]
enum Fault {
    /// The broker does not accept one of them.
    Refused(String),
    /// The connection does not carry them.
    Lost(String),
}

impl From<Fault> for String {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Refused(text) | Fault::Lost(text) => text,
        }
    }
}

/// The link.
pub struct Link<'a> {
    /// Settings.
    pub settings: &'a MqttSettings,
    /// Messages that wait.
    pub queue: &'a Queue,
    /// The newest document.
    pub documents: Documents,
}

impl Link<'_> {
    /// Connects again and again until `stopped` changes; then takes leave of the broker.
    pub async fn run(&self, mut stopped: watch::Receiver<bool>) {
        let most = Duration::from_secs(self.settings.retry_max_s);
        let (mut pause, mut latest) = (RETRY, String::new());
        while !*stopped.borrow() {
            let mut was_connected = false;
            let Err(error) = self.connection(&mut stopped, &mut was_connected).await else { return };
            if was_connected {
                (pause, latest) = (RETRY, String::new());
            }
            // Once for each reason, not at each attempt.
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

    /// One connection, until it fails or `stopped` changes.
    async fn connection(&self, stopped: &mut watch::Receiver<bool>, was_connected: &mut bool) -> Result<(), String> {
        let (client, mut events) = connect::client(self.settings)?;
        let mut driven = pin!(drive(&mut events));
        let work = async {
            publish(&client, vec![Message::retained(self.settings.topic(topic::STATUS), ONLINE)]).await?;
            tracing::info!(broker = self.broker(), waiting = self.queue.fill().messages, "connected");
            *was_connected = true;
            tokio::try_join!(self.current(&client), self.forward(&client)).map(|_| ())
        };
        tokio::select! {
            error = &mut driven => return Err(error),
            result = work => return result,
            _ = stopped.changed() => {}
        }
        self.farewell(&client, driven).await;
        Ok(())
    }

    /// Publishes what the last will would, and disconnects.
    async fn farewell(&self, client: &AsyncClient, driven: Pin<&mut impl Future<Output = String>>) {
        let farewell = async {
            let _ = publish(client, vec![Message::retained(self.settings.topic(topic::STATUS), OFFLINE)]).await;
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

    /// Publishes current values every period, and at once when the daemon falls silent or comes back.
    async fn current(&self, client: &AsyncClient) -> Result<Infallible, String> {
        let mut documents = self.documents.clone();
        let mut rhythm = interval(Duration::from_secs(self.settings.period_s));
        rhythm.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut published = Published::default();
        loop {
            let document = documents.borrow_and_update().clone();
            let is_online = document.is_some();
            publish(client, published.news(self.settings, document.as_deref(), self.queue.fill())).await?;
            tokio::select! {
                _ = rhythm.tick() => {}
                changed = documents.wait_for(|document| document.is_some() != is_online) => {
                    // The sender lives as long as the link.
                    changed.map_err(|error| error.to_string())?;
                }
            }
        }
    }

    /// Sends the queue, oldest first, and removes what the broker acknowledged. What it refuses stays until the next connection.
    async fn forward(&self, client: &AsyncClient) -> Result<Infallible, String> {
        let mut reported = self.queue.fill();
        loop {
            reported = report_drops(reported, self.queue.fill());
            let batch = self.queue.oldest(WINDOW)?;
            if batch.is_empty() {
                self.queue.wait().await;
                continue;
            }
            let messages = batch.iter().map(|stored| self.message(stored)).collect();
            match publish(client, messages).await {
                Ok(()) => self.queue.remove(&batch)?,
                Err(Fault::Lost(error)) => return Err(error),
                Err(Fault::Refused(error)) => {
                    tracing::error!(
                        error,
                        "the broker refuses messages of the queue: they wait for the next connection"
                    );
                    std::future::pending::<()>().await;
                }
            }
        }
    }

    /// The message of the queue with its number, by which a reader finds gaps and repetitions.
    fn message(&self, stored: &Stored) -> Message {
        let topic = match stored.class {
            Class::Sample => topic::HISTORY,
            Class::Event => topic::EVENTS,
        };
        let rest = stored.body.strip_prefix('{').unwrap_or_default();
        let text = format!("{{\"sequence\":{},{rest}", stored.sequence);
        Message { topic: self.settings.topic(topic), text, is_retained: false }
    }
}

/// Logs messages that fell out of the queue since `before`.
fn report_drops(before: Fill, now: Fill) -> Fill {
    let (samples, events) = (now.dropped_samples - before.dropped_samples, now.dropped_events - before.dropped_events);
    if samples + events > 0 {
        tracing::warn!(samples, events, "the queue was full: the oldest messages were dropped");
    }
    now
}

/// What this connection has published, so that only news is.
#[derive(Debug, Default)]
struct Published {
    discovery: Option<(usize, Vec<Rule>, String, String)>,
    topics: Vec<String>,
    is_online: Option<bool>,
    fill: Option<Fill>,
}

impl Published {
    /// Messages that are due: discovery when the entities changed, the values, whether the daemon is online, how full the queue is.
    fn news(&mut self, settings: &MqttSettings, document: Option<&StatusDocument>, fill: Fill) -> Vec<Message> {
        let mut news = Vec::new();
        if let Some(document) = document {
            if settings.discovery.enabled {
                news.extend(self.discovery(settings, document));
            }
            news.push(Message::retained(settings.topic(topic::INFO), payload::info(document).to_string()));
            news.push(Message::retained(settings.topic(topic::CELLS), payload::spec_data(document).to_string()));
        }
        // After the values, so that no reader takes earlier ones as current.
        if self.is_online.replace(document.is_some()) != Some(document.is_some()) {
            let word = if document.is_some() { ONLINE } else { OFFLINE };
            news.push(Message::retained(settings.topic(topic::DAEMON), word));
        }
        if self.fill.replace(fill) != Some(fill) {
            news.push(Message::retained(settings.topic(topic::UPLINK), uplink(fill)));
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

/// How full the queue is.
fn uplink(fill: Fill) -> String {
    json!({
        "queue_messages": fill.messages,
        "queue_bytes": fill.bytes,
        "dropped_samples": fill.dropped_samples,
        "dropped_events": fill.dropped_events,
    })
    .to_string()
}

/// Drives the connection until it fails; returns why.
async fn drive(events: &mut EventLoop) -> String {
    loop {
        match events.poll().await {
            Ok(Event::Incoming(Packet::Disconnect(packet))) => {
                return format!("the broker disconnects: {:?}", packet.reason_code);
            }
            Ok(_) => {}
            Err(error) => return connect::explain(&error),
        }
    }
}

/// Publishes messages with QoS 1, in order, and waits until the broker has acknowledged all.
async fn publish(client: &AsyncClient, messages: Vec<Message>) -> Result<(), Fault> {
    let acknowledged = timeout(ACKNOWLEDGEMENT, publish_all(client, messages)).await;
    acknowledged.unwrap_or_else(|_| Err(Fault::Lost(format!("no acknowledgement within {ACKNOWLEDGEMENT:?}"))))
}

async fn publish_all(client: &AsyncClient, messages: Vec<Message>) -> Result<(), Fault> {
    let mut notices = Vec::with_capacity(messages.len());
    for Message { topic, text, is_retained } in messages {
        let options = PublishOptions::new(QoS::AtLeastOnce).retain(is_retained);
        let notice = client.publish_tracked(topic.clone(), text, options).await;
        notices.push((notice.map_err(|error| Fault::Lost(format!("{topic}: {error}")))?, topic));
    }
    for (notice, topic) in notices {
        notice.wait_completion_async().await.map_err(|error| match error {
            PublishNoticeError::V5PubAck(reason) => {
                Fault::Refused(format!("{topic}: the broker refuses it: {reason:?}"))
            }
            other => Fault::Lost(format!("{topic}: {other}")),
        })?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
