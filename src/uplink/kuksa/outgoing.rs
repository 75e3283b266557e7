//! Queues the messages of one connection to the broker. A message is created only when the connection can send it.
//!
//! * While the connection cannot send, only the newest batch of values is kept.
//! * A claim is a request for the right to provide signals. An empty claim (for no signals) follows each batch. The
//!   broker reads messages in order, so when it accepts the empty claim, it has read the batch. The acceptance
//!   therefore serves as a *receipt* for the batch. The protocol has no other receipt. A *check* is an empty claim that
//!   is sent without a batch.
//! * An answer overtakes a waiting batch. See `value_requests` for why the order matters.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};

use tokio::sync::{mpsc, watch};
use tokio_stream::Stream;
use tokio_stream::wrappers::WatchStream;

use super::messages::{Action, GetProviderValueResponse, ProvideSignalRequest, PublishValuesRequest, ToBroker};

/// Maximum number of waiting answers. The broker sends one request at a time.
const MAX_ANSWERS: usize = 8;

/// What a receipt confirms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReceiptScope {
    /// The broker has read the batch with this number, and every message before it.
    Batch(u32),
    /// The broker has read every message before the check.
    Check,
}

/// Messages that were sent and are not yet confirmed as read, in the order of sending.
type UnreadMessages = Arc<Mutex<VecDeque<ReceiptScope>>>;

/// Takes the session's messages. When the outbox is dropped, the waiting messages are sent and the stream ends.
#[derive(Debug)]
pub(crate) struct Outbox {
    batches: watch::Sender<PublishValuesRequest>,
    /// The answers to send; `None` stands for a check.
    answers: mpsc::Sender<Option<GetProviderValueResponse>>,
    unread: UnreadMessages,
}

impl Outbox {
    /// Creates an outbox and the stream of its messages. The stream begins with `claim`.
    pub(crate) fn open(claim: ProvideSignalRequest) -> (Self, Messages) {
        let (batches, newest) = watch::channel(PublishValuesRequest::default());
        let (answers, waiting) = mpsc::channel(MAX_ANSWERS);
        let unread = UnreadMessages::default();
        let next = Some(Action::Provide(claim));
        let messages = Messages {
            next,
            answers: waiting,
            batches: WatchStream::from_changes(newest),
            unread: Arc::clone(&unread),
        };
        (Self { batches, answers, unread }, messages)
    }

    /// Queues a batch. It replaces a batch that is still waiting.
    pub(crate) fn publish(&self, batch: PublishValuesRequest) {
        self.batches.send_replace(batch);
    }

    /// Queues an answer. Returns `false` if too many answers are waiting.
    pub(crate) fn answer(&self, answer: GetProviderValueResponse) -> bool {
        self.answers.try_send(Some(answer)).is_ok()
    }

    /// Queues a check. Returns `false` if too many answers are waiting.
    pub(crate) fn check(&self) -> bool {
        self.answers.try_send(None).is_ok()
    }

    /// Handles a receipt. Returns what the broker has read.
    pub(crate) fn acknowledge(&self) -> Option<ReceiptScope> {
        self.unread.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }
}

#[derive(Debug)]
pub(crate) struct Messages {
    /// A message that is sent before all others: first the initial claim, later the empty claim after each batch.
    next: Option<Action>,
    answers: mpsc::Receiver<Option<GetProviderValueResponse>>,
    batches: WatchStream<PublishValuesRequest>,
    unread: UnreadMessages,
}

impl Messages {
    fn note_unread(&self, sent: ReceiptScope) {
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
                self.note_unread(ReceiptScope::Check);
                return Poll::Ready(Some(receipt));
            }
            // If the outbox is closed, the stream of batches has ended too, which is handled below.
            Poll::Ready(None) | Poll::Pending => {}
        }
        let Some(batch) = std::task::ready!(Pin::new(&mut self.batches).poll_next(context)) else {
            return Poll::Ready(None);
        };
        self.note_unread(ReceiptScope::Batch(batch.request_id));
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
    async fn blocked_connection_keeps_newest_batch_only() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        (1..=1000).for_each(|id| outbox.publish(batch(id)));
        let unread = Arc::clone(&outbox.unread);
        drop(outbox);
        let claim = || Action::Provide(ProvideSignalRequest::default());
        assert_eq!(sent(messages).await, [claim(), Action::Publish(batch(1000)), claim()]);
        assert_eq!(*unread.lock().unwrap(), [ReceiptScope::Batch(1000)]);
    }

    #[tokio::test]
    async fn answer_overtakes_batch_and_receipts_keep_order() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        outbox.publish(batch(1));
        assert!(outbox.answer(answer(7)) && outbox.check());
        let actions: Vec<_> = messages.take(5).filter_map(|message| message.action).collect().await;
        let claim = || Action::Provide(ProvideSignalRequest::default());
        assert_eq!(actions, [claim(), Action::Answer(answer(7)), claim(), Action::Publish(batch(1)), claim()]);
        let read = [outbox.acknowledge(), outbox.acknowledge(), outbox.acknowledge()];
        assert_eq!(read, [Some(ReceiptScope::Check), Some(ReceiptScope::Batch(1)), None]);
    }

    #[tokio::test]
    async fn waiting_answers_are_bounded() {
        let (outbox, messages) = Outbox::open(ProvideSignalRequest::default());
        assert!((1..=8).all(|id| outbox.answer(answer(id))));
        assert!(!outbox.answer(answer(9)) && !outbox.check(), "the queue is unbounded");
        drop((outbox, messages));
    }
}
