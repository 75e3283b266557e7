//! The output of `convert` in each format.

use std::io;
use std::path::Path;

use packwatch_formats::Mf4Writer;

use super::candump::CandumpFile;
use super::mcap::McapFile;
use crate::can::Frame;
use crate::io::result_file::ResultFile;
use crate::quantity::{BusIndex, Timestamp};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Format {
    Candump,
    Mf4,
    Mcap,
}

impl Format {
    /// The format that a file name states.
    pub(super) fn of_name(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_string_lossy().to_ascii_lowercase();
        let plain = name.trim_end_matches(".gz").trim_end_matches(".zst");
        match name.rsplit_once('.')?.1 {
            "mf4" => Some(Self::Mf4),
            "mcap" => Some(Self::Mcap),
            _ if plain.ends_with(".log") => Some(Self::Candump),
            _ => None,
        }
    }
}

pub(super) enum Output {
    Candump(CandumpFile),
    Mf4(Box<Mf4Writer<ResultFile>>),
    Mcap(Box<McapFile>),
}

impl Output {
    pub(super) fn create(path: &Path, format: Format) -> io::Result<Self> {
        let file = ResultFile::create(path)?;
        Ok(match format {
            Format::Candump => Self::Candump(CandumpFile::new(file, path)?),
            Format::Mf4 => Self::Mf4(Box::new(Mf4Writer::new(file)?)),
            Format::Mcap => Self::Mcap(Box::new(McapFile::new(file)?)),
        })
    }

    pub(super) fn write_frame(
        &mut self,
        time: Timestamp,
        bus: BusIndex,
        interfaces: &[String],
        frame: &Frame,
    ) -> io::Result<()> {
        match self {
            Self::Candump(file) => file.write_frame(time, &interfaces[bus.index()], frame),
            Self::Mf4(file) => file.write_frame(time, channel(bus, interfaces), frame),
            Self::Mcap(file) => file.write_frame(time, &interfaces[bus.index()], frame),
        }
    }

    /// Writes an error frame. `class` has the CAN_ERR_* bits of SocketCAN.
    pub(super) fn write_error_frame(
        &mut self,
        time: Timestamp,
        bus: BusIndex,
        interfaces: &[String],
        class: u32,
    ) -> io::Result<()> {
        match self {
            Self::Candump(file) => file.write_error_frame(time, &interfaces[bus.index()], class),
            Self::Mf4(file) => file.write_error_frame(time, channel(bus, interfaces), class),
            Self::Mcap(file) => file.write_error_frame(time, &interfaces[bus.index()], class),
        }
    }

    pub(super) fn finish(self) -> io::Result<()> {
        match self {
            Self::Candump(file) => file.finish(),
            Self::Mf4(file) => file.finish()?.finish(),
            Self::Mcap(file) => file.finish(),
        }
    }
}

/// Number of a channel in MF4, counted from 1. It is one more than the number in the interface's name: `can1` is
/// channel 2. A program that reads the file can therefore give the interface the same name. If any interface name has
/// no number, the interfaces are numbered in their order.
fn channel(bus: BusIndex, interfaces: &[String]) -> u8 {
    let numbered = |name: &String| name.strip_prefix("can")?.parse::<u8>().ok()?.checked_add(1);
    let numbers: Option<Vec<u8>> = interfaces.iter().map(numbered).collect();
    numbers.map_or_else(|| bus.0.saturating_add(1), |numbers| numbers[bus.index()])
}
