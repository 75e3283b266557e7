//! A frame as a binary log contains it: identifier, flags and bytes, not yet checked.

use packwatch_core::can::{CanId, Frame};

/// Lengths that the codes 9 to 15 of CAN FD stand for, bytes.
const FD_LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

#[derive(Debug, Clone, Copy)]
pub(crate) struct RawFrame<'a> {
    /// Number of the identifier, without flags.
    pub(crate) id: u32,
    /// Whether the identifier has 29 bits.
    pub(crate) extended: bool,
    /// Remote frame: its requested length is the length of `data`, whose content is ignored.
    pub(crate) remote: bool,
    /// Bit rate switch and error state indicator of a CAN FD frame; `None` = a classic frame.
    pub(crate) fd: Option<(bool, bool)>,
    pub(crate) data: &'a [u8],
}

impl RawFrame<'_> {
    /// Checks the fields.
    ///
    /// # Errors
    /// Returns what was found and what is allowed.
    #[inline]
    pub(crate) fn check(self) -> Result<Frame, String> {
        let id = if self.extended { CanId::extended(self.id) } else { CanId::standard(self.id) };
        let frame = id.and_then(|id| match (self.remote, self.fd) {
            (true, _) => Frame::remote(id, self.data.len().min(8) as u8),
            (false, Some((brs, esi))) => Frame::fd(id, brs, esi, self.data),
            (false, None) => Frame::classic(id, self.data),
        });
        frame.ok_or_else(|| self.fault())
    }

    #[cold]
    fn fault(&self) -> String {
        let (id, len) = (self.id, self.data.len());
        match self.extended {
            true if id > 0x1FFF_FFFF => format!("identifier {id:X}, must be at most 1FFFFFFF"),
            false if id > 0x7FF => format!("identifier {id:X} of 11 bits, must be at most 7FF"),
            _ if self.fd.is_none() => format!("frame of {len} bytes, must be at most 8 without CAN FD"),
            _ => format!("CAN FD frame of {len} bytes, must be 0 to 8, 12, 16, 20, 24, 32, 48 or 64"),
        }
    }
}

/// Number of bytes that a data length code stands for.
pub(crate) fn length_of_code(code: u8, fd: bool) -> usize {
    let code = usize::from(code);
    if fd && code > 8 { FD_LENGTHS[(code - 9).min(6)] } else { code.min(8) }
}
