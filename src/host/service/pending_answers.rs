//! Holds the answer to a command until the command's changes are on disk, because a client that has received the answer
//! may cut the power.
//!
//! In: the outcome of a command and the ticket (number) of its commit; the progress of the store; the time. Out: the
//! answer, which states whether the outcome is stored. If the disk fails, the answer is sent at once. If the disk is
//! slow, the answer is sent after [`MAX_WAIT`]. In both cases the command is in effect, and its outcome is stored when
//! the disk works again.

use tokio::sync::oneshot;
use tokio::time::{Duration, Instant};

use crate::control::protocol::{Answer, CommandOutcome};
use crate::store::StoreProgress;

/// Longest wait for the disk. A client waits longer for its answer ([`crate::control::client`]).
pub(super) const MAX_WAIT: Duration = Duration::from_secs(30);

/// Waiting answers, at most one per connection.
#[derive(Debug, Default)]
pub(super) struct PendingAnswers {
    waiting: Vec<PendingAnswer>,
}

#[derive(Debug)]
struct PendingAnswer {
    ticket: u64,
    until: Instant,
    outcome: CommandOutcome,
    answer: oneshot::Sender<Answer>,
}

impl PendingAnswers {
    /// Holds an answer until the commit of `ticket`.
    pub(super) fn hold(&mut self, ticket: u64, outcome: CommandOutcome, answer: oneshot::Sender<Answer>, now: Instant) {
        self.waiting.push(PendingAnswer { ticket, until: now + MAX_WAIT, outcome, answer });
    }

    pub(super) fn note_progress(&mut self, progress: &StoreProgress) {
        self.send_if(Some(progress.works), |waiting| waiting.ticket <= progress.ticket);
    }

    pub(super) fn note_time(&mut self, now: Instant) {
        self.send_if(Some(false), |waiting| waiting.until <= now);
    }

    fn send_if(&mut self, is_stored: Option<bool>, decide: impl Fn(&PendingAnswer) -> bool) {
        for PendingAnswer { outcome, answer, .. } in self.waiting.extract_if(.., |waiting| decide(waiting)) {
            // The client may have closed the connection.
            let _ = answer.send(Answer::Outcome(CommandOutcome { is_stored, ..outcome }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quantity::Timestamp;

    fn outcome() -> CommandOutcome {
        CommandOutcome { time: Timestamp::ZERO, changed: 1, refused: 0, refused_alarms: Vec::new(), is_stored: None }
    }

    fn held(answers: &mut PendingAnswers, ticket: u64, now: Instant) -> oneshot::Receiver<Answer> {
        let (sender, receiver) = oneshot::channel();
        answers.hold(ticket, outcome(), sender, now);
        receiver
    }

    fn stored(answer: &mut oneshot::Receiver<Answer>) -> Option<bool> {
        match answer.try_recv() {
            Ok(Answer::Outcome(outcome)) => outcome.is_stored,
            Ok(other) => panic!("{other:?}"),
            Err(_) => None,
        }
    }

    #[test]
    fn answer_waits_for_its_commit() {
        let now = Instant::now();
        let mut answers = PendingAnswers::default();
        let [mut first, mut second] = [3, 4].map(|ticket| held(&mut answers, ticket, now));
        let progress = |ticket, works| StoreProgress { ticket, works, ..StoreProgress::default() };
        answers.note_progress(&progress(2, true));
        answers.note_time(now + MAX_WAIT / 2);
        assert_eq!((stored(&mut first), stored(&mut second)), (None, None));
        answers.note_progress(&progress(3, true));
        assert_eq!((stored(&mut first), stored(&mut second)), (Some(true), None));
        answers.note_progress(&progress(4, false));
        assert_eq!(stored(&mut second), Some(false), "the disk fails");
    }

    #[test]
    fn answer_wait_is_limited() {
        let now = Instant::now();
        let mut answers = PendingAnswers::default();
        let mut answer = held(&mut answers, 1, now);
        answers.note_time(now + MAX_WAIT);
        assert_eq!(stored(&mut answer), Some(false));
        assert!(answers.waiting.is_empty());
    }
}
