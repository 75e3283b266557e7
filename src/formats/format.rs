//! Finds the format of a log from its first bytes.

use std::fs::File;
use std::io::{self, Read};

use crate::blf::{self, BlfReader};
use crate::mf4::{self, Mf4Reader};
use crate::pcap::{self, PcapNgReader, PcapReader};
use crate::{Channel, Item, LogReader, Position, text};

/// A log format of another tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    // Text formats.
    /// Screen text of candump.
    Candump,
    /// Text or log of `candump -td`: each stamp is the time since the previous frame.
    CandumpDeltas,
    /// Vector ASC.
    Asc,
    /// PEAK trace file, version 1.0 to 3.0.
    Trc,
    /// Table with a row per frame, as SavvyCAN, GVRET devices and USB adapters write it.
    FrameTable,
    /// CSV of python-can.
    PythonCanCsv,
    /// Text log of CSS Electronics CL1000, CL2000 and CL3000.
    Css,
    /// CRTD of the Open Vehicle Monitoring System.
    Crtd,
    /// Text log of Kvaser CanKing.
    CanKing,
    /// BUSMASTER log.
    Busmaster,
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
    /// All formats.
    pub const ALL: &[Self] = &[
        // Text formats.
        Self::Candump,
        Self::CandumpDeltas,
        Self::Asc,
        Self::Trc,
        Self::FrameTable,
        Self::PythonCanCsv,
        Self::Css,
        Self::Crtd,
        Self::CanKing,
        Self::Busmaster,
        // Binary formats.
        Self::Blf,
        Self::Mf4,
        Self::Pcap,
        Self::PcapNg,
    ];

    /// Number of bytes that [`recognise`](Self::recognise) needs to find every format.
    pub const HEAD_BYTES: usize = 16 * 1024;

    /// Finds the format from the first bytes of a log (at most [`HEAD_BYTES`](Self::HEAD_BYTES) are needed). `None` =
    /// none of these formats.
    pub fn recognise(head: &[u8]) -> Option<Self> {
        binary(head).or_else(|| text::recognise(&head[..head.len().min(Self::HEAD_BYTES)]))
    }

    /// Opens a log of this format.
    ///
    /// # Errors
    /// Fails if the source cannot be read or its header is damaged.
    pub fn open(self, source: Source) -> io::Result<Box<dyn LogReader>> {
        let reader: Box<dyn LogReader> = match self {
            // Binary formats.
            Self::Blf => Box::new(BlfReader::open(source)?),
            Self::Mf4 => Box::new(Mf4Reader::open(source)?),
            Self::Pcap => Box::new(PcapReader::open(source)?),
            Self::PcapNg => Box::new(PcapNgReader::open(source)),
            // Text formats.
            text => text::open(text, source.reader)?,
        };
        Ok(Box::new(UntilEnd { reader, has_ended: false }))
    }

    /// Name of the format, for messages: "Vector ASC".
    pub fn name(self) -> &'static str {
        match self {
            // Text formats.
            Self::Candump => "candump screen text",
            Self::CandumpDeltas => "candump -td, with its time differences added up",
            Self::Asc => "Vector ASC",
            Self::Trc => "PEAK TRC",
            Self::FrameTable => "table of frames, such as SavvyCAN and GVRET CSV",
            Self::PythonCanCsv => "python-can CSV",
            Self::Css => "CSS Electronics text log",
            Self::Crtd => "OVMS CRTD",
            Self::CanKing => "Kvaser CanKing text",
            Self::Busmaster => "BUSMASTER log",
            // Binary formats.
            Self::Blf => "Vector BLF",
            Self::Mf4 => "ASAM MF4",
            Self::Pcap => "PCAP",
            Self::PcapNg => "PCAPNG",
        }
    }
}

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

/// Wraps a reader, and returns nothing after the first end or error.
struct UntilEnd {
    reader: Box<dyn LogReader>,
    has_ended: bool,
}

impl LogReader for UntilEnd {
    fn next_item(&mut self) -> io::Result<Option<Item>> {
        if self.has_ended {
            return Ok(None);
        }
        let result = self.reader.next_item();
        self.has_ended = !matches!(result, Ok(Some(_)));
        result
    }

    fn position(&self) -> Position {
        self.reader.position()
    }

    fn remark(&self) -> Option<&'static str> {
        self.reader.remark()
    }

    fn channels(&self) -> &[Channel] {
        self.reader.channels()
    }
}
