//! Protects generated input frames (CSV replay, simulator) as a sender with end-to-end protection does.
//!
//! In: frames in sending order. Each frame of a protected message gets the next counter and its CRC. Other frames, and
//! frames that are too short for the header, stay unchanged.

use crate::can::e2e::Protection;
use crate::can::guard::GuardConfig;
use crate::can::{CanId, Frame};
use crate::quantity::BusIndex;

/// Adds counters and CRCs to all protected input messages.
#[derive(Debug, Clone, Default)]
pub struct InputProtector {
    senders: Vec<MessageSender>,
}

#[derive(Debug, Clone)]
struct MessageSender {
    bus: BusIndex,
    id: CanId,
    protection: Protection,
    counter: u8,
}

impl InputProtector {
    /// Creates a protector whose counters start at 0.
    pub fn new(guards: &[GuardConfig]) -> Self {
        let sender = |guard: &GuardConfig| MessageSender {
            bus: guard.bus,
            id: guard.id,
            protection: guard.check.protection,
            counter: 0,
        };
        Self { senders: guards.iter().map(sender).collect() }
    }

    /// Adds counter and CRC to the frames of protected messages.
    pub fn protect(&mut self, frames: &mut [(BusIndex, Frame)]) {
        if self.senders.is_empty() {
            return;
        }
        for (bus, frame) in frames {
            let key = (*bus, frame.id());
            if let Some(sender) = self.senders.iter_mut().find(|sender| (sender.bus, sender.id) == key)
                && sender.protection.protect(frame.data_mut(), sender.counter).is_ok()
            {
                sender.counter = sender.protection.profile.next_counter(sender.counter);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests may panic")]

    use super::*;
    use crate::can::e2e::{CheckConfig, Profile, Status};
    use crate::can::guard::Guards;
    use crate::quantity::Timestamp;

    #[test]
    fn protected_frames_pass_guard_and_others_are_unchanged() {
        let protection = Protection { profile: Profile::P01C, data_id: 0x0456 };
        let (bus, id) = (BusIndex(0), CanId::Standard(0x123));
        let guard = GuardConfig { bus, id, check: CheckConfig::new(protection), cycle_time_s: None };
        let (mut guards, mut protector) = (Guards::new(vec![guard]), InputProtector::new(&[guard]));
        let other = Frame::classic(CanId::Standard(0x124), &[9; 8]).unwrap();
        let short = Frame::classic(id, &[9]).unwrap();
        for n in 0..100 {
            let mut frames = vec![(bus, Frame::classic(id, &[n; 8]).unwrap()), (bus, other), (bus, short)];
            protector.protect(&mut frames);
            let wanted = if n == 0 { Status::Initial } else { Status::Ok };
            assert_eq!(guards.check(Timestamp::ZERO, bus, &frames[0].1), Some(wanted));
            assert_eq!((frames[1].1, frames[2].1), (other, short));
        }
    }
}
