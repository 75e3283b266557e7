//! Looks up the configured signal names in the DBC files and in the diagnostic answers.
//!
//! Every name must occur exactly once, and every cell must have exactly one signal. A signal of a message longer than 8
//! bytes requires an interface with `fd = true`. Checking continues after a fault.

use std::collections::BTreeMap;
use std::path::Path;

use super::answers::{self, AnswerDefinition, AnswerPlace};
use super::pattern::Pattern;
use crate::can::CanId;
use crate::can::dbc::{Database, DbcError, Message, Signal};
use crate::can::decode::{Binding, InputMap};
use crate::can::j1939::parameter_group;
use crate::can::signal::{LayoutFault, ValueType};
use crate::can::unit::{Quantity, SignalUnit};
use crate::config::document::{Faults, ReadFile, SourceLine, TablePlace, beside, meant_file};
use crate::config::schema::RawTables;
use crate::config::schema::did_you_mean;
use crate::config::schema::keys::{CurrentSign, DiagnosticInput, PositiveCurrent, SignalSource, SourceAddress};
use crate::quantity::{BusIndex, CellIndex, Channel};

const MAX_NAMED_CELLS: usize = 8;

/// Largest length of a pack identity (for example a serial number), bits. A reading is a 64-bit float, which represents
/// integers of up to 53 bits exactly.
const MAX_IDENTITY_BITS: u16 = 53;

#[derive(Debug)]
pub(crate) struct Databases {
    files: Vec<(String, Database)>,
    answers: Vec<AnswerDefinition>,
}

/// A signal that the configuration may name.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NamedSignal<'d> {
    /// DBC file, or table of the answer.
    pub file: &'d str,
    /// The message that contains the signal.
    pub message: &'d Message,
    pub signal: &'d Signal,
    /// Position of the signal in its answer; `None` if the signal is in a DBC file.
    pub answer: Option<AnswerPlace<'d>>,
}

impl NamedSignal<'_> {
    /// The name of the signal in the form `Message.Signal`.
    pub(crate) fn full_name(&self) -> String {
        format!("{}.{}", self.message.name, self.signal.name)
    }

    fn is_named(&self, full_name: &str) -> bool {
        let rest = full_name.strip_prefix(self.message.name.as_str()).and_then(|rest| rest.strip_prefix('.'));
        rest == Some(self.signal.name.as_str())
    }
}

#[derive(Debug, Clone)]
pub(crate) struct ResolvedSignal<'d> {
    /// Input that the signal feeds.
    pub channel: Channel,
    /// Interface that carries the signal.
    pub bus: BusIndex,
    /// DBC file or table of the answer.
    pub file: &'d str,
    /// The message that contains the signal.
    pub message: &'d Message,
    pub signal: &'d Signal,
    /// Position of the signal in its answer; `None` if the signal is in a DBC file.
    pub answer: Option<AnswerPlace<'d>>,
    /// Factor from the DBC's unit and sign to packwatch's. The factor is negative if charge is positive on the bus.
    pub scale: f64,
    /// Offset in packwatch's unit and sign, added after the scale.
    pub offset: f64,
    /// Raw codes that mean "not available", from the configuration and the DBC.
    pub not_available: Vec<u64>,
    /// Values that mean charging, if the signal is the direction of the current; else empty.
    pub charge: Vec<f64>,
    /// Whether any J1939 source address may send the message.
    pub of_any_source: bool,
}

/// Ranges and resolution stated by the DBC, in packwatch's units and sign. Ranges that are not stated are infinite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DbcRanges {
    /// Pack current (A), positive = discharge.
    pub current_a: (f64, f64),
    /// Cell voltage (V).
    pub voltage_v: (f64, f64),
    /// Temperature (degrees C).
    pub temperature_c: (f64, f64),
    /// Coarsest resolution of a cell's voltage (V); 0 = unknown.
    pub voltage_step_v: f64,
}

/// Length of the longest CAN FD frame, bytes.
const MAX_FRAME_BYTES: u16 = 64;

pub(crate) const UNLIMITED: (f64, f64) = (f64::NEG_INFINITY, f64::INFINITY);

