//! Receives diagnostic responses over ISO-TP (UDS ISO 14229-1, KWP 2000, OBD ISO 15031-5) and decodes their signals.
//!
//! In: frames with the configured identifiers. Any tester may send the requests. Out: complete responses and their
//! readings ([`Answer::readings`]), and counts per controller ([`ControllerCounts`]). This module sends nothing. It
//! stores one message per configured controller.

use serde::{Deserialize, Serialize};

use super::decode::Binding;
use super::id_table::IdTable;
use super::isotp::{IsoTpFault, Progress, Receiver};
use super::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Channel, Fault, Reading, Timestamp};

/// Added to the service code in a positive response.
const POSITIVE: u8 = 0x40;
/// Negative response code requestCorrectlyReceived-ResponsePending: the response follows later.
pub const PENDING: u8 = 0x78;

/// A read-only service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Service {
    /// Live data of OBD, with an identifier of one byte.
    CurrentData = 0x01,
    /// KWP 2000, with an identifier of one byte.
    ByLocalIdentifier = 0x21,
    /// UDS, with an identifier of two bytes.
    ByIdentifier = 0x22,
}

impl Service {
    /// The service with this code. `None` = another service, which packwatch neither decodes nor requests.
    pub fn from_code(code: u8) -> Option<Self> {
        [Self::CurrentData, Self::ByLocalIdentifier, Self::ByIdentifier].into_iter().find(|s| *s as u8 == code)
    }

    /// Length of an identifier, bytes.
    pub fn identifier_bytes(self) -> usize {
        match self {
            Self::CurrentData | Self::ByLocalIdentifier => 1,
            Self::ByIdentifier => 2,
        }
    }
}

/// A controller on a bus, with the identifiers of its requests and responses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Controller {
    pub bus: BusIndex,
    pub response: CanId,
    /// First data byte of the responses (extended addressing).
    pub response_extension: Option<u8>,
    pub request: CanId,
    /// First data byte of the requests (extended addressing).
    pub request_extension: Option<u8>,
}

/// A diagnostic request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Question {
    pub controller: Controller,
    pub service: Service,
    /// Identifier of the requested value.
    pub identifier: u16,
}

impl Question {
    /// The request message.
    pub fn request(&self) -> Vec<u8> {
        self.message(self.service as u8)
    }

    /// First bytes of the response: service and identifier.
    pub fn answer_head(&self) -> Vec<u8> {
        self.message(self.service as u8 + POSITIVE)
    }

    fn message(&self, first: u8) -> Vec<u8> {
        let identifier = self.identifier.to_be_bytes();
        [&[first], &identifier[2 - self.service.identifier_bytes()..]].concat()
    }
}

/// A signal of a response.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerSignal {
    /// Byte at which the layout starts, after the echoed service and identifier.
    pub first_byte: usize,
    /// The signal, with the interface and identifier of the response frames.
    pub binding: Binding,
}

/// A response to be decoded.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    pub question: Question,
    pub signals: Vec<AnswerSignal>,
}

impl Answer {
    /// Whether a signal's channel satisfies the predicate.
    pub fn has(&self, is_wanted: impl Fn(Channel) -> bool) -> bool {
        self.signals.iter().any(|signal| is_wanted(signal.binding.channel))
    }

    /// Decodes the data after the echoed service and identifier. A signal beyond the end gives a short-frame fault.
    pub fn readings<'a>(&'a self, data: &'a [u8]) -> impl Iterator<Item = Reading> + 'a {
        self.signals.iter().map(move |signal| {
            let bytes = data.get(signal.first_byte..).ok_or(Fault::ShortFrame);
            Reading { channel: signal.binding.channel, value: bytes.and_then(|bytes| signal.binding.value(bytes)) }
        })
    }
}

