//! Sends simulated frames on a CAN interface, in real time, or faster or slower by a factor.

use std::time::{Duration, Instant};

use crate::can::Frame;
use crate::cli::common::output::failure;
use crate::io::socket::CanSender;
use crate::quantity::Timestamp;
use packwatch_host::failure::Failure;

pub(super) struct Player {
    sender: CanSender,
    speed: f64,
    /// Time at which the first frame was sent, and its time stamp.
    started: Option<(Instant, Timestamp)>,
}

impl Player {
    /// Opens `interface`; speed 0 sends without waiting.
    pub(super) fn open(interface: &str, fd: bool, speed: f64) -> Result<Self, Failure> {
        let sender = CanSender::open(interface, fd).map_err(failure)?;
        Ok(Self { sender, speed, started: None })
    }

    /// Waits until the frame is due, then sends it. The frames of all configured interfaces are sent on this one
    /// interface.
    pub(super) fn play(&mut self, time: Timestamp, frame: &Frame) -> Result<(), Failure> {
        let (start, first) = *self.started.get_or_insert_with(|| (Instant::now(), time));
        if self.speed > 0.0 {
            let due = Duration::try_from_secs_f64(time.since(first) / self.speed).unwrap_or_default();
            if let Some(wait) = due.checked_sub(start.elapsed()) {
                std::thread::sleep(wait);
            }
        }
        self.sender.send(frame).map_err(failure)
    }
}
