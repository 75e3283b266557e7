//! State machine of the node's J1939 address (J1939-81). If two nodes claim the same address, the node with the lower
//! NAME (a 64-bit identity) wins, and the other node falls silent.
//!
//! | state | started | lower or equal NAME claims | higher NAME claims | request for claims | 300 ms passed |
//! | --- | --- | --- | --- | --- | --- |
//! | idle | claiming; claim | - | - | - | - |
//! | claiming | claiming; claim | lost; cannot claim | claiming; claim | claiming; claim | claimed |
//! | claimed | claiming; claim | lost; cannot claim | claimed; claim | claimed; claim | - |
//! | lost | claiming; claim | - | - | lost; cannot claim | - |
//!
//! A cell contains the next state and, after the semicolon, the frame that the node sends; "-" = no effect.
//!
//! An equal NAME belongs to a second node with the same configuration. Arbitration cannot separate these nodes, and
//! their broadcasts would corrupt each other. Therefore, a node that receives its own NAME falls silent. (A socket does
//! not receive its own frames.)

use serde::{Deserialize, Serialize};

use super::event::NodeEvent;
use super::id::{GLOBAL_ADDRESS, NULL_ADDRESS, PGN_ADDRESS_CLAIMED, PRIORITY, can_id};
use super::name::Name;
use crate::can::Frame;
use crate::quantity::Timestamp;

