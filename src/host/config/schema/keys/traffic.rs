//! Declares the tables of sent frames, requests and received commands, such as `[output]`, `[j1939]` and `[commands]`.

use super::choices::E2eKey;
use crate::can::secoc;
use crate::config::document::TablePlace;
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Any, Between, NotEmpty};
use crate::config::schema::section::section;

section! {
    /// Diagnostic requests that packwatch sends, for the answers of `[[input.diagnostic]]` that have a period. Off by default, because polling can disturb a car (warning lamps, a car that does not fall asleep, an empty 12 V battery). Try it in a parked car first.
    /// packwatch sends only the services that an answer can have (0x22, 0x21, 0x01), one request at a time. It sends nothing for one minute after a request of another tester, and nothing after `packwatch poll standby`. It also sends nothing while the bus sleeps (no foreign frame for two seconds) and while the supply voltage is low (`[input.supply_voltage]`). If a controller rejects a request permanently (0x11, 0x31, 0x33), packwatch does not send this request again. After other failures, packwatch sends the request less and less often. All frames of a polled interface are received, and recorded by `--record`.
    Poll at "poll" {
        /// Whether requests are sent.
        enabled: bool, "", Any, Default("false");
        /// Largest number of sent frames (requests and flow control) per second, for all answers together.
        max_requests_per_s: f64, "1/s", Between(0.01, 100.0), Default("10.0");
    }
}

section! {
    /// A J1939 node in addition to the frames of `[output]`. It claims an address and sends alarms as trouble codes: in DM1 once a second and on every change, in DM2 on request.
    /// If several raised alarms of a rule share a parameter number, only the most severe is sent. Rule and severity determine the failure mode; severity determines the lamp (info: protect, warning: amber, severe: red). Without this table there is no node. With `output.enabled = false`, the node is silent too.
    /// The NAME identifies the node. If two nodes claim the same address, the one with the smaller NAME keeps it and the other stops sending.
    J1939 at "j1939" {
        /// Interface that the node uses.
        interface: Option<String>, "", NotEmpty, Optional("the only interface; required with several");
        /// Address that the node claims. If it loses this address, it claims no other.
        address: u8, "", Between(0.0, 253.0), Required;
        /// Serial number in the NAME, unique among the manufacturer's nodes.
        identity_number: u32, "", Between(0.0, 2_097_151.0), Required;
        /// Manufacturer code in the NAME, assigned by SAE.
        manufacturer_code: u16, "", Between(0.0, 2047.0), Required;
        /// Function of the node in the NAME, numbered by SAE; 255 = not available.
        function: u8, "", Between(0.0, 255.0), Default("255");
        /// Instance number among several nodes with this function.
        function_instance: u8, "", Between(0.0, 31.0), Default("0");
        /// Instance number among several ECUs that share the function.
        ecu_instance: u8, "", Between(0.0, 7.0), Default("0");
        /// Vehicle system within the industry group; 127 = not available.
        vehicle_system: u8, "", Between(0.0, 127.0), Default("127");
        /// Instance number among several equal vehicle systems.
        vehicle_system_instance: u8, "", Between(0.0, 15.0), Default("0");
        /// Industry group: 0 global, 1 on-highway, 2 agriculture and forestry, 3 construction, 4 marine, 5 industrial.
        industry_group: u8, "", Between(0.0, 7.0), Default("0");
        /// Suspect parameter number sent, with FMI 31 and no lamp, while `packwatch test-alarm` runs. It is separate because a trouble code cannot be marked as a test.
        test_spn: u32, "", Between(1.0, 524_287.0), Default("524286");
    }
}

section! {
    /// Frames that the daemon sends: status, health, alarm, digest and, with `[commands]`, reply. Without this table the daemon only listens. With this table, it sends no other identifiers. `packwatch dbc` writes the DBC of the frames as configured.
    Output at "output" {
        /// Whether anything is sent.
        enabled: bool, "", Any, Default("true");
        /// Interfaces on which the frames are sent.
        interfaces: Option<Vec<String>>, "", NotEmpty, Optional("all");
        /// DBC that defines the layout of the frames, relative to this file.
        dbc: Option<String>, "", NotEmpty, Optional("built-in `packwatch.dbc`, with an Ah resolution that fits the cell");
        /// Whether cyclic frames (also DM1 and the freshness announcement) are sent while the buses sleep (`input.asleep_after_s`). Cyclic frames can keep other nodes awake and drain the 12 V battery. Alarm changes, replies and tests are sent in both cases.
        while_asleep: bool, "", Any, Default("false");
        /// Whether the health frame also has the pages 5 to 12: energy, time and power with their standard deviations (`[outlook]`).
        outlook: bool, "", Any, Default("false");
    }
}

/// The keys that all tables of sent frames share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameKeys<'a> {
    pub place: &'a TablePlace,
    /// CAN identifier; `None` = the DBC's.
    pub id: Option<u32>,
    /// Whether the identifier has 29 bits.
    pub extended: bool,
    /// Whether the frame is sent as CAN FD; `None` = as in the DBC.
    pub fd: Option<bool>,
    /// Whether an FD frame switches the bit rate; `None` = as in the DBC.
    pub brs: Option<bool>,
    /// Period, ms; `None` = the DBC's.
    pub period_ms: Option<u32>,
    /// End-to-end protection; `None` = not given.
    pub e2e: Option<E2eKey>,
    /// SecOC authentication; `None` = not given.
    pub secoc: Option<secoc::Profile>,
    /// Data id for protection and authentication.
    pub data_id: Option<u16>,
}

