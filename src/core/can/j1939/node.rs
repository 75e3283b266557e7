//! The J1939 node: claims its address, sends trouble codes (DM1: active codes; DM2: previously active codes), and
//! answers requests.
//!
//! * DM1 is sent once a second, even without codes, and at once on a change. The module `codes` limits how often one
//!   code changes.
//! * DM2 is sent only on request.
//! * Messages of more than 8 bytes are transferred one after the other, so a changed DM1 waits for the end of a
//!   transfer. If a DM1 and a DM2 wait, they are sent alternately, so that neither of them blocks the other. A
//!   single-frame DM1 is sent even during the transfer of a DM2.
//! * A request for an unsupported group is rejected if it is addressed to the node, and ignored if it is addressed to
//!   all nodes.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::address::{AddressClaim, ClaimState};
use super::codes::{ActiveCode, Codes};
use super::event::NodeEvent;
use super::id::{
    GLOBAL_ADDRESS, Header, NULL_ADDRESS, PGN_ACKNOWLEDGEMENT, PGN_ADDRESS_CLAIMED, PGN_DM1, PGN_DM2, PGN_REQUEST,
    PGN_TRANSPORT_CONTROL, PGN_TRANSPORT_DATA, PRIORITY, TRANSPORT_PRIORITY, can_id, filter, pgn_bytes, pgn_of,
};
use super::name::Name;
use super::transport::Transfer;
use super::trouble_code::{DmPayload, TroubleCode, dm_payload};
use crate::can::{CanId, Frame, FrameKind};
use crate::quantity::Timestamp;

/// Period of DM1 (J1939-73), ns.
const DM1_PERIOD_NS: i64 = 1_000_000_000;
/// Maximum number of pending responses. A fifth response could be sent more than 200 ms after its request, when the
/// requester has already given up (J1939-21).
const MAX_WAITING_ANSWERS: usize = 4;

/// Identity of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NodeConfig {
    pub name: Name,
    /// 0 to [`MAX_ADDRESS`](super::MAX_ADDRESS).
    pub address: u8,
}

impl NodeConfig {
    /// Identifiers of all frames that the node sends.
    pub fn sent_ids(&self) -> [CanId; 7] {
        let id = |priority, pgn, source| can_id(priority, pgn, GLOBAL_ADDRESS, source);
        [
            id(PRIORITY, PGN_DM1, self.address),
            id(PRIORITY, PGN_DM2, self.address),
            id(PRIORITY, PGN_ADDRESS_CLAIMED, self.address),
            id(PRIORITY, PGN_ADDRESS_CLAIMED, NULL_ADDRESS),
            id(PRIORITY, PGN_ACKNOWLEDGEMENT, self.address),
            id(TRANSPORT_PRIORITY, PGN_TRANSPORT_CONTROL, self.address),
            id(TRANSPORT_PRIORITY, PGN_TRANSPORT_DATA, self.address),
        ]
    }
}

/// Output of the node; the caller empties it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct NodeOutputs {
    pub frames: Vec<Frame>,
    pub events: Vec<NodeEvent>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum PendingAnswer {
    Dm1,
    Dm2,
    Refusal { pgn: u32, to: u8 },
}

/// One node. Call [`poll`](Self::poll) at [`next_due`](Self::next_due), or at every tick.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Node {
    address: u8,
    claim: AddressClaim,
    codes: Codes,
    previously_active: Vec<TroubleCode>,
    next_dm1: Timestamp,
    transfer: Option<Transfer>,
    transport_free_at: Timestamp,
    last_transferred: u32,
    answers: VecDeque<PendingAnswer>,
    next_answer_at: Timestamp,
    polled_at: Timestamp,
    codes_left_out: usize,
}

