//! Handles requests of the broker for values. When a reader asks the broker for a current value, the broker asks this
//! program.
//!
//! While the databroker (0.7) waits for an answer (up to a second), it reads nothing else from this program. It
//! mistakes a late answer for the answer to its next request, which may be about another signal. If an unread batch of
//! values was sent before the answer, the broker must first read the batch, and may read the answer too late.
//! Therefore:
//!
//! * A request is answered only after the broker has read all earlier messages. If this takes longer than [`DEADLINE`],
//!   the request gets no answer, and the broker gives its reader the last value.
//! * Every answer needs a proof that the broker read it in time. The proof is either the broker's next request, if it
//!   arrives before [`LATEST_PROOF`], or a receipt (the broker's confirmation that it has read all messages so far).
//!   Without a proof the connection is closed, which also discards answers that wait in the broker.

use std::time::Duration;

use tokio::time::Instant;

use super::messages::GetProviderValueRequest;
use super::outgoing::ReceiptScope;

/// Longest wait before an answer: half of the broker's timeout.
const DEADLINE: Duration = Duration::from_millis(500);
/// If no further request arrives within this time after a request, a receipt is requested. A reader that asks for many
/// values in a row proves each answer by its next request.
const CHECK_AFTER: Duration = Duration::from_millis(100);
/// Latest time of the proof, counted from the request: the broker's timeout minus 200 ms of transport latency.
const LATEST_PROOF: Duration = Duration::from_millis(800);
/// Maximum number of waiting requests. The broker sends one request at a time.
const MAX_REQUESTS: usize = 8;

pub(crate) type ValueRequest = (Instant, GetProviderValueRequest);

#[derive(Debug, Default)]
pub(crate) struct ValueRequests {
    waiting: Vec<ValueRequest>,
    /// Number of the latest batch that was created.
    made: u32,
    /// Number of the latest batch that the broker has read.
    read: u32,
    /// Arrival of the latest answered request; `None` = no answer waits for a proof.
    unproved: Option<Instant>,
    is_checking: bool,
}

impl ValueRequests {
    pub(crate) fn note_batch(&mut self, number: u32) {
        self.made = number;
    }

    /// Notes that the broker has read a message.
    pub(crate) fn note_read(&mut self, scope: Option<ReceiptScope>) {
        match scope {
            Some(ReceiptScope::Batch(number)) => self.read = number,
            Some(ReceiptScope::Check) => (self.unproved, self.is_checking) = (None, false),
            None => {}
        }
    }

    /// Adds a request. Returns `false` if too many requests are waiting.
    pub(crate) fn ask(&mut self, request: GetProviderValueRequest, now: Instant) -> bool {
        if self.unproved.is_some_and(|asked| now.duration_since(asked) <= LATEST_PROOF) {
            self.unproved = None;
        }
        let has_room = self.waiting.len() < MAX_REQUESTS;
        if has_room {
            self.waiting.push((now, request));
        }
        has_room
    }

    /// Returns the requests to answer now, and the number of requests that have expired.
    pub(crate) fn take(&mut self, now: Instant) -> (Vec<ValueRequest>, u64) {
        if self.made != self.read || self.is_checking {
            return (Vec::new(), 0);
        }
        let all = self.waiting.len();
        let mut open = std::mem::take(&mut self.waiting);
        open.retain(|(asked, _)| now.duration_since(*asked) <= DEADLINE);
        let expired = u64::try_from(all - open.len()).unwrap_or_default();
        self.unproved = open.last().map(|(asked, _)| *asked).or(self.unproved);
        (open, expired)
    }

