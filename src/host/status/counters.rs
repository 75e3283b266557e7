//! Counts the work of the service loop, the status clients and the latency of frames.
//!
//! In: the lateness of ticks and the latency of frames (s). Out: structs of the status document. The counters are plain
//! numbers that the loop owns, so nothing is allocated or locked per frame.

use serde::{Deserialize, Serialize};

/// Upper bounds of the latency buckets (s).
pub const LATENCY_BOUNDS_S: [f64; 14] =
    [50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 0.1, 0.2, 0.5, 1.0];

/// Latency of frames since the program's start, from the kernel's receive stamp to the estimate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Latency {
    /// Frames per bucket, not cumulative.
    pub buckets: Vec<Bucket>,
    /// Number of frames.
    pub frames: u64,
    /// Sum of the latencies of all frames (s).
    pub sum_s: f64,
}

/// One bucket.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bucket {
    /// Upper bound of the bucket (s); `None` = unbounded.
    pub le_s: Option<f64>,
    /// Number of frames in the bucket.
    pub frames: u64,
}

impl Default for Latency {
    fn default() -> Self {
        let bounds = LATENCY_BOUNDS_S.into_iter().map(Some).chain([None]);
        Self { buckets: bounds.map(|le_s| Bucket { le_s, frames: 0 }).collect(), frames: 0, sum_s: 0.0 }
    }
}

impl Latency {
    /// Counts one frame. The two stamps of a latency may come from different clocks, so the latency may be negative. It
    /// then counts as zero.
    #[inline]
    pub fn record(&mut self, seconds: f64) {
        let seconds = seconds.max(0.0);
        let bucket = LATENCY_BOUNDS_S.iter().take_while(|bound| seconds > **bound).count();
        if let Some(bucket) = self.buckets.get_mut(bucket) {
            bucket.frames += 1;
        }
        self.frames += 1;
        self.sum_s += seconds;
    }

    /// Returns the lowest bucket bound (s) for which at least the fraction `share` of all frames had a latency up to
    /// this bound. `None` = no frame was counted, or too many frames are in the last, unbounded bucket.
    pub fn quantile_s(&self, share: f64) -> Option<f64> {
        let wanted = (share * self.frames as f64).ceil().max(1.0);
        let mut so_far = 0;
        let found = self.buckets.iter().find(|bucket| {
            so_far += bucket.frames;
            so_far as f64 >= wanted
        });
        found.filter(|_| self.frames > 0)?.le_s
    }
}

/// Counters of the loop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ServiceCounters {
    /// Ticks.
    pub ticks: u64,
    /// Ticks that were more than one period late.
    pub missed_deadlines: u64,
    /// Greatest lateness of a tick (s).
    pub worst_lateness_s: f64,
    /// Configurations applied while running.
    pub reloads: u64,
    /// Configurations rejected while running.
    pub reloads_refused: u64,
    /// Status documents dropped because the previous one was not yet serialised.
    pub documents_skipped: u64,
}

impl ServiceCounters {
    /// Counts a tick and its lateness.
    pub fn note_tick(&mut self, lateness_s: f64, period_s: f64) {
        self.ticks += 1;
        self.missed_deadlines += u64::from(lateness_s > period_s);
        self.worst_lateness_s = self.worst_lateness_s.max(lateness_s);
    }
}

/// Clients of the status sockets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClientCounts {
    /// Clients that are connected at present.
    pub connected: u64,
    /// Clients served since the start, including clients that are being served.
    pub served: u64,
    /// Clients rejected because there were too many.
    pub refused: u64,
    /// Clients dropped because they did not read in time.
    pub dropped: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latency_counts_in_lowest_fitting_bucket() {
        let mut latency = Latency::default();
        for seconds in [-1.0, 50e-6, 51e-6, 1.0, 1.1, 60.0] {
            latency.record(seconds);
        }
        let of = |le_s| latency.buckets.iter().find(|bucket| bucket.le_s == le_s).map(|bucket| bucket.frames);
        assert_eq!((of(Some(50e-6)), of(Some(100e-6)), of(Some(1.0)), of(None)), (Some(2), Some(1), Some(1), Some(2)));
        assert_eq!(latency.frames, 6);
        assert!((latency.sum_s - 62.100_101).abs() < 1e-9);
        assert_eq!((latency.quantile_s(0.5), latency.quantile_s(0.99)), (Some(100e-6), None));
        assert_eq!(Latency::default().quantile_s(0.5), None);
    }

    #[test]
    fn deadline_is_missed_after_one_period() {
        let mut counters = ServiceCounters::default();
        for lateness_s in [0.0, 0.01, 0.011, 60.0] {
            counters.note_tick(lateness_s, 0.01);
        }
        let ServiceCounters { ticks, missed_deadlines, worst_lateness_s, .. } = counters;
        assert_eq!((ticks, missed_deadlines, worst_lateness_s), (4, 2, 60.0));
    }
}
