//! Limits each sent trouble code to one change a second (J1939-73).
//!
//! A code is added to the message when it becomes active, and removed when it becomes inactive. If the code's last
//! change on the bus is less than a second ago, the new change waits. If the code was active only during this wait, it
//! is still sent for at least a second. If the code was inactive only during this wait, it stays in the message with a
//! higher count.
//!
//! The state "all values are known" also waits when it becomes true. When it becomes false, the change is sent at once.

use serde::{Deserialize, Serialize};

use super::trouble_code::{Lamp, Lamps, TroubleCode};
use crate::quantity::Timestamp;

/// Maximum number of followed codes. No configuration has as many (18 rules with three severities give 54), and a
/// linear search is fast enough.
const MAX_FOLLOWED: usize = 64;

/// An active code and its lamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActiveCode {
    pub code: TroubleCode,
    pub lamp: Lamp,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct FollowedCode {
    code: TroubleCode,
    is_active: bool,
    /// Whether the code became active while it was not on the bus, and has not been sent since then.
    is_unseen: bool,
    /// Lamp to send: the present lamp, or a more severe lamp that was not sent yet.
    lamp: Lamp,
    lamp_now: Lamp,
    /// Lamp with which the code is now sent; `None` = the code is not sent.
    shown: Option<Lamp>,
    changed_at: Option<Timestamp>,
    /// Whether the latest change is in a message that is still being transferred.
    is_in_flight: bool,
}

impl FollowedCode {
    fn new(active: &ActiveCode) -> Self {
        Self {
            code: active.code,
            is_active: true,
            is_unseen: true,
            lamp: active.lamp,
            lamp_now: active.lamp,
            shown: None,
            changed_at: None,
            is_in_flight: false,
        }
    }

    fn wanted(&self) -> Option<Lamp> {
        (self.is_active || self.is_unseen).then_some(self.lamp)
    }

    /// Time from which the waiting change may be sent; `None` = no change waits.
    fn due(&self) -> Option<Timestamp> {
        (self.wanted() != self.shown).then_some(spaced(self.changed_at))
    }

    /// The lamp of this code in a message sent at `now`; `None` = the message does not contain the code.
    fn shown_at(&self, now: Timestamp) -> Option<Lamp> {
        if self.due().is_some_and(|due| due <= now) { self.wanted() } else { self.shown }
    }

    fn activate(&mut self, active: &ActiveCode) {
        // If the list contains the code twice, the more severe lamp and the higher count apply.
        let (lamp_before, count_before) = match self.is_active {
            true => (self.lamp_now, self.code.occurrence_count()),
            false => (Lamp::None, 0),
        };
        self.is_active = true;
        self.is_unseen |= self.shown.is_none();
        self.lamp_now = active.lamp.max(lamp_before);
        self.code = active.code.with_occurrences(active.code.occurrence_count().max(count_before).into());
    }

    /// Keeps a more severe lamp that has not been sent yet.
    fn settle_lamp(&mut self) {
        if self.is_active {
            let is_unseen = self.shown.is_none_or(|shown| self.lamp > shown);
            self.lamp = if is_unseen { self.lamp.max(self.lamp_now) } else { self.lamp_now };
        }
    }
}