impl Node {
    /// Creates a node that is silent until it is started.
    pub fn new(config: &NodeConfig) -> Self {
        Self {
            address: config.address,
            claim: AddressClaim::new(config.name, config.address),
            codes: Codes::default(),
            previously_active: Vec::new(),
            next_dm1: Timestamp::LONG_AGO,
            transfer: None,
            transport_free_at: Timestamp::LONG_AGO,
            last_transferred: PGN_DM2,
            answers: VecDeque::with_capacity(MAX_WAITING_ANSWERS),
            next_answer_at: Timestamp::LONG_AGO,
            polled_at: Timestamp::LONG_AGO,
            codes_left_out: 0,
        }
    }

    /// Resumes from `stored`, if it belongs to the same node.
    pub fn resume(&mut self, stored: &Self) {
        if self.address == stored.address && self.claim.is_same(&stored.claim) {
            self.clone_from(stored);
        }
    }

    /// Claims the address. If no other node objects, codes are sent 300 ms later.
    pub fn start(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        self.fall_silent();
        self.codes.restart();
        self.claim.start(now);
        self.transport_free_at = Timestamp::LONG_AGO;
        self.next_answer_at = Timestamp::LONG_AGO;
        self.poll(now, out);
    }

    /// Sets the codes to send. The caller sorts `active` by severity (most severe first) and `previously_active` by
    /// time (latest first). `all_known` says whether every value that could activate a code is known.
    pub fn set_codes(
        &mut self,
        now: Timestamp,
        active: &[ActiveCode],
        previously_active: &[TroubleCode],
        all_known: bool,
    ) {
        self.codes.set(now, active, all_known);
        self.previously_active.clear();
        self.previously_active.extend_from_slice(previously_active);
    }

    /// Handles a received frame; ignores frames that do not concern the node.
    pub fn handle_frame(&mut self, now: Timestamp, frame: &Frame, out: &mut NodeOutputs) {
        let Some(header) = Header::of(frame.id()).filter(|_| frame.kind() == FrameKind::Classic) else { return };
        match header.pgn {
            PGN_ADDRESS_CLAIMED if header.source == self.address => self.handle_claim(now, frame, out),
            PGN_REQUEST if header.destination == GLOBAL_ADDRESS || header.destination == self.address => {
                self.handle_request(now, frame, header);
            }
            _ => return,
        }
        self.poll(now, out);
    }

    fn handle_claim(&mut self, now: Timestamp, frame: &Frame, out: &mut NodeOutputs) {
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else { return };
        out.events.extend(self.claim.contend(now, Name::from_bytes(bytes)));
        if self.claim.state == ClaimState::Lost {
            self.fall_silent();
        }
    }

    fn handle_request(&mut self, now: Timestamp, frame: &Frame, header: Header) {
        let &[low, middle, high, ..] = frame.data() else { return };
        let is_for_all = header.destination == GLOBAL_ADDRESS;
        let answer = match (pgn_of([low, middle, high]), self.claim.state) {
            // If the address was lost, another node has it. Then only requests to all nodes concern this node.
            (PGN_ADDRESS_CLAIMED, ClaimState::Lost) if !is_for_all => return,
            (PGN_ADDRESS_CLAIMED, ClaimState::Idle | ClaimState::Claiming | ClaimState::Claimed | ClaimState::Lost) => {
                return self.claim.handle_request(now);
            }
            (_, ClaimState::Idle | ClaimState::Claiming | ClaimState::Lost) => return,
            (PGN_DM1, ClaimState::Claimed) => PendingAnswer::Dm1,
            (PGN_DM2, ClaimState::Claimed) => PendingAnswer::Dm2,
            (_, ClaimState::Claimed) if is_for_all => return,
            (pgn, ClaimState::Claimed) => PendingAnswer::Refusal { pgn, to: header.source },
        };
        // One broadcast serves all requesters.
        if !self.answers.contains(&answer) && self.answers.len() < MAX_WAITING_ANSWERS {
            self.answers.push_back(answer);
        }
    }

    /// Sends the frames that are due.
    pub fn poll(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        self.polled_at = now;
        let (frame, event) = self.claim.poll(now);
        out.frames.extend(frame);
        if let Some(event) = event {
            self.next_dm1 = now;
            out.events.push(event);
        }
        if self.is_silent() {
            return;
        }
        self.poll_transfer(now, out);
        if self.is_turn_of_dm2() {
            self.poll_answers(now, out);
            self.poll_dm1(now, out);
        } else {
            self.poll_dm1(now, out);
            self.poll_answers(now, out);
        }
    }