    /// Time when [`ValueRequests::handle_time`] is due; `None` = not before the next message.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.unproved.map(|asked| asked + if self.is_checking { LATEST_PROOF } else { CHECK_AFTER })
    }

    /// Whether to request a receipt now.
    ///
    /// # Errors
    /// Fails if the proof of an answer is overdue.
    pub(crate) fn handle_time(&mut self, now: Instant) -> Result<bool, String> {
        if self.unproved.is_some_and(|asked| now.duration_since(asked) >= LATEST_PROOF) {
            return Err("the broker may have read an answer late".to_owned());
        }
        let is_due = !self.is_checking && self.due().is_some_and(|due| due <= now);
        self.is_checking |= is_due;
        Ok(is_due)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(id: i32) -> GetProviderValueRequest {
        GetProviderValueRequest { request_id: 0, signal_ids: vec![id] }
    }

    fn answered(requests: &mut ValueRequests, now: Instant) -> (Vec<i32>, u64) {
        let (open, expired) = requests.take(now);
        (open.iter().flat_map(|(_, request)| request.signal_ids.clone()).collect(), expired)
    }

    fn ms(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn request_waits_until_latest_batch_is_read() {
        let (mut requests, start) = (ValueRequests::default(), Instant::now());
        requests.note_batch(1);
        requests.note_batch(2);
        assert!(requests.ask(request(5), start));
        assert_eq!(answered(&mut requests, start), (vec![], 0));
        requests.note_read(Some(ReceiptScope::Batch(1)));
        assert_eq!(answered(&mut requests, start), (vec![], 0), "batch 2 is on its way");
        requests.note_read(Some(ReceiptScope::Batch(2)));
        assert_eq!(answered(&mut requests, start), (vec![5], 0));
        assert_eq!(answered(&mut requests, start), (vec![], 0), "answered once");
    }

    #[test]
    fn expired_request_gets_no_answer() {
        let (mut requests, start) = (ValueRequests::default(), Instant::now());
        requests.note_batch(1);
        assert!(requests.ask(request(5), start));
        requests.note_read(Some(ReceiptScope::Batch(1)));
        assert_eq!(answered(&mut requests, start + DEADLINE + ms(1)), (vec![], 1));
        assert_eq!(requests.due(), None);
        assert!((0..8).all(|id| requests.ask(request(id), start)) && !requests.ask(request(9), start));
    }

    #[test]
    fn next_request_within_second_proves_answer() {
        let (mut requests, start) = (ValueRequests::default(), Instant::now());
        requests.ask(request(5), start);
        assert_eq!(answered(&mut requests, start), (vec![5], 0));
        assert_eq!(requests.due(), Some(start + CHECK_AFTER));
        requests.ask(request(6), start + ms(50));
        assert_eq!(requests.due(), None);
        assert_eq!(answered(&mut requests, start + ms(50)), (vec![6], 0));
    }

    #[test]
    fn receipt_proves_answer_and_precedes_next_answer() {
        let (mut requests, start) = (ValueRequests::default(), Instant::now());
        requests.ask(request(5), start);
        answered(&mut requests, start);
        assert_eq!(requests.handle_time(start + ms(99)), Ok(false));
        assert_eq!(requests.handle_time(start + ms(100)), Ok(true));
        assert_eq!(requests.handle_time(start + ms(101)), Ok(false), "asked for once");
        requests.ask(request(6), start + ms(102));
        assert_eq!(answered(&mut requests, start + ms(102)), (vec![], 0));
        requests.note_read(Some(ReceiptScope::Check));
        assert_eq!(answered(&mut requests, start + ms(103)), (vec![6], 0));
    }

    #[test]
    fn unproved_answer_ends_connection() {
        let (mut requests, start) = (ValueRequests::default(), Instant::now());
        requests.ask(request(5), start);
        answered(&mut requests, start);
        assert_eq!(requests.handle_time(start + ms(100)), Ok(true));
        assert_eq!(requests.due(), Some(start + LATEST_PROOF));
        assert!(requests.handle_time(start + LATEST_PROOF).is_err());
        requests.ask(request(6), start + ms(900));
        assert!(
            requests.handle_time(start + ms(901)).is_err(),
            "a request after the first one's second proves nothing"
        );
    }
}
