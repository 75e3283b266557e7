//! Claiming the address, defending it, falling silent (J1939-81), as a machine of four states.
//!
//! | state | started | lower or same NAME claims it | higher NAME claims it | request for claims | 300 ms passed |
//! | --- | --- | --- | --- | --- | --- |
//! | idle | claim | - | - | - | - |
//! | claiming | claim | lost | claim, wait again | claim | claimed |
//! | claimed | claim | lost | claim | claim | - |
//! | lost | claim | - | - | cannot claim | - |
//!
//! An equal NAME is a second node with this node's configuration. Arbitration cannot separate the two, and broadcasts of two
//! nodes under one address would destroy each other: a node that receives its own NAME falls silent. (A socket does not
//! receive its own frames.)

use serde::{Deserialize, Serialize};

use super::event::NodeEvent;
use super::id::{GLOBAL_ADDRESS, NULL_ADDRESS, PGN_ADDRESS_CLAIMED, PRIORITY, can_id};
use super::name::Name;
use crate::can::Frame;
use crate::quantity::Timestamp;

/// Time without objection after which the node has the address, ns: the 250 ms of J1939-81, and 50 ms because a frame is on
/// the wire a little later than its time here (interfaces start, queues empty; 12 ms were measured).
const CONTENTION_NS: i64 = 300_000_000;

/// State of the claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum ClaimState {
    /// Not started.
    Idle,
    /// Has claimed, waits for objections.
    Claiming,
    /// The node has the address.
    Claimed,
    /// Another node has the address.
    Lost,
}

/// Input of the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ClaimEvent {
    /// The program starts, or continues after time without listening.
    Started,
    /// A lower or equal NAME claims the address.
    ClaimedByStronger,
    /// A higher NAME claims the address.
    ClaimedByWeaker,
    /// A node requests address claims.
    Requested,
    /// No objection for the time of contention.
    Unopposed,
}

/// Frame to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ClaimAnswer {
    Nothing,
    Claim,
    CannotClaim,
}

/// The table above.
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

