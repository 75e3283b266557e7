//! AUTOSAR secure on-board communication (SecOC): layout of an authenticated payload and input of its authenticator.
//!
//! ```text
//! data | low bits of the freshness | first bits of the authenticator      most significant bit first
//! ```
//!
//! Freshness is a counter that never repeats. The authenticator is AES-128-CMAC over data id (16 bit), data and the
//! whole freshness (64 bit), big-endian. The caller has the key and the cipher and passes the 16 bytes of a CMAC. This
//! module contains no secret, so its results can be reproduced without the key.
//!
//! | profile | freshness sent | authenticator sent | both, bytes | guesses until one succeeds, on average |
//! | --- | --- | --- | --- | --- |
//! | 1 | 8 bit | 24 bit | 4 | 1.7 x 10^7 |
//! | 3 | 4 bit | 28 bit | 4 | 2.7 x 10^8 for one freshness value; the receiver may try two |
//! | fd | 32 bit | 64 bit | 12 | 1.8 x 10^19 |
//! | announcement | 36 bit | 28 bit | 8 | 2.7 x 10^8 |
//!
//! Source: AUTOSAR Classic Platform R22-11, "Specification of Secure Onboard Communication": profiles 1 and 3, order
//! and width of the authenticated fields. The lengths of the profiles `fd` and `announcement` are packwatch's own.
//!
//! Deviation: AUTOSAR leaves the management of freshness to the manufacturer. Here, the receiver of commands announces
//! the freshness that commands must carry ([`FreshnessWindow`]). In all other authenticated frames that packwatch
//! sends, the freshness increases by one with each frame.

mod window;

use serde::{Deserialize, Serialize};

use super::MAX_DATA;

pub use window::{ANNOUNCEMENT_STEP, FreshnessWindow};

/// Bytes: data id, payload, freshness.
const MAX_INPUT: usize = 2 + MAX_DATA + 8;

/// A complete authenticator (AES-128-CMAC).
pub type Mac = [u8; 16];

/// Defines how many bits of freshness and authenticator are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Profile {
    #[serde(rename = "1")]
    P1,
    #[serde(rename = "3")]
    P3,
    #[serde(rename = "fd")]
    Fd,
    /// For the frame that announces the freshness of commands.
    #[serde(rename = "announcement")]
    Announcement,
}

impl Profile {
    pub const ALL: [Self; 4] = [Self::P1, Self::P3, Self::Fd, Self::Announcement];

    /// Name in the configuration.
    pub const fn name(self) -> &'static str {
        match self {
            Self::P1 => "1",
            Self::P3 => "3",
            Self::Fd => "fd",
            Self::Announcement => "announcement",
        }
    }

    /// Sent bits of the freshness.
    pub const fn freshness_bits(self) -> u32 {
        match self {
            Self::P1 => 8,
            Self::P3 => 4,
            Self::Fd => 32,
            Self::Announcement => 36,
        }
    }

    /// Sent bits of the authenticator.
    pub const fn mac_bits(self) -> u32 {
        match self {
            Self::P1 => 24,
            Self::P3 | Self::Announcement => 28,
            Self::Fd => 64,
        }
    }

    /// Bytes of freshness and authenticator at the end of the payload.
    pub const fn trailer_bytes(self) -> usize {
        ((self.freshness_bits() + self.mac_bits()) / 8) as usize
    }
}

/// Authentication of one message, without the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Authentication {
    pub profile: Profile,
    /// Unique among the messages of one key.
    pub data_id: u16,
}

/// Input of an authenticator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MacInput {
    bytes: [u8; MAX_INPUT],
    len: usize,
}

