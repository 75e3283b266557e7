//! One SocketCAN raw socket. The filters are set before the socket is bound, so the socket receives only wanted
//! identifiers. One system call reads several frames with their stamps. Writing does not block.
//!
//! The kernel's drop counter is read separately, for two reasons. First, the control message of a frame contains only
//! the drops before that frame, so the latest drops stay invisible until another frame arrives. Second, the first drop
//! changes the size of the control message (see [`Slots`]).

use std::cell::RefCell;
use std::io::{self, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, RawFd};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::libc;
use nix::sys::socket::{
    AddressFamily, ControlMessageOwned, MsgFlags, MultiHeaders, SockFlag, SockProtocol, SockType, TimestampingFlag,
    Timestamps, recvmmsg, send, setsockopt, socket, sockopt,
};
use nix::sys::time::TimeSpec;
use socketcan::{CanAddr, CanFdSocket, CanFilter, Socket, SocketOptions};

use super::wire::{self, FD_BYTES, Wire};
use crate::can::{CanId, Frame};
use crate::io::clock::{KernelStamps, nanos};

/// Size of the receive buffer to request, bytes. The kernel doubles the requested size and counts 768 bytes per frame,
/// so the buffer holds about 2,700 frames. A full 1 Mbit/s bus sends that many in a third of a second. The kernel
/// limits the requested size to net.core.rmem_max.
pub const DEFAULT_RECEIVE_BUFFER_BYTES: usize = 1 << 20;

/// Maximum number of frames read in one system call. With 16 frames, the call itself no longer dominates the cost of a
/// frame. Preparing 16 buffers is cheap even if only one frame arrives.
pub(super) const CALL_BATCH: usize = 16;

/// Maximum number of filters that the kernel accepts (CAN_RAW_FILTER_MAX).
const MAX_KERNEL_FILTERS: usize = 512;

#[derive(Debug, Clone, Copy)]
pub(super) struct RawRead {
    pub(super) what: Wire,
    pub(super) stamps: KernelStamps,
}

/// Buffers of one call, which are reused. A call overwrites the size of each control buffer with the size that the
/// kernel used, so the next call offers only this size. This size suffices while every frame has a stamp. After a
/// frame without a stamp, the headers are built again.
struct Slots {
    headers: MultiHeaders<()>,
    bytes: [[u8; FD_BYTES]; CALL_BATCH],
}

impl Slots {
    fn new() -> Self {
        Self { headers: Self::headers(), bytes: [[0; FD_BYTES]; CALL_BATCH] }
    }

    fn headers() -> MultiHeaders<()> {
        MultiHeaders::preallocate(CALL_BATCH, Some(cmsg_space!(Timestamps, TimeSpec)))
    }

    fn receive(&mut self, fd: RawFd, into: &mut Vec<RawRead>) -> Result<(), Errno> {
        let mut lengths = [0; CALL_BATCH];
        let begin = into.len();
        {
            let mut slices = self.bytes.each_mut().map(|bytes| [IoSliceMut::new(bytes)]);
            let messages = recvmmsg(fd, &mut self.headers, slices.iter_mut(), MsgFlags::MSG_DONTWAIT, None)?;
            for (message, length) in messages.zip(&mut lengths) {
                *length = message.bytes.min(FD_BYTES);
                // An error means that a control message was cut off. Treat it like a missing stamp.
                let stamps = message.cmsgs().map_or(KernelStamps::default(), read_control);
                into.push(RawRead { what: Wire::Malformed, stamps });
            }
        }
        for ((received, length), bytes) in into[begin..].iter_mut().zip(lengths).zip(&self.bytes) {
            received.what = wire::decode(&bytes[..length]);
        }
        if into[begin..].iter().any(|received| received.stamps.software_ns.is_none()) {
            self.headers = Self::headers();
        }
        Ok(())
    }
}

thread_local! {
    /// Slots for all sockets of a thread. Headers contain pointers, so they cannot move between threads as sockets do.
    static SLOTS: RefCell<Slots> = RefCell::new(Slots::new());
}

#[derive(Debug)]
pub(super) struct RawSocket {
    socket: CanFdSocket,
    pub(super) index: u32,
}

