//! Diagnostic answers (UDS ISO 14229-1, KWP 2000, OBD ISO 15031-5) over ISO-TP: which are read, and where their signals are.
//!
//! In: frames of the configured identifiers, from any tester. Out: whole answers, and their readings
//! ([`Answer::readings`]). Of every controller it is counted what came: answers, refusals, answers without a request
//! before, lost messages by their fault. Nothing is sent here. Memory: one message per configured controller.

use serde::{Deserialize, Serialize};

use super::decode::Binding;
use super::id_table::IdTable;
use super::isotp::{IsoTpFault, Progress, Receiver};
use super::{CanId, Frame, FrameKind};
use crate::quantity::{BusIndex, Channel, Fault, Reading, Timestamp};

/// Added to the service in an answer.
const POSITIVE: u8 = 0x40;
/// Code of a refusal that only says "wait" (requestCorrectlyReceived-ResponsePending).
pub const PENDING: u8 = 0x78;

/// A service that only reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Service {
    /// Current data of OBD, identifier of one byte.
    CurrentData = 0x01,
    /// `ReadDataByLocalIdentifier` of KWP 2000, identifier of one byte.
    ByLocalIdentifier = 0x21,
    /// `ReadDataByIdentifier` of UDS, identifier of two bytes.
    ByIdentifier = 0x22,
}

impl Service {
    /// The service of this number; `None` = any other, which this program neither reads nor asks.
    pub fn from_code(code: u8) -> Option<Self> {
        [Self::CurrentData, Self::ByLocalIdentifier, Self::ByIdentifier].into_iter().find(|s| *s as u8 == code)
    }

    /// Bytes of an identifier.
    pub fn identifier_bytes(self) -> usize {
        match self {
            Self::CurrentData | Self::ByLocalIdentifier => 1,
            Self::ByIdentifier => 2,
        }
    }
}

/// A controller on a bus: where it is asked and where it answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Controller {
    /// Interface.
    pub bus: BusIndex,
    /// Identifier of its answers.
    pub response: CanId,
    /// First data byte of its answers, with extended addressing.
    pub response_extension: Option<u8>,
    /// Identifier of requests to it.
    pub request: CanId,
    /// First data byte of requests, with extended addressing.
    pub request_extension: Option<u8>,
}

/// What an answer is an answer to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Question {
    /// The controller asked.
    pub controller: Controller,
    /// Service.
    pub service: Service,
    /// Identifier of the values.
    pub identifier: u16,
}

impl Question {
    /// The request's message.
    pub fn request(&self) -> Vec<u8> {
        self.message(self.service as u8)
    }

    /// What the answer begins with.
    pub fn answer_head(&self) -> Vec<u8> {
        self.message(self.service as u8 + POSITIVE)
    }

    fn message(&self, first: u8) -> Vec<u8> {
        let identifier = self.identifier.to_be_bytes();
        [&[first], &identifier[2 - self.service.identifier_bytes()..]].concat()
    }
}

/// A signal of an answer.
#[derive(Debug, Clone, PartialEq)]
pub struct AnswerSignal {
    /// Byte behind the echoed service and identifier with which the layout begins.
    pub first_byte: usize,
    /// The signal from there on; its interface and identifier are those of the answer's frames.
    pub binding: Binding,
}

/// An answer that is read.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// What it answers.
    pub question: Question,
    /// Its signals.
    pub signals: Vec<AnswerSignal>,
}

impl Answer {
    /// Whether it has a reading of this kind.
    pub fn has(&self, is_wanted: impl Fn(Channel) -> bool) -> bool {
        self.signals.iter().any(|signal| is_wanted(signal.binding.channel))
    }

    /// The readings of an answer's data, which begin behind the echoed service and identifier. A signal behind the end of a
    /// cut answer is a short frame.
    pub fn readings<'a>(&'a self, data: &'a [u8]) -> impl Iterator<Item = Reading> + 'a {
        self.signals.iter().map(move |signal| {
            let bytes = data.get(signal.first_byte..).ok_or(Fault::ShortFrame);
            Reading { channel: signal.binding.channel, value: bytes.and_then(|bytes| signal.binding.value(bytes)) }
        })
    }
}

