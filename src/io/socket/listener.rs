//! A listener that asks for what has come: sees what really went out on an interface, whoever sent it.

use std::io;

use nix::errno::Errno;

use super::raw::{DEFAULT_RECEIVE_BUFFER_BYTES, RawConfig, RawSocket};
use super::wire::Wire;
use crate::can::{CanId, Frame};
use crate::io::clock::{MappedClock, Reading, StampMapper};
use crate::quantity::Timestamp;

/// Receives frames of some identifiers on one interface; sends nothing and never waits.
#[derive(Debug)]
pub(crate) struct CanListener {
    socket: RawSocket,
    mapper: StampMapper,
    dropped_total: u32,
}

impl CanListener {
    /// Opens the interface for these identifiers, ascending, and for extended ones by identifier and mask; `fd` = FD
    /// frames too.
    ///
    /// # Errors
    /// When the interface does not exist, is down, or this kernel has no SocketCAN.
    pub(crate) fn open(interface: &str, fd: bool, ids: &[CanId], patterns: &[(u32, u32)]) -> io::Result<Self> {
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{interface}: {error}"));
        let config = RawConfig { interface, fd, ids, patterns, receive_buffer_bytes: DEFAULT_RECEIVE_BUFFER_BYTES };
        let socket = RawSocket::open(&config).map_err(named)?;
        if let Some(error) = socket.take_error().map_err(named)? {
            return Err(named(error));
        }
        let now = Reading::now();
        Ok(Self { socket, mapper: StampMapper::new(MappedClock::new(now), now), dropped_total: 0 })
    }

    /// The next frame that has come, and when; `None` = there is none now.
    ///
    /// # Errors
    /// When the interface went down or away.
    pub(crate) fn next(&mut self) -> io::Result<Option<(Timestamp, Frame)>> {
        loop {
            match self.socket.receive() {
                Ok(received) => {
                    let time = self.mapper.arrival(received.stamps, Reading::now());
                    self.dropped_total = received.dropped_total.unwrap_or(self.dropped_total);
                    if let Wire::Frame(frame) = received.what {
                        return Ok(Some((time, frame)));
                    }
                }
                Err(Errno::EAGAIN) => return Ok(None),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Frames the kernel had no room to keep for us.
    pub(crate) fn dropped(&self) -> u32 {
        self.dropped_total
    }
}
