//! Work on many items by several threads, with the results in the items' order.
//!
//! Promise: the number of threads, not of items, bounds the waiting results: no thread begins an item far beyond the first
//! one that is not done.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

/// Items per thread that may be begun beyond the first one not returned, so that a long item does not stop the others soon.
const AHEAD: usize = 4;

/// State shared by the threads.
struct Schedule<R> {
    /// The next item to begin.
    next: usize,
    /// The first item whose result was not returned.
    first: usize,
    /// Results from that one on, of those that are done.
    done: VecDeque<Option<R>>,
    /// Whether no further item is begun.
    stopped: bool,
}

struct SharedSchedule<R> {
    state: Mutex<Schedule<R>>,
    changed: Condvar,
}

/// Stops the others when its thread panics, so that none waits for a result that will not come.
struct PanicGuard<'a, R>(&'a SharedSchedule<R>);

impl<R> Drop for PanicGuard<'_, R> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.lock().stopped = true;
            self.0.changed.notify_all();
        }
    }
}

impl<R> SharedSchedule<R> {
    fn lock(&self) -> MutexGuard<'_, Schedule<R>> {
        // No thread panics while holding it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, Schedule<R>>) -> MutexGuard<'a, Schedule<R>> {
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }

    /// The next item to work on; blocks while too many results are waiting.
    fn begin(&self, items: usize, ahead: usize) -> Option<usize> {
        let mut state = self.lock();
        while !state.stopped && state.next < items && state.next >= state.first + ahead {
            state = self.wait(state);
        }
        let index = state.next;
        state.next += 1;
        (!state.stopped && index < items).then_some(index)
    }

    fn put(&self, index: usize, result: R) {
        let mut state = self.lock();
        let place = index - state.first;
        if state.done.len() <= place {
            state.done.resize_with(place + 1, || None);
        }
        state.done[place] = Some(result);
        self.changed.notify_all();
    }

    /// The next result in order; `None` when a thread has failed.
    fn take(&self) -> Option<R> {
        let mut state = self.lock();
        loop {
            if let Some(result) = state.done.front_mut().and_then(Option::take) {
                state.done.pop_front();
                state.first += 1;
                self.changed.notify_all();
                return Some(result);
            }
            if state.stopped {
                return None;
            }
            state = self.wait(state);
        }
    }
}

/// Gives every item to `work` on up to `jobs` threads, and each result to `take` on this one: in the items' order, and as soon
/// as all before are done. When `take` gives `false` no further item is begun and no result returned.
pub fn in_order<T: Sync, R: Send>(
    items: &[T],
    jobs: usize,
    work: impl Fn(&T) -> R + Sync,
    mut take: impl FnMut(&T, R) -> bool,
) {
    let jobs = jobs.clamp(1, items.len().max(1));
    let state = Schedule { next: 0, first: 0, done: VecDeque::new(), stopped: false };
    let shared = SharedSchedule { state: Mutex::new(state), changed: Condvar::new() };
    thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                let _guard = PanicGuard(&shared);
                while let Some(index) = shared.begin(items.len(), AHEAD * jobs) {
                    shared.put(index, work(&items[index]));
                }
            });
        }
        for item in items {
            if !shared.take().is_some_and(|result| take(item, result)) {
                break;
            }
        }
        shared.lock().stopped = true;
        shared.changed.notify_all();
    });
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn results_come_in_the_items_order_whatever_the_threads_do() {
        let items: Vec<usize> = (0..200).collect();
        for jobs in [0, 1, 3, 500] {
            let mut seen = Vec::new();
            let work = |item: &usize| {
                // Early items take longest.
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
    fn no_thread_runs_far_ahead_of_a_slow_item() {
        let items: Vec<usize> = (0..1000).collect();
        let begun = AtomicUsize::new(0);
        let furthest = AtomicUsize::new(0);
        let work = |item: &usize| {
            begun.fetch_max(*item, Ordering::SeqCst);
            if *item == 0 {
                // The first item is done when the others can go no further, or never.
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
    fn nothing_more_is_begun_once_no_result_is_wanted() {
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
    fn a_panic_is_passed_on_and_hangs_no_thread() {
        in_order(&[1, 2, 3, 4], 2, |item| assert!(*item != 2), |_, ()| true);
    }
}
