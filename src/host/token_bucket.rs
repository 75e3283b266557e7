//! Limits how often an action may happen: a burst at once, then once per period.
//!
//! In: the time of each request. Out: whether the request is allowed. If a request has an earlier time than the
//! previous request, no tokens are added.

use crate::quantity::Timestamp;

#[derive(Debug, Clone, Copy)]
pub(crate) struct BucketSize {
    /// Tokens of a full bucket.
    pub(crate) burst: f64,
    /// Time until the next token (s).
    pub(crate) period_s: f64,
}

/// A bucket of tokens. Each allowed action takes one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TokenBucket {
    size: BucketSize,
    tokens: f64,
    filled: Option<Timestamp>,
}

impl TokenBucket {
    pub(crate) const fn new(size: BucketSize) -> Self {
        Self { size, tokens: size.burst, filled: None }
    }

    /// Takes a token. Returns `false` if no token is left.
    pub(crate) fn take(&mut self, now: Timestamp) -> bool {
        let elapsed_s = self.filled.map_or(0.0, |filled| now.since(filled).max(0.0));
        self.filled = Some(now);
        self.tokens = (self.tokens + elapsed_s / self.size.period_s).min(self.size.burst);
        let has_token = self.tokens >= 1.0;
        self.tokens -= f64::from(u8::from(has_token));
        has_token
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn burst_is_followed_by_one_per_period() {
        let mut bucket = TokenBucket::new(BucketSize { burst: 3.0, period_s: 10.0 });
        let taken = (0..100).filter(|&second| bucket.take(Timestamp::from_secs(f64::from(second)))).count();
        assert_eq!(taken, 3 + 9);
        assert!(bucket.take(Timestamp::from_secs(1e6)));
    }

    #[test]
    fn bucket_fills_only_to_burst() {
        let mut bucket = TokenBucket::new(BucketSize { burst: 150.0, period_s: 2.0 });
        let at = |ms: u32| Timestamp::from_secs(f64::from(ms) / 1e3);
        assert_eq!((0..100_000).filter(|ms| bucket.take(at(*ms))).count(), 150 + 49);
        assert_eq!((0..10_000).filter(|_| bucket.take(at(100_000_000))).count(), 150);
    }
}