fn spaced(changed_at: Option<Timestamp>) -> Timestamp {
    // At least 1 s (in ns) between two changes of a code on the bus.
    changed_at.map_or(Timestamp::from_nanos(i64::MIN), |changed| changed.plus_nanos(1_000_000_000))
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(super) struct Codes {
    followed: Vec<FollowedCode>,
    all_known: bool,
    all_known_shown: bool,
    known_changed_at: Option<Timestamp>,
}

impl Codes {
    /// Sets the codes that are active now. At most [`MAX_FOLLOWED`] codes are followed.
    pub(super) fn set(&mut self, now: Timestamp, active: &[ActiveCode], all_known: bool) {
        self.forget_settled(now);
        self.all_known = all_known;
        for followed in &mut self.followed {
            followed.is_active = false;
        }
        for active in active {
            match self.followed.iter().position(|followed| followed.code.is_same_failure(active.code)) {
                Some(index) => self.followed[index].activate(active),
                None if self.followed.len() < MAX_FOLLOWED => self.followed.push(FollowedCode::new(active)),
                None => {}
            }
        }
        for followed in &mut self.followed {
            followed.settle_lamp();
        }
    }

    /// Removes codes that are inactive and not sent.
    fn forget_settled(&mut self, now: Timestamp) {
        self.followed.retain(|f| {
            let is_settled = f.wanted().is_none() && f.shown.is_none() && !f.is_in_flight;
            !is_settled || now < spaced(f.changed_at)
        });
    }

    pub(super) fn restart(&mut self) {
        self.followed.retain(|followed| followed.is_active);
        for followed in &mut self.followed {
            *followed = FollowedCode::new(&ActiveCode { code: followed.code, lamp: followed.lamp_now });
        }
        self.all_known_shown = false;
        self.known_changed_at = None;
    }

    /// Time from which the next waiting change may be sent; `None` = all changes have been sent.
    pub(super) fn change_due(&self) -> Option<Timestamp> {
        let known = match (self.all_known, self.all_known_shown) {
            (true, true) | (false, false) => None,
            (true, false) => Some(spaced(self.known_changed_at)),
            (false, true) => Some(Timestamp::from_nanos(i64::MIN)),
        };
        self.changes().chain(known).min()
    }

    pub(super) fn changes(&self) -> impl Iterator<Item = Timestamp> {
        self.followed.iter().filter_map(FollowedCode::due)
    }

    /// Number of codes in a message sent at `now`.
    pub(super) fn count_at(&self, now: Timestamp) -> usize {
        self.followed.iter().filter(|followed| followed.shown_at(now).is_some()).count()
    }

    /// Applies every due change to a message built at `now`.
    pub(super) fn show(&mut self, now: Timestamp) {
        for followed in &mut self.followed {
            if followed.due().is_some_and(|due| due <= now) {
                followed.shown = followed.wanted();
                followed.is_unseen = false;
                followed.lamp = if followed.is_active { followed.lamp_now } else { Lamp::None };
                followed.changed_at = Some(now);
                followed.is_in_flight = true;
            }
        }
        if self.all_known != self.all_known_shown && (!self.all_known || spaced(self.known_changed_at) <= now) {
            self.all_known_shown = self.all_known;
            self.known_changed_at = Some(now);
        }
    }

    /// Handles the end of a message's transfer. From then on, the codes that the message changed stay unchanged on the
    /// bus for a second.
    pub(super) fn sent(&mut self, now: Timestamp) {
        for followed in self.followed.iter_mut().filter(|followed| followed.is_in_flight) {
            followed.changed_at = Some(now);
            followed.is_in_flight = false;
        }
    }

    /// The lamps of all sent codes, including the codes that do not fit into the message.
    pub(super) fn lamps(&self) -> Lamps {
        Lamps::of(self.followed.iter().filter_map(|followed| followed.shown), self.all_known_shown)
    }

    pub(super) fn shown(&self) -> Vec<TroubleCode> {
        let mut shown: Vec<(Lamp, TroubleCode)> =
            self.followed.iter().filter_map(|followed| Some((followed.shown?, followed.code))).collect();
        shown.sort_by_key(|&(lamp, code)| (std::cmp::Reverse(lamp), code));
        shown.into_iter().map(|(_, code)| code).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::trouble_code::LampState;
    use super::*;

    fn at(ms: i64) -> Timestamp {
        Timestamp::from_nanos(ms * 1_000_000)
    }

    fn active(spn: u32, lamp: Lamp, count: u32) -> ActiveCode {
        ActiveCode { code: TroubleCode::new(spn, 31, count).unwrap(), lamp }
    }

    /// Sets the active codes and sends a message. Returns the codes of the message.
    fn step(codes: &mut Codes, ms: i64, now_active: &[ActiveCode]) -> Vec<u32> {
        codes.set(at(ms), now_active, true);
        codes.show(at(ms));
        codes.sent(at(ms));
        codes.shown().iter().map(|code| code.spn()).collect()
    }

    #[test]
    fn new_code_is_sent_at_once_and_next_change_waits() {
        let mut codes = Codes::default();
        assert_eq!(step(&mut codes, 0, &[active(1, Lamp::Amber, 1)]), [1]);
        assert_eq!(step(&mut codes, 10, &[]), [1]);
        assert_eq!(codes.change_due(), Some(at(1000)));
        assert_eq!(step(&mut codes, 999, &[]), [1]);
        assert_eq!(step(&mut codes, 1000, &[]), [] as [u32; 0]);
        assert_eq!(codes.change_due(), None);
    }

    #[test]
    fn briefly_active_code_is_sent_for_a_second() {
        let mut codes = Codes::default();
        step(&mut codes, 0, &[active(1, Lamp::Amber, 1)]);
        assert_eq!(step(&mut codes, 1000, &[]), [] as [u32; 0]);
        assert_eq!(step(&mut codes, 1100, &[active(1, Lamp::Amber, 2)]), [] as [u32; 0]);
        assert_eq!(step(&mut codes, 1200, &[]), [] as [u32; 0]);
        assert_eq!(step(&mut codes, 2000, &[]), [1], "sent although no longer active");
        assert_eq!(codes.shown()[0].occurrence_count(), 2);
        assert_eq!(step(&mut codes, 2999, &[]), [1]);
        assert_eq!(step(&mut codes, 3000, &[]), [] as [u32; 0]);
    }

    #[test]
    fn briefly_inactive_code_stays_with_new_count() {
        let mut codes = Codes::default();
        step(&mut codes, 0, &[active(1, Lamp::Amber, 1)]);
        assert_eq!(step(&mut codes, 100, &[]), [1]);
        assert_eq!(step(&mut codes, 200, &[active(1, Lamp::Amber, 2)]), [1]);
        assert_eq!(codes.change_due(), None);
        assert_eq!(codes.shown()[0].occurrence_count(), 2);
    }

    #[test]
    fn codes_do_not_wait_for_each_other() {
        let mut codes = Codes::default();
        assert_eq!(step(&mut codes, 0, &[active(1, Lamp::Amber, 1)]), [1]);
        assert_eq!(step(&mut codes, 100, &[active(1, Lamp::Amber, 1), active(2, Lamp::Amber, 1)]), [1, 2]);
    }

    #[test]
    fn briefly_worse_lamp_is_still_sent() {
        let mut codes = Codes::default();
        let red = |codes: &Codes| codes.lamps().red;
        step(&mut codes, 0, &[active(1, Lamp::Amber, 1)]);
        step(&mut codes, 100, &[active(1, Lamp::Red, 1)]);
        step(&mut codes, 200, &[active(1, Lamp::Amber, 1)]);
        assert_eq!((red(&codes), codes.change_due()), (LampState::Off, Some(at(1000))));
        step(&mut codes, 1000, &[active(1, Lamp::Amber, 1)]);
        assert_eq!(red(&codes), LampState::On, "the lamp was red in between");
        step(&mut codes, 1500, &[active(1, Lamp::Amber, 1)]);
        assert_eq!(red(&codes), LampState::On);
        step(&mut codes, 2000, &[active(1, Lamp::Amber, 1)]);
        assert_eq!((red(&codes), codes.change_due()), (LampState::Off, None));
    }

    #[test]
    fn milder_lamp_is_sent() {
        let mut codes = Codes::default();
        step(&mut codes, 0, &[active(1, Lamp::Red, 1)]);
        step(&mut codes, 5000, &[active(1, Lamp::Protect, 1)]);
        assert_eq!(codes.lamps(), Lamps::of([Lamp::Protect], true));
    }

    #[test]
    fn code_returning_milder_does_not_light_old_lamp() {
        let mut codes = Codes::default();
        step(&mut codes, 0, &[active(1, Lamp::Red, 1)]);
        step(&mut codes, 1000, &[]);
        step(&mut codes, 1500, &[active(1, Lamp::Amber, 2)]);
        step(&mut codes, 2000, &[active(1, Lamp::Amber, 2)]);
        assert_eq!(codes.lamps(), Lamps::of([Lamp::Amber], true));
    }

    #[test]
    fn duplicate_failure_keeps_worse_lamp_and_higher_count() {
        let mut codes = Codes::default();
        assert_eq!(step(&mut codes, 0, &[active(1, Lamp::Red, 1), active(1, Lamp::Amber, 5)]), [1]);
        assert_eq!(codes.lamps(), Lamps::of([Lamp::Red], true));
        assert_eq!(codes.shown()[0].occurrence_count(), 5);
    }

    #[test]
    fn unknown_is_sent_at_once_but_known_waits() {
        let mut codes = Codes::default();
        let show = |codes: &mut Codes, ms, all_known| {
            codes.set(at(ms), &[], all_known);
            codes.show(at(ms));
            codes.lamps() == Lamps::default()
        };
        assert!(!Codes::default().all_known_shown, "unknown at the start");
        assert!(show(&mut codes, 0, true));
        assert!(!show(&mut codes, 10, false));
        assert!(!show(&mut codes, 1009, true));
        assert!(show(&mut codes, 1010, true));
        assert!(!show(&mut codes, 1011, false), "unknown is sent without delay");
    }

    #[test]
    fn codes_are_sorted_by_lamp_then_number() {
        let mut codes = Codes::default();
        let lamps = [(4, Lamp::None), (3, Lamp::Red), (2, Lamp::Amber), (1, Lamp::Red), (5, Lamp::Protect)];
        assert_eq!(step(&mut codes, 0, &lamps.map(|(spn, lamp)| active(spn, lamp, 1))), [1, 3, 2, 5, 4]);
    }

    #[test]
    fn followed_codes_are_bounded_and_forgotten() {
        let mut codes = Codes::default();
        let many: Vec<_> = (1..=70).map(|spn| active(spn, Lamp::Amber, 1)).collect();
        codes.set(at(0), &many, true);
        assert_eq!(codes.followed.len(), MAX_FOLLOWED);
        codes.show(at(0));
        codes.sent(at(0));
        step(&mut codes, 1000, &[]);
        step(&mut codes, 2000, &[]);
        assert_eq!(codes.followed, []);
    }

    #[test]
    fn restart_forgets_inactive_and_renews_active_codes() {
        let mut codes = Codes::default();
        step(&mut codes, 0, &[active(1, Lamp::Amber, 1), active(2, Lamp::Red, 1)]);
        codes.set(at(10), &[active(2, Lamp::Amber, 1)], true);
        codes.restart();
        assert_eq!(codes.lamps(), Lamps::of([], false));
        codes.show(at(20));
        assert_eq!(codes.shown().len(), 1);
        assert_eq!(codes.lamps(), Lamps::of([Lamp::Amber], true));
    }
}