/// If no other node objects within this time (ns), the node has the address. J1939-81 specifies 250 ms. 50 ms are
/// added, because a frame reaches the bus later than its time stamp (12 ms were measured).
const CONTENTION_NS: i64 = 300_000_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum ClaimState {
    Idle,
    /// Waits for objections.
    Claiming,
    Claimed,
    Lost,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ClaimEvent {
    /// The node has started, or listens again after a pause.
    Started,
    ClaimedByStronger,
    ClaimedByWeaker,
    Requested,
    Unopposed,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ClaimAnswer {
    Nothing,
    Claim,
    CannotClaim,
}

/// Returns the next state and the frame to send, as in the table of the module header.
fn next(state: ClaimState, event: ClaimEvent) -> (ClaimState, ClaimAnswer) {
    match (state, event) {
        (ClaimState::Idle | ClaimState::Claiming | ClaimState::Claimed | ClaimState::Lost, ClaimEvent::Started)
        | (ClaimState::Claiming, ClaimEvent::ClaimedByWeaker | ClaimEvent::Requested) => {
            (ClaimState::Claiming, ClaimAnswer::Claim)
        }
        (ClaimState::Claimed, ClaimEvent::ClaimedByWeaker | ClaimEvent::Requested) => {
            (ClaimState::Claimed, ClaimAnswer::Claim)
        }
        (ClaimState::Claiming | ClaimState::Claimed, ClaimEvent::ClaimedByStronger)
        | (ClaimState::Lost, ClaimEvent::Requested) => (ClaimState::Lost, ClaimAnswer::CannotClaim),
        (ClaimState::Claiming, ClaimEvent::Unopposed) => (ClaimState::Claimed, ClaimAnswer::Nothing),
        (
            ClaimState::Idle,
            ClaimEvent::ClaimedByStronger | ClaimEvent::ClaimedByWeaker | ClaimEvent::Requested | ClaimEvent::Unopposed,
        )
        | (ClaimState::Claimed, ClaimEvent::Unopposed)
        | (ClaimState::Lost, ClaimEvent::ClaimedByStronger | ClaimEvent::ClaimedByWeaker | ClaimEvent::Unopposed) => {
            (state, ClaimAnswer::Nothing)
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct AddressClaim {
    name: Name,
    address: u8,
    pub(super) state: ClaimState,
    /// End of the contention time.
    unopposed_at: Timestamp,
    /// Time of the next claim or "cannot claim".
    send_at: Option<Timestamp>,
    last_sent: Option<Timestamp>,
    /// Whether the first claim, which starts the contention time, was not sent yet.
    is_first: bool,
}

impl AddressClaim {
    pub(super) fn new(name: Name, address: u8) -> Self {
        Self {
            name,
            address,
            state: ClaimState::Idle,
            unopposed_at: Timestamp::ZERO,
            send_at: None,
            last_sent: None,
            is_first: false,
        }
    }

    pub(super) fn is_same(&self, other: &Self) -> bool {
        (self.name, self.address) == (other.name, other.address)
    }

    /// Starts the claim, or starts it again after a time without listening.
    pub(super) fn start(&mut self, now: Timestamp) {
        self.last_sent = None;
        self.send_at = None;
        self.is_first = true;
        self.handle(now, ClaimEvent::Started);
    }

    pub(super) fn contend(&mut self, now: Timestamp, by: Name) -> Option<NodeEvent> {
        let (before, was_answered) = (self.state, self.send_at.is_none());
        self.handle(now, if by <= self.name { ClaimEvent::ClaimedByStronger } else { ClaimEvent::ClaimedByWeaker });
        match (before, self.state) {
            (ClaimState::Claiming | ClaimState::Claimed, ClaimState::Lost) => Some(NodeEvent::AddressLost { to: by }),
            // A flood of claims is answered at a limited rate. Report one event per answer, not per claim.
            (ClaimState::Claiming | ClaimState::Claimed, ClaimState::Claiming | ClaimState::Claimed) => {
                was_answered.then_some(NodeEvent::AddressDefended { against: by })
            }
            (ClaimState::Idle | ClaimState::Lost, _) | (_, ClaimState::Idle) => None,
        }
    }

    pub(super) fn handle_request(&mut self, now: Timestamp) {
        self.handle(now, ClaimEvent::Requested);
    }

    fn handle(&mut self, now: Timestamp, event: ClaimEvent) {
        let before = self.state;
        let (state, answer) = next(before, event);
        self.state = state;
        // At least 50 ms (in ns) between two claims, so that a flood of claims is not answered by a flood. Five claims
        // still fit into the 250 ms that the other node waits.
        let spaced = self.last_sent.map_or(now, |sent| now.max(sent.plus_nanos(50_000_000)));
        match answer {
            ClaimAnswer::Nothing => {}
            ClaimAnswer::Claim => self.send_at = Some(self.send_at.map_or(spaced, |due| due.min(spaced))),
            // A frame that is due in state `Lost` is a "cannot claim". Keep its time.
            ClaimAnswer::CannotClaim if before == ClaimState::Lost && self.send_at.is_some() => {}
            ClaimAnswer::CannotClaim => self.send_at = Some(spaced.plus_nanos(self.loser_delay_ns())),
        }
        // Only the start restarts the contention time, because requests and weaker claims must not keep the node
        // silent.
        if event == ClaimEvent::Started {
            self.unopposed_at = now.plus_nanos(CONTENTION_NS);
        }
    }

    /// Delay before "cannot claim", ns. It follows from the NAME, so that it is the same in every run and differs
    /// between most nodes.
    fn loser_delay_ns(&self) -> i64 {
        // Fibonacci hashing: consecutive serial numbers give very different delays.
        let mixed = self.name.raw().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        // 0 to 153 ms, so that nodes without address do not send equal identifiers at the same time (J1939-81).
        1_000_000 * i64::try_from(mixed % 154).unwrap_or(0)
    }

    /// Returns the frame that is due, or reports that the node has the address.
    pub(super) fn poll(&mut self, now: Timestamp) -> (Option<Frame>, Option<NodeEvent>) {
        if let Some(due) = self.send_at {
            if now < due {
                return (None, None);
            }
            self.send_at = None;
            self.last_sent = Some(now);
            if self.state == ClaimState::Claiming && std::mem::take(&mut self.is_first) {
                self.unopposed_at = now.plus_nanos(CONTENTION_NS);
            }
            return (self.frame(), None);
        }
        if self.state == ClaimState::Claiming && now >= self.unopposed_at {
            self.handle(now, ClaimEvent::Unopposed);
            return (None, Some(NodeEvent::Claimed { address: self.address }));
        }
        (None, None)
    }

    fn frame(&self) -> Option<Frame> {
        let source = match self.state {
            ClaimState::Idle => return None,
            ClaimState::Claiming | ClaimState::Claimed => self.address,
            ClaimState::Lost => NULL_ADDRESS,
        };
        Frame::classic(can_id(PRIORITY, PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS, source), &self.name.to_bytes())
    }

    pub(super) fn next_due(&self) -> Option<Timestamp> {
        self.send_at.or((self.state == ClaimState::Claiming).then_some(self.unopposed_at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATES: [ClaimState; 4] = [ClaimState::Idle, ClaimState::Claiming, ClaimState::Claimed, ClaimState::Lost];
    const EVENTS: [ClaimEvent; 5] = [
        ClaimEvent::Started,
        ClaimEvent::ClaimedByStronger,
        ClaimEvent::ClaimedByWeaker,
        ClaimEvent::Requested,
        ClaimEvent::Unopposed,
    ];

    fn at(ms: i64) -> Timestamp {
        Timestamp::from_nanos(ms * 1_000_000)
    }

    fn name(raw: u64) -> Name {
        Name::from_bytes(raw.to_le_bytes())
    }

    fn claimed(raw: u64) -> AddressClaim {
        let mut claim = AddressClaim::new(name(raw), 0xF9);
        claim.start(at(0));
        assert!(claim.poll(at(0)).0.is_some());
        assert_eq!(claim.poll(at(299)), (None, None));
        assert_eq!(claim.poll(at(300)), (None, Some(NodeEvent::Claimed { address: 0xF9 })));
        claim
    }

    #[test]
    fn transitions_match_table_for_all_events() {
        use ClaimAnswer::{CannotClaim, Claim, Nothing};
        use ClaimState::{Claimed, Claiming, Idle, Lost};
        let wanted = [
            [(Claiming, Claim), (Idle, Nothing), (Idle, Nothing), (Idle, Nothing), (Idle, Nothing)],
            [(Claiming, Claim), (Lost, CannotClaim), (Claiming, Claim), (Claiming, Claim), (Claimed, Nothing)],
            [(Claiming, Claim), (Lost, CannotClaim), (Claimed, Claim), (Claimed, Claim), (Claimed, Nothing)],
            [(Claiming, Claim), (Lost, Nothing), (Lost, Nothing), (Lost, CannotClaim), (Lost, Nothing)],
        ];
        for (state, row) in STATES.into_iter().zip(wanted) {
            for (event, wanted) in EVENTS.into_iter().zip(row) {
                assert_eq!(next(state, event), wanted, "{state:?}, {event:?}");
            }
        }
    }

    #[test]
    fn claim_frame_carries_name_to_all() {
        let mut claim = AddressClaim::new(name(0x8877_6655_4433_2211), 0xF9);
        claim.start(at(0));
        let frame = claim.poll(at(0)).0.unwrap();
        assert_eq!(frame.id().raw(), 0x18EE_FFF9);
        assert_eq!(frame.data(), [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]);
    }

    #[test]
    fn higher_name_gets_claim_without_longer_wait() {
        let mut claim = AddressClaim::new(name(10), 0xF9);
        claim.start(at(0));
        assert!(claim.poll(at(0)).0.is_some());
        assert_eq!(claim.contend(at(100), name(11)), Some(NodeEvent::AddressDefended { against: name(11) }));
        assert_eq!(claim.poll(at(100)).0.unwrap().id().raw(), 0x18EE_FFF9);
        // Requests for claims do not delay the address.
        claim.handle_request(at(250));
        assert!(claim.poll(at(250)).0.is_some());
        assert_eq!(claim.poll(at(299)), (None, None));
        assert_eq!(claim.poll(at(300)).1, Some(NodeEvent::Claimed { address: 0xF9 }));
    }

    #[test]
    fn lower_name_wins_and_loser_reports_within_153_ms() {
        let mut claim = claimed(10);
        assert_eq!(claim.contend(at(1000), name(9)), Some(NodeEvent::AddressLost { to: name(9) }));
        let due = claim.next_due().unwrap();
        assert!(at(1000) <= due && due <= at(1153), "{due:?}");
        let frame = claim.poll(due).0.unwrap();
        assert_eq!((frame.id().raw(), frame.data()[0]), (0x18EE_FFFE, 10));
        assert_eq!(claim.contend(at(2000), name(8)), None, "the address is already lost");
        assert_eq!((claim.poll(at(9000)), claim.next_due()), ((None, None), None));
    }

    #[test]
    fn equal_name_silences_this_node() {
        let mut claim = claimed(10);
        assert_eq!(claim.contend(at(1000), name(10)), Some(NodeEvent::AddressLost { to: name(10) }));
        assert_eq!(claim.state, ClaimState::Lost);
    }

    #[test]
    fn flood_of_claims_is_answered_every_50_ms() {
        let mut claim = claimed(10);
        let (mut sent, mut events) = (0, 0);
        for ms in 1000..2000 {
            events += usize::from(claim.contend(at(ms), name(11)).is_some());
            sent += usize::from(claim.poll(at(ms)).0.is_some());
        }
        assert_eq!(sent, 20);
        assert!(events <= 21, "one event per response, not {events}");
    }

    #[test]
    fn loser_answers_request_with_cannot_claim() {
        let mut claim = claimed(10);
        claim.contend(at(1000), name(9));
        assert!(claim.poll(at(1153)).0.is_some());
        claim.handle_request(at(5000));
        assert_eq!(claim.poll(at(5153)).0.unwrap().id().raw(), 0x18EE_FFFE);
    }

    #[test]
    fn restart_after_loss_claims_again() {
        let mut claim = claimed(10);
        claim.contend(at(1000), name(9));
        claim.start(at(1001));
        assert_eq!(claim.poll(at(1001)).0.unwrap().id().raw(), 0x18EE_FFF9);
        assert_eq!(claim.poll(at(1301)).1, Some(NodeEvent::Claimed { address: 0xF9 }));
    }
}