/// Number of a controller's messages by kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ControllerCounts {
    /// Decoded responses.
    pub read: u64,
    /// Messages with other identifiers or services.
    pub other: u64,
    /// Negative responses, except "response pending".
    pub refused: u64,
    pub pending: u64,
    /// Code of the latest negative response, except "response pending".
    pub latest_refusal: Option<u8>,
    /// Decoded responses that do not answer the latest request, or that arrive more than five seconds after the
    /// request. After "response pending", the five seconds start again.
    pub unasked: u64,
    /// Number of lost messages by fault. Indexed like [`IsoTpFault::ALL`].
    pub lost: [u64; IsoTpFault::ALL.len()],
}

impl ControllerCounts {
    /// Difference from the earlier counts `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        Self {
            read: self.read.saturating_sub(before.read),
            other: self.other.saturating_sub(before.other),
            refused: self.refused.saturating_sub(before.refused),
            pending: self.pending.saturating_sub(before.pending),
            latest_refusal: self.latest_refusal,
            unasked: self.unasked.saturating_sub(before.unasked),
            lost: std::array::from_fn(|fault| self.lost[fault].saturating_sub(before.lost[fault])),
        }
    }

    /// Faults with at least one lost message.
    pub fn losses(&self) -> impl Iterator<Item = (IsoTpFault, u64)> + '_ {
        IsoTpFault::ALL.into_iter().zip(self.lost).filter(|(_, count)| *count > 0)
    }

    /// Total number of lost messages.
    pub fn lost_in_all(&self) -> u64 {
        self.lost.iter().fold(0, |sum, count| sum.saturating_add(*count))
    }
}

/// Reports that messages of a controller were lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageLoss {
    pub bus: BusIndex,
    /// Identifier of the controller's responses.
    pub id: CanId,
    /// Fault of the latest lost message.
    pub fault: IsoTpFault,
    /// Number of lost messages so far.
    pub lost: u64,
}

/// A negative response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal {
    /// The requested service.
    pub service: u8,
    /// ISO 14229-1, table A.1; [`PENDING`] = the response follows later.
    pub code: u8,
}

/// Result of a frame. `controller` is an index in [`Listener::counts`].
#[derive(Debug, PartialEq)]
pub enum FrameOutcome<'a> {
    Nothing,
    /// The frame starts a response, whose values count as measured when this frame arrives.
    Begun {
        controller: usize,
    },
    /// The frame continues a response.
    Continued {
        controller: usize,
    },
    /// A negative response.
    Refused {
        controller: usize,
        refusal: Refusal,
    },
    /// A complete response.
    Whole {
        controller: usize,
        answer: &'a Answer,
        /// Data after the echoed service and identifier.
        data: &'a [u8],
        /// Whether the response is a single frame, without a preceding [`FrameOutcome::Begun`].
        is_single: bool,
    },
}

#[derive(Debug, Clone)]
struct Link {
    controller: Controller,
    receiver: Receiver,
    counts: ControllerCounts,
    /// First bytes of the response to the latest request, and the time of the request or of the latest "response
    /// pending".
    asked: Option<([u8; 3], Timestamp)>,
    reported_at: Option<Timestamp>,
}

/// Partial response of one controller, from which the monitor resumes without a gap.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkProgress {
    controller: Controller,
    receiver: Receiver,
    asked: Option<([u8; 3], Timestamp)>,
    reported_at: Option<Timestamp>,
}

/// Receives the responses of all configured controllers.
#[derive(Debug, Clone, Default)]
pub struct Listener {
    /// Sorted by question.
    answers: Vec<Answer>,
    /// Sorted by controller.
    links: Vec<Link>,
    ids: IdTable,
    id_count: usize,
    pub(crate) losses: Vec<MessageLoss>,
}

