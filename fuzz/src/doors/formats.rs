//! Fuzz entry point for logs of other tools.

use std::fs::File;
use std::io::{Cursor, Read};

use packwatch_formats::{Format, Item, Source as LogSource};

use super::files::with_file;
use super::source::Source;

const MAX_ITEMS: usize = 20_000;

/// Returns at most seven bytes per call.
struct Trickle<R>(R);

impl<R: Read> Read for Trickle<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let len = buffer.len().min(7);
        self.0.read(&mut buffer[..len])
    }
}

/// Reads a log of another tool; the first byte selects the format. Reading in small parts must give the same items. The
/// channel of each item must be in the list of channels. After the end of the log, the reader must give no further
/// items.
pub fn formats(data: &[u8]) {
    let mut source = Source::new(data);
    let format = source.one_of(Format::ALL);
    let log = source.rest();
    let _ = Format::recognise(log);
    let _ = packwatch_formats::foreign(log);
    let opened = with_file("log", log, |path| File::open(path).expect("opens"));
    let copy = || Some(opened.try_clone().expect("a second handle"));
    let whole = items(format, LogSource { reader: Box::new(Cursor::new(log.to_vec())), file: copy() });
    let parts = items(format, LogSource { reader: Box::new(Trickle(Cursor::new(log.to_vec()))), file: copy() });
    assert!(whole == parts, "{format:?}: small parts give other items: {whole:?}\n{parts:?}");
}

fn items(format: Format, source: LogSource) -> Vec<Item> {
    let mut items = Vec::new();
    let Ok(mut log) = format.open(source) else { return items };
    while let Ok(Some(item)) = log.next_item() {
        if let Item::Frame { channel, .. } | Item::ErrorFrame { channel, .. } = item {
            assert!(usize::from(channel) < log.channels().len(), "{format:?}: a channel is missing in the list");
        }
        items.push(item);
        if items.len() == MAX_ITEMS {
            return items;
        }
    }
    assert!(matches!(log.next_item(), Ok(None)), "{format:?}: items after the end");
    items
}
