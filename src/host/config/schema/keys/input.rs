//! The tables of what is read from the buses: `[input]` and the signals below it.

use super::choices::{PositiveCurrent, WireOrder};
use crate::can::e2e::Profile;
use crate::config::document::TablePlace;
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Above, Any, Between, NotEmpty};
use crate::config::schema::section::SubTables;
use crate::config::schema::section::section;
use crate::config::schema::setting::{CellRanges, NumberRange};

section! {
    /// The inputs: what is read from the buses. One of `[input.cell_voltage]` and `[input.pack_voltage]` is needed, and `[input.current]`.
    Input at "input" {
        /// DBC files that describe the signals named below, relative to this file. Not needed where all of them are in the answers of `[[input.diagnostic]]`.
        dbc: Vec<String>, "", Any, Default("[]");
        /// Silence of all inputs together, while no current flows, after which the buses are taken to sleep: that is no fault, raises no alarm and takes two events. At least the largest age of currents and voltages (`max_age_s` of the limits). 0: never; a parked vehicle's silent inputs are then missing.
        asleep_after_s: f64, "s", Between(0.0, 86_400.0), Default("5.0");
        /// Most frames of one identifier on one interface that are processed in a second; a tenth of them may arrive at once. Further frames are dropped, counted and reported, so that a faulty sender takes no time from the others. The default is twice the rate of the fastest sensible sender (one frame a millisecond) and half the rate of a saturated bus of 500 kbit/s.
        max_frames_per_s: u32, "frames/s", Between(10.0, 1e6), Default("2000");
    }
}

section! {
    /// An input message whose sender protects it end to end (AUTOSAR). The readings of a frame that fails its check (damaged, repeated, out of sequence, of another message, or the first after a start) are bad. Each outcome is counted; a change between good and bad is reported.
    ProtectedInput at "input.protected" {
        /// Name of the message in its DBC file; one of its signals must be an input.
        message: String, "", NotEmpty, Required;
        /// Interface that carries the message. Needed when there are several.
        interface: Option<String>, "", NotEmpty, Optional;
        /// AUTOSAR profile: 1 with the whole data identifier in the CRC (variant A), 1 with four bits of it sent (variant C), or 5.
        profile: Profile, "", Any, Required;
        /// Data identifier agreed with the sender; up to 0xFFF in 1C.
        data_id: u16, "", Between(0.0, 65535.0), Required;
        /// Frames that may be lost between two; each further check without a good frame allows one more. Up to 14 in profile 1.
        max_delta_counter: u8, "frames", Between(0.0, 255.0), Default("1");
        /// Repeated or missing frames in a row after which the sender must show its sequence again (`sync_counter`); 14 = any number.
        max_repeated: u8, "frames", Between(0.0, 14.0), Default("14");
        /// Frames in sequence that show it after too large a jump of the counter; their readings are used. 0 = none is needed: then profile 1 keeps its old counter after a jump (of a sender that restarted) until the sender reaches that counter, after at most 14 frames.
        sync_counter: u8, "frames", Between(0.0, 14.0), Default("0");
    }
}

section! {
    /// An answer to a diagnostic request, over ISO-TP, whichever tester asks for it: most electric cars report their cell voltages only so. Nothing is sent without `[poll]`. Its signals are named in `[input.*]` as those of a DBC file: `Name.Signal`. The values of an answer count as measured when its first frame came.
    DiagnosticInput at "input.diagnostic" {
        /// What its signals are named by, before the dot; several answers may share it.
        name: String, "", NotEmpty, Required;
        /// CAN identifier of the requests; above 0x7FF one of 29 bits.
        request: u32, "", Between(0.0, 0x1FFF_FFFF as f64), Required;
        /// CAN identifier of the answers.
        response: u32, "", Between(0.0, 0x1FFF_FFFF as f64), Required;
        /// First data byte of the requests, with extended addressing. Without it: normal addressing.
        request_extension: Option<u8>, "", Any, Optional;
        /// First data byte of the answers, with extended addressing. Without it: normal addressing.
        response_extension: Option<u8>, "", Any, Optional;
        /// Service: 0x22 (ReadDataByIdentifier of UDS), 0x21 (ReadDataByLocalIdentifier of KWP 2000) or 0x01 (current data of OBD).
        service: u8, "", Any, Required;
        /// Identifier of the values: two bytes with service 0x22, otherwise one.
        identifier: u16, "", Any, Required;
        /// How often `[poll]` asks for it while the pack is discharged. Without it: not asked then.
        drive_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional;
        /// The same while the pack is charged. Without it: not asked then.
        charge_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional;
        /// The same while no current flows, or none is known, and the bus is awake all the same. Without it: not asked then.
        parked_every_s: Option<f64>, "s", Between(0.1, 86_400.0), Optional;
        /// The signals, one table each; those that no input names are not read.
        signals: SubTables<AnswerSignalKeys>, "", NotEmpty, Required;
    }
}

