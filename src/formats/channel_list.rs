//! Channels of a log, in the order of their first frame.

use crate::Channel;

/// Channels found so far. At most 256, because an item's channel is a `u8`.
#[derive(Debug, Default)]
pub(crate) struct ChannelList(Vec<Channel>);

impl ChannelList {
    /// Index of a channel in a log that numbers its channels from `first`; `None` if the list is full.
    pub(crate) fn of_number(&mut self, written: u32, first: u32) -> Option<u8> {
        self.index_of(&Channel::Number { written, index: written.saturating_sub(first) })
    }

    /// Index of a channel in a log that numbers its channels arbitrarily (for example with the kernel's interface
    /// numbers). The channels are indexed in the order of their first frame. `None` if the list is full.
    pub(crate) fn of_label(&mut self, written: u32) -> Option<u8> {
        let is_same = |known: &Channel| matches!(known, Channel::Number { written: number, .. } if *number == written);
        let index = self.0.iter().position(is_same).unwrap_or(self.0.len());
        self.index_of(&Channel::Number { written, index: u32::try_from(index).ok()? })
    }

    /// Index of a channel; `None` if the list is full.
    #[inline]
    pub(crate) fn index_of(&mut self, channel: &Channel) -> Option<u8> {
        let index = self.0.iter().position(|known| known == channel).unwrap_or(self.0.len());
        let number = u8::try_from(index).ok()?;
        if index == self.0.len() {
            self.0.push(channel.clone());
        }
        Some(number)
    }

    pub(crate) fn as_slice(&self) -> &[Channel] {
        &self.0
    }
}
