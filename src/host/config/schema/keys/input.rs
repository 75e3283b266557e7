//! Declares the tables that describe what is read from the buses: `[input]` and its subtables.

use super::choices::{PositiveCurrent, SourceAddress, WireOrder};
use crate::can::e2e::Profile;
use crate::config::document::TablePlace;
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Above, Any, Between, NotEmpty};
use crate::config::schema::section::SubTables;
use crate::config::schema::section::section;
use crate::config::schema::setting::{CellRanges, NumberRange};

section! {
    /// The inputs that are read from the buses. `[input.current]` is required. Either `[input.cell_voltage]` or `[input.pack_voltage]` is required too.
    Input at "input" {
        /// DBC files that describe the signals named below, relative to this file. Not required if all signals are in the answers of `[[input.diagnostic]]`.
        dbc: Vec<String>, "", Any, Default("[]");
        /// Which J1939 source addresses may send a message of the DBC files. "auto": any address, if the DBC gives the message the frame format J1939PG (attribute `VFrameFormat`) or, without this attribute, states `ProtocolType` J1939. "any": any address, for every 29-bit identifier. "exact": only the address in the DBC. Messages that share their parameter group (PGN) with another message of the DBC files are always matched exactly.
        source_address: SourceAddress, "", Any, Default("\"auto\"");
        /// If all inputs are silent for this long and no current flows, the vehicle counts as asleep. Sleep is not a fault and raises no alarm; its beginning and its end are recorded as events (asleep, awake). Must be at least the largest `max_age_s` of current and voltages (`[limits.*]`). 0: the vehicle never counts as asleep, so the silent inputs of a parked vehicle are reported as missing.
        asleep_after_s: f64, "s", Between(0.0, 86_400.0), Default("5.0");
        /// Largest number of frames per second that are processed for one identifier on one interface. A tenth of this number may arrive at once. Further frames are dropped, counted and reported, so that a faulty sender cannot displace the others. The default is twice the rate of the fastest sensible sender (one frame per millisecond), and half of what fits on a 500 kbit/s bus.
        max_frames_per_s: u32, "frames/s", Between(10.0, 1e6), Default("2000");
    }
}

section! {
    /// An input message that its sender protects end to end (AUTOSAR). A frame fails its check if it is damaged, repeated or out of sequence. It also fails if it belongs to another message, or if it is the first frame after a start. The readings of such a frame are bad. Each outcome is counted; a change between good and bad is reported.
    ProtectedInput at "input.protected" {
        /// Name of the message in its DBC file. At least one of its signals must be an input.
        message: String, "", NotEmpty, Required;
        /// Interface that carries the message.
        interface: Option<String>, "", NotEmpty, Optional("the only interface; required with several");
        /// AUTOSAR profile: "1A" (profile 1, whole data identifier in the CRC), "1C" (profile 1, four bits of the data identifier are sent), or "5".
        profile: Profile, "", Any, Required;
        /// Data identifier agreed with the sender; at most 0xFFF for "1C".
        data_id: u16, "", Between(0.0, 65535.0), Required;
        /// Number of frames that may be lost between two good frames. Each further check without a good frame allows one more lost frame. At most 14 for profile 1.
        max_delta_counter: u8, "frames", Between(0.0, 255.0), Default("1");
        /// After this many consecutive repeated or missing frames, the sender must establish its sequence again (see `sync_counter`). 14 = never.
        max_repeated: u8, "frames", Between(0.0, 14.0), Default("14");
        /// Number of frames in sequence that establish the sender's sequence again after its counter has jumped too far. The readings of these frames are used. 0 = no such frames are required. In that case, profile 1 keeps its old counter after a jump, for example after a restart of the sender. The sender's counter reaches the old counter after at most 14 frames.
        sync_counter: u8, "frames", Between(0.0, 14.0), Default("0");
    }
}

section! {
    /// An answer to a diagnostic request over ISO-TP; any tester may have sent the request. Most electric cars report cell voltages only this way. packwatch sends requests only with `[poll]`. The tables `[input.*]` name the signals of an answer in the same way as DBC signals: `Name.Signal`. The values have the time at which the first frame of the answer arrived.
    DiagnosticInput at "input.diagnostic" {
        /// Name of the answer, which precedes the dot in `Name.Signal`. Several answers may share a name.
        name: String, "", NotEmpty, Required;
        /// CAN identifier of the requests. A number above 0x7FF is a 29-bit identifier.
        request: u32, "", Between(0.0, 0x1FFF_FFFF as f64), Required;
        /// CAN identifier of the answers. A number above 0x7FF is a 29-bit identifier.
        response: u32, "", Between(0.0, 0x1FFF_FFFF as f64), Required;
        /// Extended addressing: first data byte of the requests.
        request_extension: Option<u8>, "", Any, Optional("normal addressing");
        /// Extended addressing: first data byte of the answers.
        response_extension: Option<u8>, "", Any, Optional("normal addressing");
        /// Service: 0x22 (UDS, ReadDataByIdentifier), 0x21 (KWP 2000, readDataByLocalIdentifier) or 0x01 (OBD, current data).
        service: u8, "", Any, Required;
        /// Identifier of the data: two bytes for service 0x22, else one byte.
        identifier: u16, "", Any, Required;
        /// Time between requests of `[poll]` while the pack is being discharged.
        drive_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional("not polled");
        /// Time between requests while the pack is being charged.
        charge_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional("not polled");
        /// Time between requests while the bus is awake and no current flows or the current is unknown.
        parked_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional("not polled");
        /// The signals of the answer, one table each. Signals that no input names are ignored.
        signals: SubTables<AnswerSignalKeys>, "", NotEmpty, Required;
    }
}