section! {
    /// A signal of the answer, or a row of equal ones. Its value is code x factor + offset.
    AnswerSignalKeys at "input.diagnostic.signals" {
        /// Its name, with `{n}` where the number stands in a row of them.
        name: String, "", NotEmpty, Required;
        /// Position of its first (most significant) bit, counted from the most significant bit of the byte behind the echoed service and identifier (as `bix` of OBDb).
        bit: u32, "bits", Between(0.0, 8.0 * 65_535.0), Required;
        /// Its length.
        length: u16, "bits", Between(1.0, 64.0), Required;
        /// Whether its codes are two's complement.
        signed: bool, "", Any, Default("false");
        /// Which of its bytes comes first: the most ("big") or the least significant one ("little", for whole bytes).
        byte_order: WireOrder, "", Any, Default("\"big\"");
        /// Value of one code.
        factor: f64, "unit", Between(-1e9, 1e9), Default("1.0");
        /// Value of code 0.
        offset: f64, "unit", Between(-1e9, 1e9), Default("0.0");
        /// Unit of the value, as a DBC would name it.
        unit: String, "", Any, Default("\"\"");
        /// Smallest value that is plausible; below it the reading is bad. Without it: any.
        minimum: Option<f64>, "unit", Any, Optional;
        /// Largest value that is plausible; above it the reading is bad. Without it: any.
        maximum: Option<f64>, "unit", Any, Optional;
        /// Codes that mean "not available".
        not_available: Vec<u64>, "", Any, Default("[]");
        /// Numbers that `{n}` in the name counts through. Without it: one signal.
        numbers: Option<NumberRange>, "", Any, Optional;
        /// Bits from the first bit of one to that of the next. Without it: the length.
        step: Option<u32>, "bits", Between(1.0, 8.0 * 65_535.0), Optional;
    }
}

/// Declares a table that names a signal on a bus; every such table has these keys.
macro_rules! signal_section {
    ($(#[doc = $about:literal])+ $name:ident at $path:literal, $unit:literal { $($keys:tt)* }) => {
        section! {
            $(#[doc = $about])+
            $name at $path gives SignalSource<'_>, |keys| {
                /// `Message.Signal` of one of the DBC files, or `Name.Signal` of a diagnostic answer; in `[input.cell_voltage]` and `[input.balancing]` a pattern, see there.
                signal: String, "", NotEmpty, Required => signal: &keys.signal;
                /// Interface that carries the signal. Needed when there are several.
                interface: Option<String>, "", NotEmpty, Optional => interface: keys.interface.as_deref();
                /// Factor from the DBC's unit to this program's, after the DBC's own factor (0.001 for a DBC in milli-units).
                scale: f64, $unit, Above(0.0, 1e9), Default("1.0");
                /// Added after `scale`, in this program's unit (-273.15 for a DBC in kelvin).
                offset: f64, "", Between(-1e9, 1e9), Default("0.0");
                /// Raw codes that mean "not available", in addition to those of the DBC's value table.
                not_available: Vec<u64>, "", Any, Default("[]") => not_available: &keys.not_available;
                $($keys)*
            } and { place: &keys.place }
        }
    };
}

/// The keys that all signal tables have.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SignalSource<'a> {
    /// Place in the file.
    pub place: &'a TablePlace,
    /// `Message.Signal`, or a pattern.
    pub signal: &'a str,
    /// Interface name, when given.
    pub interface: Option<&'a str>,
    /// DBC unit to ours.
    pub scale: f64,
    /// Added after it.
    pub offset: f64,
    /// Raw codes that mean "not available".
    pub not_available: &'a [u64],
}

signal_section! {
    /// The pack current.
    CurrentInput at "input.current", "A per unit of the DBC" {
        /// What a positive value on the bus means. Buses differ, so there is no default. Inside this program and in everything it reports, positive is discharge.
        positive: PositiveCurrent, "", Any, Required =>;
    }
}

