//! Limits the frame rate per identifier, so that one faulty sender does not use up the processing time of other
//! messages.
//!
//! In: time and identifier of each received frame. Out: whether the frame is admitted. Dropped frames are counted, and
//! a [`FloodChange`] reports when dropping starts and ends. Each message has a leaky bucket, stored as a time: an
//! admitted frame advances this time by the duration of one frame at the allowed rate, and a frame is dropped if the
//! time would lie more than one burst ahead. A burst may have as many frames as the allowed rate permits in a tenth of a
//! second, or two frames per multiplexer page if this is more. Nothing is allocated after the start. Messages that are
//! not configured always pass, because they are not decoded and cost almost no time.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::can::CanId;
use crate::can::id_table::IdTable;
use crate::quantity::{BusIndex, Timestamp};

/// Allowed rate of one identifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FloodConfig {
    /// Per interface.
    pub max_frames_per_s: NonZeroU32,
}

impl Default for FloodConfig {
    /// 2,000 frames a second, twice the rate of the fastest intended sender: no battery message is sent more often than
    /// once a millisecond. A faulty sender can reach 4,000 frames a second, which saturates a bus of 500 kbit/s.
    fn default() -> Self {
        Self { max_frames_per_s: const { NonZeroU32::new(2000).unwrap() } }
    }
}

/// Reports that dropping started or ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FloodChange {
    pub bus: BusIndex,
    pub id: CanId,
    pub active: bool,
    /// 1 at the start, the total at the end.
    pub dropped: u64,
}

/// Number of dropped frames of one message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FloodCount {
    pub bus: BusIndex,
    pub id: CanId,
    pub dropped: u64,
}

/// Spent budget and current flood of one message, stored in a snapshot. They are restored only if no frame was missed
/// since the snapshot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FloodProgress {
    bus: BusIndex,
    id: CanId,
    spent_until: Option<Timestamp>,
    flood: Option<(u64, Timestamp)>,
}

#[derive(Debug, Clone)]
struct LeakyBucket {
    bus: BusIndex,
    id: CanId,
    /// Time (ns) of the largest burst at the allowed rate.
    burst_ns: i64,
    spent_until: Option<Timestamp>,
    dropped: u64,
    /// Number of dropped frames, and time of the last dropped frame.
    flood: Option<(u64, Timestamp)>,
}

/// Rate limits of all configured messages.
#[derive(Debug, Clone)]
pub struct FloodGate {
    /// Time of one frame at the allowed rate, ns.
    frame_ns: i64,
    /// Sorted by interface and identifier.
    buckets: Vec<LeakyBucket>,
    numbers: IdTable,
    pub(crate) changes: Vec<FloodChange>,
}

impl FloodGate {
    /// Creates a gate for messages, given with their numbers of pages.
    pub fn new(config: &FloodConfig, messages: impl IntoIterator<Item = (BusIndex, CanId, usize)>) -> Self {
        let frame_ns = (1_000_000_000 / i64::from(config.max_frames_per_s.get())).max(1);
        let bucket = |(bus, id, pages): (BusIndex, CanId, usize)| {
            let pages_ns = i64::try_from(2 * pages).unwrap_or(i64::MAX).saturating_mul(frame_ns);
            // The largest burst has as many frames as the allowed rate permits in a tenth of a second (in ns), or more
            // if the message has many pages.
            let burst_ns = 100_000_000.max(pages_ns).max(frame_ns);
            LeakyBucket { bus, id, burst_ns, spent_until: None, dropped: 0, flood: None }
        };
        let mut buckets: Vec<_> = messages.into_iter().map(bucket).collect();
        buckets.sort_by_key(|bucket| (bucket.bus, bucket.id));
        buckets.dedup_by_key(|bucket| (bucket.bus, bucket.id));
        let numbers = IdTable::new(buckets.iter().map(|bucket| (bucket.bus, bucket.id)));
        Self { frame_ns, numbers, changes: Vec::with_capacity(buckets.len() + 1), buckets }
    }

