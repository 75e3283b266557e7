//! Writes frames and estimates as MCAP with JSON messages, which Foxglove and PlotJuggler show without a plug-in.

use std::collections::BTreeMap;
use std::io;

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions, Writer};
use serde_json::{Value, json};

use crate::can::{CanId, Frame, FrameKind};
use crate::io::result_file::ResultFile;
use crate::monitor::Estimate;
use crate::quantity::Timestamp;

pub(super) struct McapFile {
    writer: Writer<NoSeek<ResultFile>>,
    /// Schemas of frames, error frames and estimates.
    schemas: [u16; 3],
    topics: BTreeMap<String, u16>,
    sequence: u32,
}

impl McapFile {
    pub(super) fn new(file: ResultFile) -> io::Result<Self> {
        // The file is not compressed, because the crate would add other versions of zstd and lz4 to the program.
        let options = WriteOptions::new().compression(None).disable_seeking(true).library("packwatch");
        let mut writer = options.create(NoSeek::new(file)).map_err(fault)?;
        let mut add = |name: &str, schema: Value| writer.add_schema(name, "jsonschema", schema.to_string().as_bytes());
        let schemas = [
            add("packwatch.Frame", frame_schema()).map_err(fault)?,
            add("packwatch.ErrorFrame", object(&[("class", "integer")])).map_err(fault)?,
            add("packwatch.Estimate", estimate_schema()).map_err(fault)?,
        ];
        Ok(Self { writer, schemas, topics: BTreeMap::new(), sequence: 0 })
    }

    pub(super) fn write_frame(&mut self, time: Timestamp, interface: &str, frame: &Frame) -> io::Result<()> {
        let kind = match frame.kind() {
            FrameKind::Classic => "data",
            FrameKind::Remote => "remote",
            FrameKind::Fd { .. } => "fd",
        };
        let extended = matches!(frame.id(), CanId::Extended(_));
        let (id, len, data) = (frame.id().raw(), frame.len(), frame.data());
        let message = json!({ "id": id, "extended": extended, "kind": kind, "length": len, "data": data });
        self.write(time, format!("/can/{interface}"), 0, &message)
    }

    pub(super) fn write_error_frame(&mut self, time: Timestamp, interface: &str, class: u32) -> io::Result<()> {
        self.write(time, format!("/errors/{interface}"), 1, &json!({ "class": class }))
    }

    pub(super) fn write_estimate(&mut self, e: &Estimate) -> io::Result<()> {
        let message = json!({
            "soc": e.soc,
            "soc_std": e.soc_std,
            "capacity_ah": e.capacity_ah,
            "capacity_std_ah": e.capacity_std_ah,
            "resistance_ratio": e.resistance_ratio,
            "resistance_ratio_std": e.resistance_ratio_std,
            "innovation_v": e.innovation_v,
            "innovation_std_v": e.innovation_std_v,
            "accepted": e.accepted,
            "voltage_v": e.measured.voltage_v,
            "current_a": e.measured.current_a,
            "temperature_c": e.measured.temperature_c,
        });
        self.write(e.time, format!("/cells/{}", e.cell.0), 2, &message)
    }

    /// Writes a message. Times before 1970 become 0, because MCAP has no earlier times.
    fn write(&mut self, time: Timestamp, topic: String, schema: usize, message: &Value) -> io::Result<()> {
        let channel_id = match self.topics.get(&topic) {
            Some(id) => *id,
            None => {
                let id = self.writer.add_channel(self.schemas[schema], &topic, "json", &BTreeMap::new());
                let id = id.map_err(fault)?;
                self.topics.insert(topic, id);
                id
            }
        };
        let log_time = u64::try_from(time.nanos()).unwrap_or(0);
        let header = MessageHeader { channel_id, sequence: self.sequence, log_time, publish_time: log_time };
        self.sequence = self.sequence.wrapping_add(1);
        self.writer.write_to_known_channel(&header, &serde_json::to_vec(message)?).map_err(fault)
    }

    pub(super) fn finish(mut self) -> io::Result<()> {
        self.writer.finish().map_err(fault)?;
        self.writer.into_inner().into_inner().finish()
    }
}

fn fault(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        error => io::Error::other(error),
    }
}

/// JSON schema of an object with these fields.
fn object(fields: &[(&str, &str)]) -> Value {
    let fields: serde_json::Map<_, _> =
        fields.iter().map(|(name, kind)| ((*name).to_owned(), json!({ "type": kind }))).collect();
    json!({ "type": "object", "properties": fields })
}

fn frame_schema() -> Value {
    let mut schema = object(&[
        ("id", "integer"),
        ("extended", "boolean"),
        ("kind", "string"),
        ("length", "integer"),
        ("data", "array"),
    ]);
    schema["properties"]["data"]["items"] = json!({ "type": "integer" });
    schema
}

fn estimate_schema() -> Value {
    const NUMBERS: [&str; 11] = [
        "soc",
        "soc_std",
        "capacity_ah",
        "capacity_std_ah",
        "resistance_ratio",
        "resistance_ratio_std",
        "innovation_v",
        "innovation_std_v",
        "voltage_v",
        "current_a",
        "temperature_c",
    ];
    let mut fields = NUMBERS.map(|name| (name, "number")).to_vec();
    fields.push(("accepted", "boolean"));
    object(&fields)
}
