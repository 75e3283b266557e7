//! Processes many items on several threads and returns the results in the order of the items.
//!
//! Guarantee: the memory for waiting results depends on the number of threads, not on the number of items. No thread
//! starts an item far beyond the first item that is not finished.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::thread;

/// Number of items per thread that may be started beyond the first unfinished item. The number is larger than 1, so
/// that the other threads can continue for some time while one thread processes a long item.
const AHEAD: usize = 4;

/// Items that are not yet started, and the queue of receivers for their results, in the same order.
struct Schedule<'a, T, R> {
    items: std::slice::Iter<'a, T>,
    results: SyncSender<Receiver<R>>,
}

impl<'a, T, R> Schedule<'a, T, R> {
    /// Returns the next item and the channel for its result. Blocks while too many results wait. `None` = all items are
    /// started, or no more results are wanted.
    fn begin(&mut self) -> Option<(&'a T, SyncSender<R>)> {
        let item = self.items.next()?;
        let (result, receiver) = sync_channel(1);
        self.results.send(receiver).ok().map(|()| (item, result))
    }
}

/// Passes every item to `work` on up to `jobs` threads. Passes each result to `take` on this thread, in the order of
/// the items, as soon as all earlier results are done. After `take` has returned `false`, no further item is started
/// and no further result is passed.
pub fn in_order<T: Sync, R: Send>(
    items: &[T],
    jobs: usize,
    work: impl Fn(&T) -> R + Sync,
    mut take: impl FnMut(&T, R) -> bool,
) {
    let jobs = jobs.clamp(1, items.len().max(1));
    // The queue has one place less, because the receiver whose result is awaited is not in the queue.
    let (results, queue) = sync_channel(AHEAD * jobs - 1);
    let schedule = Mutex::new(Schedule { items: items.iter(), results });
    let begin = || schedule.lock().unwrap_or_else(PoisonError::into_inner).begin();
    thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                while let Some((item, result)) = begin() {
                    let _ = result.send(work(item)); // sending fails if no more results are wanted
                }
            });
        }
        let queue = queue; // the queue is dropped with this block, so that no thread waits for room in it
        // A thread that panics drops its channel without a result.
        let _ = items.iter().try_for_each(|item| take(item, queue.recv().ok()?.recv().ok()?).then_some(()));
    });
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn results_keep_the_order_of_items() {
        let items: Vec<usize> = (0..200).collect();
        for jobs in [0, 1, 3, 500] {
            let mut seen = Vec::new();
            let work = |item: &usize| {
                // The first items take the longest.
                (0..(200 - item) * 50).for_each(|_| std::hint::spin_loop());
                item * 2
            };
            in_order(&items, jobs, work, |item, result| {
                seen.push((*item, result));
                true
            });
            assert_eq!(seen, items.iter().map(|item| (*item, item * 2)).collect::<Vec<_>>());
        }
        in_order(&[], 2, |_: &usize| 0, |_, _| panic!("there is no item"));
    }

    #[test]
    fn threads_do_not_run_far_ahead_of_slow_item() {
        let items: Vec<usize> = (0..1000).collect();
        let begun = AtomicUsize::new(0);
        let furthest = AtomicUsize::new(0);
        let work = |item: &usize| {
            begun.fetch_max(*item, Ordering::SeqCst);
            if *item == 0 {
                // Finishes the first item only when the other threads cannot start any more items.
                while begun.load(Ordering::SeqCst) < 2 * AHEAD - 1 {
                    thread::yield_now();
                }
                furthest.store(begun.load(Ordering::SeqCst), Ordering::SeqCst);
            }
        };
        in_order(&items, 2, work, |_, ()| true);
        assert!(furthest.load(Ordering::SeqCst) < 2 * AHEAD, "{furthest:?}");
    }

    #[test]
    fn no_item_starts_after_take_returns_false() {
        let items: Vec<usize> = (0..1000).collect();
        let (begun, mut taken) = (AtomicUsize::new(0), 0);
        in_order(
            &items,
            2,
            |_| begun.fetch_add(1, Ordering::SeqCst),
            |_, _| {
                taken += 1;
                taken < 3
            },
        );
        assert_eq!(taken, 3);
        assert!(begun.load(Ordering::SeqCst) <= 3 + 2 * AHEAD, "{begun:?}");
    }

    #[test]
    #[should_panic(expected = "a scoped thread panicked")]
    fn panic_is_propagated_without_deadlock() {
        in_order(&[1, 2, 3, 4], 2, |item| assert!(*item != 2), |_, ()| true);
    }
}
