//! Which pack is connected, where the bus says so.
//!
//! In: readings of the identity signal. Out: the number that is known, and another pack when enough readings in a row
//! say another one. Bad readings and single odd ones say nothing. The number is kept over restarts, so that a pack
//! changed meanwhile is found.

use serde::{Deserialize, Serialize};

use super::{Command, Event, EventKind, Monitor, Outputs, Source};
use crate::quantity::{BusIndex, Fault};

/// What the signal has said.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Identity {
    known: Option<f64>,
    /// Another number, and how many readings in a row have said it.
    #[serde(skip)]
    candidate: Option<(f64, u32)>,
}

impl Identity {
    /// Takes a reading; the new number when it has been said often enough.
    fn observe(&mut self, value: f64, readings: u32) -> Option<f64> {
        if self.known == Some(value) {
            self.candidate = None;
            return None;
        }
        let count = self.candidate.filter(|(number, _)| *number == value).map_or(0, |(_, count)| count) + 1;
        self.candidate = Some((value, count));
        (count >= readings).then_some(value)
    }
}

impl Monitor {
    /// The number of the pack that is connected; `None` = no signal is configured, or it has said nothing yet.
    pub fn pack_identity(&self) -> Option<f64> {
        self.identity.known
    }

    pub(super) fn observe_identity(&mut self, bus: BusIndex, reading: Result<f64, Fault>, out: &mut Outputs) {
        let Some(value) = reading.ok().filter(|value| value.is_finite()) else { return };
        let Some(identity) = self.identity.observe(value, self.config.identity_readings) else { return };
        let is_another = self.identity.known.is_some();
        self.identity = Identity { known: Some(identity), candidate: None };
        if is_another {
            self.handle_command(Source::Bus(bus), Command::PackReplaced, out);
        }
        out.events.push(Event { time: self.now, kind: EventKind::PackIdentity { identity } });
    }
}