    fn poll_transfer(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        let Some(transfer) = &mut self.transfer else { return };
        out.frames.extend(transfer.poll(now, self.address));
        if transfer.is_complete() {
            // The announcement of the next transfer must keep the packet spacing, too.
            self.transport_free_at = transfer.due;
            self.last_transferred = transfer.pgn;
            if transfer.pgn == PGN_DM1 {
                self.codes.sent(now);
            }
            self.transfer = None;
        }
    }

    /// Skips a cyclic DM1 that is due.
    pub(crate) fn skip_cyclic(&mut self, now: Timestamp) {
        if self.next_dm1 <= now {
            self.next_dm1 = now.plus_nanos(DM1_PERIOD_NS);
        }
    }

    /// Resumes the cyclic DM1, which was skipped since `skipped_since`. It is due now, or one period after
    /// `skipped_since` if that is later.
    pub(crate) fn resume_cyclic(&mut self, now: Timestamp, skipped_since: Timestamp) {
        let earliest = skipped_since.plus_nanos(DM1_PERIOD_NS).max(now);
        self.next_dm1 = self.next_dm1.min(earliest);
    }

    fn poll_dm1(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        let is_cyclic = self.next_dm1 <= now;
        let has_changed = self.codes.change_due().is_some_and(|due| due <= now);
        if (is_cyclic || has_changed) && self.can_start(now, PGN_DM1) {
            // A cyclic DM1 that is less than a period late keeps the cycle. Any other DM1 starts a new cycle.
            let next = self.next_dm1.plus_nanos(DM1_PERIOD_NS);
            self.next_dm1 = if is_cyclic && now < next { next } else { now.plus_nanos(DM1_PERIOD_NS) };
            self.send_dm1(now, out);
        }
    }

    fn poll_answers(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        if now < self.next_answer_at {
            return;
        }
        let ready = self.answers.iter().position(|answer| match answer {
            PendingAnswer::Dm1 => self.can_start(now, PGN_DM1),
            PendingAnswer::Dm2 => self.can_start(now, PGN_DM2),
            PendingAnswer::Refusal { .. } => true,
        });
        let Some(answer) = ready.and_then(|index| self.answers.remove(index)) else { return };
        // At least 50 ms (in ns) between two responses, so that a flood of requests causes at most 20 responses a
        // second.
        self.next_answer_at = now.plus_nanos(50_000_000);
        match answer {
            PendingAnswer::Dm1 => self.send_dm1(now, out),
            PendingAnswer::Dm2 => self.send(now, PGN_DM2, dm_payload(self.codes.lamps(), &self.previously_active), out),
            PendingAnswer::Refusal { pgn, to } => {
                let [low, middle, high] = pgn_bytes(pgn);
                // 1 = negative acknowledgement.
                let refusal = [1, 0xFF, 0xFF, 0xFF, to, low, middle, high];
                let id = can_id(PRIORITY, PGN_ACKNOWLEDGEMENT, GLOBAL_ADDRESS, self.address);
                out.frames.extend(Frame::classic(id, &refusal));
            }
        }
    }

    fn send_dm1(&mut self, now: Timestamp, out: &mut NodeOutputs) {
        self.codes.show(now);
        let payload = dm_payload(self.codes.lamps(), &self.codes.shown());
        if payload.left_out != self.codes_left_out {
            self.codes_left_out = payload.left_out;
            out.events.push(NodeEvent::CodesLeftOut { codes: self.codes_left_out });
        }
        self.send(now, PGN_DM1, payload, out);
        if self.transfer.is_none_or(|transfer| transfer.pgn != PGN_DM1) {
            self.codes.sent(now);
        }
    }

