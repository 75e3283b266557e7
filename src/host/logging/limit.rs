//! How many lines of each kind the log takes: a burst, and then a trickle. What is over that is left out and counted;
//! the count is logged when there is room again.
//!
//! A bus that flips all day must not wear the flash out. A kind of line is a place in the program: a thousand lines about
//! cells do not hide the one that says that the interface is down. Alarms are never left out: their rules debounce them.
//! Nor are lines below `info`: whoever asks for those wants them all.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Instant;

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Filter};

use super::LEFT_OUT;

/// Lines of one kind at once: a pack of 96 cells loses its input, all signals told one by one.
const BURST: f64 = 150.0;
/// Lines of one kind a second in the long run: some 30 MB of journal a day, were it a storm of lost and good again all day.
const RATE_PER_S: f64 = 0.5;

/// See the module. As many buckets as the program has places that log.
#[derive(Debug, Default)]
pub(super) struct Limit(Mutex<HashMap<Identifier, Bucket>>);

/// Lines that may still be written.
#[derive(Debug)]
struct Bucket {
    lines: f64,
    filled: Instant,
}

impl Bucket {
    /// A full burst may come.
    const fn full(now: Instant) -> Self {
        Self { lines: BURST, filled: now }
    }

    fn take(&mut self, now: Instant) -> bool {
        let elapsed_s = now.saturating_duration_since(self.filled).as_secs_f64();
        (self.lines, self.filled) = ((self.lines + elapsed_s * RATE_PER_S).min(BURST), now);
        let has_room = self.lines >= 1.0;
        self.lines -= f64::from(u8::from(has_room));
        has_room
    }
}

impl<S: Subscriber> Filter<S> for Limit {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        if *event.metadata().level() > Level::INFO || is_exempt(event) {
            return true;
        }
        let now = Instant::now();
        // A panic while the lock was held has left a number there, whatever it is.
        let mut buckets = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let is_taken = buckets.entry(event.metadata().callsite()).or_insert_with(|| Bucket::full(now)).take(now);
        if !is_taken {
            LEFT_OUT.add(1);
        }
        is_taken
    }
}

/// Lines about alarms name the rule; the line about what was left out is one a minute.
fn is_exempt(event: &Event<'_>) -> bool {
    struct Exempt(bool);
    impl Visit for Exempt {
        fn record_debug(&mut self, field: &Field, _: &dyn std::fmt::Debug) {
            self.0 |= ["rule", "left_out"].contains(&field.name());
        }
    }
    let mut exempt = Exempt(false);
    event.record(&mut exempt);
    exempt.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::time::Duration;
    use tracing_subscriber::layer::{Layer, SubscriberExt};

    #[test]
    fn a_storm_gets_its_burst_and_then_a_trickle() {
        let began = Instant::now();
        let mut bucket = Bucket::full(began);
        let at = |ms| began + Duration::from_millis(ms);
        let taken = (0..100_000).filter(|ms| bucket.take(at(*ms))).count();
        assert_eq!(taken, 150 + 49);
        // Silence fills it again, no further than at first.
        let taken = (0..10_000).filter(|_| bucket.take(at(100_000_000))).count();
        assert_eq!(taken, 150);
    }

    struct Count(Arc<AtomicU64>);
    impl<S: Subscriber> Layer<S> for Count {
        fn on_event(&self, _: &Event<'_>, _: Context<'_, S>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn alarms_pass_when_everything_else_is_left_out() {
        let count = Arc::new(AtomicU64::new(0));
        let registry = tracing_subscriber::registry().with(Count(Arc::clone(&count)).with_filter(Limit::default()));
        tracing::subscriber::with_default(registry, || {
            (0..1000).for_each(|n| tracing::warn!(n, "signal lost"));
            let others = count.swap(0, Ordering::Relaxed);
            assert!((150..=155).contains(&others), "{others} of 1000 lines");
            // Another kind of line has its own room.
            tracing::info!("interface up");
            assert_eq!(count.swap(0, Ordering::Relaxed), 1);
            (0..1000).for_each(|n| tracing::warn!(rule = ?"soc_low", n, "alarm raised"));
            assert_eq!(count.load(Ordering::Relaxed), 1000);
        });
    }
}