impl Listener {
    /// Creates a listener. Answers with the same request are merged.
    pub fn new(answers: &[Answer]) -> Self {
        let mut sorted: Vec<Answer> = Vec::new();
        for answer in answers {
            match sorted.iter_mut().find(|other| other.question == answer.question) {
                Some(other) => other.signals.extend(answer.signals.iter().cloned()),
                None => sorted.push(answer.clone()),
            }
        }
        sorted.sort_by_key(|answer| answer.question);
        for answer in &mut sorted {
            // Sort the current before the voltages, because the voltage samples use the current.
            answer.signals.sort_by_key(|signal| signal.binding.channel);
        }
        let mut controllers: Vec<Controller> = sorted.iter().map(|answer| answer.question.controller).collect();
        controllers.dedup();
        let ids = wanted(&sorted);
        let link = |controller: Controller| Link {
            controller,
            receiver: Receiver::new(controller.response_extension),
            counts: ControllerCounts::default(),
            asked: None,
            reported_at: None,
        };
        Self {
            losses: Vec::with_capacity(controllers.len() + 1),
            links: controllers.into_iter().map(link).collect(),
            ids: IdTable::new(ids.iter().copied()),
            id_count: ids.len(),
            answers: sorted,
        }
    }

    /// Whether no response is configured.
    pub fn is_empty(&self) -> bool {
        self.links.is_empty()
    }

    /// The controllers and their counts.
    pub fn counts(&self) -> impl Iterator<Item = (Controller, ControllerCounts)> + '_ {
        self.links.iter().map(|link| (link.controller, link.counts))
    }

    /// Restores stored counts; ignores counts of other controllers.
    pub fn restore(&mut self, counts: impl Iterator<Item = (Controller, ControllerCounts)>) {
        for (controller, counts) in counts {
            if let Some(link) = self.links.iter_mut().find(|link| link.controller == controller) {
                link.counts = counts;
            }
        }
    }

    /// Partial responses, to store.
    pub fn progress(&self) -> Vec<LinkProgress> {
        let of = |link: &Link| LinkProgress {
            controller: link.controller,
            receiver: link.receiver.clone(),
            asked: link.asked,
            reported_at: link.reported_at,
        };
        self.links.iter().map(of).collect()
    }

    /// Restores stored partial responses.
    pub fn resume(&mut self, stored: &[LinkProgress]) {
        for link in &mut self.links {
            if let Some(of) = stored.iter().find(|of| of.controller == link.controller) {
                link.receiver.resume(&of.receiver);
                (link.asked, link.reported_at) = (of.asked, of.reported_at);
            }
        }
    }

    /// Drops partial messages and requests.
    pub fn restart(&mut self) {
        for link in &mut self.links {
            link.receiver.restart();
            link.asked = None;
        }
    }

    /// Drops messages whose next frame is overdue.
    pub fn poll(&mut self, now: Timestamp) {
        for link in &mut self.links {
            let fault = link.receiver.poll(now);
            link.note(now, fault, &mut self.losses);
        }
    }

    /// Handles a received frame.
    #[inline]
    pub fn handle(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> FrameOutcome<'_> {
        if self.links.is_empty() || self.ids.number(bus, frame.id()) >= self.id_count {
            return FrameOutcome::Nothing;
        }
        self.handle_wanted(now, bus, frame)
    }

    fn handle_wanted(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> FrameOutcome<'_> {
        if frame.kind() == FrameKind::Remote {
            return FrameOutcome::Nothing;
        }
        let mut outcome = None;
        for (index, link) in self.links.iter_mut().enumerate().filter(|(_, link)| link.controller.bus == bus) {
            if link.controller.request == frame.id() {
                let fault = link.handle_request(now, frame.data());
                link.note(now, fault, &mut self.losses);
            }
            if link.controller.response == frame.id() {
                let was_receiving = link.receiver.is_receiving();
                let received = link.receiver.handle(now, frame.data());
                link.note(now, received.fault, &mut self.losses);
                match received.progress {
                    Progress::Begun => outcome = Some((index, Progress::Begun, false)),
                    Progress::Complete => {
                        outcome = Some((index, Progress::Complete, !was_receiving || received.fault.is_some()))
                    }
                    Progress::Continued => outcome = Some((index, Progress::Continued, false)),
                    Progress::None => {}
                }
            }
        }
        match outcome {
            Some((controller, Progress::Begun, _)) => FrameOutcome::Begun { controller },
            Some((controller, Progress::Continued, _)) => FrameOutcome::Continued { controller },
            Some((controller, Progress::Complete, is_single)) => self.whole(now, controller, is_single),
            Some((_, Progress::None, _)) | None => FrameOutcome::Nothing,
        }
    }

    fn whole(&mut self, now: Timestamp, controller: usize, is_single: bool) -> FrameOutcome<'_> {
        let Self { answers, links, .. } = self;
        let Some(link) = links.get_mut(controller) else { return FrameOutcome::Nothing };
        let message = link.receiver.message();
        // Negative response (ISO 14229-1, table A.1).
        if let &[0x7F, service, code, ..] = message {
            if code == PENDING {
                link.counts.pending = link.counts.pending.saturating_add(1);
                link.asked = link.asked.map(|(head, _)| (head, now));
            } else {
                link.counts.refused = link.counts.refused.saturating_add(1);
                link.counts.latest_refusal = Some(code);
            }
            return FrameOutcome::Refused { controller, refusal: Refusal { service, code } };
        }
        let is_own = |answer: &&Answer| {
            answer.question.controller == link.controller && message.starts_with(&answer.question.answer_head())
        };
        let Some(answer) = answers.iter().find(is_own) else {
            link.counts.other = link.counts.other.saturating_add(1);
            return FrameOutcome::Nothing;
        };
        let head = answer.question.answer_head();
        link.counts.read = link.counts.read.saturating_add(1);
        let is_asked = link.asked.is_some_and(|(asked, at)| {
            // In ns: the longest P2* of ISO 14229-2.
            asked.starts_with(&head) && now.nanos().saturating_sub(at.nanos()) <= 5_000_000_000
        });
        link.counts.unasked = link.counts.unasked.saturating_add(u64::from(!is_asked));
        FrameOutcome::Whole { controller, answer, data: &link.receiver.message()[head.len()..], is_single }
    }
}

