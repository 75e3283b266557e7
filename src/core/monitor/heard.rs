//! Whether input comes at all, and which of it is lost: for whoever tells people that the service runs.

use super::Monitor;
use crate::quantity::{Channel, Reading};

impl Monitor {
    /// Whether a reading that can be used has come since the first input. What a restored state knows does not count.
    pub fn has_heard(&self) -> bool {
        self.heard
    }

    /// Configured signals whose last good value is too old: none came, or only bad ones. One that was never heard is
    /// lost once it should have come.
    pub fn lost_inputs(&self) -> impl Iterator<Item = Channel> + '_ {
        self.sampler.channels().iter().copied().filter(|&channel| self.sampler.is_lost(channel, self.now))
    }

    /// How many signals are configured.
    pub fn inputs(&self) -> usize {
        self.sampler.channels().len()
    }

    /// After the sampler has judged it.
    #[inline]
    pub(super) fn note_heard(&mut self, reading: &Reading) {
        self.heard = self.heard || (reading.value.is_ok() && self.sampler.is_fresh(reading.channel, self.now));
    }
}
