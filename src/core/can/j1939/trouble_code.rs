//! Trouble codes, lamps, and the common payload of DM1 and DM2 (layout: J1939-73).
//!
//! ```text
//! byte 0      lamps, 2 bits each: malfunction, red stop, amber warning, protect (00 off, 01 on, 11 not available)
//! byte 1      flashing of the same lamps: 11 = does not flash
//! per code    SPN 7..0 | SPN 15..8 | SPN 18..16 and FMI | occurrence count
//! ```
//! A message without codes has four zero bytes instead of the codes. A message with at most one code is padded with
//! 0xFF to 8 bytes. SPN is the suspect parameter number, and FMI the failure mode identifier. The highest bit of an
//! occurrence count is the conversion method. packwatch never sets it, because a receiver could then not tell three
//! older layouts of the SPN apart.

use serde::{Deserialize, Serialize};

use super::name::OutOfRange;

/// Maximum number of codes in one message. 27 codes are 110 bytes in 16 packets. The packets are sent every 50 ms, each
/// up to one tick of 10 ms late. A transfer therefore ends within 0.96 s, before the next DM1 is due. packwatch's 18
/// alarm rules need only 18 codes if the thresholds of each rule share a parameter number, because then only the most
/// severe threshold is sent.
pub const MAX_CODES: usize = 27;

pub(super) const MAX_PAYLOAD: usize = 2 + 4 * MAX_CODES;

/// 19 bits.
const MAX_SPN: u32 = (1 << 19) - 1;
/// 5 bits.
const MAX_FMI: u8 = 31;
/// 127 means "not available", so counting stops at 126.
const MAX_OCCURRENCES: u8 = 126;

/// A failure and its number of occurrences.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct TroubleCode {
    spn: u32,
    fmi: u8,
    occurrence_count: u8,
}

impl TroubleCode {
    /// Creates a code. The count saturates at 126. Fails if a number does not fit its bits, or if the SPN is 0, which
    /// would mean "no code".
    pub fn new(spn: u32, fmi: u8, occurrence_count: u32) -> Result<Self, OutOfRange> {
        if !(1..=MAX_SPN).contains(&spn) {
            return Err(OutOfRange { field: "spn", found: spn.into(), lowest: 1, highest: MAX_SPN.into() });
        }
        if fmi > MAX_FMI {
            return Err(OutOfRange { field: "fmi", found: fmi.into(), lowest: 0, highest: MAX_FMI.into() });
        }
        Ok(Self { spn, fmi, occurrence_count: 0 }.with_occurrences(occurrence_count))
    }

    /// The same code with another count, saturated at 126.
    #[must_use]
    pub fn with_occurrences(self, count: u32) -> Self {
        let occurrence_count = u8::try_from(count).unwrap_or(MAX_OCCURRENCES).min(MAX_OCCURRENCES);
        Self { occurrence_count, ..self }
    }

    /// Suspect parameter number: the failed part, 1 to 524,287.
    pub const fn spn(self) -> u32 {
        self.spn
    }

    /// Failure mode identifier: the kind of failure, 0 to 31.
    pub const fn fmi(self) -> u8 {
        self.fmi
    }

    /// Number of occurrences; 126 = 126 or more.
    pub const fn occurrence_count(self) -> u8 {
        self.occurrence_count
    }

    /// Whether the two codes report the same failure, regardless of their counts.
    pub const fn is_same_failure(self, other: Self) -> bool {
        self.spn == other.spn && self.fmi == other.fmi
    }

    fn to_bytes(self) -> [u8; 4] {
        let [low, middle, high, _] = self.spn.to_le_bytes();
        [low, middle, (high << 5) | self.fmi, self.occurrence_count]
    }
}

/// The lamp of a code, least severe first. The malfunction lamp is only for emissions, so it is not included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lamp {
    None,
    /// A fault outside the electronics.
    Protect,
    /// Service is needed, but the vehicle need not stop.
    Amber,
    /// The driver must stop the vehicle.
    Red,
}

