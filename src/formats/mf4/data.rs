//! Reads the data of a group as one stream of bytes. The data are one block or a list of blocks, compressed or not.

use std::io::{self, BufReader, Read};
use std::rc::Rc;

use flate2::bufread::ZlibDecoder;

use super::blocks::{BLOCK_HEAD, Block, MdfFile};
use crate::byte_stream::{cut, damaged, u32_at, u64_at};

const DATA: [&[u8; 4]; 6] = [b"##DT", b"##DV", b"##SD", b"##DI", b"##RD", b"##DZ"];
const LISTS: [&[u8; 4]; 2] = [b"##DL", b"##LD"];
/// Maximum unpacked size of a transposed block, bytes. Such a block is held in memory as a whole. The standard allows 4
/// MiB.
const MAX_TRANSPOSED: u64 = 32 << 20;
/// Size of the buffer for compressed data, bytes.
const PACKED_BUFFER: usize = 32 * 1024;

pub(super) struct DataBlocks {
    file: Rc<MdfFile>,
    list: List,
    body: Body,
    /// Address of the current block.
    at: u64,
    /// Bytes of blocks that may still be read. All blocks together cannot be longer than the file.
    left_in_file: u64,
}

enum List {
    End,
    /// A single block.
    Block(u64),
    /// A list: its current part, the next link in it, and the number of parts that may still follow.
    Part {
        part: Block,
        /// Number of links to data, and number of the link read last. Link 0 leads to the next part.
        links: u64,
        index: u64,
        parts_left: u64,
        is_circular: bool,
    },
}

enum Body {
    Empty,
    Stored(Section),
    Deflated(Box<ZlibDecoder<BufReader<Section>>>),
    Transposed(Transposed),
}

struct Section {
    file: Rc<MdfFile>,
    at: u64,
    left: u64,
    /// Whether the section may end early, at the end of the file.
    is_open: bool,
}

impl DataBlocks {
    /// Reads the data behind a link; a link 0 has no data.
    ///
    /// # Errors
    /// Fails if the link is damaged.
    pub(super) fn open(file: &Rc<MdfFile>, link: u64) -> io::Result<Self> {
        let list = open_list(file, link)?;
        let left_in_file = file.len();
        Ok(Self { file: Rc::clone(file), list, body: Body::Empty, at: link, left_in_file })
    }

    pub(super) fn position(&self) -> u64 {
        self.at
    }

    /// Opens the next block. Returns whether there is one.
    fn open_next(&mut self) -> io::Result<bool> {
        loop {
            let link = match &mut self.list {
                List::End => return Ok(false),
                List::Block(link) => {
                    let link = *link;
                    self.list = List::End;
                    link
                }
                List::Part { part, links, index, parts_left, is_circular } => {
                    *index += 1;
                    if *index <= *links {
                        self.file.link(part, *index)?
                    } else if *parts_left > 1 {
                        let next = self.file.link(part, 0)?;
                        self.list = open_part(&self.file, next, *parts_left - 1, *is_circular)?;
                        continue;
                    } else {
                        self.at = part.address;
                        let is_circular = *is_circular;
                        self.list = List::End;
                        return if is_circular {
                            Err(damaged("the list of data blocks is a circle"))
                        } else {
                            Ok(false)
                        };
                    }
                }
            };
            if link == 0 {
                continue;
            }
            self.at = link;
            let block = self.file.block(link, &DATA)?;
            self.body = self.open_body(&block)?;
            return Ok(true);
        }
    }

    fn open_body(&mut self, block: &Block) -> io::Result<Body> {
        let (at, mut left) = (block.data_address(), block.data_len());
        // If a recorder has lost its supply, the length of its last block is 0, because it was not written yet.
        let is_open = self.file.has_open_data() && left == 0;
        if is_open {
            left = self.file.len().saturating_sub(at);
        }
        let rest = self.left_in_file.checked_sub(left.min(self.file.len().saturating_sub(at)) + BLOCK_HEAD);
        self.left_in_file = rest.ok_or_else(|| damaged("data blocks are linked more than once"))?;
        if &block.id != b"##DZ" {
            return Ok(Body::Stored(Section { file: Rc::clone(&self.file), at, left, is_open }));
        }
        let head = self.file.description(block, 24)?;
        let [kind, parameter] = [u32::from(head[2]), u32_at(&head, 4, false)];
        let [unpacked, packed] = [8, 16].map(|at| u64_at(&head, at));
        let section = Section { file: Rc::clone(&self.file), at: at + 24, left: packed, is_open: false };
        let unpack = ZlibDecoder::new(BufReader::with_capacity(PACKED_BUFFER, section));
        match kind {
            0 => Ok(Body::Deflated(Box::new(unpack))),
            1 => Ok(Body::Transposed(Transposed::unpack(unpack, unpacked, parameter as usize)?)),
            _ => Err(damaged(format!("compression {kind}, must be 0 (deflate) or 1 (transposed, deflate)"))),
        }
    }
}

impl Read for DataBlocks {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        loop {
            let count = match &mut self.body {
                Body::Empty => 0,
                Body::Stored(section) => section.read(out)?,
                Body::Deflated(unpack) => unpack.read(out).map_err(unpack_error)?,
                Body::Transposed(block) => block.read(out),
            };
            if count > 0 {
                return Ok(count);
            }
            self.body = Body::Empty;
            if !self.open_next()? {
                return Ok(0);
            }
        }
    }
}

