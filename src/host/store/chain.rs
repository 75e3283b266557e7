//! The hash chain: every chained row carries the SHA-256 of the row before it and of its own contents.
//!
//! It shows a row that was changed, removed, inserted or moved; the head, stored separately, shows a tail that was cut
//! off. It finds damage and careless edits. A person who can write the file can recompute the whole chain; a copy of the
//! head kept elsewhere shows that too.

use rusqlite::types::Value;
use sha2::{Digest, Sha256};

use super::rows::HistoryTable;

/// A SHA-256.
pub(super) type Hash = [u8; 32];

/// The chain's end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ChainHead {
    /// Rows so far; the next has the number after it.
    pub(super) count: i64,
    /// Hash of the last row; zeros before the first.
    pub(super) hash: Hash,
}

impl ChainHead {
    /// Appends a row; afterwards `count` is its number and `hash` its hash.
    pub(super) fn append(&mut self, table: HistoryTable, values: &[Value]) {
        self.count += 1;
        self.hash = link(&self.hash, table, self.count, values);
    }
}

/// Hash of a row: of the one before, the table, the number, and every value with its type and length.
pub(super) fn link(before: &Hash, table: HistoryTable, seq: i64, values: &[Value]) -> Hash {
    let mut hasher = Sha256::new();
    hasher.update(before);
    hasher.update(table.name().as_bytes());
    hasher.update([0]);
    hasher.update(seq.to_le_bytes());
    for value in values {
        match value {
            Value::Null => hasher.update([0]),
            Value::Integer(whole) => {
                hasher.update([1]);
                hasher.update(whole.to_le_bytes());
            }
            Value::Real(real) => {
                hasher.update([2]);
                hasher.update(real.to_bits().to_le_bytes());
            }
            Value::Text(text) => update_bytes(&mut hasher, 3, text.as_bytes()),
            Value::Blob(blob) => update_bytes(&mut hasher, 4, blob),
        }
    }
    hasher.finalize().into()
}

fn update_bytes(hasher: &mut Sha256, tag: u8, bytes: &[u8]) {
    hasher.update([tag]);
    hasher.update((bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

/// A hash in hexadecimal digits.
pub(super) fn hex(hash: &[u8]) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}
