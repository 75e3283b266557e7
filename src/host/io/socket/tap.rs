//! Receives everything on an interface: all identifiers, classic and FD, error frames, and the number of dropped frames.

use std::io;

use nix::errno::Errno;

use super::raw::{CALL_BATCH, RawRead, RawSocket};
use super::wire::Wire;
use crate::can::Frame;
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::quantity::Timestamp;

/// A frame or event on the interface.
#[derive(Debug, Clone, Copy)]
pub enum TapEvent {
    /// A frame.
    Frame(Frame),
    /// An error frame: its class.
    Error(u32),
    /// Number of frames the kernel dropped.
    Dropped(u64),
}

/// Listens on one interface; sends nothing and never waits.
#[derive(Debug)]
pub struct Tap {
    socket: RawSocket,
    mapper: StampMapper,
    /// Frames of one call; kept to reuse its memory.
    received: Vec<RawRead>,
    dropped_total: u32,
    /// The clocks as last read: before what is read next.
    before: Reading,
}

impl Tap {
    /// Opens the interface; whether it is up.
    ///
    /// # Errors
    /// When the interface does not exist, or this kernel has no SocketCAN.
    pub fn open(interface: &str, clock: MappedClock) -> io::Result<(Self, bool)> {
        let socket = RawSocket::open_all(interface)?;
        let is_up = socket.take_error()?.is_none();
        let before = Reading::now();
        let (mapper, received) = (StampMapper::new(clock, before), Vec::with_capacity(CALL_BATCH));
        Ok((Self { socket, mapper, received, dropped_total: 0, before }, is_up))
    }

    /// Appends the frames and events received so far with their times; `false` = there are no more now.
    ///
    /// # Errors
    /// When the interface went down (`ENETDOWN`: the tap stays good) or away.
    pub fn next(&mut self, into: &mut Vec<(Timestamp, TapEvent)>) -> io::Result<bool> {
        self.received.clear();
        match self.socket.receive(&mut self.received) {
            Ok(()) => self.before = Reading::now(),
            Err(Errno::EAGAIN) => {
                self.mapper.socket_empty(self.before);
                self.before = Reading::now();
                self.note_dropped(into);
                return Ok(false);
            }
            Err(Errno::EINTR) => return Ok(true),
            Err(error) => return Err(error.into()),
        }
        for received in &self.received {
            let time = self.mapper.arrival(received.stamps, self.before);
            let what = match received.what {
                Wire::Frame(frame) => TapEvent::Frame(frame),
                Wire::Error(class) => TapEvent::Error(class),
                Wire::Malformed => TapEvent::Dropped(1),
            };
            into.push((time, what));
        }
        Ok(true)
    }

    fn note_dropped(&mut self, into: &mut Vec<(Timestamp, TapEvent)>) {
        let total = self.socket.dropped_total();
        let lost = total.wrapping_sub(std::mem::replace(&mut self.dropped_total, total));
        if lost > 0 {
            into.push((self.mapper.event(self.before), TapEvent::Dropped(u64::from(lost))));
        }
    }
}
