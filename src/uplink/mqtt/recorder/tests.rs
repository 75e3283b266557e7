//! Tests which samples and events are queued, and that each is queued once, even after a restart.

use super::super::settings::HistorySettings;
use super::*;
use serde_json::json;

const START: i64 = 1_800_000_000;

fn document(second: f64) -> StatusDocument {
    let mut document: StatusDocument = serde_json::from_str(include_str!("../../tests/data/status.json")).unwrap();
    document.time = Timestamp::from_secs(second);
    document.events.clear();
    document
}

fn queue(folder: &tempfile::TempDir) -> Queue {
    Queue::open(&HistorySettings { folder: folder.path().to_owned(), ..HistorySettings::default() }).unwrap()
}

/// Seconds of the documents that became samples.
fn sampled(period_s: u64, seconds: &[f64]) -> Vec<f64> {
    let folder = tempfile::tempdir().unwrap();
    let queue = queue(&folder);
    let mut recorder = Recorder::new(&queue, period_s);
    let is_taken = |&second: &f64| {
        let before = queue.fill().messages;
        recorder.take(&document(second));
        queue.fill().messages > before
    };
    seconds.iter().copied().filter(is_taken).collect()
}

#[test]
fn samples_keep_period_despite_document_jitter() {
    let jitter = [0.0, 1.02, 1.97, 3.01, 3.98, 5.03, 6.0];
    assert_eq!(sampled(2, &jitter), [0.0, 1.97, 3.98, 6.0]);
    assert_eq!(sampled(1, &jitter), jitter);
    assert_eq!(sampled(0, &jitter), Vec::<f64>::new());
}

#[test]
fn schedule_restarts_after_pause_or_clock_step() {
    assert_eq!(sampled(10, &[0.0, 10.0, 95.0, 99.0, 105.0]), [0.0, 10.0, 95.0, 105.0]);
    // The daemon restarted with a clock that was set back.
    assert_eq!(sampled(10, &[1000.0, 1005.0, 100.0, 105.0, 110.0]), [1000.0, 100.0, 110.0]);
}

#[test]
fn new_events_are_those_not_listed_before() {
    let list = |numbers: &[i64]| numbers.iter().map(|&number| json!({ "time": number })).collect::<Vec<_>>();
    for (before, now, new) in [
        (&[][..], &[1, 2][..], &[1, 2][..]),
        (&[1, 2], &[1, 2], &[]),
        (&[1, 2], &[1, 2, 3], &[3]),
        // The daemon dropped its oldest event.
        (&[1, 2, 3], &[2, 3, 4], &[4]),
        (&[1, 2, 3], &[7, 8, 9], &[7, 8, 9]),
        // Two events of the same time.
        (&[1, 1], &[1, 1, 1], &[1]),
        // Another daemon, which has no events.
        (&[1, 2, 3], &[], &[]),
    ] {
        assert_eq!(new_events(&list(before), &list(now)), list(new), "{before:?} {now:?}");
    }
}

#[test]
fn event_is_queued_once_across_restart() {
    let folder = tempfile::tempdir().unwrap();
    let mut with_event = document(START as f64);
    with_event.events = vec![json!({ "event": "gap", "time": START * 1_000_000_000, "seconds": 4.0 })];
    for messages in [1, 1] {
        let queue = queue(&folder);
        let mut recorder = Recorder::new(&queue, 0);
        recorder.take(&with_event);
        recorder.take(&with_event);
        assert_eq!(queue.fill().messages, messages);
    }
}