    fn send(&mut self, now: Timestamp, pgn: u32, payload: DmPayload, out: &mut NodeOutputs) {
        if payload.as_slice().len() <= 8 {
            let id = can_id(PRIORITY, pgn, GLOBAL_ADDRESS, self.address);
            out.frames.extend(Frame::classic(id, payload.as_slice()));
        } else {
            let (transfer, announcement) = Transfer::start(now, pgn, payload, self.address);
            self.transfer = Some(transfer);
            out.frames.extend(announcement);
        }
    }

    /// Whether a pending DM2 goes first, because the last transfer was a DM1.
    fn is_turn_of_dm2(&self) -> bool {
        self.last_transferred == PGN_DM1 && self.answers.contains(&PendingAnswer::Dm2)
    }

    fn can_start(&self, now: Timestamp, pgn: u32) -> bool {
        self.start_at(now, pgn).is_some_and(|start| start <= now)
    }

    /// Earliest time at which a message of this group can be sent, given the state at `now`; `None` = another message
    /// goes first.
    fn start_at(&self, now: Timestamp, pgn: u32) -> Option<Timestamp> {
        let codes = if pgn == PGN_DM1 { self.codes.count_at(now) } else { self.previously_active.len() };
        match &self.transfer {
            // Only one transfer runs at a time. A single frame of the same group waits, too, because a transfer with
            // older content must not end after a frame with newer content.
            Some(transfer) if codes > 1 || transfer.pgn == pgn => None,
            None if codes > 1 && pgn == PGN_DM1 && self.is_turn_of_dm2() => None,
            None if codes > 1 => Some(self.transport_free_at),
            Some(_) | None => Some(Timestamp::LONG_AGO),
        }
    }

    /// Time of the next [`poll`](Self::poll), which may be in the past. `None` = not before a frame arrives or
    /// [`start`](Self::start) is called. An earlier poll does nothing.
    pub fn next_due(&self) -> Option<Timestamp> {
        let claim = self.claim.next_due();
        if self.is_silent() {
            return claim;
        }
        let dm1 = self.codes.change_due().map_or(self.next_dm1, |change| change.min(self.next_dm1));
        let dm1 = self.startable_from(PGN_DM1, dm1);
        let answers = self.answers.iter().filter_map(|answer| match answer {
            PendingAnswer::Dm1 => self.startable_from(PGN_DM1, self.next_answer_at),
            PendingAnswer::Dm2 => self.startable_from(PGN_DM2, self.next_answer_at),
            PendingAnswer::Refusal { .. } => Some(self.next_answer_at),
        });
        let transfer = self.transfer.map(|transfer| transfer.due);
        claim.into_iter().chain(transfer).chain(dm1).chain(answers).min()
    }

    /// Like `start_at`, for a message that is due at `wanted`.
    fn startable_from(&self, pgn: u32, wanted: Timestamp) -> Option<Timestamp> {
        let from = wanted.max(self.polled_at);
        let start = self.start_at(from, pgn).map(|start| start.max(wanted));
        if pgn != PGN_DM1 || start.is_some_and(|start| start <= from) {
            return start;
        }
        // When codes leave the message, the message may become short enough to be sent during a transfer or the
        // following pause.
        let shorter = self.codes.changes().filter(|&change| change > from);
        shorter.filter_map(|change| self.start_at(change, pgn).map(|start| start.max(change))).chain(start).min()
    }

    /// Whether the node has no address and may send only claims.
    pub fn is_silent(&self) -> bool {
        match self.claim.state {
            ClaimState::Idle | ClaimState::Claiming | ClaimState::Lost => true,
            ClaimState::Claimed => false,
        }
    }

    /// Identifiers and masks of the frames to receive, for any priority: claims of the address, requests to the node,
    /// and requests to all nodes.
    pub fn wanted(&self) -> [(u32, u32); 3] {
        let (claim, mask) = filter(PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS);
        [
            (claim | u32::from(self.address), mask | 0xFF),
            filter(PGN_REQUEST, self.address),
            filter(PGN_REQUEST, GLOBAL_ADDRESS),
        ]
    }

    fn fall_silent(&mut self) {
        self.transfer = None;
        self.answers.clear();
    }
}

#[cfg(test)]
mod tests;
