//! Claiming the address, defending it, falling silent (J1939-81), as a machine of four states.
//!
//! | state | started | lower or same NAME claims it | higher NAME claims it | asked who has it | 300 ms passed |
//! | --- | --- | --- | --- | --- | --- |
//! | idle | claim | - | - | - | - |
//! | claiming | claim | lost | claim, wait again | claim | claimed |
//! | claimed | claim | lost | claim | claim | - |
//! | lost | claim | - | - | cannot claim | - |
//!
//! A NAME equal to ours is a second node configured as this one. Arbitration cannot part the two, and broadcasts of two
//! nodes under one address would destroy each other: who hears its own NAME falls silent. (A socket does not hear its own frames.)

use super::id::{GLOBAL_ADDRESS, NULL_ADDRESS, PGN_ADDRESS_CLAIMED, PRIORITY, can_id};
use super::name::Name;
use super::node::NodeEvent;
use crate::can::Frame;
use crate::quantity::Timestamp;

/// How long nobody must object before the address is ours, ns: the 250 ms of J1939-81, and 50 ms because a frame is on the
/// wire a little later than its time here (interfaces come up, queues empty; 12 ms were seen).
const CONTENTION_NS: i64 = 300_000_000;
/// Shortest time between two claims, ns: five in the time the other side waits, and a flood of claims is not answered by one.
const CLAIM_SPACING_NS: i64 = 50_000_000;
/// "Cannot claim" waits 0 to 153 ms, so that several losers do not collide with equal identifiers (J1939-81).
const MAX_LOSER_DELAY_MS: u64 = 153;

/// Where the node stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum State {
    /// Not started.
    Idle,
    /// Has claimed, waits for objections.
    Claiming,
    /// The address is ours.
    Claimed,
    /// The address is somebody else's.
    Lost,
}

/// What happens to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ClaimEvent {
    /// The program starts, or was away.
    Started,
    /// A NAME that beats ours, or equals it, claims our address.
    ClaimedByStronger,
    /// A NAME that ours beats claims our address.
    ClaimedByWeaker,
    /// Somebody asks who has which address.
    Asked,
    /// Nobody objected for the time of contention.
    Unopposed,
}

/// What is sent about the address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Answer {
    Nothing,
    Claim,
    CannotClaim,
}

/// The table above.
fn next(state: State, happening: ClaimEvent) -> (State, Answer) {
    match (state, happening) {
        (State::Idle | State::Claiming | State::Claimed | State::Lost, ClaimEvent::Started)
        | (State::Claiming, ClaimEvent::ClaimedByWeaker | ClaimEvent::Asked) => (State::Claiming, Answer::Claim),
        (State::Claimed, ClaimEvent::ClaimedByWeaker | ClaimEvent::Asked) => (State::Claimed, Answer::Claim),
        (State::Claiming | State::Claimed, ClaimEvent::ClaimedByStronger) | (State::Lost, ClaimEvent::Asked) => {
            (State::Lost, Answer::CannotClaim)
        }
        (State::Claiming, ClaimEvent::Unopposed) => (State::Claimed, Answer::Nothing),
        (
            State::Idle,
            ClaimEvent::ClaimedByStronger | ClaimEvent::ClaimedByWeaker | ClaimEvent::Asked | ClaimEvent::Unopposed,
        )
        | (State::Claimed, ClaimEvent::Unopposed)
        | (State::Lost, ClaimEvent::ClaimedByStronger | ClaimEvent::ClaimedByWeaker | ClaimEvent::Unopposed) => {
            (state, Answer::Nothing)
        }
    }
}

/// The claim to one address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct AddressClaim {
    name: Name,
    address: u8,
    state: State,
    /// When contention ends, while claiming.
    unopposed_at: Timestamp,
    /// When a claim (or "cannot claim", in state lost) is to be sent.
    send_at: Option<Timestamp>,
    last_sent: Option<Timestamp>,
    /// The claim that begins the contention is still to be sent.
    is_first: bool,
}

impl AddressClaim {
    pub(super) fn new(name: Name, address: u8) -> Self {
        Self {
            name,
            address,
            state: State::Idle,
            unopposed_at: Timestamp::ZERO,
            send_at: None,
            last_sent: None,
            is_first: false,
        }
    }

    pub(super) const fn state(&self) -> State {
        self.state
    }

    /// Starts, or starts again after time nobody saw.
    pub(super) fn start(&mut self, now: Timestamp) {
        self.last_sent = None;
        self.send_at = None;
        self.is_first = true;
        self.happens(now, ClaimEvent::Started);
    }

    /// Another node claims our address.
    pub(super) fn contend(&mut self, now: Timestamp, by: Name) -> Option<NodeEvent> {
        let (before, was_answered) = (self.state, self.send_at.is_none());
        self.happens(now, if by <= self.name { ClaimEvent::ClaimedByStronger } else { ClaimEvent::ClaimedByWeaker });
        match (before, self.state) {
            (State::Claiming | State::Claimed, State::Lost) => Some(NodeEvent::AddressLost { to: by }),
            // Told once per answer: a flood of claims is answered at a limited rate.
            (State::Claiming | State::Claimed, State::Claiming | State::Claimed) => {
                was_answered.then_some(NodeEvent::AddressDefended { against: by })
            }
            (State::Idle | State::Lost, _) | (_, State::Idle) => None,
        }
    }

    /// Somebody asks for claims.
    pub(super) fn asked(&mut self, now: Timestamp) {
        self.happens(now, ClaimEvent::Asked);
    }

