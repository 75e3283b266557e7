//! A reader that decompresses ahead on its own thread, because decompression costs several times as much as parsing.
//!
//! Bytes and errors keep their order. At most [`BLOCKS`] blocks exist at a time. The blocks are reused, so memory is
//! bounded and nothing is allocated while reading. After the reader is dropped, the thread ends with its next block.
//! The drop does not wait for the thread, because the source may be a pipe that stays silent for a long time.

use std::io::{self, Read};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread;

/// Number of blocks: one being filled, one being read, and two to absorb delays.
const BLOCKS: usize = 4;

pub(super) struct ReadAhead {
    /// Filled blocks in order; an empty block marks the end.
    pieces: Receiver<io::Result<Vec<u8>>>,
    used: Sender<Vec<u8>>,
    block: Vec<u8>,
    /// Number of bytes of the current block that were already read.
    given: usize,
    ended: bool,
}

impl ReadAhead {
    pub(super) fn new(source: impl Read + Send + 'static, block_len: usize) -> io::Result<Self> {
        let (full, pieces) = sync_channel(BLOCKS);
        let (used, empty) = channel();
        for _ in 0..BLOCKS {
            let _ = used.send(Vec::with_capacity(block_len));
        }
        thread::Builder::new().name("unpack".to_owned()).spawn(move || work(source, &empty, &full))?;
        Ok(Self { pieces, used, block: Vec::new(), given: 0, ended: false })
    }

    /// Waits for the next block. Returns `false` at the end of the source.
    fn next_block(&mut self) -> io::Result<bool> {
        if self.ended {
            return Ok(false);
        }
        let stopped = |_| Err(io::Error::other("decompression stopped for an unknown reason"));
        let next = self.pieces.recv().unwrap_or_else(stopped);
        self.ended = next.as_ref().map_or(true, Vec::is_empty);
        let used = std::mem::replace(&mut self.block, next?);
        self.given = 0;
        if !used.is_empty() {
            // An error means that the thread has ended.
            let _ = self.used.send(used);
        }
        Ok(!self.ended)
    }
}

impl Read for ReadAhead {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while self.given == self.block.len() {
            if !self.next_block()? {
                return Ok(0);
            }
        }
        let count = buffer.len().min(self.block.len() - self.given);
        buffer[..count].copy_from_slice(&self.block[self.given..self.given + count]);
        self.given += count;
        Ok(count)
    }
}

fn work(mut source: impl Read, empty: &Receiver<Vec<u8>>, full: &SyncSender<io::Result<Vec<u8>>>) {
    while let Ok(mut block) = empty.recv() {
        block.clear();
        let room = block.capacity() as u64;
        let read = source.by_ref().take(room).read_to_end(&mut block);
        let is_end = block.is_empty();
        // Bytes read before an error are delivered before the error.
        if (!is_end || read.is_ok()) && full.send(Ok(block)).is_err() {
            return;
        }
        if let Err(error) = read {
            let _ = full.send(Err(error));
            return;
        }
        if is_end {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns `bytes` in pieces of 1 to 7 bytes, then `end`.
    struct Drip {
        bytes: Vec<u8>,
        at: usize,
        end: Option<io::ErrorKind>,
    }

    impl Read for Drip {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let count = (1 + self.at % 7).min(self.bytes.len() - self.at).min(buffer.len());
            buffer[..count].copy_from_slice(&self.bytes[self.at..self.at + count]);
            self.at += count;
            match self.end {
                Some(kind) if count == 0 => Err(kind.into()),
                _ => Ok(count),
            }
        }
    }

    fn drip(len: usize, end: Option<io::ErrorKind>) -> Drip {
        Drip { bytes: (0..len).map(|n| (n * 31 % 251) as u8).collect(), at: 0, end }
    }

    #[test]
    fn bytes_arrive_complete_and_in_order() {
        for len in [0, 1, 99, 100, 101, 12_345] {
            let mut out = Vec::new();
            ReadAhead::new(drip(len, None), 100).expect("a thread").read_to_end(&mut out).expect("no error");
            assert_eq!(out, drip(len, None).bytes, "{len}");
        }
    }

    #[test]
    fn error_follows_all_earlier_bytes() {
        let mut ahead = ReadAhead::new(drip(1234, Some(io::ErrorKind::InvalidData)), 100).expect("a thread");
        let mut out = Vec::new();
        let error = ahead.read_to_end(&mut out).expect_err("the source's error");
        assert_eq!((error.kind(), out.len()), (io::ErrorKind::InvalidData, 1234));
        assert_eq!(ahead.read(&mut [0; 8]).expect("the end"), 0);
    }

    #[test]
    fn panicking_source_is_an_error() {
        struct Panics;
        impl Read for Panics {
            fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
                panic!("simulates a faulty decoder");
            }
        }
        let mut ahead = ReadAhead::new(Panics, 100).expect("a thread");
        assert!(ahead.read(&mut [0; 8]).is_err());
    }

    #[test]
    fn dropping_reader_early_does_not_block() {
        let endless = io::repeat(b'x');
        let mut ahead = ReadAhead::new(endless, 100).expect("a thread");
        assert_eq!(ahead.read(&mut [0; 8]).expect("bytes"), 8);
        drop(ahead);
    }
}
