//! Finds the format of a log from its first bytes.

use std::fs::File;
use std::io::{self, Read};

use crate::LogReader;
use crate::blf::{self, BlfReader};
use crate::mf4::{self, Mf4Reader};
use crate::pcap::{self, PcapNgReader, PcapReader};

/// A log format of another tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    // Binary formats.
    /// Vector binary logging format.
    Blf,
    /// ASAM measurement data format, version 4, with the frames of a bus.
    Mf4,
    /// Packet capture of SocketCAN, old form.
    Pcap,
    /// Packet capture of SocketCAN, new form.
    PcapNg,
}

/// An open log.
pub struct Source {
    /// The decompressed bytes from the start of the file.
    pub reader: Box<dyn Read>,
    /// The file itself if it is a regular file and not compressed. Formats that are not read from start to end use it.
    pub file: Option<File>,
}

impl Format {
    /// Number of bytes from which [`recognise`](Self::recognise) finds every format.
    pub const HEAD_BYTES: usize = 16 * 1024;

    /// Finds the format from the first bytes of a log (at most [`HEAD_BYTES`](Self::HEAD_BYTES) are needed). `None` =
    /// none of these formats.
    pub fn recognise(head: &[u8]) -> Option<Self> {
        binary(head)
    }

    /// Opens a log of this format.
    ///
    /// # Errors
    /// Fails if the source cannot be read or its header is damaged.
    pub fn open(self, source: Source) -> io::Result<Box<dyn LogReader>> {
        Ok(match self {
            Self::Blf => Box::new(BlfReader::open(source)?),
            Self::Mf4 => Box::new(Mf4Reader::open(source)?),
            Self::Pcap => Box::new(PcapReader::open(source)?),
            Self::PcapNg => Box::new(PcapNgReader::open(source)),
        })
    }

    /// Name of the format, for messages: "Vector ASC".
    pub fn name(self) -> &'static str {
        match self {
            Self::Blf => "Vector BLF",
            Self::Mf4 => "ASAM MF4",
            Self::Pcap => "PCAP",
            Self::PcapNg => "PCAPNG",
        }
    }
}

/// Finds a binary format.
fn binary(head: &[u8]) -> Option<Format> {
    let begins = |magics: &[&[u8]]| magics.iter().any(|magic| head.starts_with(magic));
    if begins(&[blf::MAGIC]) {
        Some(Format::Blf)
    } else if begins(&mf4::MAGICS) {
        Some(Format::Mf4)
    } else if pcap::Form::of_magic(head).is_some() {
        Some(Format::Pcap)
    } else {
        begins(&[pcap::SECTION_HEADER]).then_some(Format::PcapNg)
    }
}
