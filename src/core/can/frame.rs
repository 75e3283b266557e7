//! A CAN frame without its socket: classic, FD or remote, with an identifier and up to 64 bytes.
//!
//! A constructor returns `None` for an identifier or length that no frame can have. The drivers convert error frames to
//! [`crate::monitor::BusEvent`].

use serde::{Deserialize, Serialize};

/// Largest payload, bytes (CAN FD).
pub const MAX_DATA: usize = 64;

/// A CAN identifier. An 11-bit and a 29-bit identifier with the same number are different.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum CanId {
    /// 11 bit, 0 to 0x7FF.
    Standard(u16),
    /// 29 bit, 0 to 0x1FFF_FFFF.
    Extended(u32),
}

impl CanId {
    /// A standard identifier; `None` above 0x7FF.
    pub const fn standard(id: u32) -> Option<Self> {
        if id <= 0x7FF { Some(Self::Standard(id as u16)) } else { None }
    }

    /// An extended identifier; `None` above 0x1FFF_FFFF.
    pub const fn extended(id: u32) -> Option<Self> {
        if id <= 0x1FFF_FFFF { Some(Self::Extended(id)) } else { None }
    }

    /// Number in a DBC, where bit 31 marks an extended identifier.
    pub const fn dbc_number(self) -> u32 {
        match self {
            Self::Standard(id) => id as u32,
            Self::Extended(id) => id | 0x8000_0000,
        }
    }

    /// The number without bit 31.
    pub const fn raw(self) -> u32 {
        match self {
            Self::Standard(id) => id as u32,
            Self::Extended(id) => id,
        }
    }
}

impl std::fmt::Display for CanId {
    /// Hexadecimal, 3 or 8 digits, like candump.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Standard(id) => write!(f, "{id:03X}"),
            Self::Extended(id) => write!(f, "{id:08X}"),
        }
    }
}

/// Whether a classic or FD frame can have this length, bytes.
pub(crate) const fn is_frame_length(len: usize) -> bool {
    matches!(len, 0..=8 | 12 | 16 | 20 | 24 | 32 | 48 | 64)
}

/// Kind of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum FrameKind {
    /// At most 8 bytes.
    Classic,
    /// Has no data. Its length is the requested length.
    Remote,
    /// At most 64 bytes.
    Fd {
        /// Bit rate switch.
        brs: bool,
        /// Error state indicator.
        esi: bool,
    },
}

/// Payload, followed by zeros. The alignment makes decoding faster, because copying then writes each word with a single
/// store. A load that spans two recent stores must wait for both.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
#[repr(align(8))]
struct Data([u8; MAX_DATA]);

/// One frame: identifier, kind and payload.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: CanId,
    kind: FrameKind,
    len: u8,
    data: Data,
}

impl Frame {
    /// A classic data frame; `None` for more than 8 bytes.
    pub fn classic(id: CanId, data: &[u8]) -> Option<Self> {
        (data.len() <= 8).then(|| Self::build(id, FrameKind::Classic, data))
    }

    /// An FD data frame; `None` for a length that FD does not support.
    pub fn fd(id: CanId, brs: bool, esi: bool, data: &[u8]) -> Option<Self> {
        is_frame_length(data.len()).then(|| Self::build(id, FrameKind::Fd { brs, esi }, data))
    }

    /// An FD frame with `len` rounded up to an FD length; `None` above 64.
    pub fn fd_padded(id: CanId, brs: bool, esi: bool, len: usize, payload: &[u8; MAX_DATA]) -> Option<Self> {
        let len = (len..=MAX_DATA).find(|len| is_frame_length(*len))?;
        Self::fd(id, brs, esi, &payload[..len])
    }

    /// A frame with at least `len` bytes: classic up to 8, FD above; `None` above 64.
    pub(crate) fn padded(id: CanId, len: usize, payload: &[u8; MAX_DATA]) -> Option<Self> {
        if len <= 8 { Self::classic(id, &payload[..len]) } else { Self::fd_padded(id, false, false, len, payload) }
    }

    /// A remote request for `len` bytes; `None` above 8.
    pub fn remote(id: CanId, len: u8) -> Option<Self> {
        (len <= 8).then_some(Self { id, kind: FrameKind::Remote, len, data: Data([0; MAX_DATA]) })
    }

    /// A classic data frame with the lowest `len` (at most 8) bytes of `word`. The other bytes must be zero.
    #[inline]
    pub fn of_word(id: CanId, word: u64, len: u8) -> Self {
        debug_assert!(len <= 8 && (len == 8 || word >> (8 * len) == 0), "bytes beyond the payload must be zero");
        let mut data = [0; MAX_DATA];
        data[..8].copy_from_slice(&word.to_le_bytes());
        Self { id, kind: FrameKind::Classic, len, data: Data(data) }
    }

    /// A classic data frame without payload.
    pub const fn empty(id: CanId) -> Self {
        Self { id, kind: FrameKind::Classic, len: 0, data: Data([0; MAX_DATA]) }
    }

    /// The same frame with another identifier.
    #[must_use]
    pub const fn with_id(&self, id: CanId) -> Self {
        Self { id, ..*self }
    }

    fn build(id: CanId, kind: FrameKind, bytes: &[u8]) -> Self {
        let mut data = [0; MAX_DATA];
        data[..bytes.len()].copy_from_slice(bytes);
        Self { id, kind, len: bytes.len() as u8, data: Data(data) }
    }

    pub const fn id(&self) -> CanId {
        self.id
    }

    /// Classic, remote or FD.
    pub const fn kind(&self) -> FrameKind {
        self.kind
    }

    /// The payload; empty for a remote request.
    #[inline]
    pub fn data(&self) -> &[u8] {
        match self.kind {
            FrameKind::Remote => &[],
            FrameKind::Classic | FrameKind::Fd { .. } => &self.data.0[..usize::from(self.len)],
        }
    }

    /// The payload, followed by zeros; all zeros for a remote request.
    pub(crate) const fn padded_data(&self) -> &[u8; MAX_DATA] {
        &self.data.0
    }

    pub(crate) fn data_mut(&mut self) -> &mut [u8] {
        match self.kind {
            FrameKind::Remote => &mut [],
            FrameKind::Classic | FrameKind::Fd { .. } => &mut self.data.0[..usize::from(self.len)],
        }
    }

    /// Payload length, bytes; for a remote request, the requested length.
    pub const fn len(&self) -> usize {
        self.len as usize
    }

    /// Whether the payload is empty.
    pub fn is_empty(&self) -> bool {
        self.data().is_empty()
    }
}

impl std::fmt::Debug for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Frame({}, {:?}, {:02X?})", self.id, self.kind, self.data())
    }
}
