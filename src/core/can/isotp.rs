//! ISO-TP (ISO 15765-2): reassembles messages of up to 65,535 bytes from single, first and consecutive frames, and
//! segments them.
//!
//! In: payloads of one sender's frames with their times. Out: complete messages, and the faults of lost messages.
//! Supports normal and extended addressing with classic frames. Reassembly also supports CAN FD (length escapes). A
//! [`Receiver`] only listens, because the diagnostic tester sends flow control. It stores only the bytes that have
//! arrived.

use crate::quantity::Timestamp;

/// Longest time between two frames of a message, ns (N_Cr of ISO 15765-2, 1 s).
pub const FRAME_TIMEOUT_NS: i64 = 1_000_000_000;

/// Longest message, bytes. Lengths above 4,095 use the escape of ISO 15765-2:2016.
pub const MAX_MESSAGE: usize = 65_535;

/// Flow control that allows all frames at once, without a pause.
pub(crate) const FLOW_CONTROL: [u8; 3] = [0x30, 0, 0];

const CLASSIC: usize = 8;

/// Reason why a message is lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IsoTpFault {
    /// A frame is missing, duplicated or out of order.
    WrongSequence,
    /// The next frame did not arrive within a second.
    Timeout,
    /// Another message started too early: there are two senders, or the sender gave up.
    Overlap,
    /// Flow control refused the message (buffer overflow, reserved state).
    Refused,
    /// The length is 0, or exceeds the single frame that states it, or is so small that the message would fit into a
    /// single frame although a first frame states it. Also used for a first frame that is not full.
    WrongLength,
    /// Longer than [`MAX_MESSAGE`].
    TooLong,
    /// A consecutive frame is shorter than the first frame and does not complete the message.
    ShortFrame,
    /// A consecutive frame that no first frame preceded.
    NotBegun,
}

impl IsoTpFault {
    /// All faults, in the order of counts.
    pub const ALL: [Self; 8] = [
        Self::WrongSequence,
        Self::Timeout,
        Self::Overlap,
        Self::Refused,
        Self::WrongLength,
        Self::TooLong,
        Self::ShortFrame,
        Self::NotBegun,
    ];

    /// Description for logs and status.
    pub fn words(self) -> &'static str {
        match self {
            Self::WrongSequence => "wrong sequence",
            Self::Timeout => "consecutive frame missing",
            Self::Overlap => "interrupted by another message",
            Self::Refused => "refused by flow control",
            Self::WrongLength => "impossible length",
            Self::TooLong => "too long",
            Self::ShortFrame => "short frame",
            Self::NotBegun => "consecutive frame without a first one",
        }
    }
}

/// Outcome of a frame. A frame can interrupt one message and complete another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Received {
    /// Why a message was lost.
    pub fault: Option<IsoTpFault>,
    /// Effect on the frame's own message.
    pub progress: Progress,
}

/// Effect of a frame on a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Progress {
    /// The frame does not belong to a message, or its message was lost.
    #[default]
    None,
    Begun,
    Continued,
    /// [`Receiver::message`] returns the completed message.
    Complete,
}

/// Reassembles the messages of one sender.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Receiver {
    /// Address byte that begins every payload with extended addressing; `None` = normal addressing.
    extension: Option<u8>,
    message: Vec<u8>,
    /// 0 = no message.
    length: usize,
    /// Next sequence number, 0 to 15.
    next: u8,
    /// Length of the first frame (RX_DL), without the address byte.
    frame_len: usize,
    latest: Timestamp,
    /// Whether the remaining frames of a lost message are ignored.
    is_discarding: bool,
}

impl Receiver {
    /// Creates a receiver that waits for its first frame.
    pub fn new(extension: Option<u8>) -> Self {
        let latest = Timestamp::from_nanos(0);
        Self { extension, message: Vec::new(), length: 0, next: 0, frame_len: 0, latest, is_discarding: false }
    }

    /// The message that the latest frame completed.
    pub fn message(&self) -> &[u8] {
        &self.message
    }

    /// Resumes from `stored`. Drops a stored partial message that is impossible.
    pub fn resume(&mut self, stored: &Self) {
        let is_possible = stored.message.len() < stored.length
            && stored.length <= MAX_MESSAGE
            && (2..=64).contains(&stored.frame_len)
            && stored.next < 16;
        let (is_discarding, extension) = (stored.is_discarding, self.extension);
        *self = if is_possible { stored.clone() } else { Self { is_discarding, ..Self::new(extension) } };
        self.extension = extension;
    }

    /// Whether a message is being received.
    pub fn is_receiving(&self) -> bool {
        self.length > 0
    }

    /// Handles the payload of a received frame.
    pub fn handle(&mut self, now: Timestamp, payload: &[u8]) -> Received {
        let late = self.poll(now);
        let Some(data) = without_extension(self.extension, payload) else { return Received::lost(late) };
        let received = match data {
            [control, ..] => match control >> 4 {
                0x0 => self.single(data),
                0x1 => self.first(now, data),
                0x2 => self.consecutive(now, control & 0xF, &data[1..]),
                _ => Received::default(), // Flow control and reserved types do not belong to a message.
            },
            [] => Received::default(),
        };
        Received { fault: late.or(received.fault), ..received }
    }

    /// Handles a flow control frame. A refusal ends the message that is being received.
    pub fn handle_flow_control(&mut self, extension: Option<u8>, payload: &[u8]) -> Option<IsoTpFault> {
        let control = *without_extension(extension, payload)?.first()?;
        let is_refusal = control >> 4 == 0x3 && !matches!(control & 0xF, 0 | 1);
        (is_refusal && self.is_receiving()).then(|| self.drop_message(IsoTpFault::Refused))
    }

