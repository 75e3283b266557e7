//! Reads a damaged database file page by page, without its schema.
//!
//! In: the file and its write-ahead log. Out: the records on its leaf pages, each as a list of values. A page, a record or a
//! chain of overflow pages that does not follow the format gives no record; nothing panics. Pages with deleted contents give
//! none, because SQLite overwrites them (`secure_delete`).
//!
//! The format is that of <https://www.sqlite.org/fileformat2.html#b_tree_pages>.

use std::collections::HashMap;
use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use rusqlite::types::Value;

use super::database::PAGE_BYTES;
use super::wal;
use crate::io::place::with_suffix;

/// Bytes of a page, and of the file's header on the first.
const PAGE: usize = PAGE_BYTES as usize;
const FILE_HEADER: usize = 100;
/// Bytes of the header of a leaf page, and of an inner page.
const LEAF_HEADER: usize = 8;
const INNER_HEADER: usize = 12;

/// A kind of page that holds records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PageKind {
    /// Rows of a table with numbers.
    Rows,
    /// Rows of a table without (`WITHOUT ROWID`); inner pages hold rows too.
    Keys,
}

/// A record of a page.
#[derive(Debug)]
pub(super) struct PageRecord {
    /// The row's number; 0 on pages of kind [`PageKind::Keys`].
    pub(super) rowid: i64,
    /// Its values, in the order of the table's columns.
    pub(super) values: Vec<Value>,
}

/// The pages of a database file, with those of its log over them.
#[derive(Debug)]
pub(super) struct PageFile {
    file: File,
    log: HashMap<u32, Vec<u8>>,
    pages: u32,
}

impl PageFile {
    /// Opens a database file.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(super) fn open(path: &Path) -> std::io::Result<Self> {
        let file = File::open(path)?;
        let log = wal::pages(&with_suffix(path, "-wal"));
        let in_file = u32::try_from(file.metadata()?.len() / u64::from(PAGE_BYTES)).unwrap_or(u32::MAX);
        let pages = log.keys().copied().max().unwrap_or(0).max(in_file);
        Ok(Self { file, log, pages })
    }

    /// Its number of pages, which count from 1.
    pub(super) fn pages(&self) -> u32 {
        self.pages
    }

    /// The records of a page and the number of those that cannot be read; `None` = it holds none.
    pub(super) fn records(&self, number: u32) -> Option<(PageKind, Vec<PageRecord>, usize)> {
        let page = self.page(number)?;
        let header = if number == 1 { FILE_HEADER } else { 0 };
        let (kind, header_bytes) = match page[header] {
            0x0D => (PageKind::Rows, LEAF_HEADER),
            0x0A => (PageKind::Keys, LEAF_HEADER),
            0x02 => (PageKind::Keys, INNER_HEADER),
            _ => return None,
        };
        let cells = usize::from(be16(&page, header + 3)?);
        let (mut records, mut unreadable) = (Vec::new(), 0);
        for cell in 0..cells {
            let Some(at) = be16(&page, header + header_bytes + 2 * cell) else { break };
            let child_bytes = if header_bytes == INNER_HEADER { 4 } else { 0 };
            match page.get(usize::from(at) + child_bytes..).and_then(|cell| self.record(kind, cell)) {
                Some(record) => records.push(record),
                None => unreadable += 1,
            }
        }
        Some((kind, records, unreadable))
    }

    fn page(&self, number: u32) -> Option<Vec<u8>> {
        if let Some(page) = self.log.get(&number) {
            return (page.len() == PAGE).then(|| page.clone());
        }
        let mut page = vec![0; PAGE];
        let at = u64::from(number.checked_sub(1)?) * u64::from(PAGE_BYTES);
        self.file.read_exact_at(&mut page, at).ok().map(|()| page)
    }

    fn record(&self, kind: PageKind, mut cell: &[u8]) -> Option<PageRecord> {
        let length = usize::try_from(varint(&mut cell)?).ok()?;
        let rowid = if kind == PageKind::Rows { varint(&mut cell)?.cast_signed() } else { 0 };
        let payload = self.payload(kind, length, cell)?;
        Some(PageRecord { rowid, values: values(&payload)? })
    }

    /// The bytes of a record: those in its cell, and those on overflow pages.
    fn payload(&self, kind: PageKind, length: usize, cell: &[u8]) -> Option<Vec<u8>> {
        let least = (PAGE - 12) * 32 / 255 - 23;
        let most = if kind == PageKind::Rows { PAGE - 35 } else { (PAGE - 12) * 64 / 255 - 23 };
        if length <= most {
            return cell.get(..length).map(<[u8]>::to_vec);
        }
        // A damaged length must not ask for more than the file has.
        if length / PAGE > self.pages as usize {
            return None;
        }
        let here = least + (length - least) % (PAGE - 4);
        let here = if here <= most { here } else { least };
        let mut payload = cell.get(..here)?.to_vec();
        let mut next = be32(cell, here)?;
        while payload.len() < length {
            let page = self.page(next)?;
            next = be32(&page, 0)?;
            let rest = (length - payload.len()).min(PAGE - 4);
            payload.extend_from_slice(&page[4..4 + rest]);
        }
        Some(payload)
    }
}

fn be16(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn be32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

/// Reads SQLite's integer of 1 to 9 bytes.
fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0_u64;
    for place in 0..9 {
        let (&byte, rest) = bytes.split_first()?;
        *bytes = rest;
        if place == 8 {
            return Some(value << 8 | u64::from(byte));
        }
        value = value << 7 | u64::from(byte & 0x7F);
        if byte & 0x80 == 0 {
            break;
        }
    }
    Some(value)
}

/// The values of a record; `None` = it does not follow the format.
fn values(payload: &[u8]) -> Option<Vec<Value>> {
    let mut header = payload;
    let header_bytes = usize::try_from(varint(&mut header)?).ok()?;
    let mut header = payload.get(payload.len() - header.len()..header_bytes)?;
    let mut body = payload.get(header_bytes..)?;
    let mut values = Vec::new();
    while !header.is_empty() {
        values.push(value(varint(&mut header)?, &mut body)?);
    }
    body.is_empty().then_some(values)
}

/// Takes one value of a serial type from the body of a record.
fn value(serial_type: u64, body: &mut &[u8]) -> Option<Value> {
    let length = match serial_type {
        0 | 8 | 9 => 0,
        1..=4 => usize::try_from(serial_type).ok()?,
        5 => 6,
        6 | 7 => 8,
        10 | 11 => return None,
        _ => usize::try_from((serial_type - 12) / 2).ok()?,
    };
    let (bytes, rest) = body.split_at_checked(length)?;
    *body = rest;
    Some(match serial_type {
        0 => Value::Null,
        1..=6 => {
            let is_negative = bytes.first().is_some_and(|byte| byte & 0x80 != 0);
            Value::Integer(
                bytes.iter().fold(if is_negative { -1 } else { 0 }, |whole: i64, &byte| whole << 8 | i64::from(byte)),
            )
        }
        7 => Value::Real(f64::from_be_bytes(bytes.try_into().ok()?)),
        8 => Value::Integer(0),
        9 => Value::Integer(1),
        kind if kind % 2 == 0 => Value::Blob(bytes.to_vec()),
        _ => Value::Text(String::from_utf8(bytes.to_vec()).ok()?),
    })
}
