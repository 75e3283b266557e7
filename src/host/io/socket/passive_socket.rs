//! Receives from an interface without blocking: frames (including frames that this computer sends), error frames, and
//! the number of dropped frames.

use std::io;

use nix::errno::Errno;
use socketcan::CanFilter;

use super::raw::{CALL_BATCH, DEFAULT_RECEIVE_BUFFER_BYTES, RawRead, RawSocket, filters};
use super::wire::Wire;
use crate::can::CanId;
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::monitor::{BusEvent, Record};
use crate::quantity::BusIndex;

/// Listens on one interface. It sends nothing and never waits.
#[derive(Debug)]
pub struct PassiveSocket {
    socket: RawSocket,
    mapper: StampMapper,
    /// Frames of the latest call; kept to reuse the memory.
    received: Vec<RawRead>,
    dropped_total: u32,
    /// Clock reading taken after the latest read from the socket.
    before: Reading,
}

impl PassiveSocket {
    /// Opens the interface for all identifiers, classic and FD. Also returns whether the interface is up.
    ///
    /// # Errors
    /// Fails if the interface does not exist, or this kernel has no SocketCAN.
    pub fn open(interface: &str, clock: MappedClock) -> io::Result<(Self, bool)> {
        let socket = RawSocket::open(interface, true, &[CanFilter::new(0, 0)], DEFAULT_RECEIVE_BUFFER_BYTES)?;
        let is_up = socket.take_error()?.is_none();
        Ok((Self::new(socket, clock), is_up))
    }

    /// Opens the interface for these identifiers (ascending) and for extended identifiers that match a pair of
    /// identifier and mask. If `fd`, the socket also receives FD frames.
    ///
    /// # Errors
    /// Fails if the interface does not exist, is down, or this kernel has no SocketCAN.
    pub fn open_for(interface: &str, fd: bool, ids: &[CanId], patterns: &[(u32, u32)]) -> io::Result<Self> {
        let socket = RawSocket::open_up(interface, fd, &filters(ids, patterns), DEFAULT_RECEIVE_BUFFER_BYTES)?;
        Ok(Self::new(socket, MappedClock::new(Reading::now())))
    }

    fn new(socket: RawSocket, clock: MappedClock) -> Self {
        let before = Reading::now();
        let (mapper, received) = (StampMapper::new(clock, before), Vec::with_capacity(CALL_BATCH));
        Self { socket, mapper, received, dropped_total: 0, before }
    }

    /// Appends the received frames and events as records of interface `bus`. Returns `false` if the socket is empty at
    /// the moment.
    ///
    /// # Errors
    /// Fails if the interface went down (`ENETDOWN`; the socket remains usable) or was removed.
    pub fn next(&mut self, bus: BusIndex, into: &mut Vec<Record>) -> io::Result<bool> {
        self.received.clear();
        match self.socket.receive(&mut self.received) {
            Ok(()) => self.before = Reading::now(),
            Err(Errno::EAGAIN) => {
                self.mapper.socket_empty(self.before);
                self.before = Reading::now();
                self.note_dropped(bus, into);
                return Ok(false);
            }
            Err(Errno::EINTR) => return Ok(true),
            Err(error) => return Err(error.into()),
        }
        for received in &self.received {
            let time = self.mapper.arrival(received.stamps, self.before);
            into.push(match received.what {
                Wire::Frame(frame) => Record::frame(time, bus, &frame),
                Wire::Error(class) => Record::bus(time, bus, BusEvent::ErrorFrame { class }),
                Wire::Malformed => Record::bus(time, bus, BusEvent::Dropped { frames: 1 }),
            });
        }
        Ok(true)
    }

    fn note_dropped(&mut self, bus: BusIndex, into: &mut Vec<Record>) {
        let total = self.socket.dropped_total();
        let frames = u64::from(total.wrapping_sub(std::mem::replace(&mut self.dropped_total, total)));
        if frames > 0 {
            into.push(Record::bus(self.mapper.event(self.before), bus, BusEvent::Dropped { frames }));
        }
    }
}
