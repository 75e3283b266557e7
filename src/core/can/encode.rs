//! The daemon's frames, laid out by a DBC ([`layout`], [`OutputPlan`]); its command frame ([`CommandPlan`]); and input frames
//! made from values, for CSV replay and the simulator ([`InputEncoder`]).
//!
//! In: values in the program's units (fractions, Ah, s, A positive for discharge). Out: frames. An unknown value is sent as
//! the signal's "not available" code, never as a number.

mod command;
mod input;
mod layout;
mod message;
mod output;
mod protector;

pub use command::{Command, CommandFault, CommandFields, CommandPlan};
pub use input::InputEncoder;
pub use layout::{
    E2eSetting, LayoutBase, LayoutMessage, LayoutSettings, MessageSettings, SettingFault, default_database, layout,
};
pub use output::{AlarmFields, HealthFields, OutputPlan, PlanFaults, SendCounters, StatusFields};
pub use protector::InputProtector;

use crate::can::{CanId, Frame, MAX_DATA};

/// Payload lengths of CAN FD above 8 bytes.
const FD_STEPS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];

/// Whether a frame, classic or FD, can have exactly this length.
fn is_frame_length(len: usize) -> bool {
    len <= 8 || FD_STEPS.contains(&len)
}

/// An FD frame of at least `len` bytes, rounded up to a length FD has. `None` beyond 64.
fn fd_frame(id: CanId, brs: bool, len: usize, payload: &[u8; MAX_DATA]) -> Option<Frame> {
    let step = if len <= 8 { len } else { FD_STEPS.into_iter().find(|step| *step >= len)? };
    Frame::fd(id, brs, false, payload.get(..step)?)
}

/// A frame of at least `len` bytes: classic up to 8, FD above. `None` beyond 64.
fn frame_of(id: CanId, len: usize, payload: &[u8; MAX_DATA]) -> Option<Frame> {
    if len <= 8 { Frame::classic(id, payload.get(..len)?) } else { fd_frame(id, false, len, payload) }
}
