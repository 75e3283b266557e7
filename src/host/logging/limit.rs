//! Limits the number of log lines of each kind: a burst, then a low rate. Further lines are dropped and counted. The
//! count is logged once a minute.
//!
//! A bus that changes state all day must not wear out the flash memory. Each place in the program that logs has its own
//! kind of line. A thousand lines about cells therefore do not suppress the line about an interface. Some lines are
//! never dropped: lines about alarms (the rules debounce alarms), the line with the count, and lines of the levels
//! `debug` and `trace` (they are logged only on request).

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Instant;

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Filter};

use super::note_left_out;
use crate::quantity::Timestamp;
use crate::token_bucket::{BucketSize, TokenBucket};

/// Limit for each kind of line. The burst covers a pack of 96 cells that loses its input, with a line per signal. If
/// signals come and go all day, the rate gives about 30 MB of journal.
const LINES: BucketSize = BucketSize { burst: 150.0, period_s: 2.0 };

/// The limit, with a bucket for each place in the program that logs.
#[derive(Debug)]
pub(super) struct RateLimit {
    began: Instant,
    buckets: Mutex<HashMap<Identifier, TokenBucket>>,
}

impl Default for RateLimit {
    fn default() -> Self {
        Self { began: Instant::now(), buckets: Mutex::default() }
    }
}

impl<S: Subscriber> Filter<S> for RateLimit {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        if *event.metadata().level() > Level::INFO || is_exempt(event) {
            return true;
        }
        let now = Timestamp::from_secs(self.began.elapsed().as_secs_f64());
        // If a thread panics while it holds the lock, the buckets are still valid.
        let mut buckets = self.buckets.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let is_written = buckets.entry(event.metadata().callsite()).or_insert(TokenBucket::new(LINES)).take(now);
        if !is_written {
            note_left_out();
        }
        is_written
    }
}

/// Whether a line is exempt from the limit. Lines about alarms have the field `rule`; the line about dropped lines is
/// written only once a minute.
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
    use tracing_subscriber::layer::{Layer, SubscriberExt};

    struct Count(Arc<AtomicU64>);
    impl<S: Subscriber> Layer<S> for Count {
        fn on_event(&self, _: &Event<'_>, _: Context<'_, S>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn alarm_lines_are_never_dropped() {
        let count = Arc::new(AtomicU64::new(0));
        let registry = tracing_subscriber::registry().with(Count(Arc::clone(&count)).with_filter(RateLimit::default()));
        tracing::subscriber::with_default(registry, || {
            (0..1000).for_each(|n| tracing::warn!(n, "signal lost"));
            let others = count.swap(0, Ordering::Relaxed);
            assert!((150..=155).contains(&others), "{others} of 1000 lines");
            // Lines of another kind have their own bucket.
            tracing::info!("interface up");
            assert_eq!(count.swap(0, Ordering::Relaxed), 1);
            (0..1000).for_each(|n| tracing::warn!(rule = ?"soc_low", n, "alarm raised"));
            assert_eq!(count.load(Ordering::Relaxed), 1000);
        });
    }
}