impl Link {
    /// Handles a frame to the controller: a request or flow control.
    fn handle_request(&mut self, now: Timestamp, payload: &[u8]) -> Option<IsoTpFault> {
        let extension = self.controller.request_extension;
        let mut request = Receiver::new(extension);
        if request.handle(now, payload).progress == Progress::Complete {
            let mut head = [0; 3];
            head.iter_mut().zip(request.message()).for_each(|(place, byte)| *place = *byte);
            head[0] = head[0].wrapping_add(POSITIVE);
            self.asked = Some((head, now));
        }
        self.receiver.handle_flow_control(extension, payload)
    }

    /// Counts a loss, and reports it at most once a minute.
    fn note(&mut self, now: Timestamp, fault: Option<IsoTpFault>, losses: &mut Vec<MessageLoss>) {
        let Some(fault) = fault else { return };
        let place = IsoTpFault::ALL.iter().position(|other| *other == fault);
        if let Some(count) = place.and_then(|place| self.counts.lost.get_mut(place)) {
            *count = count.saturating_add(1);
        }
        // A minute, in ns.
        if self.reported_at.is_none_or(|at| now.nanos().saturating_sub(at.nanos()) >= 60_000_000_000) {
            self.reported_at = Some(now);
            let Controller { bus, response: id, .. } = self.controller;
            losses.push(MessageLoss { bus, id, fault, lost: self.counts.lost_in_all() });
        }
    }
}

/// Identifiers to receive: those of the responses, and those of the requests, which show whether a response was
/// requested.
pub fn wanted(answers: &[Answer]) -> Vec<(BusIndex, CanId)> {
    let both = |answer: &Answer| {
        let Controller { bus, request, response, .. } = answer.question.controller;
        [(bus, request), (bus, response)]
    };
    let mut ids: Vec<_> = answers.iter().flat_map(both).collect();
    ids.sort_unstable();
    ids.dedup();
    ids
}

#[cfg(test)]
mod tests;
