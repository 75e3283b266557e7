//! Reads CAN logs of other tools as frames.
//!
//! In: the bytes of a file. Out: [`Item`]s in the order of the file, with their channel. [`Format::recognise`] finds
//! the format from the first bytes; the file name is not used. Every reader streams: its memory does not depend on the
//! size of the file. A bad part becomes [`Item::Bad`], and reading continues after it. If a file ends too early or its
//! structure is damaged, the reader returns all frames before the damage, and then an error.
//!
//! [`Mf4Writer`] writes frames as MF4, for other tools.
//!
//! `packwatch_host::io::log` reads candump logs (`candump -L`), CSV tables, and packwatch's own journals (recordings of
//! the daemon's inputs).

mod blf;
mod byte_stream;
mod channel_list;
mod foreign;
mod format;
mod item;
mod mf4;
mod pcap;
mod raw_frame;
#[cfg(test)]
mod testing;
mod text;

pub use foreign::foreign;
pub use format::{Format, Source};
pub use item::{Channel, Item, Position};
pub use mf4::Mf4Writer;

use std::io;

/// Reads one log. Each format has one implementor.
pub trait LogReader {
    /// Reads the next item. `None` = the log has ended.
    ///
    /// # Errors
    /// Fails if the source cannot be read, or if the structure of the file is so damaged that the rest cannot be read.
    /// The message states what was found and what is allowed; the caller adds the file and
    /// [`position`](Self::position). Later calls return `None`.
    fn next_item(&mut self) -> io::Result<Option<Item>>;

    /// Position of the item last returned, or of the damage.
    fn position(&self) -> Position;

    /// What was assumed about the log, to be shown to the user.
    fn remark(&self) -> Option<&'static str> {
        None
    }

    /// The channels found so far. An item's `channel` is an index into this list.
    fn channels(&self) -> &[Channel];
}
