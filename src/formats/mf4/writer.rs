//! Writes frames as a sorted MF4 file with bus logging, which asammdf and python-can read.
//!
//! Each kind of frame is a group of its own. The records of a group are compressed in blocks as they arrive. The
//! description of the groups is written after the data. At last, the header at the start of the file gets the address
//! of this description.

use std::io::{self, Seek, SeekFrom, Write};

use flate2::Compression;
use flate2::write::ZlibEncoder;
use packwatch_core::can::{CanId, Frame, FrameKind};
use packwatch_core::quantity::Timestamp;

use super::blocks::{BLOCK_HEAD, FIRST_BLOCK};

/// Unpacked size of a data block, bytes. The standard allows 4 MiB.
const BLOCK: usize = 1 << 20;
/// Size of the header block, bytes.
const HEADER_LEN: u64 = 104;
/// Name in the file's first bytes.
const PROGRAM: &[u8; 8] = b"packwtch";
/// Flags of a group with events of a bus.
const BUS_EVENT: u16 = 2 | 4;
/// Flag of a channel with events of a bus.
const BUS_EVENT_CHANNEL: u32 = 1 << 10;
/// Data types: unsigned number, signed number, array of bytes.
const UNSIGNED: u8 = 0;
const SIGNED: u8 = 2;
const BYTES: u8 = 10;
/// Length of the time in a record, bytes.
const TIME_LEN: usize = 8;
/// Length of the longest fields between time and data in a record, bytes.
const FIELDS_LEN: usize = 12;

/// Fields of a frame after the time, with their lengths.
const FRAME_FIELDS: [(&str, usize); 9] = [
    ("BusChannel", 1),
    ("ID", 4),
    ("IDE", 1),
    ("DLC", 1),
    ("DataLength", 1),
    ("Dir", 1),
    ("EDL", 1),
    ("BRS", 1),
    ("ESI", 1),
];
/// Number of these fields that remote frames have.
const REMOTE_FIELDS: usize = 6;
/// Fields of an error frame after the time.
const ERROR_FIELDS: [(&str, usize); 2] = [("BusChannel", 1), ("ErrorType", 1)];

/// Codes of the lengths above 8 bytes.
const FD_CODES: [(usize, u8); 7] = [(12, 9), (16, 10), (20, 11), (24, 12), (32, 13), (48, 14), (64, 15)];

/// Writes an MF4 file.
pub struct Mf4Writer<W> {
    out: W,
    /// Length of the file so far.
    len: u64,
    start: Option<Timestamp>,
    groups: [Group; 4],
}

struct Group {
    event: &'static str,
    fields: Vec<(&'static str, usize)>,
    records: Vec<u8>,
    record_len: usize,
    cycles: u64,
    /// Address of each block, and offset of its first byte in the unpacked data.
    blocks: Vec<(u64, u64)>,
    unpacked: u64,
}

impl Group {
    fn new(event: &'static str, fields: &[(&'static str, usize)], data: usize) -> Self {
        let mut fields = fields.to_vec();
        if data > 0 {
            fields.push(("DataBytes", data));
        }
        let record_len = TIME_LEN + fields.iter().map(|(_, len)| len).sum::<usize>();
        Self { event, fields, records: Vec::new(), record_len, cycles: 0, blocks: Vec::new(), unpacked: 0 }
    }
}

