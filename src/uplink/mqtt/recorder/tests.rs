//! Tests which samples and events are queued, and that each is queued once, even after a restart.

use super::super::settings::HistorySettings;
use super::*;

const START: i64 = 1_800_000_000;

fn document(second: f64) -> StatusDocument {
    let mut document: StatusDocument = serde_json::from_str(include_str!("../../tests/data/status.json")).unwrap();
    document.time = Timestamp::from_secs(second);
    (document.events, document.event_count) = (Vec::new(), 0);
    document
}

fn queue(folder: &tempfile::TempDir) -> Queue {
    Queue::open(&HistorySettings { folder: folder.path().to_owned(), ..HistorySettings::default() }).unwrap()
}

/// Passes status documents with the times `seconds` to a recorder. Returns the times of the documents that were queued
/// as samples.
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

/// Numbers of the queued events in order. -1 stands for a restart of the daemon, -1000 times N for N missed events.
fn queued(queue: &Queue) -> Vec<i64> {
    let number = |body: &str| {
        let event: Value = serde_json::from_str(body).unwrap();
        match event["event_type"].as_str().unwrap() {
            "daemon_restarted" => -1,
            "events_missed" => -1000 * event["data"]["missed"].as_i64().unwrap(),
            _ => event["data"]["seconds"].as_i64().unwrap(),
        }
    };
    queue.oldest(Class::Event, 10_000).unwrap().iter().map(|queued| number(&queued.body)).collect()
}

/// A status document that lists the events `first..=last`, from the run of the daemon that started at the time
/// `started`.
fn with_events(started: i64, first: i64, last: i64) -> StatusDocument {
    let mut document = document(START as f64);
    document.started = Timestamp::from_nanos(started);
    document.events = (first..=last).map(|number| json!({ "event": "gap", "time": 0, "seconds": number })).collect();
    document.event_count = last.unsigned_abs();
    document
}

#[test]
fn each_event_is_queued_once_or_counted() {
    for (documents, events, missed) in [
        // On the first start, events that the document no longer lists do not count as missed.
        (&[(1, 5, 9)][..], &[5, 6, 7, 8, 9][..], 0),
        (&[(1, 1, 0), (1, 1, 2), (1, 1, 2), (1, 2, 4)], &[1, 2, 3, 4], 0),
        (&[(1, 1, 2), (1, 67, 98)], &[&[1, 2, -64_000][..], &(67..=98).collect::<Vec<_>>()].concat(), 64),
        (&[(1, 1, 2), (1, 6, 7), (1, 9, 9)], &[1, 2, -3000, 6, 7, -1000, 9], 4),
        // The daemon restarts, with a smaller or a higher event number.
        (&[(1, 1, 3), (2, 1, 1)], &[1, 2, 3, -1, 1], 0),
        (&[(1, 1, 3), (2, 3, 4)], &[1, 2, 3, -1, -2000, 3, 4], 2),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut fill = Fill::default();
        for (index, &(started, first, last)) in documents.iter().enumerate() {
            // The uplink restarts before each document.
            let queue = queue(&folder);
            Recorder::new(&queue, 0).take(&with_events(started, first, last));
            fill = queue.fill();
            if index + 1 == documents.len() {
                assert_eq!(queued(&queue), events, "{documents:?}");
            }
        }
        assert_eq!(fill.missed_events, missed, "{documents:?}");
    }
    // A daemon of an older version does not number its events.
    let folder = tempfile::tempdir().unwrap();
    let queue = queue(&folder);
    Recorder::new(&queue, 0).take(&StatusDocument { event_count: 0, ..with_events(1, 1, 2) });
    assert!(queued(&queue).is_empty());
}