impl Databases {
    /// Reads the DBC files and the answers. If there are no files and no answers, or if one of them is unusable
    /// (reported), signals cannot be looked up. The result is then `None`.
    pub(crate) fn load(config: &Path, raw: &RawTables, read: ReadFile<'_>) -> Option<Self> {
        let mut files = Vec::new();
        for (input, name) in raw.input.iter().flat_map(|input| input.dbc.iter().map(move |name| (input, name))) {
            let path = beside(config, name);
            let database = read_dbc(&path, read, &raw.faults, |faults, at, what| faults.warn(at, what));
            if database.is_none() && read(&path).is_err() {
                let meant = meant_file(config, name);
                let what = format!("{name:?} must be a DBC file, relative to the folder of the configuration{meant}");
                input.place.fault("dbc", what);
            }
            files.push(database.map(|database| (name.clone(), database)));
        }
        let files = files.into_iter().collect::<Option<Vec<_>>>()?;
        let answers = answers::definitions(raw);
        let are_all_usable = answers.len() == raw.count::<DiagnosticInput>();
        (are_all_usable && !(files.is_empty() && answers.is_empty())).then_some(Self { files, answers })
    }

    /// Returns every signal that the configuration may name.
    pub(crate) fn signals(&self) -> impl Iterator<Item = NamedSignal<'_>> {
        let messages = self.files.iter().flat_map(|(file, db)| db.messages.iter().map(move |m| (file.as_str(), m)));
        let of_files = messages.flat_map(|(file, message)| {
            message.signals.iter().map(move |signal| NamedSignal { file, message, signal, answer: None })
        });
        let of_answers = self.answers.iter().flat_map(|answer| {
            let (file, message) = (answer.table.as_str(), &answer.message);
            answer.signals().map(move |(signal, place)| NamedSignal { file, message, signal, answer: Some(place) })
        });
        of_files.chain(of_answers)
    }

    /// Returns another message of the same file with the same identifier as `message`.
    fn twin(&self, file: &str, message: &Message) -> Option<&Message> {
        let databases = self.files.iter().filter(|(name, _)| name == file).map(|(_, database)| database);
        let mut messages = databases.flat_map(|database| &database.messages);
        messages.find(|other| other.id == message.id && other.name != message.name)
    }

    fn file_names(&self) -> String {
        let mut names: Vec<&str> = self.files.iter().map(|(file, _)| file.as_str()).collect();
        names.extend((!self.answers.is_empty()).then_some("[[input.diagnostic]]"));
        names.join(" or ")
    }
}

/// Reads one DBC file. If the file cannot be read, adds a fault and returns `None`. Calls `report` for each part of the
/// file that is left out.
pub(crate) fn read_dbc(
    path: &Path,
    read: ReadFile<'_>,
    faults: &Faults,
    report: impl Fn(&Faults, &SourceLine, &str),
) -> Option<Database> {
    let file = path.display().to_string();
    let bytes = read(path).map_err(|error| faults.add(&file, 0, format!("cannot be read: {error}"))).ok()?;
    let database = Database::parse_bytes(&bytes).map_err(|error| faults.add(&file, error.line, error.what)).ok()?;
    let left_out =
        database.left_out.iter().map(|DbcError { line, what }| (SourceLine { file: file.clone(), line: *line }, what));
    if database.messages.is_empty() {
        left_out.for_each(|(at, what)| faults.add_at(&at, what));
        faults.add(&file, 0, "contains no message, must be a DBC file with at least one message (BO_)");
        return None;
    }
    left_out.for_each(|(at, what)| report(faults, &at, what));
    Some(database)
}

pub(crate) fn resolve<'d>(raw: &RawTables, databases: &'d Databases) -> Vec<ResolvedSignal<'d>> {
    let mut search = Search { raw, databases, found: Vec::new() };
    for (channel, source) in raw.sources() {
        match channel {
            Channel::CellVoltage(_) => {
                let first = raw.cell_voltage.as_ref().map_or(1, |keys| keys.first);
                search.cells(&source, first, Channel::CellVoltage);
            }
            Channel::Balancing(_) => {
                let first = raw.balancing.as_ref().map_or(1, |keys| keys.first);
                search.cells(&source, first, Channel::Balancing);
            }
            Channel::Current => search.one(channel, &source, current_sign(raw)),
            _ => search.one(channel, &source, 1.0),
        }
    }
    search.found
}

pub(crate) fn check_name(raw: &RawTables, databases: &Databases, source: &SignalSource<'_>) {
    if !databases.signals().any(|signal| signal.is_named(source.signal)) {
        Search { raw, databases, found: Vec::new() }.not_found(source);
    }
}

