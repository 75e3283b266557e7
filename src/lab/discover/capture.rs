//! Stores the frames and diagnostic answers of a log within a memory limit.
//!
//! All frames are kept until they exceed [`MAX_BYTES`]. Then whole windows of [`WINDOW_S`] are dropped: first every
//! second window, then three of four, and so on. All identifiers keep the same windows, so that the pages of
//! multiplexed messages stay complete. Answers are reassembled from all frames, including those in dropped windows. If
//! the answers of one kind exceed [`MAX_ANSWER_BYTES`], every second answer is dropped.

use std::collections::BTreeMap;

use crate::can::isotp::{Progress, Receiver};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Timestamp};

/// Maximum number of bytes of frames that are kept: about two million classic frames.
const MAX_BYTES: usize = 48 << 20;
/// Maximum number of bytes kept per kind of answer: about 800 answers of 64 bytes.
const MAX_ANSWER_BYTES: usize = 64 << 10;
/// Length of a window (s): long compared with the period of a multiplexer page, and short compared with a drive.
const WINDOW_S: f64 = 2.0;
/// Maximum number of kept messages (identifiers on an interface). A car has a few hundred; a flood of random
/// identifiers has more.
const MAX_MESSAGES: usize = 4096;
/// First data byte of answers from BMW controllers. It shows that addressing is extended, even if no
/// `[[input.diagnostic]]` describes the controller.
const TESTER: u8 = 0xF1;

pub(super) type MessageKey = (BusIndex, CanId);

#[derive(Debug, Default)]
pub(super) struct Payloads {
    /// Times since the first frame of the log (s).
    times: Vec<f64>,
    data: Vec<u8>,
    ends: Vec<usize>,
}

/// Kind of answer: sender, service, and identifier of the values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct AnswerKey {
    pub(super) bus: BusIndex,
    pub(super) response: CanId,
    pub(super) extension: Option<u8>,
    pub(super) service: u8,
    pub(super) identifier: u16,
}

/// A request: time (s), CAN identifier, and the first data byte if addressing is extended.
type HeardRequest = (f64, CanId, Option<u8>);

#[derive(Debug, Default)]
pub(super) struct Answers {
    /// CAN identifier of the requests, and their first data byte if addressing is extended; `None` = no request was
    /// received.
    pub(super) request: Option<(CanId, Option<u8>)>,
    /// Data of the answers, without the service and the identifier that each answer repeats from its request.
    pub(super) payloads: Payloads,
    pub(super) seen: u64,
    stride: u64,
}

#[derive(Debug, Default)]
pub(super) struct Capture {
    pub(super) messages: BTreeMap<MessageKey, Payloads>,
    pub(super) answers: BTreeMap<AnswerKey, Answers>,
    /// Number of frames received, without remote frames.
    pub(super) frames: u64,
    pub(super) ignored: u64,
    receivers: BTreeMap<(MessageKey, Option<u8>), Receiver>,
    requests: BTreeMap<(BusIndex, u8, u16), HeardRequest>,
    start: Option<Timestamp>,
    latest_s: f64,
    bytes: usize,
    /// One of `mask` + 1 windows is kept. Values are 0, 1, 3, 7, ...
    mask: u64,
}

impl Payloads {
    pub(super) fn iter(&self) -> impl Iterator<Item = (f64, &[u8])> {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        let ranges = starts.zip(&self.ends).map(|(start, end)| &self.data[start..*end]);
        self.times.iter().copied().zip(ranges)
    }

    pub(super) fn len(&self) -> usize {
        self.times.len()
    }

    fn push(&mut self, time_s: f64, payload: &[u8]) {
        self.times.push(time_s);
        self.data.extend_from_slice(payload);
        self.ends.push(self.data.len());
    }

    fn retain(&mut self, mut is_kept: impl FnMut(usize, f64) -> bool) {
        let mut kept = Self::default();
        for (index, (time_s, payload)) in self.iter().enumerate() {
            if is_kept(index, time_s) {
                kept.push(time_s, payload);
            }
        }
        *self = kept;
    }

    fn bytes(&self) -> usize {
        self.data.len() + self.times.len() * (size_of::<f64>() + size_of::<usize>())
    }
}