/// Describes an error of a CAN socket, with its cause and the next step if these are known.
pub(crate) fn explained(error: &io::Error) -> String {
    let cause = match error.raw_os_error().map(Errno::from_raw) {
        Some(Errno::EAFNOSUPPORT) => ": this kernel has no SocketCAN; load the module can_raw",
        Some(Errno::ENODEV) => ": there is no interface of this name; \"ip link\" lists the interfaces",
        Some(Errno::ENETDOWN) => ": the interface is down; start it with \"ip link set NAME up\"",
        _ => "",
    };
    format!("{error}{cause}")
}

impl RawSocket {
    /// Opens and binds the socket. If `fd` is true, the socket also receives FD frames. Filters are set before the
    /// bind, so that no unwanted frame is queued.
    ///
    /// # Errors
    /// Returns `ENODEV` if the interface does not exist. If the interface is down, the call succeeds, and
    /// [`RawSocket::take_error`] returns the error.
    pub(super) fn open(interface: &str, fd: bool, filters: &[CanFilter], buffer_bytes: usize) -> io::Result<Self> {
        let flags = SockFlag::SOCK_NONBLOCK | SockFlag::SOCK_CLOEXEC;
        let descriptor = socket(AddressFamily::Can, SockType::Raw, flags, SockProtocol::CanRaw)?;
        set_stamping(&descriptor)?;
        let socket = CanFdSocket::from(descriptor);
        socket.set_recv_own_msgs(false)?;
        socket.set_socket_option_int(
            socketcan::socket::SOL_CAN_RAW,
            socketcan::socket::CAN_RAW_FD_FRAMES,
            i32::from(fd),
        )?;
        socket.set_filters(filters)?;
        socket.set_error_filter_accept_all()?;
        socket.as_raw_socket().set_recv_buffer_size(buffer_bytes)?;
        let index = index_of(interface)?;
        socket.as_raw_socket().bind(&CanAddr::new(index).into_sock_addr())?;
        Ok(Self { socket, index })
    }

    /// Like [`RawSocket::open`], but also fails if the interface is down. Errors contain the name of the interface.
    pub(super) fn open_up(interface: &str, fd: bool, filters: &[CanFilter], buffer_bytes: usize) -> io::Result<Self> {
        let opened = Self::open(interface, fd, filters, buffer_bytes);
        let opened = opened.and_then(|socket| socket.take_error()?.map_or(Ok(socket), Err));
        opened.map_err(|error| io::Error::new(error.kind(), format!("{interface}: {}", explained(&error))))
    }

    /// The pending error of the socket: `ENETDOWN` right after opening on an interface that is down.
    pub(super) fn take_error(&self) -> io::Result<Option<io::Error>> {
        self.socket.as_raw_socket().take_error()
    }

    /// The receive buffer granted by the kernel, bytes (twice the requested size).
    pub(super) fn receive_buffer_bytes(&self) -> io::Result<usize> {
        self.socket.as_raw_socket().recv_buffer_size()
    }

    /// Reads up to [`CALL_BATCH`] frames and appends them. If fewer are read, the socket is empty.
    ///
    /// # Errors
    /// Returns `EAGAIN` if the socket is empty. Returns `ENETDOWN` or `ENODEV` once when the interface went down or was
    /// removed.
    pub(super) fn receive(&self, into: &mut Vec<RawRead>) -> Result<(), Errno> {
        SLOTS.with_borrow_mut(|slots| slots.receive(self.socket.as_raw_fd(), into))
    }

    /// Number of frames that the kernel has dropped since the socket was opened, because the receive buffer was full
    /// (modulo 2^32). The number is 0 if the kernel has no such counter.
    pub(super) fn dropped_total(&self) -> u32 {
        // SO_MEMINFO returns nine numbers. The last one counts drops (linux/sock_diag.h, since Linux 4.12).
        let mut bytes = [0; 9 * size_of::<u32>()];
        let result = self.socket.get_socket_option_bytes(libc::SOL_SOCKET, libc::SO_MEMINFO, &mut bytes);
        let (numbers, _) = bytes.as_chunks();
        // If the kernel returns fewer numbers, the last one stays zero.
        result.map_or(0, |_| u32::from_ne_bytes(numbers[8]))
    }

