//! The tables of sent frames and received commands: `[output]`, `[j1939]`, `[commands]`.

use super::choices::E2eKey;
use crate::can::secoc;
use crate::config::document::TablePlace;
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Any, Between, NotEmpty};
use crate::config::schema::section::section;

section! {
    /// Diagnostic requests, which this program sends itself, for the answers of `[[input.diagnostic]]` that have a period. Off by default: polling can disturb a car (warning lamps, a car that does not fall asleep, an empty 12 V battery), so try it in a standing car first.
    /// Only the services that an answer can have (0x22, 0x21, 0x01) can be sent, one request at a time. Nothing is sent for a minute after the request of another tester; while the bus sleeps (no frame of others for two seconds); while the supply voltage is low (`[input.supply_voltage]`); on `packwatch poll standby`. A controller that refuses a request for good (0x11, 0x31, 0x33) is not asked for it again; other failures are asked less and less often. All frames of a polled interface are received, and recorded by `--record`.
    Poll at "poll" {
        /// Whether requests are sent.
        enabled: bool, "", Any, Default("false");
        /// Most requests in a second, of all answers together.
        max_requests_per_s: f64, "1/s", Between(0.01, 100.0), Default("10.0");
    }
}

section! {
    /// A J1939 node, in addition to the frames of `[output]`: it claims an address and sends alarms as trouble codes, in DM1 once a second and on every change, in DM2 on request.
    /// Of a rule's alarms that share a parameter number the most severe is sent. The failure mode follows from rule and severity, the lamp from the severity (info: protect, warning: amber, severe: red). Without this table there is no node; with `output.enabled = false` it is silent too.
    /// The NAME identifies the node: of two nodes that claim one address the one with the smaller NAME keeps it, and the other stops sending.
    J1939 at "j1939" {
        /// Interface the node is on. Needed when there are several.
        interface: Option<String>, "", NotEmpty, Optional;
        /// Address that the node claims; if it loses the address it claims no other.
        address: u8, "", Between(0.0, 253.0), Required;
        /// Serial number in the NAME, unique among the maker's nodes.
        identity_number: u32, "", Between(0.0, 2_097_151.0), Required;
        /// The maker's number in the NAME, which SAE assigns.
        manufacturer_code: u16, "", Between(0.0, 2047.0), Required;
        /// What the node does, as SAE numbers it; 255 = not available.
        function: u8, "", Between(0.0, 255.0), Default("255");
        /// Which one of several nodes of this function.
        function_instance: u8, "", Between(0.0, 31.0), Default("0");
        /// Which one of several computers that share the function.
        ecu_instance: u8, "", Between(0.0, 7.0), Default("0");
        /// Vehicle system within the industry group; 127 = not available.
        vehicle_system: u8, "", Between(0.0, 127.0), Default("127");
        /// Which one of several equal vehicle systems.
        vehicle_system_instance: u8, "", Between(0.0, 15.0), Default("0");
        /// 0 global, 1 on-highway, 2 agriculture and forestry, 3 construction, 4 marine, 5 industrial.
        industry_group: u8, "", Between(0.0, 7.0), Default("0");
        /// Suspect parameter number that is sent, with FMI 31 and no lamp, while `packwatch test-alarm` runs: a trouble code itself cannot mark a test.
        test_spn: u32, "", Between(1.0, 524_287.0), Default("524286");
    }
}

section! {
    /// Frames that the daemon sends: status, health, alarm, digest and, with `[commands]`, reply. Without this table it only listens; it never sends another identifier. `packwatch dbc` writes the DBC of the frames as they are configured.
    Output at "output" {
        /// Whether anything is sent.
        enabled: bool, "", Any, Default("true");
        /// Interfaces to send on. Without it: all.
        interfaces: Option<Vec<String>>, "", NotEmpty, Optional;
        /// DBC that lays the frames out, relative to this file. Without it: the built-in `packwatch.dbc`, with steps of Ah that fit the cell.
        dbc: Option<String>, "", NotEmpty, Optional;
    }
}

/// The keys that all tables of frames have.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameKeys<'a> {
    /// Place in the file.
    pub place: &'a TablePlace,
    /// Identifier.
    pub id: Option<u32>,
    /// Whether it has 29 bits.
    pub extended: bool,
    /// Classic or FD.
    pub fd: Option<bool>,
    /// Bit rate switch.
    pub brs: Option<bool>,
    /// Period.
    pub period_ms: Option<u32>,
    /// Protection.
    pub e2e: Option<E2eKey>,
    /// Authentication.
    pub secoc: Option<secoc::Profile>,
    /// Data id of both.
    pub data_id: Option<u16>,
}

