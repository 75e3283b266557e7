//! One SocketCAN raw socket: opened so that nothing but the wanted identifiers ever reaches it, read with its
//! control messages (stamps, drop counter), written without blocking.

use std::io::{self, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, RawFd};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, ControlMessageOwned, MsgFlags, SockFlag, SockProtocol, SockType, TimestampingFlag, Timestamps,
    recvmsg, send, setsockopt, socket, sockopt,
};
use nix::sys::time::TimeSpec;
use socketcan::{CanAddr, CanFdSocket, CanFilter, Socket, SocketOptions};

use super::wire::{self, FD_BYTES, Wire};
use crate::can::{CanId, Frame};
use crate::io::clock::KernelStamps;

/// Receive buffer asked for, bytes: about 2,700 frames of 768 bytes (the kernel counts a frame with its
/// bookkeeping), a third of a second of a full 1 Mbit/s bus. The kernel caps it at net.core.rmem_max.
pub(crate) const DEFAULT_RECEIVE_BUFFER_BYTES: usize = 1 << 20;

/// Most filters the kernel takes (CAN_RAW_FILTER_MAX).
const MAX_KERNEL_FILTERS: usize = 512;

/// How a socket is to be opened.
#[derive(Debug, Clone)]
pub(super) struct RawConfig<'a> {
    /// Kernel name of the interface.
    pub(super) interface: &'a str,
    /// FD frames too.
    pub(super) fd: bool,
    /// Identifiers wanted.
    pub(super) ids: &'a [CanId],
    /// Extended identifiers wanted besides, as identifier and mask.
    pub(super) patterns: &'a [(u32, u32)],
    /// Receive buffer to ask for, bytes.
    pub(super) receive_buffer_bytes: usize,
}

/// One read: what came, its stamps, and the kernel's drop counter where it has moved from zero.
#[derive(Debug, Clone, Copy)]
pub(super) struct RawReceived {
    pub(super) what: Wire,
    pub(super) stamps: KernelStamps,
    /// Frames this socket has lost since it was opened, modulo 2^32.
    pub(super) dropped_total: Option<u32>,
}

/// A bound, nonblocking raw socket.
#[derive(Debug)]
pub(super) struct RawSocket {
    socket: CanFdSocket,
    /// The kernel's number of the interface it is bound to.
    pub(super) index: u32,
    control: Vec<u8>,
}

impl RawSocket {
    /// Opens and binds. Filters are set before the bind, so that not one unwanted frame is queued.
    ///
    /// # Errors
    /// `ENODEV` when there is no such interface; an interface that is down opens, and says so in
    /// [`RawSocket::take_error`].
    pub(super) fn open(config: &RawConfig<'_>) -> io::Result<Self> {
        Self::open_filtered(config, &filters(config.ids, config.patterns))
    }

    /// As [`RawSocket::open`], for every identifier there is.
    ///
    /// # Errors
    /// As there.
    pub(super) fn open_all(interface: &str) -> io::Result<Self> {
        let receive_buffer_bytes = DEFAULT_RECEIVE_BUFFER_BYTES;
        let config = RawConfig { interface, fd: true, ids: &[], patterns: &[], receive_buffer_bytes };
        Self::open_filtered(&config, &[CanFilter::new(0, 0)])
    }

    fn open_filtered(config: &RawConfig<'_>, filters: &[CanFilter]) -> io::Result<Self> {
        let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
        let fd = socket(AddressFamily::Can, SockType::Raw, flags, SockProtocol::CanRaw)?;
        setsockopt(&fd, sockopt::RxqOvfl, &1)?;
        set_stamping(&fd)?;
        let socket = CanFdSocket::from(fd);
        socket.set_recv_own_msgs(false)?;
        socket.set_socket_option_int(
            socketcan::socket::SOL_CAN_RAW,
            socketcan::socket::CAN_RAW_FD_FRAMES,
            i32::from(config.fd),
        )?;
        socket.set_filters(filters)?;
        socket.set_error_filter_accept_all()?;
        socket.as_raw_socket().set_recv_buffer_size(config.receive_buffer_bytes)?;
        let index = index_of(config.interface)?;
        socket.as_raw_socket().bind(&CanAddr::new(index).into_sock_addr())?;
        Ok(Self { socket, index, control: cmsg_space!(Timestamps, TimeSpec, u32) })
    }

    /// The pending error of the socket: `ENETDOWN` right after opening on an interface that is down.
    pub(super) fn take_error(&self) -> io::Result<Option<io::Error>> {
        self.socket.as_raw_socket().take_error()
    }

    /// The receive buffer the kernel granted, bytes (it doubles what it was asked for).
    pub(super) fn receive_buffer_bytes(&self) -> io::Result<usize> {
        self.socket.as_raw_socket().recv_buffer_size()
    }

