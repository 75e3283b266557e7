//! Writes a candump log, plain or compressed.

use std::io::{self, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::can::Frame;
use crate::io::candump::{StampDigits, write_line, write_stamp};
use crate::io::result_file::ResultFile;
use crate::quantity::Timestamp;

/// Flag in the identifier that marks an error frame.
const ERROR_FRAME: u32 = 1 << 29;

pub(super) enum CandumpFile {
    Plain(ResultFile),
    Gzip(GzEncoder<ResultFile>),
    Zstd(zstd::Encoder<'static, ResultFile>),
}

impl CandumpFile {
    /// Begins a file. Its name decides whether it is compressed.
    pub(super) fn new(file: ResultFile, path: &Path) -> io::Result<Self> {
        Ok(match path.extension().and_then(|extension| extension.to_str()) {
            Some("gz") => Self::Gzip(GzEncoder::new(file, Compression::default())),
            Some("zst") => Self::Zstd(zstd::Encoder::new(file, 0)?),
            _ => Self::Plain(file),
        })
    }

    pub(super) fn write_frame(&mut self, time: Timestamp, interface: &str, frame: &Frame) -> io::Result<()> {
        write_line(self, time, StampDigits::Micros, interface, frame)
    }

    pub(super) fn write_error_frame(&mut self, time: Timestamp, interface: &str, class: u32) -> io::Result<()> {
        write_stamp(self, time, StampDigits::Micros)?;
        writeln!(self, " {interface} {:08X}#0000000000000000", ERROR_FRAME | class)
    }

    pub(super) fn finish(self) -> io::Result<()> {
        match self {
            Self::Plain(file) => file.finish(),
            Self::Gzip(file) => file.finish()?.finish(),
            Self::Zstd(file) => file.finish()?.finish(),
        }
    }
}

impl Write for CandumpFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(file) => file.write(bytes),
            Self::Gzip(file) => file.write(bytes),
            Self::Zstd(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(file) => file.flush(),
            Self::Gzip(file) => file.flush(),
            Self::Zstd(file) => file.flush(),
        }
    }
}