    /// Inherits the state of the messages that are in both gates.
    #[must_use]
    pub fn inheriting(mut self, old: &Self) -> Self {
        for bucket in &mut self.buckets {
            if let Some(old) = old.buckets.iter().find(|old| (old.bus, old.id) == (bucket.bus, bucket.id)) {
                (bucket.spent_until, bucket.dropped, bucket.flood) = (old.spent_until, old.dropped, old.flood);
            }
        }
        self
    }

    /// Whether a frame is admitted. `now` must not go back, except after [`Self::restart`].
    #[inline]
    pub fn admit(&mut self, now: Timestamp, bus: BusIndex, id: CanId) -> bool {
        let Some(bucket) = self.buckets.get_mut(self.numbers.number(bus, id)) else { return true };
        let spent = bucket.spent_until.map_or(now, |spent| spent.max(now)).plus_nanos(self.frame_ns);
        if spent <= now.plus_nanos(bucket.burst_ns) {
            bucket.spent_until = Some(spent);
            return true;
        }
        bucket.dropped = bucket.dropped.saturating_add(1);
        let (frames, _) = bucket.flood.unwrap_or((0, now));
        if frames == 0 {
            self.changes.push(FloodChange { bus, id, active: true, dropped: 1 });
        }
        bucket.flood = Some((frames.saturating_add(1), now));
        false
    }

    /// Ends each flood in which no frame was dropped for a second.
    pub fn poll(&mut self, now: Timestamp) {
        self.end(|last| now.since(last) >= 1.0);
    }

    /// Restores the whole budget and ends every flood.
    pub fn restart(&mut self) {
        self.end(|_| true);
        self.buckets.iter_mut().for_each(|bucket| bucket.spent_until = None);
    }