/// The claim to one address.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct AddressClaim {
    name: Name,
    address: u8,
    pub(super) state: ClaimState,
    /// When contention ends, while claiming.
    unopposed_at: Timestamp,
    /// Time to send a claim (in state lost: "cannot claim").
    send_at: Option<Timestamp>,
    last_sent: Option<Timestamp>,
    /// The claim that begins the contention is not yet sent.
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

    /// Whether both claim the same address for the same node.
    pub(super) fn is_same(&self, other: &Self) -> bool {
        (self.name, self.address) == (other.name, other.address)
    }

    /// Starts, or starts again after time without listening.
    pub(super) fn start(&mut self, now: Timestamp) {
        self.last_sent = None;
        self.send_at = None;
        self.is_first = true;
        self.handle(now, ClaimEvent::Started);
    }

    /// Takes a claim of the address by another node.
    pub(super) fn contend(&mut self, now: Timestamp, by: Name) -> Option<NodeEvent> {
        let (before, was_answered) = (self.state, self.send_at.is_none());
        self.handle(now, if by <= self.name { ClaimEvent::ClaimedByStronger } else { ClaimEvent::ClaimedByWeaker });
        match (before, self.state) {
            (ClaimState::Claiming | ClaimState::Claimed, ClaimState::Lost) => Some(NodeEvent::AddressLost { to: by }),
            // One event per answer: a flood of claims is answered at a limited rate.
            (ClaimState::Claiming | ClaimState::Claimed, ClaimState::Claiming | ClaimState::Claimed) => {
                was_answered.then_some(NodeEvent::AddressDefended { against: by })
            }
            (ClaimState::Idle | ClaimState::Lost, _) | (_, ClaimState::Idle) => None,
        }
    }

    /// Takes a request for claims.
    pub(super) fn handle_request(&mut self, now: Timestamp) {
        self.handle(now, ClaimEvent::Requested);
    }

    fn handle(&mut self, now: Timestamp, event: ClaimEvent) {
        let before = self.state;
        let (state, answer) = next(before, event);
        self.state = state;
        // Shortest time between two claims, ns: five in the time the other node waits; a flood of claims causes no flood of answers.
        let spaced = self.last_sent.map_or(now, |sent| now.max(sent.plus_nanos(50_000_000)));
        match answer {
            ClaimAnswer::Nothing => {}
            ClaimAnswer::Claim => self.send_at = Some(self.send_at.map_or(spaced, |due| due.min(spaced))),
            // A frame that was due before the loss was a claim.
            ClaimAnswer::CannotClaim if before == ClaimState::Lost && self.send_at.is_some() => {}
            ClaimAnswer::CannotClaim => self.send_at = Some(spaced.plus_nanos(self.loser_delay_ns())),
        }
        // Only the start counts: requests and weaker claims must not keep the node silent.
        if event == ClaimEvent::Started {
            self.unopposed_at = now.plus_nanos(CONTENTION_NS);
        }
    }

    /// From the NAME, so that every run waits equally long and two nodes most likely do not.
    fn loser_delay_ns(&self) -> i64 {
        // Fibonacci hashing: neighbouring serial numbers come out far apart.
        let mixed = self.name.raw().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        // "Cannot claim" waits 0 to 153 ms, so that several losers do not collide with equal identifiers (J1939-81).
        1_000_000 * i64::try_from(mixed % 154).unwrap_or(0)
    }

    /// The frame that is due, or the event that the node has the address.
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

    /// When `poll` has something to do.
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
    fn every_state_answers_every_event_as_the_table_says() {
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
    fn a_claim_is_the_name_from_the_address_to_all() {
        let mut claim = AddressClaim::new(name(0x8877_6655_4433_2211), 0xF9);
        claim.start(at(0));
        let frame = claim.poll(at(0)).0.unwrap();
        assert_eq!(frame.id().raw(), 0x18EE_FFF9);
        assert_eq!(frame.data(), [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]);
    }

    #[test]
    fn a_higher_name_is_answered_by_a_claim_and_lengthens_no_wait() {
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
    fn a_lower_name_takes_the_address_and_cannot_claim_follows_within_153_ms() {
        let mut claim = claimed(10);
        assert_eq!(claim.contend(at(1000), name(9)), Some(NodeEvent::AddressLost { to: name(9) }));
        let due = claim.next_due().unwrap();
        assert!(at(1000) <= due && due <= at(1153), "{due:?}");
        let frame = claim.poll(due).0.unwrap();
        assert_eq!((frame.id().raw(), frame.data()[0]), (0x18EE_FFFE, 10));
        assert_eq!(claim.contend(at(2000), name(8)), None, "lost is lost");
        assert_eq!((claim.poll(at(9000)), claim.next_due()), ((None, None), None));
    }

    #[test]
    fn an_equal_name_from_another_node_silences_this_one() {
        let mut claim = claimed(10);
        assert_eq!(claim.contend(at(1000), name(10)), Some(NodeEvent::AddressLost { to: name(10) }));
        assert_eq!(claim.state, ClaimState::Lost);
    }

    #[test]
    fn a_flood_of_claims_is_answered_every_50_ms() {
        let mut claim = claimed(10);
        let (mut sent, mut events) = (0, 0);
        for ms in 1000..2000 {
            events += usize::from(claim.contend(at(ms), name(11)).is_some());
            sent += usize::from(claim.poll(at(ms)).0.is_some());
        }
        assert_eq!(sent, 20);
        assert!(events <= 21, "one event per answer, not {events}");
    }

    #[test]
    fn a_loser_answers_a_request_with_cannot_claim() {
        let mut claim = claimed(10);
        claim.contend(at(1000), name(9));
        assert!(claim.poll(at(1153)).0.is_some());
        claim.handle_request(at(5000));
        assert_eq!(claim.poll(at(5153)).0.unwrap().id().raw(), 0x18EE_FFFE);
    }

    #[test]
    fn a_start_after_a_loss_claims_again() {
        let mut claim = claimed(10);
        claim.contend(at(1000), name(9));
        claim.start(at(1001));
        assert_eq!(claim.poll(at(1001)).0.unwrap().id().raw(), 0x18EE_FFF9);
        assert_eq!(claim.poll(at(1301)).1, Some(NodeEvent::Claimed { address: 0xF9 }));
    }
}