/// Returns 1 or -1, the factor from the current's sign on the bus to packwatch's sign. The factor is 1 if another
/// signal gives the direction.
fn current_sign(raw: &RawTables) -> f64 {
    match raw.current.as_ref().and_then(|keys| keys.positive) {
        Some(PositiveCurrent::Charge) if !raw.is_written::<CurrentSign>() => -1.0,
        _ => 1.0,
    }
}

struct Search<'s, 'd> {
    raw: &'s RawTables,
    databases: &'d Databases,
    found: Vec<ResolvedSignal<'d>>,
}

impl<'d> Search<'_, 'd> {
    fn one(&mut self, channel: Channel, source: &SignalSource<'_>, sign: f64) {
        let name = source.signal;
        let hits: Vec<NamedSignal<'d>> = self.databases.signals().filter(|signal| signal.is_named(name)).collect();
        match hits[..] {
            [] => self.not_found(source),
            [hit] => self.add(channel, source, sign, hit),
            [first, .., last] => {
                source.place.fault("signal", format!("must be unique, but is in {} and {}", first.file, last.file));
            }
        }
    }

    fn not_found(&mut self, source: &SignalSource<'_>) {
        let what = format!("must be a signal (Message.Signal) of {}", self.databases.file_names());
        let names: Vec<String> = self.databases.signals().map(|signal| signal.full_name()).collect();
        let hint = did_you_mean(source.signal, names.iter().map(String::as_str));
        source.place.fault("signal", &(what + &hint));
        self.left_out(source.signal);
    }

    /// If the message of a signal was left out of its DBC file, reports why.
    fn left_out(&self, signal: &str) {
        let Some((message, _)) = signal.split_once('.') else { return };
        let beginning = format!("message {message} is left out: ");
        for (name, database) in &self.databases.files {
            let file = beside(Path::new(&self.raw.file), name).display().to_string();
            let faults = database.left_out.iter().filter(|fault| fault.what.starts_with(&beginning));
            faults.for_each(|fault| self.raw.faults.add(&file, fault.line, &fault.what));
        }
    }

    /// Looks up the signals of all cells by a pattern. `first` is the number of the first cell in the signal names.
    fn cells(&mut self, source: &SignalSource<'_>, first: u16, channel: fn(CellIndex) -> Channel) {
        let Some(pack) = &self.raw.pack else { return };
        let cells = pack.cells;
        let pattern = match Pattern::parse(source.signal) {
            Ok(pattern) => pattern,
            Err(what) => return source.place.fault("signal", &what),
        };
        if !pattern.has_cell() && cells > 1 {
            let what = format!("must contain {{n}} for the cell's number, because pack.cells = {cells}");
            return source.place.fault("signal", &what);
        }
        let mut hits: BTreeMap<u32, Vec<NamedSignal<'d>>> = BTreeMap::new();
        for hit in self.databases.signals() {
            if let Some(number) = pattern.fits(&hit.full_name()) {
                hits.entry(number.unwrap_or(u32::from(first))).or_default().push(hit);
            }
        }
        if hits.is_empty() {
            return self.not_found(source);
        }
        let mut missing = Vec::new();
        for (index, number) in (0..cells).zip(u32::from(first)..) {
            match hits.get(&number).map(Vec::as_slice) {
                None | Some([]) => missing.push(number),
                Some([hit]) => self.add(channel(CellIndex(index)), source, 1.0, *hit),
                Some([a, .., b]) => {
                    let what = format!(
                        "must match one signal per cell, but number {number} matches {} and {}",
                        a.full_name(),
                        b.full_name()
                    );
                    source.place.fault("signal", &what);
                }
            }
        }
        if !missing.is_empty() {
            let what = format!(
                "must match a signal for each of {cells} cells (pack.cells), but none has number {}",
                list(&missing)
            );
            source.place.fault("signal", &what);
        }
    }

    fn add(&mut self, channel: Channel, source: &SignalSource<'_>, sign: f64, named: NamedSignal<'d>) {
        let NamedSignal { file, message, signal, answer } = named;
        let Some(bus) = self.raw.bus_of(source.interface) else {
            return; // `input_tables` reports unknown interfaces
        };
        let full_name = named.full_name();
        let fd = self.raw.interfaces.get(bus.index()).is_some_and(|interface| interface.fd);
        if message.len_bytes > MAX_FRAME_BYTES && answer.is_none() {
            let what = format!(
                "message {} has {} bytes in {file}, must have at most {MAX_FRAME_BYTES}",
                message.name, message.len_bytes
            );
            source.place.fault("signal", &what);
        } else if message.len_bytes > 8 && !fd && answer.is_none() {
            let what = format!(
                "message {} has {} bytes, requires fd = true on its interface",
                message.name, message.len_bytes
            );
            source.place.fault("signal", &what);
        }
        if let Some(twin) = self.databases.twin(file, message).filter(|_| answer.is_none()) {
            let what = format!(
                "message {} has identifier {}, which {file} also gives to {}, must be unique",
                message.name, message.id, twin.name
            );
            source.place.fault("signal", &what);
        }
        if let Some(other) = self.found.iter().find(|f| f.bus == bus && std::ptr::eq(f.signal, signal)) {
            source
                .place
                .fault("signal", format!("must not be used twice, but is also {}", channel_words(other.channel)));
        }
        if channel == Channel::PackIdentity && signal.layout.length_bits > MAX_IDENTITY_BITS {
            let what =
                format!("{full_name} has {} bits, must have at most {MAX_IDENTITY_BITS}", signal.layout.length_bits);
            source.place.fault("signal", &what);
        }
        let largest = u64::MAX >> (64 - u32::from(signal.layout.length_bits.clamp(1, 64)));
        if source.not_available.iter().any(|&code| code > largest) {
            source.place.fault("not_available", format!("must be 0 to {largest:#X}, the codes of {full_name}"));
        }
        let mut not_available = signal.not_available_codes();
        not_available.extend(source.not_available.iter().filter(|code| **code <= largest));
        not_available.sort_unstable();
        not_available.dedup();
        let is_percent = SignalUnit::parse(&signal.unit).is_some_and(|unit| unit.quantity == Quantity::PERCENTAGE)
            && matches!(channel, Channel::ReportedSoc | Channel::ReportedSoh);
        let usual_scale = if is_percent && !source.place.has("scale") { 0.01 } else { source.scale };
        let (scale, offset) = (sign * usual_scale, sign * source.offset);
        let is_direction = channel == Channel::CurrentDirection;
        let charge = self.raw.current_sign.as_ref().filter(|_| is_direction).map(|keys| keys.charge.clone());
        let of_any_source = answer.is_none() && self.is_of_any_source(message);
        self.found.push(ResolvedSignal {
            channel,
            bus,
            file,
            message,
            signal,
            answer,
            scale,
            offset,
            not_available,
            charge: charge.unwrap_or_default(),
            of_any_source,
        });
    }

    /// Whether any J1939 source address may send a message. If another message has the same parameter group, only the
    /// source address distinguishes the two.
    fn is_of_any_source(&self, message: &Message) -> bool {
        let group = parameter_group(message.id);
        let is_wanted = match self.raw.input.as_ref().map_or(SourceAddress::Auto, |input| input.source_address) {
            SourceAddress::Auto => message.is_j1939,
            SourceAddress::Any => group.is_some(),
            SourceAddress::Exact => false,
        };
        let mut messages = self.databases.files.iter().flat_map(|(_, database)| &database.messages);
        is_wanted && !messages.any(|other| other.id != message.id && parameter_group(other.id) == group)
    }
}

