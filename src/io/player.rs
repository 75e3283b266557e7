//! Sends frames onto a CAN interface, blocking: what `replay --to` and `simulate --to` play with.
//!
//! A full transmit queue is waited for ([`MAX_WAIT`] at most); every other failure is an error.

use std::io;
use std::time::{Duration, Instant};

use socketcan::{CanAnyFrame, CanDataFrame, CanFdFrame, CanFdSocket, CanRemoteFrame, EmbeddedFrame, Id, Socket};

use crate::can::{CanId, Frame, FrameKind};

/// Longest wait for room in the queue: a bus at its slowest (10 kbit/s) empties the usual ten frames in 160 ms.
const MAX_WAIT: Duration = Duration::from_secs(2);
/// Time between two attempts: about two frames at 250 kbit/s.
const RETRY: Duration = Duration::from_micros(1000);

/// An interface to send on.
#[derive(Debug)]
pub struct Player {
    socket: CanFdSocket,
    interface: String,
}

impl Player {
    /// Opens `interface`.
    ///
    /// # Errors
    /// When it does not exist or may not be used; the message names it.
    pub fn open(interface: &str) -> io::Result<Self> {
        let socket = CanFdSocket::open(interface).map_err(|e| named(interface, &e))?;
        Ok(Self { socket, interface: interface.to_owned() })
    }

    /// Sends one frame, waiting while the queue is full.
    ///
    /// # Errors
    /// When the interface is down or gone, or the queue stays full.
    pub fn send(&mut self, frame: &Frame) -> io::Result<()> {
        let started = Instant::now();
        let frame = convert(frame).ok_or_else(|| io::Error::from(io::ErrorKind::InvalidInput))?;
        loop {
            match self.socket.write_frame(&frame) {
                Ok(()) => return Ok(()),
                Err(error) if is_full(&error) && started.elapsed() < MAX_WAIT => std::thread::sleep(RETRY),
                Err(error) => return Err(named(&self.interface, &error)),
            }
        }
    }
}

fn is_full(error: &io::Error) -> bool {
    error.raw_os_error() == Some(nix::errno::Errno::ENOBUFS as i32) || error.kind() == io::ErrorKind::WouldBlock
}

fn named(interface: &str, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("interface {interface}: {error}"))
}

/// As the socket crate has it; `None` for what it cannot carry.
fn convert(frame: &Frame) -> Option<CanAnyFrame> {
    let id: Id = match frame.id() {
        CanId::Standard(id) => socketcan::StandardId::new(id)?.into(),
        CanId::Extended(id) => socketcan::ExtendedId::new(id)?.into(),
    };
    Some(match frame.kind() {
        FrameKind::Classic => CanAnyFrame::Normal(CanDataFrame::new(id, frame.data())?),
        FrameKind::Remote => CanAnyFrame::Remote(CanRemoteFrame::new_remote(id, frame.len())?),
        FrameKind::Fd { brs, esi } => {
            let mut fd = CanFdFrame::new(id, frame.data())?;
            fd.set_brs(brs);
            fd.set_esi(esi);
            CanAnyFrame::Fd(fd)
        }
    })
}