    /// Passes one frame to the kernel.
    ///
    /// # Errors
    /// Returns `EAGAIN` or `ENOBUFS` if the send buffer is full, and `ENETDOWN`, `ENODEV` or `ENXIO` if the interface
    /// is down or was removed. Returns `EINVAL` for an FD frame on a classic interface.
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

/// The kernel's index of an interface; `ENODEV` if no interface has this name.
pub(super) fn index_of(interface: &str) -> io::Result<u32> {
    Ok(nix::net::if_::if_nametoindex(interface)?)
}

/// Requests hardware and software stamps. If the kernel cannot distinguish them, requests plain software stamps.
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

/// Filters that pass only data frames with these identifiers. If the kernel does not accept that many filters, all
/// frames pass, and the reader ignores unknown identifiers.
pub(super) fn filters(ids: &[CanId], patterns: &[(u32, u32)]) -> Vec<CanFilter> {
    if ids.len() + patterns.len() > MAX_KERNEL_FILTERS {
        return every_frame();
    }
    let exact = ids.iter().map(|&id| CanFilter::new(wire::id_word(id), filter_mask(id)));
    let flags = wire::EXTENDED_FLAG | wire::REMOTE_FLAG;
    let patterns = patterns.iter().map(|&(id, mask)| CanFilter::new(id | wire::EXTENDED_FLAG, mask | flags));
    exact.chain(patterns).collect()
}

pub(super) fn every_frame() -> Vec<CanFilter> {
    vec![CanFilter::new(0, 0)]
}

fn filter_mask(id: CanId) -> u32 {
    let bits = match id {
        CanId::Standard(_) => wire::STANDARD_MASK,
        CanId::Extended(_) => wire::EXTENDED_MASK,
    };
    bits | wire::EXTENDED_FLAG | wire::REMOTE_FLAG
}

fn read_control(messages: impl Iterator<Item = ControlMessageOwned>) -> KernelStamps {
    let mut stamps = KernelStamps::default();
    for message in messages {
        match message {
            ControlMessageOwned::ScmTimestampsns(all) => {
                stamps.software_ns = stamp(all.system).or(stamps.software_ns);
                stamps.hardware_ns = stamp(all.hw_raw);
            }
            ControlMessageOwned::ScmTimestampns(time) => stamps.software_ns = stamp(time),
            _ => {}
        }
    }
    stamps
}

/// Converts a kernel stamp; zero means that the kernel has no such stamp.
fn stamp(time: TimeSpec) -> Option<i64> {
    Some(nanos(time)).filter(|nanos| *nanos != 0)
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::*;

    #[test]
    fn filter_separates_standard_extended_and_remote() {
        assert_eq!(filter_mask(CanId::Standard(0x123)), 0xC000_07FF);
        assert_eq!(filter_mask(CanId::Extended(0x123)), 0xDFFF_FFFF);
        assert_eq!(wire::id_word(CanId::Extended(0x123)), 0x8000_0123);
    }

    #[test]
    fn too_many_identifiers_open_the_filter() {
        let ids: Vec<CanId> = (0..=MAX_KERNEL_FILTERS as u16).map(CanId::Standard).collect();
        assert_eq!(filters(&ids, &[]).len(), 1);
        assert_eq!(filters(&ids[1..], &[]).len(), MAX_KERNEL_FILTERS);
    }

    #[test]
    fn zero_stamp_is_ignored() {
        assert_eq!(stamp(TimeSpec::new(0, 0)), None);
        assert_eq!(stamp(TimeSpec::new(1, 5)), Some(1_000_000_005));
    }

    #[test]
    fn frames_without_stamps_keep_later_stamps() {
        // A UDP socket can replace the CAN socket here, because the kernel attaches the same time stamps to its
        // datagrams.
        let (tx, rx) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        tx.connect(rx.local_addr().unwrap()).unwrap();
        let frames = [1, 2, 3].map(|id| Frame::classic(CanId::Standard(id), &[7, 8]).unwrap());
        let mut slots = Slots::new();
        for stamped in [true, false, true, true] {
            setsockopt(&rx, sockopt::ReceiveTimestampns, &stamped).unwrap();
            for frame in &frames {
                tx.send(wire::encode(frame, &mut [0; FD_BYTES])).unwrap();
            }
            let mut received = Vec::new();
            while received.len() < frames.len() {
                if let Err(error) = slots.receive(rx.as_raw_fd(), &mut received) {
                    assert_eq!(error, Errno::EAGAIN);
                }
            }
            assert!(received.iter().map(|received| received.what).eq(frames.map(Wire::Frame)));
            assert!(received.iter().all(|received| received.stamps.software_ns.is_some() == stamped), "{received:?}");
        }
        assert_eq!(slots.receive(rx.as_raw_fd(), &mut Vec::new()), Err(Errno::EAGAIN));
    }
}