/// Declares the table of a sent frame with the keys of [`FrameKeys`].
macro_rules! frame_section {
    ($(#[doc = $about:literal])+ $name:ident at $path:literal) => {
        section! {
            $(#[doc = $about])+
            $name at $path gives FrameKeys<'_>, |keys| {
                /// Identifier.
                id: Option<u32>, "", Between(0.0, 0x1FFF_FFFF as f64), Optional("the DBC's");
                /// Whether `id` has 29 bits.
                extended: bool, "", Any, Default("false");
                /// Whether the frame is sent as CAN FD (requires `fd = true` on the interface).
                fd: Option<bool>, "", Any, Optional("the DBC's; built-in: classic frames");
                /// Whether FD frames switch to the higher bit rate.
                brs: Option<bool>, "", Any, Optional("the DBC's; built-in: no");
                /// Period.
                period_ms: Option<u32>, "ms", Between(10.0, 3_600_000.0), Optional("the DBC's cycle time, else 1000");
                /// AUTOSAR end-to-end protection with a checksum and a counter in the first bytes: profile 1 variant A or C (2 bytes), or profile 5 (3 bytes). With profile 5, the built-in layout has 12 bytes and requires `fd = true`.
                e2e: Option<E2eKey>, "", Any, Optional("the DBC's; built-in: off");
                /// AUTOSAR SecOC authentication with the key of `[authentication]`: appends 12 bytes of freshness and authenticator to the data. Only "fd" is allowed here (32 bits of freshness, 64 bits of AES-128-CMAC; requires `fd = true`).
                secoc: Option<secoc::Profile>, "", Any, Optional("none");
                /// Data identifier for protection and authentication, agreed with the receivers and unique per frame; at most 0xFFF for "1C".
                data_id: Option<u16>, "", Between(0.0, 65535.0), Optional("required with `e2e` or `secoc`");
            } and { place: &keys.place }
        }
    };
}

frame_section! {
    /// The status frame: estimates.
    OutputStatus at "output.status"
}

frame_section! {
    /// The health frame: learned values. All pages are sent together in each period.
    OutputHealth at "output.health"
}

frame_section! {
    /// The alarm frame. It is sent at once on a change, then three times 100 ms apart. In addition, each raised alarm is sent once per period. At most 100 frames are sent per second, and at most 20 at once after a pause.
    OutputAlarm at "output.alarm"
}

frame_section! {
    /// The digest frame: number, worst severity and checksum of all raised alarms, the state of every rule, and, in turn, one of the configured thresholds. All pages are sent in each period. Not sent if `output.dbc` lacks `PACKWATCH_Digest`.
    OutputDigest at "output.digest"
}

frame_section! {
    /// The reply to each command frame, sent only with `[commands]`. It states whether the command was executed, the reason if it was not, and the counter that the next command must have. It has no period, and is not sent if `output.dbc` lacks `PACKWATCH_Reply`.
    OutputReply at "output.reply"
}

frame_section! {
    /// Announces the freshness value for authenticated commands once a second. The frame is sent only with `commands.secoc`. It is itself authenticated (36 bits of freshness, 28 bits of AES-128-CMAC) and requires `data_id`. It has no `period_ms` and no `e2e`.
    OutputFreshness at "output.freshness"
}

section! {
    /// The key of all authenticated frames: 16 bytes, raw or as 32 hex digits, in a systemd credential or in a file. At its start, packwatch reads the key. It does not start without the key, and never writes the key anywhere.
    Authentication at "authentication" {
        /// Name of the credential: a file in `$CREDENTIALS_DIRECTORY` (`LoadCredential=NAME:PATH` in the unit).
        credential: Option<String>, "", NotEmpty, Optional("required without `key_file`");
        /// File with the key, relative to this file, readable only by its owner (mode 0600 or 0400).
        key_file: Option<String>, "", NotEmpty, Optional("required without `credential`");
    }
}

section! {
    /// Commands of other ECUs: a frame that acknowledges or clears alarms, or reports that another pack is connected. Layout: `PACKWATCH_Command` in the DBC of the frames. Off by default, and allowed only with authentication or end-to-end protection. With protection alone, commands are unauthenticated: every node on the bus can send one. As with every protected message, the first frame after a start only sets the counter and is not executed.
    Commands at "commands" gives FrameKeys<'_>, |keys| {
        /// Whether commands from the bus are executed.
        enabled: bool, "", Any, Default("false") =>;
        /// Interface that carries the frame.
        interface: Option<String>, "", NotEmpty, Optional("the only interface; required with several") =>;
        /// Identifier.
        id: Option<u32>, "", Between(0.0, 0x1FFF_FFFF as f64), Optional("the DBC's");
        /// Whether `id` has 29 bits.
        extended: bool, "", Any, Default("false");
        /// Whether the frame is CAN FD.
        fd: Option<bool>, "", Any, Optional("the DBC's; built-in: classic frames");
        /// Profile of the end-to-end protection. "off" is not allowed while commands are enabled without `secoc`.
        e2e: Option<E2eKey>, "", Any, Optional("required if enabled without `secoc`");
        /// AUTOSAR SecOC authentication with the key of `[authentication]`, instead of `e2e`: "1" (8 bits of freshness, 24 bits of AES-128-CMAC), "3" (4 and 28 bits), or "fd" (32 and 64 bits, requires `fd = true`). Requires `[output.freshness]`.
        secoc: Option<secoc::Profile>, "", Any, Optional("none");
        /// Data identifier for protection or authentication.
        data_id: Option<u16>, "", Between(0.0, 65535.0), Optional("required with `e2e` or `secoc`");
        /// Number of frames that may be lost between two commands.
        max_delta_counter: u8, "frames", Between(1.0, 14.0), Default("1") =>;
    } and { place: &keys.place, brs: None, period_ms: None }
}
