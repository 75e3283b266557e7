//! AUTOSAR end-to-end protection: Profile 1 (variants A and C) and Profile 5, for senders and receivers.
//!
//! A protected payload starts with a header: a CRC and a counter. The CRC covers the rest of the payload and a data
//! identifier that sender and receiver have agreed on. The counter increases by one with each frame. The receiver
//! detects payloads that are damaged, repeated, lost or from another message. The protection does not stop an attacker,
//! because anybody can compute a CRC.
//!
//! | profile | header | CRC and its start value | bytes that the CRC covers, in this order | counter |
//! | --- | --- | --- | --- | --- |
//! | 1A | byte 0: CRC; byte 1, low nibble: counter | CRC-8 0x1D, 0 | id low, id high, payload from byte 1 | 0 to 14 |
//! | 1C | as 1A; byte 1, high nibble: bits 8 to 11 of the id | CRC-8 0x1D, 0 | id low, 0, payload from byte 1 | 0 to 14 |
//! | 5 | bytes 0 and 1: CRC, low byte first; byte 2: counter | CRC-16 0x1021, 0xFFFF | payload from byte 2, id low, id high | 0 to 255 |
//!
//! In 1A, a signal of the message may use the high nibble of byte 1; `protect` does not change it. AUTOSAR computes the
//! CRC of profile 1 with the CRC-8 of its library, but cancels the library's start value and final XOR (both 0xFF). The
//! table shows the resulting CRC.
//!
//! A sender rejects a payload that is shorter than the header. A receiver reports such a payload as a wrong CRC.
//! Source: AUTOSAR "SWS E2E Library". Two independent implementations that the tests use, and four open-source
//! receivers, agree with this description. The tests contain test vectors.
//!
//! * Deviation 1: profile 5 uses the receiver of profile 1 with the counter modulo 256, so that both profiles have the
//!   same statuses and counts. In AUTOSAR, the check of profile 5 has no statuses SYNC and INITIAL; a separate state
//!   machine provides them. Effects: the first frame of profile 5 is INITIAL and not used, although AUTOSAR's check
//!   alone might return OK. While frames are missing, the allowed step of the counter grows. If the counter jumps too
//!   far, that frame is not used, and the sequence continues from its counter, as in AUTOSAR. A restart of the sender
//!   therefore costs one frame. Otherwise, it might cost up to 256 frames.
//! * Deviation 2: the setting for repetitions (`max_no_new_or_repeated_data`) is at most 14 for both profiles, and 14
//!   means "any number".
//! * Deviation 3: AUTOSAR calls its check once per period, with or without a frame. Here, it is called once per frame.
//!   If the period is known, it is also called for each period without a frame. If the period is unknown, the allowed
//!   step grows only with frames that are not accepted.
//! * Deviation 4: AUTOSAR's check returns an error without a status for the counter 15 of profile 1, which no sender
//!   may use. Here, the status is [`Status::WrongCrc`].

mod receiver;

use serde::{Deserialize, Serialize};

pub use receiver::{CheckConfig, Receiver, Status, StatusCounts};

/// Profile of end-to-end protection: layout of the header, CRC and range of the counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Profile {
    /// Variant A: the data identifier is included in the CRC and not sent.
    #[serde(rename = "1A")]
    P01A,
    /// Variant C: four bits of the data identifier are sent, and its low byte is included in the CRC.
    #[serde(rename = "1C")]
    P01C,
    #[serde(rename = "5")]
    P05,
}

impl Profile {
    /// Name in the configuration.
    pub const fn name(self) -> &'static str {
        match self {
            Self::P01A => "1A",
            Self::P01C => "1C",
            Self::P05 => "5",
        }
    }

    /// Bits of the first three bytes that the protection writes.
    pub const fn header_mask(self) -> [u8; 3] {
        match self {
            Self::P01A => [0xFF, 0x0F, 0],
            Self::P01C => [0xFF, 0xFF, 0],
            Self::P05 => [0xFF, 0xFF, 0xFF],
        }
    }

    /// Shortest protectable payload, bytes.
    pub const fn header_bytes(self) -> usize {
        match self {
            Self::P01A | Self::P01C => 2,
            Self::P05 => 3,
        }
    }

    /// Longest protectable payload, bytes: 240 bits for profile 1, any frame for profile 5.
    pub const fn max_bytes(self) -> usize {
        match self {
            Self::P01A | Self::P01C => 30,
            Self::P05 => crate::can::MAX_DATA,
        }
    }

    /// Largest data identifier: variant 1C uses only 12 bits.
    pub const fn max_data_id(self) -> u16 {
        match self {
            Self::P01C => 0x0FFF,
            Self::P01A | Self::P05 => u16::MAX,
        }
    }

    /// Largest counter.
    pub const fn max_counter(self) -> u8 {
        match self {
            Self::P01A | Self::P01C => 14,
            Self::P05 => u8::MAX,
        }
    }

    /// The counter after `counter`. The largest and invalid counters are followed by 0.
    pub const fn next_counter(self, counter: u8) -> u8 {
        if counter < self.max_counter() { counter + 1 } else { 0 }
    }

    /// Number of steps between two valid counters.
    const fn counter_delta(self, from: u8, to: u8) -> u8 {
        if to >= from { to - from } else { self.max_counter().wrapping_sub(from).wrapping_add(to).wrapping_add(1) }
    }
}