    /// Drops a message whose next frame is overdue.
    pub fn poll(&mut self, now: Timestamp) -> Option<IsoTpFault> {
        let is_late = self.is_receiving() && now.nanos().saturating_sub(self.latest.nanos()) > FRAME_TIMEOUT_NS;
        is_late.then(|| self.drop_message(IsoTpFault::Timeout))
    }

    /// Drops a partial message without a fault, because frames may have been missed.
    pub fn restart(&mut self) {
        (self.length, self.is_discarding) = (0, true);
    }

    fn drop_message(&mut self, fault: IsoTpFault) -> IsoTpFault {
        (self.length, self.is_discarding) = (0, true);
        fault
    }

    /// Returns the fault of the message that is interrupted.
    fn begin(&mut self) -> Option<IsoTpFault> {
        let overlap = self.is_receiving().then_some(IsoTpFault::Overlap);
        (self.length, self.is_discarding) = (0, false);
        overlap
    }

    fn single(&mut self, data: &[u8]) -> Received {
        let overlap = self.begin();
        // If the frame has more than 8 bytes, the length is in the second byte.
        let (length, body) = match (data[0] & 0xF, data) {
            (0, [_, length, body @ ..]) if body.len() + 2 > self.classic_len() => (usize::from(*length), body),
            (length, [_, body @ ..]) => (usize::from(length), body),
            (_, []) => (0, data),
        };
        match body.get(..length).filter(|body| !body.is_empty()) {
            Some(body) => {
                self.message.clear();
                self.message.extend_from_slice(body);
                Received { fault: overlap, progress: Progress::Complete }
            }
            None => Received::lost(overlap.or(Some(IsoTpFault::WrongLength))),
        }
    }

    fn first(&mut self, now: Timestamp, data: &[u8]) -> Received {
        let overlap = self.begin();
        let (length, body) = match *data {
            [0x10, 0, a, b, c, d, ref body @ ..] => (u32::from_be_bytes([a, b, c, d]), body),
            [high, low, ref body @ ..] => (u32::from(high & 0xF) << 8 | u32::from(low), body),
            _ => (0, data),
        };
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        // A message that fits into one frame must not have a first frame, and a first frame must be full.
        let fault = if length <= body.len() || data.len() < self.classic_len() {
            Some(IsoTpFault::WrongLength)
        } else {
            (length > MAX_MESSAGE).then_some(IsoTpFault::TooLong)
        };
        if fault.is_some() {
            self.is_discarding = true;
            return Received::lost(overlap.or(fault));
        }
        self.message.clear();
        self.message.extend_from_slice(body);
        (self.length, self.next, self.frame_len, self.latest) = (length, 1, data.len(), now);
        Received { fault: overlap, progress: Progress::Begun }
    }

    fn consecutive(&mut self, now: Timestamp, number: u8, body: &[u8]) -> Received {
        if !self.is_receiving() {
            let is_known = std::mem::replace(&mut self.is_discarding, true);
            return Received::lost((!is_known).then_some(IsoTpFault::NotBegun));
        }
        if number != self.next {
            return Received::lost(Some(self.drop_message(IsoTpFault::WrongSequence)));
        }
        let wanted = (self.length - self.message.len()).min(self.frame_len - 1);
        let Some(body) = body.get(..wanted) else {
            return Received::lost(Some(self.drop_message(IsoTpFault::ShortFrame)));
        };
        self.message.extend_from_slice(body);
        (self.next, self.latest) = ((self.next + 1) % 16, now);
        if self.message.len() < self.length {
            return Received { fault: None, progress: Progress::Continued };
        }
        self.length = 0;
        Received { fault: None, progress: Progress::Complete }
    }

    /// Length of a full classic frame, without the address byte.
    fn classic_len(&self) -> usize {
        CLASSIC - usize::from(self.extension.is_some())
    }
}

impl Received {
    fn lost(fault: Option<IsoTpFault>) -> Self {
        Self { fault, progress: Progress::None }
    }
}

/// The payload after the address byte `extension`. `None` = the payload is empty or begins with another address.
fn without_extension(extension: Option<u8>, payload: &[u8]) -> Option<&[u8]> {
    match extension {
        None => Some(payload),
        Some(extension) => payload.split_first().filter(|(first, _)| **first == extension).map(|(_, data)| data),
    }
}

/// Segments a message into classic payloads, padded with `padding` (ISO 15765-2 recommends 0xCC; cars also send 0x00,
/// 0x55 and 0xAA). The result is empty for a message of 0 bytes or of more than 4,095.
pub fn segment(extension: Option<u8>, message: &[u8], padding: u8) -> Vec<[u8; CLASSIC]> {
    let room = CLASSIC - usize::from(extension.is_some());
    let Ok(length) = u16::try_from(message.len()) else { return Vec::new() };
    let frame = |control: &[u8], body: &[u8]| {
        let mut payload = [padding; CLASSIC];
        let bytes = extension.iter().chain(control).chain(body);
        payload.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        payload
    };
    match length {
        0 | 4096.. => Vec::new(),
        _ if message.len() < room => vec![frame(&[length.to_le_bytes()[0]], message)],
        _ => {
            let [high, low] = length.to_be_bytes();
            let (begin, rest) = message.split_at(room - 2);
            let numbers = (1..=15_u8).chain([0]).cycle();
            let consecutive = rest.chunks(room - 1).zip(numbers).map(|(body, number)| frame(&[0x20 | number], body));
            std::iter::once(frame(&[0x10 | high, low], begin)).chain(consecutive).collect()
        }
    }
}

#[cfg(test)]
mod tests;