impl MacInput {
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Authentication {
    /// Input of the authenticator; `None` = the payload is too short or too long.
    pub fn mac_input(&self, payload: &[u8], freshness: u64) -> Option<MacInput> {
        let data = payload.get(..payload.len().checked_sub(self.profile.trailer_bytes())?)?;
        let mut input = MacInput { bytes: [0; MAX_INPUT], len: 0 };
        for part in [&self.data_id.to_be_bytes()[..], data, &freshness.to_be_bytes()] {
            input.bytes.get_mut(input.len..input.len + part.len())?.copy_from_slice(part);
            input.len += part.len();
        }
        Some(input)
    }

    /// Low bits of the freshness in a payload; `None` = the payload is too short.
    pub fn sent_freshness(&self, payload: &[u8]) -> Option<u64> {
        let trailer = self.trailer(payload)?;
        u64::try_from(trailer >> self.profile.mac_bits()).ok()
    }

    /// Writes the freshness, and zeros as the authenticator.
    pub fn write_freshness(&self, payload: &mut [u8], freshness: u64) {
        self.write_trailer(payload, u128::from(freshness & self.freshness_mask()) << self.profile.mac_bits());
    }

    /// Writes the authenticator after the freshness.
    pub fn write_mac(&self, payload: &mut [u8], mac: Mac) {
        if let Some(trailer) = self.trailer(payload) {
            let bits = self.profile.mac_bits();
            self.write_trailer(payload, trailer >> bits << bits | self.first_bits(mac));
        }
    }

    /// Whether the payload carries the first bits of `mac`. The comparison takes constant time.
    pub fn has_mac(&self, payload: &[u8], mac: Mac) -> bool {
        let sent_bits = (1 << self.profile.mac_bits()) - 1;
        // Compare whole words, so that the time does not depend on the position of a difference.
        self.trailer(payload)
            .is_some_and(|trailer| std::hint::black_box(trailer & sent_bits ^ self.first_bits(mac)) == 0)
    }

    pub(super) const fn freshness_mask(&self) -> u64 {
        (1 << self.profile.freshness_bits()) - 1
    }

    const fn first_bits(&self, mac: Mac) -> u128 {
        // A complete authenticator has 128 bits.
        u128::from_be_bytes(mac) >> (128 - self.profile.mac_bits())
    }

    fn trailer(&self, payload: &[u8]) -> Option<u128> {
        let start = payload.len().checked_sub(self.profile.trailer_bytes())?;
        Some(payload.get(start..)?.iter().fold(0, |number, byte| number << 8 | u128::from(*byte)))
    }

    fn write_trailer(&self, payload: &mut [u8], trailer: u128) {
        let bytes = self.profile.trailer_bytes();
        let Some(start) = payload.len().checked_sub(bytes) else { return };
        let all = trailer.to_be_bytes();
        payload[start..].copy_from_slice(&all[all.len() - bytes..]);
    }
}

/// Maximum number of freshness values that one payload can stand for. The receiver accepts at most 32 values (two
/// announcements of 16), and profile 3 sends only 4 bits (16 codes).
const MAX_CANDIDATES: usize = 2;

/// The possible freshness values of a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MacCheck {
    authentication: Authentication,
    candidates: [Option<u64>; MAX_CANDIDATES],
}

impl MacCheck {
    /// The freshness with which the authenticator of `payload` is correct. `mac` computes AES-128-CMAC.
    pub fn verify(&self, payload: &[u8], mac: impl Fn(&[u8]) -> Mac) -> Option<u64> {
        let is_right = |freshness: &u64| {
            let input = self.authentication.mac_input(payload, *freshness);
            input.is_some_and(|input| self.authentication.has_mac(payload, mac(input.bytes())))
        };
        self.candidates.into_iter().flatten().find(is_right)
    }

    /// Whether no freshness value is possible.
    pub fn is_empty(&self) -> bool {
        self.candidates.iter().all(Option::is_none)
    }

    /// Whether this freshness value is possible.
    pub fn has(&self, freshness: u64) -> bool {
        self.candidates.contains(&Some(freshness))
    }
}

#[cfg(test)]
mod tests;
