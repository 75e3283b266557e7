//! A log of another tool, read by `packwatch_formats`. Without the feature `formats`, no such log is recognised.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use packwatch_formats::{Channel, Format, Item, LogReader, Position, Source};

use super::lines::Lines;
use crate::quantity::BusIndex;

pub(super) struct ToolLog {
    reader: Box<dyn LogReader>,
    /// Interface of each channel seen so far; `None` = not configured.
    buses: Vec<Option<BusIndex>>,
}

impl ToolLog {
    /// Recognises a log from its first bytes. `None` = no format of another tool.
    ///
    /// # Errors
    /// Fails if the source cannot be read, or if it has a known format that packwatch does not read. The error then
    /// names the format and a converter.
    pub(super) fn recognise(lines: &mut Lines) -> io::Result<Option<Format>> {
        let first = lines.peek()?;
        if first.starts_with(b"PACKWATCH-JOURNAL") || begins_with_unix_stamp(first) {
            // This is a journal or a candump log. Return early: a live source may need a long time to send as many
            // bytes as the other formats need to be recognised.
            return Ok(None);
        }
        let head = lines.peek_bytes(Format::HEAD_BYTES)?;
        let format = Format::recognise(head);
        match packwatch_formats::foreign(head).filter(|_| format.is_none()) {
            Some((name, advice)) => Err(io::Error::other(format!("its format is {name}; {advice}"))),
            None => Ok(format),
        }
    }

    pub(super) fn open(format: Format, mut lines: Lines, paths: &[PathBuf]) -> io::Result<Self> {
        let file = match paths {
            [path] => plain_file(path, lines.peek_bytes(Format::HEAD_BYTES)?)?,
            _ => None,
        };
        let source = Source { reader: Box::new(lines.into_reader()), file };
        Ok(Self { reader: format.open(source)?, buses: Vec::new() })
    }

    pub(super) fn next_item(&mut self) -> io::Result<Option<Item>> {
        self.reader.next_item()
    }

    pub(super) fn remark(&self) -> Option<&'static str> {
        self.reader.remark()
    }

    pub(super) fn position(&self) -> Position {
        self.reader.position()
    }

    /// The interface of a channel. For a channel not seen before, `find` returns its interface.
    pub(super) fn bus(&mut self, channel: u8, mut find: impl FnMut(&Channel) -> Option<BusIndex>) -> Option<BusIndex> {
        let new = self.reader.channels().get(self.buses.len()..).unwrap_or_default();
        self.buses.extend(new.iter().map(&mut find));
        self.buses.get(usize::from(channel)).copied().flatten()
    }

    pub(super) fn channel_name(&self, channel: u8) -> String {
        match self.reader.channels().get(usize::from(channel)) {
            Some(Channel::Name(name)) => name.clone(),
            Some(Channel::Number { written, .. }) => format!("channel {written}"),
            None => "unknown channel".to_owned(),
        }
    }
}

/// Whether a line begins like a candump log with absolute stamps: `(`, at least nine digits, `.`.
fn begins_with_unix_stamp(line: &[u8]) -> bool {
    let digits = line.strip_prefix(b"(").unwrap_or_default();
    let count = digits.iter().take_while(|byte| byte.is_ascii_digit()).count();
    count >= 9 && digits.get(count) == Some(&b'.')
}

/// The file itself if it is a regular file that begins with `head`, that is, if it is not compressed.
fn plain_file(path: &Path, head: &[u8]) -> io::Result<Option<File>> {
    if !path.is_file() {
        return Ok(None);
    }
    let mut start = Vec::with_capacity(head.len());
    File::open(path)?.take(head.len() as u64).read_to_end(&mut start)?;
    if start == head { File::open(path).map(Some) } else { Ok(None) }
}
