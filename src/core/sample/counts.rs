//! Saturating counts of accepted readings, and of rejected readings by reason.

use serde::{Deserialize, Serialize};

use crate::quantity::Fault;

/// Readings by outcome since the first start. Rejected readings are counted by [`Fault`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReadingCounts {
    pub accepted: u64,
    /// Readings of channels that the configuration does not use.
    pub unused: u64,
    /// Steps to a new level that were accepted because they persisted.
    pub levels_believed: u64,
    pub short_frame: u64,
    pub end_to_end: u64,
    pub not_available: u64,
    pub not_finite: u64,
    pub out_of_range: u64,
    pub rate_too_high: u64,
    pub stuck: u64,
    /// How often the latest reading of a signal became too old.
    pub stale: u64,
}

impl ReadingCounts {
    /// Refused readings: rejected although their sender stated a value (unlike "not available").
    pub fn refused(&self) -> u64 {
        self.refusals().iter().map(|(count, _)| count).sum()
    }

    /// Refused readings by reason, for example "12 out of range, 3 stuck".
    pub fn refused_in_words(&self) -> String {
        let refusals = self.refusals().into_iter().filter(|(count, _)| *count > 0);
        let words: Vec<_> = refusals.map(|(count, reason)| format!("{count} {reason}")).collect();
        if words.is_empty() { "none".to_owned() } else { words.join(", ") }
    }

    fn refusals(&self) -> [(u64, &'static str); 6] {
        [
            (self.out_of_range, "out of range"),
            (self.short_frame, "in short frames"),
            (self.end_to_end, "failed the end-to-end check"),
            (self.not_finite, "not a finite number"),
            (self.rate_too_high, "changed too fast"),
            (self.stuck, "stuck"),
        ]
    }

    /// Difference from the earlier counts `before`.
    pub fn since(&self, before: &Self) -> Self {
        let of = |count: fn(&Self) -> u64| count(self).saturating_sub(count(before));
        Self {
            accepted: of(|it| it.accepted),
            unused: of(|it| it.unused),
            levels_believed: of(|it| it.levels_believed),
            short_frame: of(|it| it.short_frame),
            end_to_end: of(|it| it.end_to_end),
            not_available: of(|it| it.not_available),
            not_finite: of(|it| it.not_finite),
            out_of_range: of(|it| it.out_of_range),
            rate_too_high: of(|it| it.rate_too_high),
            stuck: of(|it| it.stuck),
            stale: of(|it| it.stale),
        }
    }

    pub(super) fn note(&mut self, fault: Option<Fault>) {
        let count = match fault {
            None => &mut self.accepted,
            Some(Fault::ShortFrame) => &mut self.short_frame,
            Some(Fault::EndToEnd) => &mut self.end_to_end,
            Some(Fault::NotAvailable) => &mut self.not_available,
            Some(Fault::NotFinite) => &mut self.not_finite,
            Some(Fault::OutOfRange) => &mut self.out_of_range,
            Some(Fault::RateTooHigh) => &mut self.rate_too_high,
            Some(Fault::Stuck) => &mut self.stuck,
            Some(Fault::Stale) => &mut self.stale,
        };
        *count = count.saturating_add(1);
    }

    /// Rejected readings by reason, named like [`Fault`].
    pub fn rejected(&self) -> [(&'static str, u64); 7] {
        [
            ("short_frame", self.short_frame),
            ("end_to_end", self.end_to_end),
            ("not_available", self.not_available),
            ("not_finite", self.not_finite),
            ("out_of_range", self.out_of_range),
            ("rate_too_high", self.rate_too_high),
            ("stuck", self.stuck),
        ]
    }
}
