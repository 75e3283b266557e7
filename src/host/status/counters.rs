//! What the loop counts about itself: how late it was, and how long frames waited for their estimate. Plain numbers, owned by
//! the loop: nothing is allocated or locked per frame.

use serde::{Deserialize, Serialize};

use super::document::ServiceCounters;

/// Upper bounds of the latency's buckets, s.
pub const LATENCY_BOUNDS_S: [f64; 14] =
    [50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 0.1, 0.2, 0.5, 1.0];

/// From the kernel's receive stamp to the estimate.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LatencyHistogram {
    /// Frames up to each bound (not cumulative), and those beyond the last.
    counts: [u64; LATENCY_BOUNDS_S.len() + 1],
    sum_s: f64,
}

impl LatencyHistogram {
    /// Takes one frame's latency; one below zero (two clocks, merged) counts as none.
    #[inline]
    pub fn record(&mut self, seconds: f64) {
        let seconds = seconds.max(0.0);
        let bucket = LATENCY_BOUNDS_S.iter().take_while(|bound| seconds > **bound).count();
        self.counts[bucket] += 1;
        self.sum_s += seconds;
    }

    /// As it is told.
    pub fn document(&self) -> Latency {
        let bounds = LATENCY_BOUNDS_S.iter().copied().map(Some).chain([None]);
        Latency {
            buckets: bounds.zip(self.counts).map(|(le_s, frames)| Bucket { le_s, frames }).collect(),
            frames: self.counts.iter().sum(),
            sum_s: self.sum_s,
        }
    }
}

/// Latency of frames since the program's start.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Latency {
    /// Frames per bucket, not cumulative.
    pub buckets: Vec<Bucket>,
    /// Frames in all.
    pub frames: u64,
    /// Their latencies added up, s.
    pub sum_s: f64,
}

/// One bucket.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bucket {
    /// Its upper bound, s; `None` = no bound.
    pub le_s: Option<f64>,
    /// Frames in it.
    pub frames: u64,
}

impl Latency {
    /// An upper bound of the latency that this share of the frames did not exceed, s; `None` = no frame, or beyond the
    /// last bound.
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

/// What the shell counts since the program's start.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LoopCounters {
    /// As they are told.
    pub service: ServiceCounters,
    /// Frame to estimate.
    pub latency: LatencyHistogram,
}

impl LoopCounters {
    /// Takes how late a tick came.
    pub fn note_tick(&mut self, lateness_s: f64, period_s: f64) {
        let service = &mut self.service;
        service.ticks += 1;
        service.missed_deadlines += u64::from(lateness_s > period_s);
        service.worst_lateness_s = service.worst_lateness_s.max(lateness_s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_latency_falls_into_the_bucket_whose_bound_it_does_not_exceed() {
        let mut histogram = LatencyHistogram::default();
        for seconds in [-1.0, 50e-6, 51e-6, 1.0, 1.1, 60.0] {
            histogram.record(seconds);
        }
        let latency = histogram.document();
        let of = |le_s| latency.buckets.iter().find(|bucket| bucket.le_s == le_s).map(|bucket| bucket.frames);
        assert_eq!((of(Some(50e-6)), of(Some(100e-6)), of(Some(1.0)), of(None)), (Some(2), Some(1), Some(1), Some(2)));
        assert_eq!(latency.frames, 6);
        assert!((latency.sum_s - 62.100_101).abs() < 1e-9);
        assert_eq!((latency.quantile_s(0.5), latency.quantile_s(0.99)), (Some(100e-6), None));
        assert_eq!(Latency::default().quantile_s(0.5), None);
    }

    #[test]
    fn a_deadline_is_missed_by_more_than_a_period() {
        let mut counters = LoopCounters::default();
        for lateness_s in [0.0, 0.01, 0.011, 60.0] {
            counters.note_tick(lateness_s, 0.01);
        }
        let ServiceCounters { ticks, missed_deadlines, worst_lateness_s, .. } = counters.service;
        assert_eq!((ticks, missed_deadlines, worst_lateness_s), (4, 2, 60.0));
    }
}