/// What came from a controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ControllerCounts {
    /// Whole answers that are read.
    pub read: u64,
    /// Whole messages that are not: other identifiers, other services.
    pub other: u64,
    /// Refusals, "wait" excepted.
    pub refused: u64,
    /// Refusals that say "wait".
    pub pending: u64,
    /// Code of the latest refusal, "wait" excepted.
    pub latest_refusal: Option<u8>,
    /// Answers that are read, although no request was heard within five seconds before.
    pub unasked: u64,
    /// Lost messages, by [`IsoTpFault::ALL`].
    pub lost: [u64; IsoTpFault::ALL.len()],
}

impl ControllerCounts {
    /// What came since an earlier count.
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

    /// Lost messages by their fault, those that happened.
    pub fn losses(&self) -> impl Iterator<Item = (IsoTpFault, u64)> + '_ {
        IsoTpFault::ALL.into_iter().zip(self.lost).filter(|(_, count)| *count > 0)
    }

    /// All lost messages.
    pub fn lost_in_all(&self) -> u64 {
        self.lost.iter().fold(0, |sum, count| sum.saturating_add(*count))
    }
}

/// Messages of a controller were lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct MessageLoss {
    /// Interface.
    pub bus: BusIndex,
    /// Identifier of the controller's answers.
    pub id: CanId,
    /// What happened to the latest of them.
    pub fault: IsoTpFault,
    /// Messages lost so far.
    pub lost: u64,
}

/// A refusal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal {
    /// The service that was asked for.
    pub service: u8,
    /// Why (ISO 14229-1, table A.1); [`PENDING`] only says "wait".
    pub code: u8,
}

/// What a frame brought.
#[derive(Debug, PartialEq)]
pub enum Heard<'a> {
    /// Nothing to read.
    Nothing,
    /// An answer of the controller of this index begins: its values are of now.
    Begun {
        /// Index in [`Listener::counts`].
        controller: usize,
    },
    /// A further part of an answer.
    Continued {
        /// Index in [`Listener::counts`].
        controller: usize,
    },
    /// A refusal.
    Refused {
        /// Index in [`Listener::counts`].
        controller: usize,
        /// The refusal.
        refusal: Refusal,
    },
    /// A whole answer.
    Whole {
        /// Index in [`Listener::counts`].
        controller: usize,
        /// Its plan.
        answer: &'a Answer,
        /// Its data behind the echoed service and identifier.
        data: &'a [u8],
        /// Whether it came in one frame, without [`Heard::Begun`] before.
        is_single: bool,
    },
}

/// One controller's state.
#[derive(Debug, Clone)]
struct Link {
    controller: Controller,
    receiver: Receiver,
    counts: ControllerCounts,
    /// Head of the answer to the latest request, and when it was heard or postponed.
    asked: Option<([u8; 3], Timestamp)>,
    reported_at: Option<Timestamp>,
}

/// An answer under way of one controller: what a snapshot keeps for a continuation without a break.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkProgress {
    controller: Controller,
    receiver: Receiver,
    asked: Option<([u8; 3], Timestamp)>,
    reported_at: Option<Timestamp>,
}

/// Listens to all configured controllers.
#[derive(Debug, Clone, Default)]
pub struct Listener {
    /// Sorted by question.
    answers: Vec<Answer>,
    /// Sorted by controller.
    links: Vec<Link>,
    ids: IdTable,
    id_count: usize,
    /// Losses that wait to be reported.
    pub(crate) losses: Vec<MessageLoss>,
}

impl Listener {
    /// A listener for these answers; signals of equal questions are read together.
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
            // The current before the voltages that its sample is made with.
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

    /// Whether nothing is configured.
    pub fn is_empty(&self) -> bool {
        self.links.is_empty()
    }