section! {
    /// A signal of the answer, or a sequence of equally spaced signals. Value = code x factor + offset.
    AnswerSignalKeys at "input.diagnostic.signals" {
        /// Name of the signal. In a sequence, `{n}` stands for the number.
        name: String, "", NotEmpty, Required;
        /// Position of the first (most significant) bit, counted from the most significant bit of the byte after the echoed service and identifier (like `bix` in OBDb).
        bit: u32, "bits", Between(0.0, 8.0 * 65_535.0), Required;
        /// Length of the signal.
        length: u16, "bits", Between(1.0, 64.0), Required;
        /// Whether the codes are signed (two's complement).
        signed: bool, "", Any, Default("false");
        /// Which byte comes first: the most significant ("big") or the least significant ("little", only for signals of whole bytes).
        byte_order: WireOrder, "", Any, Default("\"big\"");
        /// Value of one step of the code.
        factor: f64, "unit", Between(-1e9, 1e9), Default("1.0");
        /// Value at code 0.
        offset: f64, "unit", Between(-1e9, 1e9), Default("0.0");
        /// Unit of the value, written as in a DBC.
        unit: String, "", Any, Default("\"\"");
        /// Smallest plausible value; a reading below it is bad.
        minimum: Option<f64>, "unit", Any, Optional("not checked");
        /// Largest plausible value; a reading above it is bad.
        maximum: Option<f64>, "unit", Any, Optional("not checked");
        /// Codes that mean "not available".
        not_available: Vec<u64>, "", Any, Default("[]");
        /// Range of numbers that replace `{n}` in the name; each number declares one signal.
        numbers: Option<NumberRange>, "", Any, Optional("one signal");
        /// Distance between the first bits of consecutive signals of a sequence.
        step: Option<u32>, "bits", Between(1.0, 8.0 * 65_535.0), Optional("`length`");
    }
}

/// Declares a table that names a signal on a bus. All tables of this macro share the keys below.
macro_rules! signal_section {
    ($(#[doc = $about:literal])+ $name:ident at $path:literal, $unit:literal { $($keys:tt)* }) => {
        section! {
            $(#[doc = $about])+
            $name at $path gives SignalSource<'_>, |keys| {
                /// `Message.Signal` of one of the DBC files, or `Name.Signal` of a diagnostic answer. In `[input.cell_voltage]` and `[input.balancing]` it is a pattern (see those tables).
                signal: String, "", NotEmpty, Required => signal: &keys.signal;
                /// Interface that carries the signal.
                interface: Option<String>, "", NotEmpty, Optional("the only interface; required with several") => interface: keys.interface.as_deref();
                /// Factor from the DBC's unit to packwatch's unit, applied after the DBC's own factor (0.001 if the DBC is in milli-units).
                scale: f64, $unit, Above(0.0, 1e9), Default("1.0");
                /// Offset in packwatch's unit, added after `scale` (-273.15 if the DBC is in kelvin).
                offset: f64, "", Between(-1e9, 1e9), Default("0.0");
                /// Raw codes that mean "not available", in addition to those in the DBC's value table.
                not_available: Vec<u64>, "", Any, Default("[]") => not_available: &keys.not_available;
                $($keys)*
            } and { place: &keys.place }
        }
    };
}

/// The keys that all signal tables share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SignalSource<'a> {
    pub place: &'a TablePlace,
    /// `Message.Signal`, or a pattern of such names.
    pub signal: &'a str,
    pub interface: Option<&'a str>,
    /// Factor from the DBC's unit to packwatch's unit.
    pub scale: f64,
    /// Offset in packwatch's unit, added after `scale`.
    pub offset: f64,
    /// Raw codes that mean "not available".
    pub not_available: &'a [u64],
}

signal_section! {
    /// The pack current.
    CurrentInput at "input.current", "A per unit of the DBC" {
        /// Meaning of a positive value on the bus. There is no default because buses differ. Everything that packwatch computes and reports uses positive = discharge.
        positive: Option<PositiveCurrent>, "", Any, Optional("required, unless `[input.current.sign]` gives the direction") =>;
    }
}

