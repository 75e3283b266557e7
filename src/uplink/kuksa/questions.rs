//! Questions of the broker: a reader wants a value now, and the broker asks the provider.
//!
//! The databroker (0.7) reads nothing else of the provider while it waits, for a second, for the answer; and an answer that comes later
//! it takes for that to its next question, of another signal. A batch sent while the broker waits delays the answer behind it.
//! Therefore:
//!
//! * A question waits until the broker has read everything; one that has waited for [`DEADLINE`] gets no answer, and the broker answers
//!   its reader with the value it has.
//! * An answer is proved in time by the next question, if that comes before the first one's second is over, else by a receipt. Without
//!   proof the connection ends: with it end the answers that wait in the broker.

use std::time::Duration;

use tokio::time::Instant;

use super::messages::GetProviderValueRequest;
use super::outgoing::Sent;

/// Longest wait of a question: half of what the broker waits.
const DEADLINE: Duration = Duration::from_millis(500);
/// Pause of the questions after which a receipt is asked for: a reader that asks for many values in a row proves each by the next.
const CHECK_AFTER: Duration = Duration::from_millis(100);
/// Latest proof: what the broker waits, less 200 ms for the way of the question.
const LATEST_PROOF: Duration = Duration::from_millis(800);
/// Questions that wait: the broker asks one at a time.
const MAX_QUESTIONS: usize = 8;

/// A question and when it came.
pub(crate) type Question = (Instant, GetProviderValueRequest);

/// The questions of one connection.
#[derive(Debug, Default)]
pub(crate) struct Questions {
    waiting: Vec<Question>,
    /// Number of the latest batch made, and of the latest that the broker has read.
    made: u32,
    read: u32,
    /// When the question came whose answer is not proved.
    unproved: Option<Instant>,
    is_checking: bool,
}

impl Questions {
    /// A batch was made.
    pub(crate) fn note_batch(&mut self, number: u32) {
        self.made = number;
    }

    /// The broker has read a message.
    pub(crate) fn note_read(&mut self, sent: Option<Sent>) {
        match sent {
            Some(Sent::Batch(number)) => self.read = number,
            Some(Sent::Check) => (self.unproved, self.is_checking) = (None, false),
            None => {}
        }
    }

    /// The broker asks; `false` = too many wait.
    pub(crate) fn ask(&mut self, question: GetProviderValueRequest, now: Instant) -> bool {
        if self.unproved.is_some_and(|asked| now.duration_since(asked) <= LATEST_PROOF) {
            self.unproved = None;
        }
        let has_room = self.waiting.len() < MAX_QUESTIONS;
        if has_room {
            self.waiting.push((now, question));
        }
        has_room
    }

    /// Questions to answer now, and how many get no answer any more.
    pub(crate) fn take(&mut self, now: Instant) -> (Vec<Question>, u64) {
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

    /// When [`Questions::handle_time`] is due; `None` = not before the next message.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.unproved.map(|asked| asked + if self.is_checking { LATEST_PROOF } else { CHECK_AFTER })
    }

    /// Whether a receipt is to be asked for now.
    ///
    /// # Errors
    /// When a proof does not come.
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

    fn question(id: i32) -> GetProviderValueRequest {
        GetProviderValueRequest { request_id: 0, signal_ids: vec![id] }
    }

    fn answered(questions: &mut Questions, now: Instant) -> (Vec<i32>, u64) {
        let (open, expired) = questions.take(now);
        (open.iter().flat_map(|(_, question)| question.signal_ids.clone()).collect(), expired)
    }

    fn ms(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn a_question_waits_until_the_latest_batch_is_read() {
        let (mut questions, start) = (Questions::default(), Instant::now());
        questions.note_batch(1);
        questions.note_batch(2);
        assert!(questions.ask(question(5), start));
        assert_eq!(answered(&mut questions, start), (vec![], 0));
        questions.note_read(Some(Sent::Batch(1)));
        assert_eq!(answered(&mut questions, start), (vec![], 0), "batch 2 is on its way");
        questions.note_read(Some(Sent::Batch(2)));
        assert_eq!(answered(&mut questions, start), (vec![5], 0));
        assert_eq!(answered(&mut questions, start), (vec![], 0), "answered once");
    }

    #[test]
    fn a_question_that_waited_too_long_gets_no_answer() {
        let (mut questions, start) = (Questions::default(), Instant::now());
        questions.note_batch(1);
        assert!(questions.ask(question(5), start));
        questions.note_read(Some(Sent::Batch(1)));
        assert_eq!(answered(&mut questions, start + DEADLINE + ms(1)), (vec![], 1));
        assert_eq!(questions.due(), None);
        assert!((0..8).all(|id| questions.ask(question(id), start)) && !questions.ask(question(9), start));
    }

    #[test]
    fn the_next_question_within_the_second_proves_an_answer() {
        let (mut questions, start) = (Questions::default(), Instant::now());
        questions.ask(question(5), start);
        assert_eq!(answered(&mut questions, start), (vec![5], 0));
        assert_eq!(questions.due(), Some(start + CHECK_AFTER));
        questions.ask(question(6), start + ms(50));
        assert_eq!(questions.due(), None);
        assert_eq!(answered(&mut questions, start + ms(50)), (vec![6], 0));
    }

    #[test]
    fn a_receipt_proves_an_answer_and_no_question_is_answered_before_it() {
        let (mut questions, start) = (Questions::default(), Instant::now());
        questions.ask(question(5), start);
        answered(&mut questions, start);
        assert_eq!(questions.handle_time(start + ms(99)), Ok(false));
        assert_eq!(questions.handle_time(start + ms(100)), Ok(true));
        assert_eq!(questions.handle_time(start + ms(101)), Ok(false), "asked for once");
        questions.ask(question(6), start + ms(102));
        assert_eq!(answered(&mut questions, start + ms(102)), (vec![], 0));
        questions.note_read(Some(Sent::Check));
        assert_eq!(answered(&mut questions, start + ms(103)), (vec![6], 0));
    }

    #[test]
    fn an_answer_without_proof_ends_the_connection() {
        let (mut questions, start) = (Questions::default(), Instant::now());
        questions.ask(question(5), start);
        answered(&mut questions, start);
        assert_eq!(questions.handle_time(start + ms(100)), Ok(true));
        assert_eq!(questions.due(), Some(start + LATEST_PROOF));
        assert!(questions.handle_time(start + LATEST_PROOF).is_err());
        questions.ask(question(6), start + ms(900));
        assert!(
            questions.handle_time(start + ms(901)).is_err(),
            "a question after the first one's second proves nothing"
        );
    }
}
