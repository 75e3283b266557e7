//! Reads the blocks of an MDF file. A block has a head with an identifier, a length and links, and then data.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;

use crate::byte_stream::{cut, damaged, u16_at, u64_at};

/// Address of the first block.
pub(super) const FIRST_BLOCK: u64 = 64;
/// Size of a block's head, bytes.
pub(super) const BLOCK_HEAD: u64 = 24;
/// Maximum number of data bytes that are read from a block that describes the measurements. Without texts, such a block
/// has less than 1 KiB.
const MAX_DESCRIPTION: u64 = 4096;

/// An MDF file and its first 64 bytes.
pub(super) struct MdfFile {
    file: File,
    len: u64,
    /// Which parts of an unfinalized file have not been updated; 0 = the file is finalized.
    unfinalized: u16,
}

/// Head of a block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    pub(super) address: u64,
    pub(super) id: [u8; 4],
    /// Length with the head, bytes, as the head states it.
    pub(super) len: u64,
    pub(super) links: u64,
}

impl Block {
    /// Address of the data after the links.
    pub(super) fn data_address(&self) -> u64 {
        self.address + BLOCK_HEAD + 8 * self.links
    }

    /// Length of the data after the links, as the head states it.
    pub(super) fn data_len(&self) -> u64 {
        self.len.saturating_sub(BLOCK_HEAD + 8 * self.links)
    }
}

impl MdfFile {
    /// Reads the first 64 bytes.
    ///
    /// # Errors
    /// Fails if the file cannot be read or is shorter.
    pub(super) fn open(file: File) -> io::Result<Self> {
        let len = file.metadata()?.len();
        let mut file = Self { file, len, unfinalized: 0 };
        let mut head = [0; FIRST_BLOCK as usize];
        if file.read(0, &mut head)? < head.len() {
            return Err(cut(format!("the file ends after {len} bytes, must have a head of 64")));
        }
        if head.starts_with(super::MAGICS[1]) {
            file.unfinalized = u16_at(&head, 60, false);
        }
        Ok(file)
    }

    pub(super) fn len(&self) -> u64 {
        self.len
    }

    /// Whether the cycle counters of the groups are valid.
    pub(super) fn has_cycle_counts(&self) -> bool {
        self.unfinalized & 1 == 0
    }

    /// Whether the last data block may state a length that was not updated.
    pub(super) fn has_open_data(&self) -> bool {
        self.unfinalized & 4 != 0
    }

    /// Whether the offsets of variable-length values in unsorted data are valid.
    pub(super) fn has_value_offsets(&self) -> bool {
        self.unfinalized & 64 == 0
    }

    /// Reads bytes at an address. Returns fewer bytes only at the end of the file.
    pub(super) fn read(&self, address: u64, out: &mut [u8]) -> io::Result<usize> {
        let mut done = 0;
        while done < out.len() {
            match self.file.read_at(&mut out[done..], address.saturating_add(done as u64)) {
                Ok(0) => break,
                Ok(count) => done += count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(done)
    }

    /// Reads the head of a block with one of these identifiers.
    ///
    /// # Errors
    /// Fails if there is no such block at this address.
    pub(super) fn block(&self, address: u64, allowed: &[&[u8; 4]]) -> io::Result<Block> {
        let mut head = [0; BLOCK_HEAD as usize];
        if address < FIRST_BLOCK || self.read(address, &mut head)? < head.len() {
            let text = format!("link to byte {address}, must be at least 64 and before the end at byte {}", self.len);
            return Err(if address < FIRST_BLOCK { damaged(text) } else { cut(text) });
        }
        let id = [head[0], head[1], head[2], head[3]];
        if !allowed.contains(&&id) {
            let allowed: Vec<_> = allowed.iter().map(|id| id.escape_ascii().to_string()).collect();
            let found = id.escape_ascii();
            return Err(damaged(format!("block {found} at byte {address}, must be {}", allowed.join(" or "))));
        }
        let block = Block { address, id, len: u64_at(&head, 8), links: u64_at(&head, 16) };
        if block.links > self.len / 8 {
            return Err(damaged(format!("block at byte {address} with {} links, more than the file has", block.links)));
        }
        Ok(block)
    }

    /// A link of a block; 0 if the block has fewer links.
    pub(super) fn link(&self, block: &Block, index: u64) -> io::Result<u64> {
        let mut link = [0; 8];
        if index >= block.links {
            return Ok(0);
        }
        if self.read(block.address + BLOCK_HEAD + 8 * index, &mut link)? < link.len() {
            return Err(cut(format!("the file ends in the links of the block at byte {}", block.address)));
        }
        Ok(u64::from_le_bytes(link))
    }

    /// Reads the data of a block that describes the measurements, at least `needed` bytes.
    pub(super) fn description(&self, block: &Block, needed: usize) -> io::Result<Vec<u8>> {
        let mut data = vec![0; usize::try_from(block.data_len().min(MAX_DESCRIPTION)).unwrap_or(0)];
        let read = self.read(block.data_address(), &mut data)?;
        data.truncate(read);
        if data.len() < needed {
            let text = format!("block at byte {} with {} bytes of data, must have {needed}", block.address, data.len());
            return Err(damaged(text));
        }
        Ok(data)
    }

    /// The text of a text block or metadata block, cut after 4096 bytes; empty if `address` is 0.
    pub(super) fn text(&self, address: u64) -> io::Result<String> {
        if address == 0 {
            return Ok(String::new());
        }
        let block = self.block(address, &[b"##TX", b"##MD"])?;
        let data = self.description(&block, 0)?;
        let end = data.iter().position(|byte| *byte == 0).unwrap_or(data.len());
        Ok(String::from_utf8_lossy(&data[..end]).into_owned())
    }
}