    /// Takes one frame from the socket.
    ///
    /// # Errors
    /// `EAGAIN` when there is none; `ENETDOWN`, `ENODEV` once when the interface went down or away.
    pub(super) fn receive(&mut self) -> Result<RawReceived, Errno> {
        let mut bytes = [0; FD_BYTES];
        let fd = self.socket.as_raw_fd();
        let (length, stamps, dropped_total) = {
            let mut slices = [IoSliceMut::new(&mut bytes)];
            let message = recvmsg::<()>(fd, &mut slices, Some(&mut self.control), MsgFlags::MSG_DONTWAIT)?;
            let (stamps, dropped) = read_control(message.cmsgs()?);
            (message.bytes, stamps, dropped)
        };
        Ok(RawReceived { what: wire::decode(&bytes[..length.min(FD_BYTES)]), stamps, dropped_total })
    }

    /// Hands one frame to the kernel.
    ///
    /// # Errors
    /// `EAGAIN` and `ENOBUFS` when there is no room, `ENETDOWN`, `ENODEV`, `ENXIO` when the interface is down or
    /// gone, `EINVAL` for an FD frame on a classic interface.
    pub(super) fn send(&self, frame: &Frame) -> Result<(), Errno> {
        let mut buffer = [0; FD_BYTES];
        send(self.socket.as_raw_fd(), wire::encode(frame, &mut buffer), MsgFlags::MSG_DONTWAIT).map(drop)
    }
}

impl AsRawFd for RawSocket {
    fn as_raw_fd(&self) -> RawFd {
        self.socket.as_raw_fd()
    }
}

impl AsFd for RawSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// The kernel's number of an interface.
///
/// # Errors
/// `ENODEV` when there is none of this name.
pub(super) fn index_of(interface: &str) -> io::Result<u32> {
    Ok(nix::net::if_::if_nametoindex(interface)?)
}

/// Hardware and software stamps, or where the kernel cannot say which, its plain ones.
fn set_stamping(fd: &impl AsFd) -> io::Result<()> {
    let flags = TimestampingFlag::SOF_TIMESTAMPING_RX_SOFTWARE
        | TimestampingFlag::SOF_TIMESTAMPING_SOFTWARE
        | TimestampingFlag::SOF_TIMESTAMPING_RX_HARDWARE
        | TimestampingFlag::SOF_TIMESTAMPING_RAW_HARDWARE;
    if setsockopt(fd, sockopt::Timestamping, &flags).is_err() {
        setsockopt(fd, sockopt::ReceiveTimestampns, &true)?;
    }
    Ok(())
}

/// Filters for exactly these identifiers, data frames only. More than the kernel takes: everything comes in,
/// and the reader passes over what it does not know.
fn filters(ids: &[CanId], patterns: &[(u32, u32)]) -> Vec<CanFilter> {
    if ids.len() + patterns.len() > MAX_KERNEL_FILTERS {
        return vec![CanFilter::new(0, 0)];
    }
    let exact = ids.iter().map(|&id| CanFilter::new(wire::id_word(id), filter_mask(id)));
    let flags = wire::EXTENDED_FLAG | wire::REMOTE_FLAG;
    let patterns = patterns.iter().map(|&(id, mask)| CanFilter::new(id | wire::EXTENDED_FLAG, mask | flags));
    exact.chain(patterns).collect()
}

fn filter_mask(id: CanId) -> u32 {
    let bits = match id {
        CanId::Standard(_) => wire::STANDARD_MASK,
        CanId::Extended(_) => wire::EXTENDED_MASK,
    };
    bits | wire::EXTENDED_FLAG | wire::REMOTE_FLAG
}

fn read_control(messages: impl Iterator<Item = ControlMessageOwned>) -> (KernelStamps, Option<u32>) {
    let mut stamps = KernelStamps::default();
    let mut dropped = None;
    for message in messages {
        match message {
            ControlMessageOwned::ScmTimestampsns(all) => {
                stamps.software_ns = nanos(all.system).or(stamps.software_ns);
                stamps.hardware_ns = nanos(all.hw_raw);
            }
            ControlMessageOwned::ScmTimestampns(stamp) => stamps.software_ns = nanos(stamp),
            ControlMessageOwned::RxqOvfl(total) => dropped = Some(total),
            _ => {}
        }
    }
    (stamps, dropped)
}

/// Zero means "no such stamp".
fn nanos(time: TimeSpec) -> Option<i64> {
    let nanos = time.tv_sec().saturating_mul(1_000_000_000).saturating_add(time.tv_nsec());
    (nanos != 0).then_some(nanos)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_filter_tells_standard_from_extended_and_keeps_remote_requests_out() {
        assert_eq!(filter_mask(CanId::Standard(0x123)), 0xC000_07FF);
        assert_eq!(filter_mask(CanId::Extended(0x123)), 0xDFFF_FFFF);
        assert_eq!(wire::id_word(CanId::Extended(0x123)), 0x8000_0123);
    }

    #[test]
    fn more_identifiers_than_the_kernel_takes_open_the_filter() {
        let ids: Vec<CanId> = (0..=MAX_KERNEL_FILTERS as u16).map(CanId::Standard).collect();
        assert_eq!(filters(&ids, &[]).len(), 1);
        assert_eq!(filters(&ids[1..], &[]).len(), MAX_KERNEL_FILTERS);
    }

    #[test]
    fn a_zero_stamp_is_none() {
        assert_eq!(nanos(TimeSpec::new(0, 0)), None);
        assert_eq!(nanos(TimeSpec::new(1, 5)), Some(1_000_000_005));
    }
}