    fn happens(&mut self, now: Timestamp, happening: ClaimEvent) {
        let before = self.state;
        let (state, answer) = next(before, happening);
        self.state = state;
        let spaced = self.last_sent.map_or(now, |sent| now.max(sent.plus_nanos(CLAIM_SPACING_NS)));
        match answer {
            Answer::Nothing => {}
            Answer::Claim => self.send_at = Some(self.send_at.map_or(spaced, |due| due.min(spaced))),
            // What was to be sent before the loss was a claim.
            Answer::CannotClaim if before == State::Lost && self.send_at.is_some() => {}
            Answer::CannotClaim => self.send_at = Some(spaced.plus_nanos(self.loser_delay_ns())),
        }
        // Only the beginning counts: requests and weaker claims, however many, must not keep the node silent.
        if happening == ClaimEvent::Started {
            self.unopposed_at = now.plus_nanos(CONTENTION_NS);
        }
    }

    /// From the NAME, so that every run waits equally long and two nodes most likely do not.
    fn loser_delay_ns(&self) -> i64 {
        // Fibonacci hashing: neighbouring serial numbers come out far apart.
        let mixed = self.name.raw().wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        1_000_000 * i64::try_from(mixed % (MAX_LOSER_DELAY_MS + 1)).unwrap_or(0)
    }

    /// What is due: a frame to send, or the news that the address is ours.
    pub(super) fn poll(&mut self, now: Timestamp) -> (Option<Frame>, Option<NodeEvent>) {
        if let Some(due) = self.send_at {
            if now < due {
                return (None, None);
            }
            self.send_at = None;
            self.last_sent = Some(now);
            if self.state == State::Claiming && std::mem::take(&mut self.is_first) {
                self.unopposed_at = now.plus_nanos(CONTENTION_NS);
            }
            return (self.frame(), None);
        }
        if self.state == State::Claiming && now >= self.unopposed_at {
            self.happens(now, ClaimEvent::Unopposed);
            return (None, Some(NodeEvent::Claimed { address: self.address }));
        }
        (None, None)
    }

    fn frame(&self) -> Option<Frame> {
        let source = match self.state {
            State::Idle => return None,
            State::Claiming | State::Claimed => self.address,
            State::Lost => NULL_ADDRESS,
        };
        Frame::classic(can_id(PRIORITY, PGN_ADDRESS_CLAIMED, GLOBAL_ADDRESS, source), &self.name.to_bytes())
    }

    /// When `poll` has something to do.
    pub(super) fn next_due(&self) -> Option<Timestamp> {
        self.send_at.or((self.state == State::Claiming).then_some(self.unopposed_at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATES: [State; 4] = [State::Idle, State::Claiming, State::Claimed, State::Lost];
    const HAPPENINGS: [ClaimEvent; 5] = [
        ClaimEvent::Started,
        ClaimEvent::ClaimedByStronger,
        ClaimEvent::ClaimedByWeaker,
        ClaimEvent::Asked,
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
    fn every_state_answers_every_happening_as_the_table_says() {
        use Answer::{CannotClaim, Claim, Nothing};
        use State::{Claimed, Claiming, Idle, Lost};
        let wanted = [
            [(Claiming, Claim), (Idle, Nothing), (Idle, Nothing), (Idle, Nothing), (Idle, Nothing)],
            [(Claiming, Claim), (Lost, CannotClaim), (Claiming, Claim), (Claiming, Claim), (Claimed, Nothing)],
            [(Claiming, Claim), (Lost, CannotClaim), (Claimed, Claim), (Claimed, Claim), (Claimed, Nothing)],
            [(Claiming, Claim), (Lost, Nothing), (Lost, Nothing), (Lost, CannotClaim), (Lost, Nothing)],
        ];
        for (state, row) in STATES.into_iter().zip(wanted) {
            for (happening, wanted) in HAPPENINGS.into_iter().zip(row) {
                assert_eq!(next(state, happening), wanted, "{state:?}, {happening:?}");
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
    fn a_higher_name_is_answered_by_our_claim_and_lengthens_no_wait() {
        let mut claim = AddressClaim::new(name(10), 0xF9);
        claim.start(at(0));
        assert!(claim.poll(at(0)).0.is_some());
        assert_eq!(claim.contend(at(100), name(11)), Some(NodeEvent::AddressDefended { against: name(11) }));
        assert_eq!(claim.poll(at(100)).0.unwrap().id().raw(), 0x18EE_FFF9);
        // Somebody asks for claims all the time: the address is ours all the same.
        claim.asked(at(250));
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
    fn our_own_name_from_another_node_silences_us() {
        let mut claim = claimed(10);
        assert_eq!(claim.contend(at(1000), name(10)), Some(NodeEvent::AddressLost { to: name(10) }));
        assert_eq!(claim.state(), State::Lost);
    }

    #[test]
    fn a_flood_of_claims_is_answered_every_50_ms() {
        let mut claim = claimed(10);
        let (mut sent, mut told) = (0, 0);
        for ms in 1000..2000 {
            told += usize::from(claim.contend(at(ms), name(11)).is_some());
            sent += usize::from(claim.poll(at(ms)).0.is_some());
        }
        assert_eq!(sent, 20);
        assert!(told <= 21, "told once per answer, not {told} times");
    }

    #[test]
    fn a_loser_asked_for_its_claim_says_that_it_has_none() {
        let mut claim = claimed(10);
        claim.contend(at(1000), name(9));
        assert!(claim.poll(at(1153)).0.is_some());
        claim.asked(at(5000));
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