    /// Messages with dropped frames.
    pub fn counts(&self) -> impl Iterator<Item = FloodCount> + '_ {
        let dropped = self.buckets.iter().filter(|bucket| bucket.dropped > 0);
        dropped.map(|bucket| FloodCount { bus: bucket.bus, id: bucket.id, dropped: bucket.dropped })
    }

    /// Spent budgets and current floods.
    pub fn progress(&self) -> Vec<FloodProgress> {
        let is_used = |bucket: &&LeakyBucket| bucket.spent_until.is_some() || bucket.flood.is_some();
        let of = |bucket: &LeakyBucket| FloodProgress {
            bus: bucket.bus,
            id: bucket.id,
            spent_until: bucket.spent_until,
            flood: bucket.flood,
        };
        self.buckets.iter().filter(is_used).map(of).collect()
    }

    /// Restores stored budgets and floods.
    pub fn resume(&mut self, stored: &[FloodProgress]) {
        for of in stored {
            if let Some(bucket) = self.buckets.get_mut(self.numbers.number(of.bus, of.id)) {
                (bucket.spent_until, bucket.flood) = (of.spent_until, of.flood);
            }
        }
    }

    /// Restores stored counts.
    pub fn restore(&mut self, counts: &[FloodCount]) {
        for bucket in &mut self.buckets {
            let stored = counts.iter().find(|count| (count.bus, count.id) == (bucket.bus, bucket.id));
            bucket.dropped = stored.map_or(0, |count| count.dropped);
        }
    }

    fn end(&mut self, is_over: impl Fn(Timestamp) -> bool) {
        for bucket in &mut self.buckets {
            if let Some((dropped, last)) = bucket.flood
                && is_over(last)
            {
                bucket.flood = None;
                let (bus, id) = (bucket.bus, bucket.id);
                self.changes.push(FloodChange { bus, id, active: false, dropped });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUS: BusIndex = BusIndex(0);
    const ID: CanId = CanId::Standard(0x100);

    fn gate(rate: u32, pages: usize) -> FloodGate {
        let max_frames_per_s = NonZeroU32::new(rate).expect("not 0");
        FloodGate::new(&FloodConfig { max_frames_per_s }, [(BUS, ID, pages), (BUS, CanId::Standard(0x101), 1)])
    }

    /// Sends a frame every `gap_ns`. Returns the number of admitted frames.
    fn taken(gate: &mut FloodGate, from_ns: i64, gap_ns: i64, frames: i64) -> usize {
        let at = |n: i64| Timestamp::from_nanos(from_ns + n * gap_ns);
        (0..frames).filter(|&n| gate.admit(at(n), BUS, ID)).count()
    }

    #[test]
    fn allowed_rate_always_passes() {
        let mut gate = gate(2000, 1);
        assert_eq!(taken(&mut gate, 0, 500_000, 100_000), 100_000);
        assert_eq!((gate.counts().count(), gate.changes.drain(..).count()), (0, 0));
    }

    #[test]
    fn burst_of_tenth_of_rate_passes() {
        let mut gate = gate(2000, 1);
        assert_eq!(taken(&mut gate, 0, 0, 1000), 200);
        assert_eq!(gate.counts().next(), Some(FloodCount { bus: BUS, id: ID, dropped: 800 }));
        assert_eq!(taken(&mut gate, 50_000_000, 0, 1000), 100, "half the budget is back after 50 ms");
    }

    #[test]
    fn tenfold_rate_is_limited_to_allowed_rate() {
        let mut gate = gate(2000, 1);
        let taken = taken(&mut gate, 0, 50_000, 200_000);
        assert_eq!(taken, 20_199, "10 s at the allowed rate plus the first burst");
    }

    #[test]
    fn other_messages_pass_during_flood() {
        let mut gate = gate(10, 1);
        taken(&mut gate, 0, 0, 1000);
        assert!(!gate.admit(Timestamp::ZERO, BUS, ID));
        assert!(gate.admit(Timestamp::ZERO, BUS, CanId::Standard(0x101)), "another identifier");
        assert!(gate.admit(Timestamp::ZERO, BusIndex(1), ID), "another interface");
        assert!(gate.admit(Timestamp::ZERO, BUS, CanId::Extended(0x100)), "not configured");
    }

    #[test]
    fn multiplexed_message_may_send_all_pages_at_once() {
        assert_eq!(taken(&mut gate(2000, 256), 0, 0, 1000), 512);
    }

    #[test]
    fn flood_is_reported_at_start_and_end() {
        let mut gate = gate(100, 1);
        assert_eq!(taken(&mut gate, 0, 0, 15), 10);
        gate.poll(Timestamp::from_secs(0.9));
        assert_eq!(taken(&mut gate, 900_000_000, 0, 12), 10, "the flood continues");
        gate.poll(Timestamp::from_secs(1.8));
        let begun = FloodChange { bus: BUS, id: ID, active: true, dropped: 1 };
        assert_eq!(gate.changes.drain(..).collect::<Vec<_>>(), [begun]);
        gate.poll(Timestamp::from_secs(1.9));
        assert_eq!(gate.changes.drain(..).collect::<Vec<_>>(), [FloodChange { active: false, dropped: 7, ..begun }]);
        gate.poll(Timestamp::from_secs(9.0));
        assert_eq!(gate.changes.drain(..).count(), 0);
    }

    #[test]
    fn backward_clock_step_does_not_block_frames() {
        let mut gate = gate(100, 1);
        assert_eq!(taken(&mut gate, 1_000_000_000_000, 0, 15), 10);
        gate.restart();
        assert_eq!(gate.changes.drain(..).map(|change| change.active).collect::<Vec<_>>(), [true, false]);
        assert_eq!(taken(&mut gate, 0, 0, 5), 5);
    }

    #[test]
    fn drop_counts_survive_restart() {
        let mut before = gate(100, 1);
        taken(&mut before, 0, 0, 15);
        let mut after = gate(100, 1);
        after.restore(&before.counts().collect::<Vec<_>>());
        assert_eq!(after.counts().next().map(|count| count.dropped), Some(5));
    }
}
