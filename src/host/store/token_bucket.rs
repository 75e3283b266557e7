//! How many rows of a kind may be written: so many at once, then one per period. What bounds the writing when an alarm
//! flickers or a pack cycles without end.

use crate::quantity::Timestamp;

/// A number at once and a period.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    /// At once, after a long quiet time.
    pub(super) burst: f64,
    /// Then one in this, s.
    pub(super) period_s: f64,
}

/// What is left of a limit.
#[derive(Debug, Clone, Copy)]
pub(super) struct TokenBucket {
    limit: Limit,
    left: f64,
    counted: Option<Timestamp>,
}

impl TokenBucket {
    /// All of it is left.
    pub(super) const fn new(limit: Limit) -> Self {
        Self { limit, left: limit.burst, counted: None }
    }

    /// Takes one, if there is one.
    pub(super) fn take(&mut self, now: Timestamp) -> bool {
        let elapsed_s = self.counted.map_or(0.0, |counted| now.since(counted).max(0.0));
        self.counted = Some(now);
        self.left = (self.left + elapsed_s / self.limit.period_s).min(self.limit.burst);
        let is_left = self.left >= 1.0;
        self.left -= f64::from(u8::from(is_left));
        is_left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_the_burst_there_is_one_per_period() {
        let mut token_bucket = TokenBucket::new(Limit { burst: 3.0, period_s: 10.0 });
        let taken = (0..100).filter(|&second| token_bucket.take(Timestamp::from_secs(f64::from(second)))).count();
        assert_eq!(taken, 3 + 9);
        assert!(token_bucket.take(Timestamp::from_secs(1e6)));
    }
}
