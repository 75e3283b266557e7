//! Reads the stream of objects inside the containers of a BLF file.

use std::io::{self, Read};

use flate2::{Decompress, FlushDecompress, Status};

use super::{MARK, OBJECT_HEAD};
use crate::byte_stream::{ByteStream, cut, damaged, u16_at, u32_at};

/// Kind of the objects that contain other objects.
const LOG_CONTAINER: u32 = 10;
/// Size of the container's own header after the object's header, bytes.
const CONTAINER_HEAD: usize = 16;
/// Largest content that a container may state, bytes. Usual containers have 128 KiB, the largest known ones a few MiB.
const MAX_CONTENT: u32 = 64 << 20;

/// How the bytes of the current outer object are stored. An outer object is a container, or an object outside of
/// containers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Packing {
    /// The position is between two outer objects.
    Between,
    /// The bytes are stored without compression.
    Stored,
    /// The bytes are compressed with zlib.
    Deflated,
}

/// Reads, one after another, the content of the containers and the objects outside of containers.
///
/// For a damaged container, returns an error of the kind `InvalidData`. The next call continues with the next
/// container.
pub(super) struct Containers {
    file: ByteStream<Box<dyn Read>>,
    packing: Packing,
    /// Bytes of the current outer object that have not been read from the file.
    left: u64,
    /// Bytes of content that remain according to the current container.
    content_left: u64,
    inflate: Decompress,
    /// Offset in the file of the current outer object.
    at: u64,
}

impl Containers {
    /// Creates a reader. `file` must be positioned after the file's header.
    pub(super) fn new(file: ByteStream<Box<dyn Read>>) -> Self {
        let at = file.offset();
        Self { file, packing: Packing::Between, left: 0, content_left: 0, inflate: Decompress::new(true), at }
    }

    /// Offset in the file of the outer object that was read last.
    pub(super) fn position(&self) -> u64 {
        self.at
    }

    /// Goes to the next outer object. Returns whether there is one.
    fn open_next(&mut self) -> io::Result<bool> {
        let is_whole = self.file.skip(std::mem::take(&mut self.left))?;
        if !is_whole {
            return Err(cut("the file ends in a container"));
        }
        self.at = self.file.offset();
        let mut head = self.file.fill(OBJECT_HEAD + CONTAINER_HEAD)?;
        let padding = head.iter().take(8).take_while(|byte| **byte == 0).count();
        self.file.consume(padding);
        head = self.file.fill(OBJECT_HEAD + CONTAINER_HEAD)?;
        if head.is_empty() {
            return Ok(false);
        }
        if !head.starts_with(MARK) {
            let found = head.escape_ascii().to_string();
            let found: String = found.chars().take(16).collect();
            self.file.find(1, MARK)?;
            return Err(damaged(format!("found {found:?}, must be an object, which begins with \"LOBJ\"")));
        }
        if head.len() < OBJECT_HEAD {
            return Err(cut("the file ends in the head of an object"));
        }
        let header = usize::from(u16_at(head, 4, false));
        let [size, kind] = [8, 12].map(|at| u32_at(head, at, false));
        if kind != LOG_CONTAINER {
            if size < OBJECT_HEAD as u32 {
                self.file.consume(MARK.len());
                self.file.find(0, MARK)?;
                return Err(damaged(format!("object of {size} bytes, must be at least {OBJECT_HEAD}")));
            }
            (self.packing, self.left, self.content_left) = (Packing::Stored, u64::from(size), u64::from(size));
            return Ok(true);
        }
        self.open_container(header, u64::from(size))
    }

    fn open_container(&mut self, header: usize, size: u64) -> io::Result<bool> {
        let own = header + CONTAINER_HEAD;
        let head = self.file.fill(own)?;
        if !(OBJECT_HEAD..=256).contains(&header) || size < own as u64 {
            self.file.find(MARK.len(), MARK)?;
            return Err(damaged(format!(
                "container of {size} bytes with a header of {header} bytes, must be 16 bytes"
            )));
        }
        if head.len() < own {
            return Err(cut("the file ends in the head of a container"));
        }
        let (method, content) = (u16_at(head, header, false), u32_at(head, header + 8, false));
        self.file.consume(own);
        self.left = size - own as u64;
        self.content_left = u64::from(content);
        self.packing = match method {
            _ if content > MAX_CONTENT => {
                return Err(damaged(format!("container with {content} bytes, must be at most {MAX_CONTENT}")));
            }
            0 => Packing::Stored,
            2 => Packing::Deflated,
            _ => return Err(damaged(format!("container with compression {method}, must be 0 (none) or 2 (zlib)"))),
        };
        self.inflate.reset(true);
        Ok(true)
    }

    fn read_stored(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let held = self.file.fill(1)?;
        let len = held.len().min(out.len()).min(usize::try_from(self.left).unwrap_or(usize::MAX));
        out[..len].copy_from_slice(&held[..len]);
        if len == 0 && self.left > 0 {
            return Err(cut(format!("the file ends in a container {} bytes too early", self.left)));
        }
        self.file.consume(len);
        self.left -= len as u64;
        Ok(len)
    }

    fn read_deflated(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let limit = out.len().min(usize::try_from(self.content_left).unwrap_or(usize::MAX));
        loop {
            let held = self.file.fill(1)?;
            let input = &held[..held.len().min(usize::try_from(self.left).unwrap_or(usize::MAX))];
            let is_at_end = input.is_empty();
            let before = (self.inflate.total_in(), self.inflate.total_out());
            let status = self.inflate.decompress(input, &mut out[..limit], FlushDecompress::None);
            let [used, made] = [self.inflate.total_in() - before.0, self.inflate.total_out() - before.1];
            self.file.consume(used as usize);
            self.left -= used;
            // Bytes before damage are valid, so they are returned first. The next call returns the error.
            if made > 0 || limit == 0 {
                return Ok(made as usize);
            }
            match status {
                Ok(Status::StreamEnd) => return Ok(0),
                Ok(_) if is_at_end && self.left > 0 => {
                    return Err(cut(format!("the file ends in a container {} bytes too early", self.left)));
                }
                Ok(_) if used == 0 => return Err(damaged("container whose zlib data end too early")),
                Ok(_) => {}
                Err(error) => return Err(damaged(format!("container with damaged zlib data: {error}"))),
            }
        }
    }
}

impl Read for Containers {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        loop {
            let made = match self.packing {
                Packing::Between => match self.open_next()? {
                    true => continue,
                    false => return Ok(0),
                },
                Packing::Stored => self.read_stored(out),
                Packing::Deflated => self.read_deflated(out),
            };
            if let Ok(count @ 1..) = made {
                self.content_left = self.content_left.saturating_sub(count as u64);
                return Ok(count);
            }
            // The content has ended or is damaged. `open_next` skips the rest of the outer object.
            self.packing = Packing::Between;
            made?;
        }
    }
}
