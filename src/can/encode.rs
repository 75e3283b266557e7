//! What the daemon sends, laid out by a DBC ([`OutputPlan`]); and input frames made from values, for CSV replay and
//! the simulator ([`InputEncoder`]).
//!
//! In: values in the program's units (fractions, Ah, s, A positive for discharge). Out: frames. What is unknown goes
//! out as the signal's "not available" code, never as a number.

mod input;
mod output;
mod protector;

pub use input::InputEncoder;
pub use output::{AlarmFields, HealthFields, IdOverrides, OutputPlan, PlanFaults, StatusFields, default_database};
pub use protector::InputProtector;

use crate::can::{CanId, Frame, MAX_DATA};

/// Payload lengths of CAN FD above 8 bytes.
const FD_STEPS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

/// A frame of at least `len` bytes: classic up to 8, FD above, rounded up to a length FD has. `None` beyond 64.
fn frame_of(id: CanId, len: usize, payload: &[u8; MAX_DATA]) -> Option<Frame> {
    if len <= 8 {
        return Frame::classic(id, payload.get(..len)?);
    }
    let step = FD_STEPS.into_iter().find(|step| *step >= len)?;
    Frame::fd(id, false, false, payload.get(..step)?)
}
