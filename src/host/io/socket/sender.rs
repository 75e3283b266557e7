//! A blocking sender that plays frames onto an interface, for `replay --to` and `simulate --to`.

use std::io;
use std::os::fd::AsFd;
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::raw::RawSocket;
use crate::can::Frame;

/// Pause before the next attempt if the transmit queue is full. A 500 kbit/s bus carries about four frames in this
/// time.
const RETRY_PAUSE: Duration = Duration::from_millis(1);

/// Maximum number of attempts before a full queue is an error. These attempts take 2 s, in which a working bus sends
/// hundreds of frames.
const MAX_TRIES: u32 = 2_000;

/// Sends frames one after the other on one interface. It receives nothing.
#[derive(Debug)]
pub struct CanSender {
    socket: RawSocket,
    interface: String,
}

impl CanSender {
    /// Opens the interface. `fd` allows FD frames.
    ///
    /// # Errors
    /// Fails if the interface does not exist, is down, or this kernel has no SocketCAN.
    pub fn open(interface: &str, fd: bool) -> io::Result<Self> {
        let socket = RawSocket::open_up(interface, fd, &[], 0)?;
        Ok(Self { socket, interface: interface.to_owned() })
    }

    /// Sends one frame. Waits while the transmit queue is full, but at most about 2 s.
    ///
    /// # Errors
    /// Fails if the queue does not empty, or if the interface goes down or is removed. Also fails if a classic
    /// interface cannot carry an FD frame.
    pub fn send(&self, frame: &Frame) -> io::Result<()> {
        for _ in 0..MAX_TRIES {
            match self.socket.send(frame) {
                Ok(()) => return Ok(()),
                Err(Errno::ENOBUFS) => std::thread::sleep(RETRY_PAUSE),
                Err(Errno::EAGAIN) => self.wait_for_room()?,
                Err(Errno::EINTR) => {}
                Err(error) => return Err(io::Error::other(format!("{}: {frame:?} not sent: {error}", self.interface))),
            }
        }
        Err(io::Error::new(io::ErrorKind::TimedOut, format!("{}: the transmit queue stays full", self.interface)))
    }

    fn wait_for_room(&self) -> io::Result<()> {
        let mut fds = [PollFd::new(self.socket.as_fd(), PollFlags::POLLOUT)];
        poll(&mut fds, PollTimeout::from(RETRY_PAUSE.as_millis() as u8)).map(drop).or_else(|error| match error {
            Errno::EINTR => Ok(()),
            other => Err(other.into()),
        })
    }
}
