//! The messages of one connection to the broker, made when the connection can take one.
//!
//! A connection that takes nothing holds no more than the newest batch of values: a newer one replaces it. After
//! [`UNTAKEN_LIMIT`] it fails, because the broker's readers take old values for present ones.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::{ReceiverStream, WatchStream};
use tokio_stream::{Stream, StreamExt as _};

use super::messages::{Action, GetProviderValueResponse, ProvideSignalRequest, PublishValuesRequest, ToBroker};

/// Answers that wait: the broker asks one question at a time.
const MAX_ANSWERS: usize = 8;
/// Longest time for which the connection takes none of the batches.
const UNTAKEN_LIMIT: Duration = Duration::from_secs(30);

/// Where the session puts its messages; dropping this ends the stream after those that wait.
#[derive(Debug)]
pub(crate) struct Outbox {
    batches: watch::Sender<PublishValuesRequest>,
    answers: mpsc::Sender<GetProviderValueResponse>,
    /// Whether the connection has taken the latest batch.
    is_taken: Arc<AtomicBool>,
    /// Since when it takes none.
    untaken_since: Option<Instant>,
}

impl Outbox {
    /// An outbox, and its messages as a stream that begins with the claim.
    pub(crate) fn open(claim: ProvideSignalRequest) -> (Self, impl Stream<Item = ToBroker> + Send + 'static) {
        let (batches, newest) = watch::channel(PublishValuesRequest::default());
        let (answers, waiting) = mpsc::channel(MAX_ANSWERS);
        let is_taken = Arc::new(AtomicBool::new(true));
        let taken = Arc::clone(&is_taken);
        let published = WatchStream::from_changes(newest).map(move |batch| {
            taken.store(true, Ordering::Relaxed);
            Action::Publish(batch)
        });
        let later = ReceiverStream::new(waiting).map(Action::Answer).merge(published);
        let actions = tokio_stream::once(Action::Provide(claim)).chain(later);
        let messages = actions.map(|action| ToBroker { action: Some(action) });
        (Self { batches, answers, is_taken, untaken_since: None }, messages)
    }

    /// Sends the batch, in place of one that waits.
    ///
    /// # Errors
    /// When the connection has taken none for too long.
    pub(crate) fn publish(&mut self, batch: PublishValuesRequest, now: Instant) -> Result<(), String> {
        if self.is_taken.swap(false, Ordering::Relaxed) {
            self.untaken_since = Some(now);
        }
        self.batches.send_replace(batch);
        match self.untaken_since {
            Some(since) if now.duration_since(since) > UNTAKEN_LIMIT => {
                Err(format!("the broker has taken no value for {} s", UNTAKEN_LIMIT.as_secs()))
            }
            _ => Ok(()),
        }
    }

    /// Sends an answer; `false` = too many wait.
    pub(crate) fn answer(&self, answer: GetProviderValueResponse) -> bool {
        self.answers.try_send(answer).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(request_id: u32) -> PublishValuesRequest {
        PublishValuesRequest { request_id, ..PublishValuesRequest::default() }
    }

    fn answer(request_id: u32) -> GetProviderValueResponse {
        GetProviderValueResponse { request_id, ..GetProviderValueResponse::default() }
    }

    #[tokio::test]
    async fn a_connection_that_takes_nothing_keeps_the_newest_batch_only() {
        let (mut outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        for id in 1..=1000 {
            outbox.publish(batch(id), Instant::now()).unwrap();
        }
        assert!(outbox.answer(answer(7)));
        drop(outbox);
        let mut sent: Vec<_> = messages.filter_map(|message| message.action).collect().await;
        assert_eq!(sent.remove(0), Action::Provide(ProvideSignalRequest::default()));
        assert!(sent.len() == 2 && sent.contains(&Action::Publish(batch(1000))), "{sent:?}");
        assert!(sent.contains(&Action::Answer(answer(7))), "{sent:?}");
    }

    #[tokio::test]
    async fn a_connection_that_takes_nothing_for_long_fails_and_an_idle_one_does_not() {
        let begin = Instant::now();
        let at = |seconds: u64| begin + Duration::from_secs(seconds);
        let (mut outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        let mut messages = std::pin::pin!(messages);
        assert_eq!(outbox.publish(batch(1), at(0)), Ok(()));
        messages.next().await;
        messages.next().await;
        // No daemon, nothing to send, for an hour; then batches that are not taken.
        for second in 3600..=3630 {
            assert_eq!(outbox.publish(batch(2), at(second)), Ok(()), "{second}");
        }
        assert_eq!(outbox.publish(batch(2), at(3631)), Err("the broker has taken no value for 30 s".to_owned()));
    }

    #[tokio::test]
    async fn waiting_answers_are_bounded() {
        let (outbox, _messages) = Outbox::open(ProvideSignalRequest::default());
        assert!((1..=8).all(|id| outbox.answer(answer(id))));
        assert!(!outbox.answer(answer(9)), "the queue has no end");
    }
}