/// Name of a channel for users (cells and sensors are counted from 1).
pub(crate) fn channel_words(channel: Channel) -> String {
    match channel {
        Channel::Current => "pack current".to_owned(),
        Channel::Temperature(sensor) => format!("temperature {}", sensor.0 + 1),
        Channel::PackVoltage => "pack voltage".to_owned(),
        Channel::CellVoltage(cell) => format!("cell {} voltage", cell.0 + 1),
        Channel::ReportedSoc => "reported SOC".to_owned(),
        Channel::ReportedSoh => "reported SOH".to_owned(),
        Channel::Balancing(cell) => format!("cell {} balancing", cell.0 + 1),
        Channel::SupplyVoltage => "supply voltage".to_owned(),
        Channel::PackIdentity => "pack identity".to_owned(),
        Channel::CurrentDirection => "direction of the current".to_owned(),
        Channel::Contactor => "contactors".to_owned(),
    }
}

/// If an input uses the identifier `id` on one of these interfaces, reports a fault at the key `id` of the frame's
/// table.
pub(crate) fn check_no_input(place: &TablePlace, id: CanId, buses: &[BusIndex], found: &[ResolvedSignal<'_>]) {
    if let Some(input) = found.iter().find(|input| buses.contains(&input.bus) && input.message.id == id) {
        place.fault("id", format!("must not be the identifier of an input, but {} has {id}", input.message.name));
    }
}

fn list(numbers: &[u32]) -> String {
    let mut words: Vec<String> = numbers.iter().take(MAX_NAMED_CELLS).map(u32::to_string).collect();
    if numbers.len() > MAX_NAMED_CELLS {
        words.push(format!("... ({} in all)", numbers.len()));
    }
    words.join(", ")
}

impl ResolvedSignal<'_> {
    /// Creates the binding with which the decoder reads the signal. The decoder checks only the DBC's range; the sample
    /// stage checks plausibility later.
    pub(crate) fn binding(&self) -> Result<Binding, LayoutFault> {
        let mut binding = Binding::new(self.bus, self.message, self.signal, self.channel)?;
        binding.scale = self.scale;
        binding.offset = self.offset;
        binding.not_available.clone_from(&self.not_available);
        binding.charge.clone_from(&self.charge);
        binding.of_any_source = self.of_any_source;
        Ok(binding)
    }

    /// Distance between neighbouring values, in packwatch's unit; 0 for IEEE floats.
    fn step(&self) -> f64 {
        match self.signal.layout.value_type {
            ValueType::Unsigned | ValueType::Signed => (self.signal.layout.factor * self.scale).abs(),
            ValueType::Float32 | ValueType::Float64 => 0.0,
        }
    }

    /// The DBC's range in packwatch's unit and sign; infinite if the DBC states no range.
    pub(crate) fn range(&self) -> (f64, f64) {
        let layout = &self.signal.layout;
        if !layout.has_range() {
            return UNLIMITED;
        }
        let (a, b) = (layout.minimum * self.scale + self.offset, layout.maximum * self.scale + self.offset);
        (a.min(b), a.max(b))
    }
}