impl<W: Write + Seek> Mf4Writer<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn new(mut out: W) -> io::Result<Self> {
        out.write_all(&file_head())?;
        out.write_all(&[0; HEADER_LEN as usize])?;
        let groups = [
            Group::new("CAN_DataFrame", &FRAME_FIELDS, 8),
            Group::new("CAN_DataFrame", &FRAME_FIELDS, 64),
            Group::new("CAN_RemoteFrame", &FRAME_FIELDS[..REMOTE_FIELDS], 0),
            Group::new("CAN_ErrorFrame", &ERROR_FIELDS, 0),
        ];
        Ok(Self { out, len: FIRST_BLOCK + HEADER_LEN, start: None, groups })
    }

    /// Writes a frame. `channel` counts from 1.
    ///
    /// # Errors
    /// Returns the errors of the output.
    pub fn write_frame(&mut self, time: Timestamp, channel: u8, frame: &Frame) -> io::Result<()> {
        let (id, extended) = match frame.id() {
            CanId::Standard(id) => (u32::from(id), false),
            CanId::Extended(id) => (id, true),
        };
        let (group, fd) = match frame.kind() {
            FrameKind::Classic => (0, [false; 3]),
            FrameKind::Fd { brs, esi } => (1, [true, brs, esi]),
            FrameKind::Remote => (2, [false; 3]),
        };
        let code = FD_CODES.iter().find(|(len, _)| *len == frame.len()).map_or(frame.len() as u8, |(_, code)| *code);
        let mut fields = [0; FIELDS_LEN];
        fields[0] = channel;
        fields[1..5].copy_from_slice(&id.to_le_bytes());
        fields[5..9].copy_from_slice(&[u8::from(extended), code, frame.data().len() as u8, 0]);
        fields[9..].copy_from_slice(&fd.map(u8::from));
        let used = if group == 2 { 9 } else { fields.len() };
        self.write_record(group, time, &fields[..used], frame.data())
    }

    /// Writes an error frame. `class` has the CAN_ERR_* bits of SocketCAN.
    ///
    /// # Errors
    /// Returns the errors of the output.
    pub fn write_error_frame(&mut self, time: Timestamp, channel: u8, class: u32) -> io::Result<()> {
        let error = match class {
            _ if class & 0x20 != 0 => 5,
            _ if class & 8 != 0 => 1,
            _ => 0,
        };
        self.write_record(3, time, &[channel, error], &[])
    }

    fn write_record(&mut self, index: usize, time: Timestamp, fields: &[u8], data: &[u8]) -> io::Result<()> {
        let start = *self.start.get_or_insert(time);
        let group = &mut self.groups[index];
        let end = group.records.len() + group.record_len;
        group.records.extend(time.nanos().saturating_sub(start.nanos()).to_le_bytes());
        group.records.extend(fields);
        group.records.extend(data);
        group.records.resize(end, 0);
        group.cycles += 1;
        if end + group.record_len > BLOCK { self.write_block(index) } else { Ok(()) }
    }

    /// Writes the records of a group as a compressed block, column by column.
    fn write_block(&mut self, index: usize) -> io::Result<()> {
        let group = &mut self.groups[index];
        let (columns, rows) = (group.record_len, group.records.len() / group.record_len);
        let mut transposed = vec![0; group.records.len()];
        for (column, values) in transposed.chunks_exact_mut(rows).enumerate() {
            values.iter_mut().zip(group.records[column..].iter().step_by(columns)).for_each(|(to, from)| *to = *from);
        }
        let mut packer = ZlibEncoder::new(Vec::new(), Compression::default());
        packer.write_all(&transposed)?;
        let packed = packer.finish()?;
        let mut data = b"DT\x01\x00".to_vec();
        data.extend((columns as u32).to_le_bytes());
        data.extend((transposed.len() as u64).to_le_bytes());
        data.extend((packed.len() as u64).to_le_bytes());
        data.extend(packed);
        group.records.clear();
        let unpacked = group.unpacked;
        group.unpacked += transposed.len() as u64;
        let address = self.write_description(b"##DZ", &[], &data)?;
        self.groups[index].blocks.push((address, unpacked));
        Ok(())
    }

    /// Writes a block at the end of the file. Returns its address.
    fn write_description(&mut self, id: &[u8; 4], links: &[u64], data: &[u8]) -> io::Result<u64> {
        let address = self.len;
        let bytes = block(id, links, data);
        self.out.write_all(&bytes)?;
        let padding = bytes.len().next_multiple_of(8) - bytes.len();
        self.out.write_all(&[0; 8][..padding])?;
        self.len += (bytes.len() + padding) as u64;
        Ok(address)
    }

    fn write_text(&mut self, id: &[u8; 4], text: &str) -> io::Result<u64> {
        self.write_description(id, &[], &[text.as_bytes(), b"\0"].concat())
    }

    /// Completes the file and returns the output.
    ///
    /// # Errors
    /// Returns the errors of the output.
    pub fn finish(mut self) -> io::Result<W> {
        for index in 0..self.groups.len() {
            if !self.groups[index].records.is_empty() {
                self.write_block(index)?;
            }
        }
        let start_ns = self.start.map_or(0, Timestamp::nanos).max(0).cast_unsigned();
        let comment = concat!(
            "<FHcomment><TX>packwatch convert</TX><tool_id>packwatch</tool_id><tool_vendor>packwatch</tool_vendor>",
            "<tool_version>",
            env!("CARGO_PKG_VERSION"),
            "</tool_version></FHcomment>"
        );
        let comment = self.write_text(b"##MD", comment)?;
        let history =
            self.write_description(b"##FH", &[0, comment], &[&start_ns.to_le_bytes()[..], &[0; 8]].concat())?;
        let name = self.write_text(b"##TX", "CAN")?;
        let source = self.write_description(b"##SI", &[name, name, 0], &[2, 2, 0, 0, 0, 0, 0, 0])?;
        let unit = self.write_text(b"##TX", "s")?;
        let mut linear = vec![1, 0, 0, 0, 0, 0, 2, 0];
        linear.extend([0.0, 0.0, 0.0, 1e-9_f64].iter().flat_map(|value| value.to_le_bytes()));
        let conversion = self.write_description(b"##CC", &[0; 4], &linear)?;
        let mut next = 0;
        // Each block links to the next one, so the last group is written first.
        for index in (0..self.groups.len()).rev() {
            if self.groups[index].cycles > 0 {
                next = self.write_group(index, next, name, source, unit, conversion)?;
            }
        }
        self.out.seek(SeekFrom::Start(FIRST_BLOCK))?;
        let header = [&start_ns.to_le_bytes()[..], &[0; 24]].concat();
        self.out.write_all(&block(b"##HD", &[next, history, 0, 0, 0, 0], &header))?;
        self.out.seek(SeekFrom::End(0))?;
        self.out.flush()?;
        Ok(self.out)
    }

    /// Writes the description of a group. Returns the address of its first block.
    fn write_group(
        &mut self,
        index: usize,
        next: u64,
        name: u64,
        source: u64,
        unit: u64,
        conversion: u64,
    ) -> io::Result<u64> {
        let Group { event, fields, record_len, cycles, blocks, .. } = &self.groups[index];
        let (event, fields, record_len, cycles) = (*event, fields.clone(), *record_len, *cycles);
        let mut list = vec![0, 0, 0, 0];
        list.extend((blocks.len() as u32).to_le_bytes());
        list.extend(blocks.iter().flat_map(|(_, offset)| offset.to_le_bytes()));
        let links: Vec<u64> = std::iter::once(0).chain(blocks.iter().map(|(address, _)| *address)).collect();
        let list = self.write_description(b"##DL", &links, &list)?;
        let data = self.write_description(b"##HL", &[list], &[0, 0, 1, 0, 0, 0, 0, 0])?;
        let (mut parts, mut end) = (0, record_len);
        for (field, len) in fields.iter().rev() {
            end -= len;
            let name = self.write_text(b"##TX", &format!("{event}.{field}"))?;
            let kind = if *field == "DataBytes" { BYTES } else { UNSIGNED };
            let links = [parts, 0, name, source, 0, 0, 0, 0];
            parts = self.write_description(b"##CN", &links, &channel([0, 0, kind], end, *len, BUS_EVENT_CHANNEL))?;
        }
        let whole = channel([0, 0, BYTES], TIME_LEN, record_len - TIME_LEN, BUS_EVENT_CHANNEL);
        let event = self.write_text(b"##TX", event)?;
        let whole = self.write_description(b"##CN", &[0, parts, event, source, 0, 0, 0, 0], &whole)?;
        let time = self.write_text(b"##TX", "Timestamp")?;
        let links = [whole, 0, time, 0, conversion, 0, unit, 0];
        let time = self.write_description(b"##CN", &links, &channel([2, 1, SIGNED], 0, TIME_LEN, 0))?;
        let mut description = [0; 32];
        description[8..16].copy_from_slice(&cycles.to_le_bytes());
        description[16..18].copy_from_slice(&BUS_EVENT.to_le_bytes());
        description[18] = b'.';
        description[24..28].copy_from_slice(&(record_len as u32).to_le_bytes());
        let group = self.write_description(b"##CG", &[0, time, name, source, 0, 0], &description)?;
        self.write_description(b"##DG", &[next, group, data, 0], &[0; 8])
    }
}

/// The first 64 bytes.
fn file_head() -> [u8; FIRST_BLOCK as usize] {
    let mut head = [0; FIRST_BLOCK as usize];
    head[..16].copy_from_slice(b"MDF     4.10    ");
    head[16..24].copy_from_slice(PROGRAM);
    head[28..30].copy_from_slice(&410_u16.to_le_bytes());
    head
}

/// The bytes of a block.
fn block(id: &[u8; 4], links: &[u64], data: &[u8]) -> Vec<u8> {
    let len = BLOCK_HEAD + 8 * links.len() as u64 + data.len() as u64;
    let mut bytes = [id.as_slice(), &[0; 4], &len.to_le_bytes(), &(links.len() as u64).to_le_bytes()].concat();
    bytes.extend(links.iter().flat_map(|link| link.to_le_bytes()));
    bytes.extend(data);
    bytes
}

/// Data of a channel block: type, synchronisation and data type, first byte and length in the record, flags.
fn channel(types: [u8; 3], byte: usize, len: usize, flags: u32) -> Vec<u8> {
    let mut data = types.to_vec();
    data.push(0);
    data.extend([byte as u32, 8 * len as u32, flags].iter().flat_map(|number| number.to_le_bytes()));
    data.resize(72, 0);
    data
}