/// Declares the table of a frame; every such table has these keys.
macro_rules! frame_section {
    ($(#[doc = $about:literal])+ $name:ident at $path:literal) => {
        section! {
            $(#[doc = $about])+
            $name at $path gives FrameKeys<'_>, |keys| {
                /// Identifier. Without it: the DBC's.
                id: Option<u32>, "", Between(0.0, 0x1FFF_FFFF as f64), Optional;
                /// Whether `id` has 29 bits.
                extended: bool, "", Any, Default("false");
                /// Whether CAN FD frames carry it (the interface must have `fd = true` too). Without it: as the DBC says; the built-in one: classic frames.
                fd: Option<bool>, "", Any, Optional;
                /// Whether FD frames switch to the higher bit rate. Without it: as the DBC says; the built-in one: no.
                brs: Option<bool>, "", Any, Optional;
                /// Period. Without it: the DBC's cycle time, or else 1000 ms.
                period_ms: Option<u32>, "ms", Between(10.0, 3_600_000.0), Optional;
                /// AUTOSAR end-to-end protection: a checksum and a counter in the first bytes, profile 1 variant A or C (2 bytes) or profile 5 (3 bytes; the built-in layout then has 12 bytes and needs `fd = true`). Without it: as the DBC says; the built-in one: off.
                e2e: Option<E2eKey>, "", Any, Optional;
                /// AUTOSAR SecOC authentication with the key of `[authentication]`: freshness and authenticator behind the data, 12 bytes more. Only "fd" (32 bits of freshness, 64 bits of AES-128-CMAC; needs `fd = true`). Without it: none.
                secoc: Option<secoc::Profile>, "", Any, Optional;
                /// Data id of protection and authentication, known to sender and receivers; each such frame has its own, up to 0xFFF with "1C". Needed with `e2e` and `secoc`.
                data_id: Option<u16>, "", Between(0.0, 65535.0), Optional;
            } and { place: &keys.place }
        }
    };
}

frame_section! {
    /// The status frame: estimates.
    OutputStatus at "output.status"
}

frame_section! {
    /// The health frame: learned values, all pages at once.
    OutputHealth at "output.health"
}

frame_section! {
    /// The alarm frame: at once on a change, then three times 100 ms apart, and each raised alarm once in a period; at most 100 frames in a second (after a pause 20 at once).
    OutputAlarm at "output.alarm"
}

frame_section! {
    /// The digest: number, worst severity and checksum of all raised alarms, the state of every rule, and one threshold; all pages in each period. A DBC of your own without `PACKWATCH_Digest` has none.
    OutputDigest at "output.digest"
}

frame_section! {
    /// The reply to each command frame, sent only with `[commands]`: whether it was executed, why not, and the counter that the next one must have. It has no period. A DBC of your own without `PACKWATCH_Reply` has none.
    OutputReply at "output.reply"
}

frame_section! {
    /// The announcement of the freshness of authenticated commands, once a second, sent only with `commands.secoc`. It is itself authenticated (36 bits of freshness, 28 bits of AES-128-CMAC) and needs `data_id`; it has no period and no `e2e`.
    OutputFreshness at "output.freshness"
}

section! {
    /// The key of all authenticated frames: 16 bytes, as they are or as 32 hex digits, in a credential of systemd or in a file. It is read at the start, which fails without it, and written nowhere.
    Authentication at "authentication" {
        /// Name of the credential: the file of this name in `$CREDENTIALS_DIRECTORY` (`LoadCredential=NAME:PATH` in the unit). Without it: `key_file` is needed.
        credential: Option<String>, "", NotEmpty, Optional;
        /// File of the key, relative to this file, readable by its owner alone (mode 0600 or 0400). Without it: `credential` is needed.
        key_file: Option<String>, "", NotEmpty, Optional;
    }
}

section! {
    /// Commands of other ECUs: a frame that acknowledges or clears alarms, or says that another pack is connected. Laid out as `PACKWATCH_Command` in the DBC of the frames. Off by default, and never without authentication or end-to-end protection. With protection alone the commands are unauthenticated: every node of the bus can make one; and, as with every protected message, the first frame after a start only shows the counter and is not executed.
    Commands at "commands" gives FrameKeys<'_>, |keys| {
        /// Whether commands from the bus are executed.
        enabled: bool, "", Any, Default("false") =>;
        /// Interface that carries the frame. Needed when there are several.
        interface: Option<String>, "", NotEmpty, Optional =>;
        /// Identifier. Without it: the DBC's.
        id: Option<u32>, "", Between(0.0, 0x1FFF_FFFF as f64), Optional;
        /// Whether `id` has 29 bits.
        extended: bool, "", Any, Default("false");
        /// Whether CAN FD frames carry it. Without it: as the DBC says; the built-in one: classic frames.
        fd: Option<bool>, "", Any, Optional;
        /// Profile of the protection. Needed when commands are enabled without `secoc`; "off" is refused then.
        e2e: Option<E2eKey>, "", Any, Optional;
        /// AUTOSAR SecOC authentication with the key of `[authentication]`, in place of `e2e`: "1" (8 bits of freshness, 24 of AES-128-CMAC), "3" (4 and 28 bits), or "fd" (32 and 64 bits, needs `fd = true`). Needs `[output.freshness]`. Without it: none.
        secoc: Option<secoc::Profile>, "", Any, Optional;
        /// Data id of protection or authentication. Needed with `e2e` and `secoc`.
        data_id: Option<u16>, "", Between(0.0, 65535.0), Optional;
        /// Frames that may be lost between two.
        max_delta_counter: u8, "frames", Between(1.0, 14.0), Default("1") =>;
    } and { place: &keys.place, brs: None, period_ms: None }
}
