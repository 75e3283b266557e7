//! Tests the queue on disk: order, bounds, drops, restarts.

use super::*;

fn settings(folder: &Path, max_messages: u64, max_bytes: u64) -> HistorySettings {
    HistorySettings { folder: folder.to_owned(), max_messages, max_bytes, ..HistorySettings::default() }
}

/// Remaining messages, in the order of arrival.
fn texts(queue: &Queue) -> Vec<String> {
    let mut left = queue.oldest(Class::Event, 100).unwrap();
    left.extend(queue.oldest(Class::Sample, 100).unwrap());
    left.sort_by_key(|message| message.sequence);
    left.into_iter().map(|message| message.body).collect()
}

fn sample(text: &str) -> (Class, String) {
    (Class::Sample, text.to_owned())
}

fn event(text: &str) -> (Class, String) {
    (Class::Event, text.to_owned())
}

#[test]
fn messages_keep_order_across_restart() {
    let folder = tempfile::tempdir().unwrap();
    let queue = Queue::open(&settings(folder.path(), 10, 1000)).unwrap();
    queue.add(&[event("{e1}"), sample("{s1 ä}")], Some(("[1]", 7))).unwrap();
    queue.add(&[sample("{s2}")], None).unwrap();
    let before = queue.fill();
    assert_eq!((before.messages, before.bytes, before.missed_events), (3, 4 + 7 + 4, 7));
    drop(queue);
    let queue = Queue::open(&settings(folder.path(), 10, 1000)).unwrap();
    assert_eq!((queue.fill(), queue.seen().as_deref()), (before, Some("[1]")));
    let mut oldest = queue.oldest(Class::Event, 2).unwrap();
    oldest.extend(queue.oldest(Class::Sample, 1).unwrap());
    let found: Vec<_> = oldest.iter().map(|message| (message.sequence, message.body.as_str())).collect();
    assert_eq!(found, [(1, "{e1}"), (2, "{s1 ä}")]);
    queue.remove(&oldest).unwrap();
    // Removing twice is allowed; the message may have been dropped before.
    queue.remove(&oldest).unwrap();
    assert_eq!((texts(&queue), queue.fill().bytes), (vec!["{s2}".to_owned()], 4));
}

#[test]
fn sequence_numbers_are_never_reused() {
    let folder = tempfile::tempdir().unwrap();
    let queue = Queue::open(&settings(folder.path(), 10, 1000)).unwrap();
    queue.add(&[sample("a")], None).unwrap();
    queue.remove(&queue.oldest(Class::Sample, 1).unwrap()).unwrap();
    drop(queue);
    let queue = Queue::open(&settings(folder.path(), 10, 1000)).unwrap();
    queue.add(&[sample("b")], None).unwrap();
    assert_eq!(queue.oldest(Class::Sample, 1).unwrap()[0].sequence, 2);
}

#[test]
fn full_queue_drops_samples_first_and_counts() {
    let folder = tempfile::tempdir().unwrap();
    let queue = Queue::open(&settings(folder.path(), 3, 1000)).unwrap();
    queue.add(&[event("e1"), sample("s1"), sample("s2"), event("e2")], None).unwrap();
    assert_eq!(texts(&queue), ["e1", "s2", "e2"]);
    queue.add(&[event("e3"), event("e4")], None).unwrap();
    assert_eq!(texts(&queue), ["e2", "e3", "e4"]);
    let fill = queue.fill();
    assert_eq!((fill.messages, fill.bytes, fill.dropped_samples, fill.dropped_events), (3, 6, 2, 1));
    drop(queue);
    assert_eq!(Queue::open(&settings(folder.path(), 3, 1000)).unwrap().fill(), fill);
}

#[test]
fn byte_limit_holds_for_oversized_message() {
    let folder = tempfile::tempdir().unwrap();
    let queue = Queue::open(&settings(folder.path(), 100, 10)).unwrap();
    queue.add(&[sample("12345"), sample("67890")], None).unwrap();
    assert_eq!(queue.fill().messages, 2);
    queue.add(&[sample("a longer one than ten bytes")], None).unwrap();
    assert_eq!((queue.fill().bytes, queue.fill().messages, queue.fill().dropped_samples), (0, 0, 3));
}

#[test]
fn second_uplink_fails_and_damaged_file_is_set_aside() {
    let folder = tempfile::tempdir().unwrap();
    let queue = Queue::open(&settings(folder.path(), 3, 1000)).unwrap();
    let refusal = Queue::open(&settings(folder.path(), 3, 1000)).unwrap_err();
    assert!(refusal.ends_with("used by another uplink"), "{refusal}");
    drop(queue);
    std::fs::write(folder.path().join(FILE), "no database, but long enough to look like one".repeat(100)).unwrap();
    let queue = Queue::open(&settings(folder.path(), 3, 1000)).unwrap();
    queue.add(&[sample("a")], None).unwrap();
    assert_eq!(queue.fill().messages, 1);
    // The new queue's numbers are above all numbers that readers know.
    assert!(queue.oldest(Class::Sample, 1).unwrap()[0].sequence > 1_700_000_000_000);
    assert!(folder.path().join("queue.damaged").exists());
}

#[test]
fn unreadable_or_newer_file_is_left_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let open = || Queue::open(&settings(folder.path(), 10, 1000));
    open().unwrap().add(&[event("e1")], None).unwrap();

    let in_the_way = folder.path().join("queue.db-wal");
    std::fs::create_dir(&in_the_way).unwrap();
    open().unwrap_err();
    std::fs::remove_dir(&in_the_way).unwrap();
    assert_eq!(texts(&open().unwrap()), ["e1"]);

    let database = Connection::open(folder.path().join(FILE)).unwrap();
    database.pragma_update(None, "user_version", VERSION + 1).unwrap();
    let refusal = open().unwrap_err();
    assert!(
        refusal.ends_with("queue.db has layout 2, must be 1: written by a newer version of packwatch"),
        "{refusal}"
    );
    database.pragma_update(None, "user_version", VERSION).unwrap();
    assert_eq!(texts(&open().unwrap()), ["e1"]);
    assert!(!folder.path().join("queue.damaged").exists());
}
