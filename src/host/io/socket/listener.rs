//! A listener that is polled: sees every frame on an interface, also those of this computer.

use std::io;

use nix::errno::Errno;

use super::raw::{CALL_BATCH, DEFAULT_RECEIVE_BUFFER_BYTES, RawConfig, RawRead, RawSocket};
use super::wire::Wire;
use crate::can::{CanId, Frame};
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::quantity::Timestamp;

/// Receives frames of some identifiers on one interface; sends nothing and never waits.
#[derive(Debug)]
pub struct CanListener {
    socket: RawSocket,
    mapper: StampMapper,
    /// Frames of the last call, how many of them were returned, and the clocks at its reading.
    received: Vec<RawRead>,
    taken: usize,
    reading: Reading,
}

impl CanListener {
    /// Opens the interface for these identifiers, ascending, and for extended ones by identifier and mask; `fd` = FD
    /// frames too.
    ///
    /// # Errors
    /// When the interface does not exist, is down, or this kernel has no SocketCAN.
    pub fn open(interface: &str, fd: bool, ids: &[CanId], patterns: &[(u32, u32)]) -> io::Result<Self> {
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{interface}: {error}"));
        let config = RawConfig { interface, fd, ids, patterns, receive_buffer_bytes: DEFAULT_RECEIVE_BUFFER_BYTES };
        let socket = RawSocket::open(&config).map_err(named)?;
        if let Some(error) = socket.take_error().map_err(named)? {
            return Err(named(error));
        }
        let now = Reading::now();
        let mapper = StampMapper::new(MappedClock::new(now), now);
        Ok(Self { socket, mapper, received: Vec::with_capacity(CALL_BATCH), taken: 0, reading: now })
    }

    /// The next frame and its time; `None` = there is none now.
    ///
    /// # Errors
    /// When the interface went down or away.
    pub fn next_frame(&mut self) -> io::Result<Option<(Timestamp, Frame)>> {
        loop {
            while let Some(received) = self.received.get(self.taken) {
                self.taken += 1;
                let time = self.mapper.arrival(received.stamps, self.reading);
                if let Wire::Frame(frame) = received.what {
                    return Ok(Some((time, frame)));
                }
            }
            self.received.clear();
            self.taken = 0;
            match self.socket.receive(&mut self.received) {
                Ok(()) => self.reading = Reading::now(),
                Err(Errno::EAGAIN) => return Ok(None),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Frames the kernel had no room to keep for us.
    pub fn dropped(&self) -> u32 {
        self.socket.dropped_total()
    }
}