/// The map from frames to inputs for the decoder, without the diagnostic answers. If a layout cannot be decoded, the
/// result is `None`; the module `plausible` has reported this fault.
pub(crate) fn input_map(found: &[ResolvedSignal<'_>]) -> Option<InputMap> {
    let in_frames = found.iter().filter(|resolved| resolved.answer.is_none());
    let bindings: Result<Vec<_>, _> = in_frames.map(ResolvedSignal::binding).collect();
    bindings.ok().map(InputMap::new)
}

/// Returns the widest range that the DBC states for each kind of value. If the signal is the pack's total voltage, the
/// range is divided by the number of cells (`series`).
pub(crate) fn ranges(found: &[ResolvedSignal<'_>], series: u16) -> DbcRanges {
    let widest = |belongs: fn(Channel) -> bool, divisor: f64| {
        let ranges = found.iter().filter(|resolved| belongs(resolved.channel)).map(ResolvedSignal::range);
        let widest = ranges.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))).unwrap_or(UNLIMITED);
        (widest.0 / divisor, widest.1 / divisor)
    };
    let has_direction = found.iter().any(|resolved| resolved.channel == Channel::CurrentDirection);
    let voltage_v = if found.iter().any(|resolved| resolved.channel == Channel::PackVoltage) {
        widest(|channel| channel == Channel::PackVoltage, f64::from(series))
    } else {
        widest(|channel| matches!(channel, Channel::CellVoltage(_)), 1.0)
    };
    let is_voltage = |channel: Channel| matches!(channel, Channel::CellVoltage(_) | Channel::PackVoltage);
    let steps = found.iter().filter(|resolved| is_voltage(resolved.channel)).map(ResolvedSignal::step);
    let per_cell = if found.iter().any(|it| it.channel == Channel::PackVoltage) { f64::from(series) } else { 1.0 };
    DbcRanges {
        voltage_step_v: steps.fold(0.0, f64::max) / per_cell,
        current_a: match widest(|channel| channel == Channel::Current, 1.0) {
            (low, high) if has_direction => (-high.max(-low), high.max(-low)),
            signed => signed,
        },
        voltage_v,
        temperature_c: widest(|channel| matches!(channel, Channel::Temperature(_)), 1.0),
    }
}
