//! Everything an interface has: all identifiers, classic and FD, error frames, and what the kernel dropped.

use std::io;

use nix::errno::Errno;

use super::raw::RawSocket;
use super::wire::Wire;
use crate::can::Frame;
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::quantity::Timestamp;

/// One thing that came.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Tapped {
    /// A frame.
    Frame(Frame),
    /// An error frame: its class.
    Error(u32),
    /// The kernel dropped so many frames.
    Dropped(u64),
}

/// Listens on one interface; sends nothing and never waits.
#[derive(Debug)]
pub(crate) struct Tap {
    socket: RawSocket,
    mapper: StampMapper,
    dropped_total: u32,
    /// The clocks as last read: before what is read next.
    before: Reading,
}

impl Tap {
    /// Opens the interface; whether it is up.
    ///
    /// # Errors
    /// When the interface does not exist, or this kernel has no SocketCAN.
    pub(crate) fn open(interface: &str, clock: MappedClock) -> io::Result<(Self, bool)> {
        let socket = RawSocket::open_all(interface)?;
        let is_up = socket.take_error()?.is_none();
        let before = Reading::now();
        Ok((Self { socket, mapper: StampMapper::new(clock, before), dropped_total: 0, before }, is_up))
    }

    /// The next thing that has come, and when; `None` = there is nothing now.
    ///
    /// # Errors
    /// When the interface went down (`ENETDOWN`: the tap stays good) or away.
    pub(crate) fn next(&mut self, into: &mut Vec<(Timestamp, Tapped)>) -> io::Result<bool> {
        match self.socket.receive() {
            Ok(received) => {
                self.before = Reading::now();
                let time = self.mapper.arrival(received.stamps, self.before);
                if let Some(total) = received.dropped_total {
                    let lost = total.wrapping_sub(std::mem::replace(&mut self.dropped_total, total));
                    into.extend((lost > 0).then_some((time, Tapped::Dropped(u64::from(lost)))));
                }
                match received.what {
                    Wire::Frame(frame) => into.push((time, Tapped::Frame(frame))),
                    Wire::Error(class) => into.push((time, Tapped::Error(class))),
                    Wire::Malformed => into.push((time, Tapped::Dropped(1))),
                }
                Ok(true)
            }
            Err(Errno::EAGAIN) => {
                self.mapper.socket_empty(self.before);
                self.before = Reading::now();
                Ok(false)
            }
            Err(Errno::EINTR) => Ok(true),
            Err(error) => Err(error.into()),
        }
    }
}