impl Read for Section {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let len = out.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        let count = self.file.read(self.at, &mut out[..len])?;
        if count == 0 && len > 0 && !self.is_open {
            return Err(cut(format!("the file ends in a data block, {} bytes too early", self.left)));
        }
        self.at += count as u64;
        self.left -= count as u64;
        Ok(count)
    }
}

/// A block whose unpacked bytes are stored column by column: the first byte of each record, then the second.
struct Transposed {
    bytes: Vec<u8>,
    columns: usize,
    rows: usize,
    next: usize,
}

impl Transposed {
    fn unpack(unpack: impl Read, unpacked: u64, columns: usize) -> io::Result<Self> {
        if unpacked > MAX_TRANSPOSED {
            return Err(damaged(format!("transposed block of {unpacked} bytes, must be at most {MAX_TRANSPOSED}")));
        }
        let mut bytes = Vec::new();
        unpack.take(unpacked).read_to_end(&mut bytes).map_err(unpack_error)?;
        if bytes.len() as u64 != unpacked {
            return Err(damaged(format!("data block with {} bytes, must have {unpacked}", bytes.len())));
        }
        let columns = columns.max(1);
        let rows = bytes.len() / columns;
        Ok(Self { bytes, columns, rows, next: 0 })
    }

    fn read(&mut self, out: &mut [u8]) -> usize {
        let (columns, rows) = (self.columns, self.rows);
        let count = out.len().min(self.bytes.len() - self.next);
        let whole = count / columns;
        if self.next.is_multiple_of(columns) && whole > 0 && self.next < columns * rows {
            let first = self.next / columns;
            let whole = whole.min(rows - first);
            let out = &mut out[..whole * columns];
            for (column, values) in self.bytes[..columns * rows].chunks_exact(rows).enumerate() {
                for (row, value) in out.chunks_exact_mut(columns).zip(&values[first..]) {
                    row[column] = *value;
                }
            }
            self.next += out.len();
            return out.len();
        }
        // Copies byte by byte what the loop above cannot copy: parts of a record that is longer than the buffer, and
        // bytes after the last record.
        for (byte, at) in out[..count].iter_mut().zip(self.next..) {
            let is_in_record = at < columns * rows;
            *byte = self.bytes[if is_in_record { at % columns * rows + at / columns } else { at }];
        }
        self.next += count;
        count
    }
}

fn unpack_error(error: io::Error) -> io::Error {
    match error.kind() {
        // The block ends, but the decoder needs more bytes.
        io::ErrorKind::UnexpectedEof => cut(format!("a compressed data block ends too early: {error}")),
        _ => damaged(format!("compressed data block with damaged data: {error}")),
    }
}

fn open_list(file: &MdfFile, link: u64) -> io::Result<List> {
    if link == 0 {
        return Ok(List::End);
    }
    let mut block = file.block(link, &[DATA.as_slice(), &LISTS, &[b"##HL"]].concat())?;
    if &block.id == b"##HL" {
        let first = file.link(&block, 0)?;
        if first == 0 {
            return Ok(List::End);
        }
        block = file.block(first, &LISTS)?;
    }
    if !LISTS.contains(&&block.id) {
        return Ok(List::Block(link));
    }
    let (parts, is_circular) = count_parts(file, block.address);
    open_part(file, block.address, parts, is_circular)
}

/// Opens a part of a list. `parts_left` includes this part.
fn open_part(file: &MdfFile, address: u64, parts_left: u64, is_circular: bool) -> io::Result<List> {
    let part = file.block(address, &LISTS)?;
    let mut links = part.links.saturating_sub(1);
    if &part.id == b"##LD" {
        // The links after the data links lead to invalidation bits.
        let data = file.description(&part, 8)?;
        links = links.min(u64::from(u32_at(&data, 4, false)));
    }
    Ok(List::Part { part, links, index: 0, parts_left, is_circular })
}

/// Number of parts of a list, and whether its last part links to an earlier part. Finds the circle with Brent's
/// algorithm, in constant memory. A damaged link ends the count; the reader reports the damage when it gets there.
fn count_parts(file: &MdfFile, first: u64) -> (u64, bool) {
    let next_of = |at: u64| file.block(at, &LISTS).and_then(|part| file.link(&part, 0)).unwrap_or(0);
    let (mut power, mut circle, mut count) = (1_u64, 1_u64, 1_u64);
    let (mut slow, mut fast) = (first, next_of(first));
    while slow != fast {
        if fast == 0 {
            return (count, false);
        }
        if power == circle {
            (slow, power, circle) = (fast, 2 * power, 0);
        }
        (fast, circle, count) = (next_of(fast), circle + 1, count + 1);
    }
    // Move two pointers that are one circle apart until they meet at the first part of the circle.
    let (mut before, mut behind, mut start) = (first, first, 0);
    for _ in 0..circle {
        behind = next_of(behind);
    }
    while before != behind {
        (before, behind, start) = (next_of(before), next_of(behind), start + 1);
    }
    (start + circle, true)
}
