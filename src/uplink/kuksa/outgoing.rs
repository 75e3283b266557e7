//! The messages of one connection to the broker, made when the connection can take one.
//!
//! * A connection that takes nothing holds no more than the newest batch of values: a newer one replaces it.
//! * Behind each batch goes a claim of nothing, which the broker accepts once it has read what came before: the only receipt that the
//!   protocol has. A check is such a claim alone.
//! * An answer goes before a batch that waits too. See `questions` for why the order matters.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};

use tokio::sync::{mpsc, watch};
use tokio_stream::Stream;
use tokio_stream::wrappers::WatchStream;

use super::messages::{Action, GetProviderValueResponse, ProvideSignalRequest, PublishValuesRequest, ToBroker};

/// Answers that wait: the broker asks one question at a time.
const MAX_ANSWERS: usize = 8;

/// What a receipt is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sent {
    /// The batch with this number, and all before it.
    Batch(u32),
    /// All before it.
    Check,
}

/// Sent, in order, and not known to be read.
type Unread = Arc<Mutex<VecDeque<Sent>>>;

/// Where the session puts its messages; dropping this ends the stream after those that wait.
#[derive(Debug)]
pub(crate) struct Outbox {
    batches: watch::Sender<PublishValuesRequest>,
    /// `None` = a check.
    answers: mpsc::Sender<Option<GetProviderValueResponse>>,
    unread: Unread,
}

impl Outbox {
    /// An outbox, and its messages as a stream that begins with the claim.
    pub(crate) fn open(claim: ProvideSignalRequest) -> (Self, Messages) {
        let (batches, newest) = watch::channel(PublishValuesRequest::default());
        let (answers, waiting) = mpsc::channel(MAX_ANSWERS);
        let unread = Unread::default();
        let next = Some(Action::Provide(claim));
        let messages = Messages {
            next,
            answers: waiting,
            batches: WatchStream::from_changes(newest),
            unread: Arc::clone(&unread),
        };
        (Self { batches, answers, unread }, messages)
    }

    /// Sends the batch, in place of one that waits.
    pub(crate) fn publish(&self, batch: PublishValuesRequest) {
        self.batches.send_replace(batch);
    }

    /// Sends an answer; `false` = too many wait.
    pub(crate) fn answer(&self, answer: GetProviderValueResponse) -> bool {
        self.answers.try_send(Some(answer)).is_ok()
    }

    /// Asks for a receipt; `false` = too many answers wait.
    pub(crate) fn check(&self) -> bool {
        self.answers.try_send(None).is_ok()
    }

    /// The broker has read one more: which.
    pub(crate) fn acknowledge(&self) -> Option<Sent> {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }
}

/// The messages, for the connection.
#[derive(Debug)]
pub(crate) struct Messages {
    /// Before everything else: the claim, later a receipt's claim of nothing.
    next: Option<Action>,
    answers: mpsc::Receiver<Option<GetProviderValueResponse>>,
    batches: WatchStream<PublishValuesRequest>,
    unread: Unread,
}

impl Messages {
    fn note_unread(&self, sent: Sent) {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner).push_back(sent);
    }

    fn poll_action(&mut self, context: &mut Context<'_>) -> Poll<Option<Action>> {
        let receipt = Action::Provide(ProvideSignalRequest::default());
        if let Some(action) = self.next.take() {
            return Poll::Ready(Some(action));
        }
        match self.answers.poll_recv(context) {
            Poll::Ready(Some(Some(answer))) => return Poll::Ready(Some(Action::Answer(answer))),
            Poll::Ready(Some(None)) => {
                self.note_unread(Sent::Check);
                return Poll::Ready(Some(receipt));
            }
            // Closed: the batches end too.
            Poll::Ready(None) | Poll::Pending => {}
        }
        let Some(batch) = std::task::ready!(Pin::new(&mut self.batches).poll_next(context)) else {
            return Poll::Ready(None);
        };
        self.note_unread(Sent::Batch(batch.request_id));
        self.next = Some(receipt);
        Poll::Ready(Some(Action::Publish(batch)))
    }
}

impl Stream for Messages {
    type Item = ToBroker;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<ToBroker>> {
        self.poll_action(context).map(|action| action.map(|action| ToBroker { action: Some(action) }))
    }
}

#[cfg(test)]
mod tests {
    use tokio_stream::StreamExt as _;

    use super::*;

    fn batch(request_id: u32) -> PublishValuesRequest {
        PublishValuesRequest { request_id, ..PublishValuesRequest::default() }
    }

    fn answer(request_id: u32) -> GetProviderValueResponse {
        GetProviderValueResponse { request_id, ..GetProviderValueResponse::default() }
    }

    async fn sent(messages: Messages) -> Vec<Action> {
        messages.filter_map(|message| message.action).collect().await
    }

    #[tokio::test]
    async fn a_connection_that_takes_nothing_keeps_the_newest_batch_only() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        (1..=1000).for_each(|id| outbox.publish(batch(id)));
        let unread = Arc::clone(&outbox.unread);
        drop(outbox);
        let claim = || Action::Provide(ProvideSignalRequest::default());
        assert_eq!(sent(messages).await, [claim(), Action::Publish(batch(1000)), claim()]);
        assert_eq!(*unread.lock().unwrap(), [Sent::Batch(1000)]);
    }

    #[tokio::test]
    async fn an_answer_goes_before_a_batch_and_receipts_are_in_order() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        outbox.publish(batch(1));
        assert!(outbox.answer(answer(7)) && outbox.check());
        let actions: Vec<_> = messages.take(5).filter_map(|message| message.action).collect().await;
        let claim = || Action::Provide(ProvideSignalRequest::default());
        assert_eq!(actions, [claim(), Action::Answer(answer(7)), claim(), Action::Publish(batch(1)), claim()]);
        let read = [outbox.acknowledge(), outbox.acknowledge(), outbox.acknowledge()];
        assert_eq!(read, [Some(Sent::Check), Some(Sent::Batch(1)), None]);
    }

    #[tokio::test]
    async fn waiting_answers_are_bounded() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        assert!((1..=8).all(|id| outbox.answer(answer(id))));
        assert!(!outbox.answer(answer(9)) && !outbox.check(), "the queue has no end");
        drop((outbox, messages));
    }
}