signal_section! {
    /// Where the direction of the current is, if `[input.current]` names a magnitude: a sign bit or a direction byte, in the same or in another message. It can be written in one line: `sign = { signal = "Pack.Charging", charge = [1] }`. While the direction is unknown (no valid value within `max_age_s` of `[limits.current]`), the current is unknown.
    CurrentSign at "input.current.sign", "any unit" {
        /// Signal values (after the DBC's factor, `scale` and `offset`) that mean charging. Every other value means discharging.
        charge: Vec<f64>, "", NotEmpty, Required =>;
    }
}

signal_section! {
    /// The state of the pack's contactors. While it reads "open", packwatch uses 0 A, regardless of the current sensor's reading and even if the sensor is silent. If the state is unknown (no reading within `max_age_s`), the current sensor's reading is used.
    ContactorInput at "input.contactor", "any unit" {
        /// Signal values (after the DBC's factor, `scale` and `offset`) that mean open. Every other value means closed.
        open: Vec<f64>, "", NotEmpty, Required =>;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("5.0") =>;
    }
}

signal_section! {
    /// One voltage per cell. In `signal`, `{n}` stands for the cell's number and `{m}` for any number, in message and signal name:
    /// `CellVoltages.Cell{n}`, `Module{m}.CellVoltage{n}`. Every cell must have exactly one signal. Multiplexed signals are supported.
    CellVoltageInput at "input.cell_voltage", "V per unit of the DBC" {
        /// Number that replaces `{n}` in the signal name of the first cell.
        first: u16, "", Between(0.0, 60000.0), Default("1") =>;
    }
}

signal_section! {
    /// One signal per cell that shows whether the BMS bleeds the cell. With this input, the leaks of all cells can be learned. `signal` is a pattern as in `[input.cell_voltage]`. A value other than 0 (after the DBC's factor, `scale` and `offset`) means that the cell is bled; for an inverted bit set `offset = -1.0`. A value is valid until the next value arrives, but for at most `max_age_s`. Frames that carry only these signals do not wake sleeping buses. Requires `pack.balancing = true`.
    BalancingInput at "input.balancing", "any unit" {
        /// Number that replaces `{n}` in the signal name of the first cell.
        first: u16, "", Between(0.0, 60000.0), Default("1") =>;
        /// Current of a balancing resistor while the bit is 1, at the BMS's balancing voltage. Parallel strings share this current. Must be at most C/5 of the pack.
        bleed_a: f64, "A", Above(0.0, 1e6), Required =>;
        /// Longest time for which a value is valid. Must be longer than the BMS's send period, including its send period while the vehicle is parked. If it is shorter, the balancing state is unknown for the rest of each period.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
        /// `true`: while no values arrive, no cell is being balanced. Set it only if the BMS sends values throughout balancing and this computer stays awake throughout. `false`: the balancing state during that time is unknown, and leaks are learned from the remaining time only. The state is always unknown while the program does not run.
        only_while_sent: bool, "", Any, Default("false") =>;
    }
}

signal_section! {
    /// The pack's total voltage, for a pack that reports no cell voltages. `pack.cells` equal cells are assumed and estimated as one.
    PackVoltageInput at "input.pack_voltage", "V per unit of the DBC" {}
}

signal_section! {
    /// A temperature sensor.
    TemperatureInput at "input.temperature", "degrees C per unit of the DBC" {
        /// Cells whose temperature this sensor measures.
        cells: Option<CellRanges>, "", Any, Optional("all cells") =>;
    }
}

signal_section! {
    /// State of charge as reported by the pack, for the rule `bms_disagrees`. Estimates do not use it. If `scale` is not set, a signal with the DBC unit % is divided by 100.
    ReportedSocInput at "input.reported_soc", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
    }
}

signal_section! {
    /// State of health (capacity over rated capacity) as reported by the pack, for the rule `bms_disagrees`. Estimates do not use it. If `scale` is not set, a signal with the DBC unit % is divided by 100.
    ReportedSohInput at "input.reported_soh", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("60.0") =>;
    }
}

signal_section! {
    /// Voltage of the vehicle's supply battery. While it is low or unknown, `[poll]` sends no requests.
    SupplyVoltageInput at "input.supply_voltage", "V per unit of the DBC" {
        /// Lowest voltage at which requests may be sent. The default is the voltage of a half-discharged 12 V lead-acid battery.
        minimum_v: f64, "V", Above(0.0, 100.0), Default("12.2") =>;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
    }
}

signal_section! {
    /// A number that identifies the pack, such as a serial number. A new value means that another pack is connected, even if the pack was exchanged while the program did not run. Values learned for the old pack are kept under its number, for up to eight packs (384 cells in total), and restored when its number returns.
    PackIdentityInput at "input.pack_identity", "any unit" {
        /// Consecutive readings that must show the same new value.
        readings: u32, "", Between(1.0, 10000.0), Default("10") =>;
        /// Whether a signal without end-to-end protection is accepted; if `false`, the message must be listed in `[[input.protected]]`. If the message is unprotected, a few forged or damaged frames can end the current half-cycle and set all learned values aside until the correct number returns. Diagnostic answers are never protected.
        accept_unprotected: bool, "", Any, Default("false") =>;
    }
}