impl Capture {
    pub(super) fn handle(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        if frame.kind() == FrameKind::Remote {
            return;
        }
        let start = *self.start.get_or_insert(time);
        // Seconds since the start of the log, exact to a microsecond even over centuries.
        let time_s = time.nanos().saturating_sub(start.nanos()) as f64 * 1e-9;
        self.latest_s = self.latest_s.max(time_s);
        self.frames += 1;
        let key = (bus, frame.id());
        if !self.messages.contains_key(&key) && self.messages.len() >= MAX_MESSAGES {
            self.ignored += 1;
            return;
        }
        if window(time_s) & self.mask == 0 {
            self.bytes += frame.data().len() + size_of::<f64>() + size_of::<usize>();
            self.messages.entry(key).or_default().push(time_s, frame.data());
        }
        if self.bytes > MAX_BYTES {
            self.thin();
        }
        self.receive(time, time_s, key, frame.data());
    }

    pub(super) fn seconds(&self) -> f64 {
        self.latest_s
    }

    fn thin(&mut self) {
        self.mask = self.mask << 1 | 1;
        let mask = self.mask;
        self.messages.values_mut().for_each(|payloads| payloads.retain(|_, time_s| window(time_s) & mask == 0));
        self.bytes = self.messages.values().map(Payloads::bytes).sum();
    }

    fn receive(&mut self, time: Timestamp, time_s: f64, key: MessageKey, data: &[u8]) {
        // A BMW tester sends requests from 6F1, with the target in the first byte. The first byte of an answer names
        // the tester.
        let is_extended = |byte: &u8| *byte == TESTER || key.1 == CanId::Standard(0x600 | u16::from(TESTER));
        let extensions = [None, data.first().copied().filter(is_extended)];
        for (index, extension) in extensions.into_iter().enumerate() {
            if index > 0 && extension.is_none() {
                continue;
            }
            // Only single, first and consecutive frames contain parts of a message.
            let control = data.get(usize::from(extension.is_some())).copied().unwrap_or(u8::MAX);
            if control >> 4 > 2 {
                continue;
            }
            let receiver = self.receivers.entry((key, extension)).or_insert_with(|| Receiver::new(extension));
            if receiver.handle(time, data).progress == Progress::Complete {
                let message = receiver.message().to_vec();
                self.message(time_s, key, extension, &message, control >> 4 == 2);
            }
        }
    }

    fn message(&mut self, time_s: f64, key: MessageKey, extension: Option<u8>, message: &[u8], is_long: bool) {
        let (bus, id) = key;
        let Some((&first, rest)) = message.split_first() else { return };
        let identifier = |service: u8| match (service, rest) {
            (0x01 | 0x21, [one, ..]) => Some((u16::from(*one), 1)),
            (0x22, [high, low, ..]) => Some((u16::from_be_bytes([*high, *low]), 2)),
            _ => None,
        };
        if let Some((number, length)) = identifier(first)
            && rest.len() == length
        {
            self.requests.insert((bus, first, number), (time_s, id, extension));
            return;
        }
        let service = first.wrapping_sub(0x40);
        let Some((number, length)) = identifier(service) else { return };
        let request = self.requests.get(&(bus, service, number));
        // The largest P2* of ISO 14229-2 (time until an answer) is 5 s.
        let request = request.filter(|(at, _, _)| time_s - at <= 5.0).map(|(_, id, first)| (*id, *first));
        let key = AnswerKey { bus, response: id, extension, service, identifier: number };
        // Without a request, a single frame may be any message that starts with the same bytes.
        let is_known = self.answers.contains_key(&key) || is_long || request.is_some();
        if is_known && (self.answers.contains_key(&key) || self.answers.len() < 1024) {
            self.answers.entry(key).or_default().push(time_s, request, &rest[length..]);
        }
    }
}

impl Answers {
    fn push(&mut self, time_s: f64, request: Option<(CanId, Option<u8>)>, data: &[u8]) {
        self.request = self.request.or(request);
        self.stride = self.stride.max(1);
        if self.seen.is_multiple_of(self.stride) {
            self.payloads.push(time_s, data);
        }
        self.seen += 1;
        if self.payloads.bytes() > MAX_ANSWER_BYTES && self.payloads.len() > 1 {
            self.stride *= 2;
            self.payloads.retain(|index, _| index % 2 == 0);
        }
    }
}

/// Returns the number of a time's window. Times before the first stamp belong to window 0.
fn window(time_s: f64) -> u64 {
    (time_s / WINDOW_S) as u64
}
