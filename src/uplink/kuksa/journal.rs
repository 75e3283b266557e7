//! Counts events and writes log lines. Each change is logged once, and the counters are logged at the end of each
//! connection.

use std::collections::HashSet;

use super::routes::{DataPoints, SkippedSignal};

/// Maximum number of logged reasons that are remembered. It is enough for all signals with a few reasons each. Further
/// reasons are not logged.
const MAX_LOGGED: usize = 1000;

/// Counts since the start of the program.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Connections on which the broker accepted packwatch as the provider of the signals.
    pub(crate) connections: u64,
    /// Batches published.
    pub(crate) batches: u64,
    /// Signals skipped, summed over all connections.
    pub(crate) skipped: u64,
    /// Values withheld because they are outside the broker's limits.
    pub(crate) withheld: u64,
    /// Values rejected by the broker.
    pub(crate) rejected: u64,
    /// Requests of the broker that were not answered.
    pub(crate) unanswered: u64,
}

/// Counters, and the reasons already logged.
#[derive(Debug, Default)]
pub(crate) struct Journal {
    pub(crate) counts: Counts,
    logged: HashSet<String>,
    /// Signals whose values in the latest batch are outside the broker's limits.
    outside: HashSet<&'static str>,
}

impl Journal {
    pub(crate) fn note_connected(&mut self, address: &str, signals: usize) {
        self.counts.connections += 1;
        tracing::info!(address, signals, "providing values to the databroker");
    }

    pub(crate) fn note_skipped(&mut self, skipped: Vec<SkippedSignal>) {
        for SkippedSignal { path, reason } in skipped {
            self.counts.skipped += 1;
            if self.is_new(format!("{path} {reason}")) {
                tracing::warn!(path, reason, "signal skipped");
            }
        }
    }

    pub(crate) fn note_published(&mut self, points: &DataPoints) {
        self.counts.batches += 1;
        let outside: HashSet<_> = points.withheld.iter().copied().collect();
        self.counts.withheld += u64::try_from(outside.len()).unwrap_or_default();
        for signal in outside.difference(&self.outside) {
            tracing::warn!(signal, "value outside the databroker's limits: sent as unknown");
        }
        self.outside = outside;
    }

    pub(crate) fn note_rejected(&mut self, signal: &str, message: &str) {
        self.counts.rejected += 1;
        if self.is_new(format!("{signal} {message}")) {
            tracing::warn!(signal, message, "the databroker rejects a value");
        }
    }

    pub(crate) fn note_unanswered(&mut self, requests: u64) {
        self.counts.unanswered += requests;
    }

    pub(crate) fn summarise(&self) {
        let Counts { connections, batches, skipped, withheld, rejected, unanswered } = self.counts;
        tracing::info!(
            connections,
            batches,
            skipped,
            withheld,
            rejected,
            unanswered,
            "counts since the start of the program"
        );
    }

    fn is_new(&mut self, text: String) -> bool {
        self.logged.len() < MAX_LOGGED && self.logged.insert(text)
    }
}