/// Reason why a payload cannot be protected.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ProtectError(String);

/// Protection of one message, as agreed between sender and receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Protection {
    pub profile: Profile,
    /// Unique among messages. Variant 1C uses only the lower 12 bits.
    pub data_id: u16,
}

impl Protection {
    /// Writes counter, identifier nibble (1C) and CRC to a payload. All other bytes must be final. Leaves the payload
    /// unchanged if it is shorter than the header or the counter is too large.
    pub fn protect(&self, payload: &mut [u8], counter: u8) -> Result<(), ProtectError> {
        let (found, needed, max) = (payload.len(), self.profile.header_bytes(), self.profile.max_counter());
        if found < needed {
            return Err(ProtectError(format!(
                "payload of {found} bytes, must be at least {needed} bytes for this profile"
            )));
        }
        if counter > max {
            return Err(ProtectError(format!("end-to-end counter {counter}, must be 0 to {max}")));
        }
        match self.profile {
            Profile::P01A => payload[1] = payload[1] & 0xF0 | counter,
            Profile::P01C => payload[1] = self.id_nibble() << 4 | counter,
            Profile::P05 => payload[2] = counter,
        }
        match self.profile {
            Profile::P01A | Profile::P01C => payload[0] = self.crc8(payload),
            Profile::P05 => {
                let crc = self.crc16(payload);
                payload[..2].copy_from_slice(&crc.to_le_bytes());
            }
        }
        Ok(())
    }

    /// The counter of a valid payload; `None` = CRC, identifier or counter is invalid.
    pub fn verified_counter(&self, payload: &[u8]) -> Option<u8> {
        let counter = self.counter(payload)?;
        let intact = match self.profile {
            Profile::P01A => payload[0] == self.crc8(payload),
            Profile::P01C => payload[0] == self.crc8(payload) && payload[1] >> 4 == self.id_nibble(),
            Profile::P05 => payload[..2] == self.crc16(payload).to_le_bytes(),
        };
        (intact && counter <= self.profile.max_counter()).then_some(counter)
    }

    /// The counter in a payload, even if the CRC is wrong; `None` = the payload is too short.
    pub fn counter(&self, payload: &[u8]) -> Option<u8> {
        match self.profile {
            Profile::P01A | Profile::P01C => payload.get(1).map(|byte| byte & 0x0F),
            Profile::P05 => payload.get(2).copied(),
        }
    }

    /// The nibble of the identifier that variant 1C sends.
    const fn id_nibble(&self) -> u8 {
        self.data_id.to_be_bytes()[0] & 0x0F
    }

    fn crc8(&self, payload: &[u8]) -> u8 {
        let [high, low] = self.data_id.to_be_bytes();
        let second = if self.profile == Profile::P01C { 0 } else { high };
        crc8(crc8(0, &[low, second]), &payload[1..])
    }

    fn crc16(&self, payload: &[u8]) -> u16 {
        crc16(crc16(0xFFFF, &payload[2..]), &self.data_id.to_le_bytes())
    }
}

/// CRC of each byte value, for a register of `bits` bits.
const fn crc_table(bits: u32, polynomial: u16) -> [u16; 256] {
    let (mut table, mut byte) = ([0; 256], 0);
    while byte < 256 {
        let (mut crc, mut bit) = ((byte as u16) << (bits - 8), 0);
        while bit < 8 {
            crc = if crc >> (bits - 1) & 1 == 1 { crc << 1 ^ polynomial } else { crc << 1 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
}

static CRC8: [u16; 256] = crc_table(8, 0x1D);
static CRC16: [u16; 256] = crc_table(16, 0x1021);

fn crc8(start: u8, bytes: &[u8]) -> u8 {
    // The CRC has eight bits: the lowest byte of a table entry.
    bytes.iter().fold(start, |crc, byte| CRC8[usize::from(crc ^ byte)].to_le_bytes()[0])
}

/// CRC-16 with the polynomial 0x1021, most significant bit first.
pub(super) fn crc16(start: u16, bytes: &[u8]) -> u16 {
    bytes.iter().fold(start, |crc, byte| CRC16[usize::from(crc >> 8 ^ u16::from(*byte))] ^ crc << 8)
}

#[cfg(test)]
mod tests;