signal_section! {
    /// The state of the pack's contactors. While it says that they are open, no current flows: 0 A is used in place of what the current sensor reports, also when it reports nothing. Without a state (no reading for `max_age_s`, or none yet) the current is as measured.
    ContactorInput at "input.contactor", "any unit" {
        /// Values of the signal (after the DBC's factor, `scale` and `offset`) that mean open; every other value means closed.
        open: Vec<f64>, "", NotEmpty, Required =>;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("5.0") =>;
    }
}

signal_section! {
    /// One voltage per cell. `{n}` in `signal` stands for the cell's number, `{m}` for any number, in message and signal name:
    /// `CellVoltages.Cell{n}`, `Module{m}.CellVoltage{n}`. Every cell must have exactly one signal; multiplexed signals are supported.
    CellVoltageInput at "input.cell_voltage", "V per unit of the DBC" {
        /// Number of the first cell in the names.
        first: u16, "", Between(0.0, 60000.0), Default("1") =>;
    }
}

signal_section! {
    /// One signal per cell that shows whether the BMS bleeds the cell, so that the leaks of all cells can be learned. `signal` is a pattern as in `[input.cell_voltage]`. A value other than 0 (after the DBC's factor, `scale` and `offset`) means bled; for an inverted bit set `offset = -1.0`. A value holds until the next one, for at most `max_age_s`. Frames with nothing but these signals do not wake sleeping buses. Needs `pack.balancing = true`.
    BalancingInput at "input.balancing", "any unit" {
        /// Number of the first cell in the names.
        first: u16, "", Between(0.0, 60000.0), Default("1") =>;
        /// Current of a balancing resistor while the bit is 1, at the voltage at which the BMS balances; parallel strings share it. At most a fifth of the pack's rated capacity in an hour.
        bleed_a: f64, "A", Above(0.0, 1e6), Required =>;
        /// Longest time for which a value holds. Must be longer than the period at which the BMS sends it, also while the vehicle is parked: the rest of a longer period counts as one without values.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
        /// Whether the BMS bleeds no cell while no values come. Only where it sends them for as long as it balances, and this computer is awake for as long. `false`: nothing is known of that time, and leaks are learned from the rest alone. The time for which the program does not run is unknown in any case.
        only_while_sent: bool, "", Any, Default("false") =>;
    }
}

signal_section! {
    /// The pack's total voltage, for a pack that publishes no cell voltages: `pack.cells` equal cells are assumed and estimated as one.
    PackVoltageInput at "input.pack_voltage", "V per unit of the DBC" {}
}

signal_section! {
    /// A temperature sensor.
    TemperatureInput at "input.temperature", "degrees C per unit of the DBC" {
        /// Cells this sensor serves. Without it: all cells.
        cells: Option<CellRanges>, "", Any, Optional =>;
    }
}

signal_section! {
    /// State of charge as the pack itself reports it, for the rule `bms_disagrees`; no estimate depends on it. Without `scale`, a signal whose unit in the DBC is % is divided by 100.
    ReportedSocInput at "input.reported_soc", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
    }
}

signal_section! {
    /// State of health (capacity over rated capacity) as the pack itself reports it, for the rule `bms_disagrees`; no estimate depends on it. Without `scale`, a signal whose unit in the DBC is % is divided by 100.
    ReportedSohInput at "input.reported_soh", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("60.0") =>;
    }
}

signal_section! {
    /// Voltage of the vehicle's supply battery: while it is low, or not known, `[poll]` asks for nothing.
    SupplyVoltageInput at "input.supply_voltage", "V per unit of the DBC" {
        /// Least voltage at which requests may be sent. The default is that of a half empty lead battery of 12 V.
        minimum_v: f64, "V", Above(0.0, 100.0), Default("12.2") =>;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0") =>;
    }
}

signal_section! {
    /// A number that identifies the pack, such as a serial number. A new value means that another pack is connected, also when the pack was exchanged while the program did not run. What was learned of the old pack is kept under its number, for up to eight packs (384 cells together), and restored when its number comes back.
    PackIdentityInput at "input.pack_identity", "any unit" {
        /// Readings in a row that must show the same new value.
        readings: u32, "", Between(1.0, 10000.0), Default("10") =>;
        /// Whether a signal without end-to-end protection is accepted. Three forged or damaged frames of one put aside everything learned until the number is right again, and end the half-cycle under way; diagnostic answers have no such protection. Without it the message must be in `[[input.protected]]`.
        accept_unprotected: bool, "", Any, Default("false") =>;
    }
}
