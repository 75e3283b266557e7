//! The messages of one connection to the broker, made when the connection can take one.
//!
//! A connection that takes nothing holds no more than the newest batch of values: a newer one replaces it. Answers to the broker's
//! questions are dropped when they are late: the broker (0.7) would take a late one for the answer to its next question, of other
//! signals.

use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_stream::wrappers::{ReceiverStream, WatchStream};
use tokio_stream::{Stream, StreamExt as _, once};

use super::messages::{Action, GetProviderValueResponse, ProvideSignalRequest, PublishValuesRequest, ToBroker};

/// Longest age of an answer: half of what the broker waits.
const ANSWER_DEADLINE: Duration = Duration::from_millis(500);
/// Answers that wait: the broker asks one question at a time.
const MAX_ANSWERS: usize = 8;

/// Where the session puts its messages; dropping this ends the stream after those that wait.
#[derive(Debug)]
pub(crate) struct Outbox {
    batches: watch::Sender<PublishValuesRequest>,
    answers: mpsc::Sender<(Instant, GetProviderValueResponse)>,
}

impl Outbox {
    /// An outbox, and its messages as a stream that begins with the claim.
    pub(crate) fn open(claim: ProvideSignalRequest) -> (Self, impl Stream<Item = ToBroker> + Send + 'static) {
        let (batches, newest) = watch::channel(PublishValuesRequest::default());
        let (answers, waiting) = mpsc::channel(MAX_ANSWERS);
        let values = WatchStream::from_changes(newest).map(Action::Publish);
        let answered = ReceiverStream::new(waiting).filter_map(|(asked, answer): (Instant, _)| {
            (asked.elapsed() <= ANSWER_DEADLINE).then_some(Action::Answer(answer))
        });
        let messages = once(Action::Provide(claim)).chain(values.merge(answered));
        (Self { batches, answers }, messages.map(|action| ToBroker { action: Some(action) }))
    }

    /// Sends the batch, in place of one that waits.
    pub(crate) fn publish(&self, batch: PublishValuesRequest) {
        self.batches.send_replace(batch);
    }

    /// Sends the answer to a question asked at `asked`; `false` = too many wait.
    pub(crate) fn answer(&self, asked: Instant, answer: GetProviderValueResponse) -> bool {
        self.answers.try_send((asked, answer)).is_ok()
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
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        tokio::pin!(messages);
        (1..=1000).for_each(|id| outbox.publish(batch(id)));
        drop(outbox);
        let actions: Vec<_> = messages.map(|message| message.action).collect().await;
        let claim = Some(Action::Provide(ProvideSignalRequest::default()));
        assert_eq!(actions, [claim, Some(Action::Publish(batch(1000)))]);
    }

    #[tokio::test]
    async fn a_late_answer_is_dropped_and_waiting_answers_are_bounded() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        tokio::pin!(messages);
        let long_ago = Instant::now().checked_sub(ANSWER_DEADLINE + Duration::from_millis(1)).unwrap();
        assert!(outbox.answer(long_ago, answer(1)));
        assert!(outbox.answer(Instant::now(), answer(2)));
        assert!((3..=8).all(|id| outbox.answer(Instant::now(), answer(id))));
        assert!(!outbox.answer(Instant::now(), answer(9)), "the queue has no end");
        drop(outbox);
        let count = messages
            .filter(|message| matches!(message.action, Some(Action::Answer(_))))
            .collect::<Vec<_>>()
            .await
            .len();
        assert_eq!(count, 7);
    }
}
