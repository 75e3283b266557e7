//! Tracks the state of the interfaces for the alarm rule about interfaces.
//!
//! An interface counts as faulty in three cases:
//! * while it is down or missing;
//! * from bus-off until the interface is up again, has restarted or receives a frame;
//! * while the daemon's frames cannot be sent.
//!
//! The state of an interface is unknown before its first report. After a restart, a fault continues until the interface
//! reports that it works.

use serde::{Deserialize, Serialize};

use crate::monitor::message::BusEvent;
use crate::quantity::{BusIndex, Timestamp};

/// Error class bits of an error frame (linux/can/error.h).
pub(crate) const CAN_ERR_BUSOFF: u32 = 0x40;
const CAN_ERR_RESTARTED: u32 = 0x100;

/// If no report of unsent frames arrives for this time, sending counts as working again (s). The daemon's sockets report
/// unsent frames every 0.25 s, so this is four report periods.
const SEND_RECOVERED_S: f64 = 1.0;

#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
struct BusState {
    is_known: bool,
    down_since: Option<Timestamp>,
    off_since: Option<Timestamp>,
    /// First and latest report that frames could not be sent.
    unsent: Option<(Timestamp, Timestamp)>,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Buses {
    states: Vec<BusState>,
}

impl Buses {
    pub(crate) fn handle_event(&mut self, now: Timestamp, bus: BusIndex, event: BusEvent) {
        let state = self.state(bus);
        state.is_known = true;
        match event {
            BusEvent::Up => *state = BusState { is_known: true, unsent: state.unsent, ..BusState::default() },
            BusEvent::Down | BusEvent::Missing => state.down_since = state.down_since.or(Some(now)),
            BusEvent::ErrorFrame { class } if class & CAN_ERR_RESTARTED != 0 => state.off_since = None,
            BusEvent::ErrorFrame { class } if class & CAN_ERR_BUSOFF != 0 => {
                state.off_since = state.off_since.or(Some(now));
            }
            BusEvent::SendFailed { .. } => {
                let first = state.unsent.filter(|(_, latest)| now.since(*latest) <= SEND_RECOVERED_S);
                state.unsent = Some((first.map_or(now, |(first, _)| first), now));
            }
            BusEvent::ErrorFrame { .. } | BusEvent::Dropped { .. } => {}
        }
    }

    /// Handles a received frame, which ends a bus-off.
    #[inline]
    pub(crate) fn handle_frame(&mut self, bus: BusIndex) {
        let state = self.state(bus);
        (state.is_known, state.off_since) = (true, None);
    }

    /// Duration of the longest present fault of an interface (s) and whether all `interfaces` have reported. The
    /// duration is 0 if no interface that has reported is faulty, and `None` if no interface has reported.
    pub(crate) fn worst_s(&self, now: Timestamp, interfaces: usize) -> (Option<f64>, bool) {
        let known = self.states.iter().filter(|state| state.is_known);
        let worst_s = known.clone().map(|state| state.fault_s(now)).max_by(f64::total_cmp);
        (worst_s, known.count() >= interfaces)
    }

    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        let moved = |stamp: Timestamp| stamp.plus_nanos(by_nanos);
        for state in &mut self.states {
            (state.down_since, state.off_since) = (state.down_since.map(moved), state.off_since.map(moved));
            state.unsent = state.unsent.map(|(first, latest)| (moved(first), moved(latest)));
        }
    }

    /// Continues at `now` with the faults stored at `taken`. Faults are kept, but the state of each interface is
    /// unknown until the interface reports. If frames could not be sent at `taken`, sending counts as faulty for
    /// another [`SEND_RECOVERED_S`].
    pub(crate) fn restored(mut self, taken: Timestamp, now: Timestamp) -> Self {
        for state in &mut self.states {
            let unsent = state.unsent.filter(|(_, latest)| taken.since(*latest) <= SEND_RECOVERED_S);
            state.unsent = unsent.map(|(first, _)| (first, now));
            state.is_known = false;
        }
        self
    }

    fn state(&mut self, bus: BusIndex) -> &mut BusState {
        if self.states.len() <= bus.index() {
            self.states.resize(bus.index() + 1, BusState::default());
        }
        &mut self.states[bus.index()]
    }
}

impl BusState {
    fn fault_s(&self, now: Timestamp) -> f64 {
        let unsent = self.unsent.filter(|(_, latest)| now.since(*latest) <= SEND_RECOVERED_S);
        let since = [self.down_since, self.off_since, unsent.map(|(first, _)| first)];
        // A duration of 0 means "no fault", so a fault that starts now gets a minimal duration.
        since.into_iter().flatten().map(|since| now.since(since).max(1e-9)).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BUS: BusIndex = BusIndex(1);

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_secs(seconds)
    }

    #[test]
    fn interface_fault_lasts_from_first_to_last_report() {
        for (fault, end) in [
            (BusEvent::Down, Some(BusEvent::Up)),
            (BusEvent::Missing, Some(BusEvent::Up)),
            (BusEvent::ErrorFrame { class: 0x40 }, Some(BusEvent::ErrorFrame { class: 0x100 })),
            (BusEvent::ErrorFrame { class: 0x40 }, Some(BusEvent::Up)),
            (BusEvent::SendFailed { frames: 3 }, None),
        ] {
            let mut buses = Buses::default();
            assert_eq!(buses.worst_s(at(0.0), 1).0, None);
            buses.handle_event(at(1.0), BUS, BusEvent::Up);
            assert_eq!(buses.worst_s(at(2.0), 1).0, Some(0.0));
            buses.handle_event(at(3.0), BUS, fault);
            assert!(buses.worst_s(at(3.0), 1).0.is_some_and(|fault_s| fault_s > 0.0));
            buses.handle_event(at(3.8), BUS, fault);
            assert_eq!(buses.worst_s(at(4.5), 1).0, Some(1.5), "{fault:?}");
            if let Some(end) = end {
                assert_eq!(buses.worst_s(at(9.0), 1).0, Some(6.0), "{fault:?}");
                buses.handle_event(at(9.0), BUS, end);
            }
            assert_eq!(buses.worst_s(at(9.0), 1).0, Some(0.0), "{fault:?}");
        }
    }

    #[test]
    fn frame_ends_bus_off_and_other_errors_are_ignored() {
        let mut buses = Buses::default();
        buses.handle_event(at(0.0), BUS, BusEvent::ErrorFrame { class: 0x40 });
        buses.handle_frame(BUS);
        buses.handle_event(at(1.0), BUS, BusEvent::ErrorFrame { class: 0x4 });
        buses.handle_event(at(1.0), BUS, BusEvent::Dropped { frames: 9 });
        assert_eq!(buses.worst_s(at(2.0), 1).0, Some(0.0));
    }
}