/// State of a lamp; the values are the wire codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[repr(u8)]
pub enum LampState {
    #[default]
    Off = 0b00,
    On = 0b01,
    NotAvailable = 0b11,
}

/// The lamps of a message. The malfunction lamp is always off, because packwatch does not monitor emissions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Lamps {
    pub protect: LampState,
    pub amber: LampState,
    pub red: LampState,
}

impl Lamps {
    /// The lamps for active codes. If `all_known` is false, a lamp that no code lights is "not available" instead of
    /// off, because an unknown state must not look healthy.
    pub fn of(lit: impl IntoIterator<Item = Lamp>, all_known: bool) -> Self {
        let dark = if all_known { LampState::Off } else { LampState::NotAvailable };
        let mut lamps = Self { protect: dark, amber: dark, red: dark };
        for lamp in lit {
            match lamp {
                Lamp::None => {}
                Lamp::Protect => lamps.protect = LampState::On,
                Lamp::Amber => lamps.amber = LampState::On,
                Lamp::Red => lamps.red = LampState::On,
            }
        }
        lamps
    }

    fn to_byte(self) -> u8 {
        (self.red as u8) << 4 | (self.amber as u8) << 2 | self.protect as u8
    }
}

/// The payload of a DM1 or DM2: 8 bytes, or more for a transfer in packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "Vec<u8>", from = "Vec<u8>")]
pub struct DmPayload {
    bytes: [u8; MAX_PAYLOAD],
    len: usize,
    pub left_out: usize,
}

impl DmPayload {
    pub fn as_slice(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or(&self.bytes)
    }
}

impl From<DmPayload> for Vec<u8> {
    fn from(payload: DmPayload) -> Self {
        payload.as_slice().to_vec()
    }
}

/// Bytes beyond [`MAX_PAYLOAD`] are dropped.
impl From<Vec<u8>> for DmPayload {
    fn from(stored: Vec<u8>) -> Self {
        let mut bytes = [0xFF; MAX_PAYLOAD];
        bytes.iter_mut().zip(&stored).for_each(|(place, byte)| *place = *byte);
        Self { bytes, len: stored.len().min(MAX_PAYLOAD), left_out: 0 }
    }
}