    /// The controllers and what came from them.
    pub fn counts(&self) -> impl Iterator<Item = (Controller, ControllerCounts)> + '_ {
        self.links.iter().map(|link| (link.controller, link.counts))
    }

    /// Continues stored counts, in the order of [`counts`](Self::counts); those of other controllers are left out.
    pub fn restore(&mut self, counts: impl Iterator<Item = (Controller, ControllerCounts)>) {
        for (controller, counts) in counts {
            if let Some(link) = self.links.iter_mut().find(|link| link.controller == controller) {
                link.counts = counts;
            }
        }
    }

    /// Answers under way.
    pub fn progress(&self) -> Vec<LinkProgress> {
        let of = |link: &Link| LinkProgress {
            controller: link.controller,
            receiver: link.receiver.clone(),
            asked: link.asked,
            reported_at: link.reported_at,
        };
        self.links.iter().map(of).collect()
    }

    /// Continues stored answers under way.
    pub fn resume(&mut self, stored: &[LinkProgress]) {
        for link in &mut self.links {
            if let Some(of) = stored.iter().find(|of| of.controller == link.controller) {
                link.receiver.resume(&of.receiver);
                (link.asked, link.reported_at) = (of.asked, of.reported_at);
            }
        }
    }

    /// After time without listening: messages under way are forgotten.
    pub fn restart(&mut self) {
        for link in &mut self.links {
            link.receiver.restart();
            link.asked = None;
        }
    }

    /// Gives up messages whose next frame is overdue.
    pub fn poll(&mut self, now: Timestamp) {
        for link in &mut self.links {
            let fault = link.receiver.poll(now);
            link.note(now, fault, &mut self.losses);
        }
    }

    /// Takes a frame.
    #[inline]
    pub fn handle(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> Heard<'_> {
        if self.links.is_empty() || self.ids.number(bus, frame.id()) >= self.id_count {
            return Heard::Nothing;
        }
        self.handle_wanted(now, bus, frame)
    }

    fn handle_wanted(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame) -> Heard<'_> {
        if frame.kind() == FrameKind::Remote {
            return Heard::Nothing;
        }
        let mut heard = None;
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
                    Progress::Begun => heard = Some((index, Progress::Begun, false)),
                    Progress::Complete => {
                        heard = Some((index, Progress::Complete, !was_receiving || received.fault.is_some()))
                    }
                    Progress::Continued => heard = Some((index, Progress::Continued, false)),
                    Progress::None => {}
                }
            }
        }
        match heard {
            Some((controller, Progress::Begun, _)) => Heard::Begun { controller },
            Some((controller, Progress::Continued, _)) => Heard::Continued { controller },
            Some((controller, Progress::Complete, is_single)) => self.whole(now, controller, is_single),
            Some((_, Progress::None, _)) | None => Heard::Nothing,
        }
    }

    /// Takes a whole message.
    fn whole(&mut self, now: Timestamp, controller: usize, is_single: bool) -> Heard<'_> {
        let Self { answers, links, .. } = self;
        let Some(link) = links.get_mut(controller) else { return Heard::Nothing };
        let message = link.receiver.message();
        // First byte of a refusal (ISO 14229-1, table A.1).
        if let &[0x7F, service, code, ..] = message {
            if code == PENDING {
                link.counts.pending = link.counts.pending.saturating_add(1);
                link.asked = link.asked.map(|(head, _)| (head, now));
            } else {
                link.counts.refused = link.counts.refused.saturating_add(1);
                link.counts.latest_refusal = Some(code);
            }
            return Heard::Refused { controller, refusal: Refusal { service, code } };
        }
        let is_own = |answer: &&Answer| {
            answer.question.controller == link.controller && message.starts_with(&answer.question.answer_head())
        };
        let Some(answer) = answers.iter().find(is_own) else {
            link.counts.other = link.counts.other.saturating_add(1);
            return Heard::Nothing;
        };
        let head = answer.question.answer_head();
        link.counts.read = link.counts.read.saturating_add(1);
        let is_asked = link.asked.is_some_and(|(asked, at)| {
            // An answer later than this after its request belongs to no request: the longest P2* of ISO 14229-2, ns.
            asked.starts_with(&head) && now.nanos().saturating_sub(at.nanos()) <= 5_000_000_000
        });
        link.counts.unasked = link.counts.unasked.saturating_add(u64::from(!is_asked));
        Heard::Whole { controller, answer, data: &link.receiver.message()[head.len()..], is_single }
    }
}

impl Link {
    /// Takes a frame to the controller: a request, or flow control.
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

    /// Counts a loss, and reports the first one in a while.
    fn note(&mut self, now: Timestamp, fault: Option<IsoTpFault>, losses: &mut Vec<MessageLoss>) {
        let Some(fault) = fault else { return };
        let place = IsoTpFault::ALL.iter().position(|other| *other == fault);
        if let Some(count) = place.and_then(|place| self.counts.lost.get_mut(place)) {
            *count = count.saturating_add(1);
        }
        // Lost messages of a controller are reported at most this often, ns.
        if self.reported_at.is_none_or(|at| now.nanos().saturating_sub(at.nanos()) >= 60_000_000_000) {
            self.reported_at = Some(now);
            let Controller { bus, response: id, .. } = self.controller;
            losses.push(MessageLoss { bus, id, fault, lost: self.counts.lost_in_all() });
        }
    }
}

/// Identifiers to be received for these answers, of requests too: an answer that was asked for differs from another by them.
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