/// Payload with lamps and at most the first [`MAX_CODES`] codes. The caller must pass the most severe codes first.
pub fn dm_payload(lamps: Lamps, codes: &[TroubleCode]) -> DmPayload {
    let mut bytes = [0xFF; MAX_PAYLOAD];
    bytes[0] = lamps.to_byte();
    // No lamp flashes.
    bytes[1] = 0xFF;
    let taken = codes.len().min(MAX_CODES);
    if taken == 0 {
        bytes[2..6].fill(0);
    }
    for (place, code) in bytes[2..].chunks_exact_mut(4).zip(codes) {
        place.copy_from_slice(&code.to_bytes());
    }
    // A single code still fits into a frame.
    let len = if taken < 2 { 8 } else { 2 + 4 * taken };
    DmPayload { bytes, len, left_out: codes.len() - taken }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn code(spn: u32, fmi: u8, count: u32) -> TroubleCode {
        TroubleCode::new(spn, fmi, count).unwrap()
    }

    #[test]
    fn no_code_is_sent_as_four_zero_bytes() {
        let payload = dm_payload(Lamps::of([], true), &[]);
        assert_eq!(payload.as_slice(), [0x00, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
    }

    #[test]
    fn unknown_lamps_are_not_available() {
        let payload = dm_payload(Lamps::of([], false), &[]);
        assert_eq!(payload.as_slice(), [0b00_11_11_11, 0xFF, 0, 0, 0, 0, 0xFF, 0xFF]);
        let lamps = Lamps::of([Lamp::Amber], false);
        assert_eq!(
            dm_payload(lamps, &[code(1, 1, 1)]).as_slice()[0],
            0b00_11_01_11,
            "whether the red lamp is off is unknown"
        );
    }

    #[test]
    fn one_code_fills_a_frame() {
        // SPN 520193 = 0x7F001: 0x01, 0xF0, 0x7 << 5.
        let payload = dm_payload(Lamps::of([Lamp::Amber], true), &[code(520_193, 18, 3)]);
        assert_eq!(payload.as_slice(), [0x04, 0xFF, 0x01, 0xF0, 0xE0 | 18, 3, 0xFF, 0xFF]);
    }

    #[test]
    fn two_codes_are_ten_bytes() {
        let codes = [code(524_287, 1, 126), code(91, 2, 1)];
        let payload = dm_payload(Lamps::of([Lamp::Red, Lamp::None], true), &codes);
        assert_eq!(payload.as_slice(), [0x10, 0xFF, 0xFF, 0xFF, 0xE1, 126, 91, 0, 2, 1]);
    }

    #[test]
    fn five_codes_are_twenty_two_bytes() {
        let codes = [code(1, 0, 1), code(256, 31, 2), code(65_536, 9, 3), code(131_072, 19, 4), code(262_144, 16, 5)];
        let payload = dm_payload(Lamps::of([Lamp::Protect, Lamp::Amber, Lamp::Red], true), &codes);
        let wanted = [0x15, 0xFF, 1, 0, 0, 1, 0, 1, 31, 2, 0, 0, 0x29, 3, 0, 0, 0x53, 4, 0, 0, 0x90, 5];
        assert_eq!(payload.as_slice(), wanted);
    }

    #[test]
    fn malfunction_lamp_is_never_lit() {
        for lamp in [Lamp::None, Lamp::Protect, Lamp::Amber, Lamp::Red] {
            for all_known in [false, true] {
                assert_eq!(dm_payload(Lamps::of([lamp], all_known), &[]).as_slice()[0] >> 6, 0, "{lamp:?}");
            }
        }
    }

    #[test]
    fn occurrence_count_saturates_at_126() {
        let counts = [0, 1, 126, 127, 128, 255, 256, u32::MAX].map(|count| code(1, 0, count).occurrence_count());
        assert_eq!(counts, [0, 1, 126, 126, 126, 126, 126, 126]);
    }

    #[test]
    fn numbers_that_do_not_fit_are_rejected() {
        let refused = |spn, fmi| TroubleCode::new(spn, fmi, 1).unwrap_err().to_string();
        assert_eq!(refused(0, 1), "spn = 0, must be 1 to 524287");
        assert_eq!(refused(524_288, 1), "spn = 524288, must be 1 to 524287");
        assert_eq!(refused(1, 32), "fmi = 32, must be 0 to 31");
    }

    #[test]
    fn codes_beyond_limit_are_counted_as_left_out() {
        let codes: Vec<_> = (1..=30).map(|spn| code(spn, 31, 1)).collect();
        let payload = dm_payload(Lamps::default(), &codes);
        assert_eq!((payload.as_slice().len(), payload.left_out), (110, 3));
        assert_eq!(payload.as_slice()[106], 27, "the message contains the first 27");
    }

    proptest! {
        #[test]
        fn code_round_trips_through_bytes(spn in 1_u32..=524_287, fmi in 0_u8..=31, count in 0_u32..=126) {
            let [a, b, c, d] = code(spn, fmi, count).to_bytes();
            let read = u32::from(a) | u32::from(b) << 8 | u32::from(c >> 5) << 16;
            prop_assert_eq!((read, c & 31, u32::from(d)), (spn, fmi, count));
        }

        #[test]
        fn message_contains_every_code_in_order(
            parts in prop::collection::vec((1_u32..=524_287, 0_u8..=31, 0_u32..=126), 0..=MAX_CODES),
        ) {
            let codes: Vec<_> = parts.into_iter().map(|(spn, fmi, count)| code(spn, fmi, count)).collect();
            let payload = dm_payload(Lamps::default(), &codes);
            let (places, _) = payload.as_slice()[2..].as_chunks::<4>();
            let wanted: Vec<_> = codes.iter().map(|code| code.to_bytes()).collect();
            prop_assert_eq!(&places[..codes.len()], wanted);
        }
    }
}
