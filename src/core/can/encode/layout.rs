//! Creates the layout of the sent frames and of the command frame as a [`Database`].
//!
//! In: a base (the built-in `config/packwatch.dbc`, or the user's own DBC) and settings per message. Out: the base's
//! messages with these settings. A protected message includes the signals of its header (CRC and counter). An
//! authenticated message includes the signals of its trailer (freshness and authenticator). The encoder and
//! `packwatch dbc` both use this database, so that sent frames always match the written DBC.
//!
//! The built-in base is adapted:
//!
//! * The steps of Ah signals grow with the cell's capacity.
//! * The header of profile 5 is one byte longer than the reserved space, so all signals move up by a byte.
//! * An authenticated message grows by its trailer.
//! * An authenticated command has no header, so its signals move to the start of the message.
//!
//! The user's own DBC must leave header and trailer free. All settings that do not fit are reported together.

use std::sync::OnceLock;

use crate::can::dbc::{Database, DbcError, FrameFormat, Message, Repetition, Signal};
use crate::can::e2e::{Profile, Protection};
use crate::can::frame::is_frame_length;
use crate::can::secoc::{self, Authentication};
use crate::can::signal::{ByteOrder, SignalLayout, ValueType};
use crate::can::{CanId, FrameKind};

/// Names of the signals that protection and authentication write.
pub(super) const HEADER_SIGNALS: [&str; 5] = ["E2eCrc", "E2eCounter", "E2eDataIdNibble", "SecOCFreshness", "SecOCMac"];

/// The next FD length above 8, for the header of profile 5.
const MOVED_LEN_BYTES: u16 = 12;

/// Number of repetitions of a changed alarm. If one in ten frames is lost, all four frames of a change are lost once in
/// 10,000 changes.
pub const CHANGE_REPETITIONS: u32 = 3;
/// Time between the repetitions of a changed alarm, ms. Most error bursts on a bus are shorter.
pub const CHANGE_REPETITION_MS: u32 = 100;
/// Minimum average time between two alarm frames, ms. 100 frames a second use 2.7 % of a bus of 500 kbit/s.
pub const ALARM_DELAY_MS: u32 = 10;
/// Minimum average time between two replies, ms.
pub const REPLY_DELAY_MS: u32 = 100;

/// Period of the freshness announcements, ms. A command is valid for two periods at most.
pub const FRESHNESS_PERIOD_MS: u32 = 1000;

/// Cycle time, ms, if neither the settings nor the base state a cycle time.
pub const DEFAULT_PERIOD_MS: u32 = 1000;

/// The DBC shipped with the program. Parsing never fails, because a test parses the file.
pub fn default_database() -> Result<Database, DbcError> {
    Database::parse(include_str!("../../packwatch.dbc"))
}

/// Parsed once, because parsing takes longer than the rest of loading a configuration.
fn shipped() -> &'static Database {
    static SHIPPED: OnceLock<Database> = OnceLock::new();
    SHIPPED.get_or_init(|| default_database().unwrap_or_default())
}

/// A message of the layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LayoutMessage {
    Status,
    Health,
    Alarm,
    /// Received, not sent.
    Command,
    Digest,
    Reply,
    /// Announces the freshness of authenticated commands.
    Freshness,
}

impl LayoutMessage {
    /// All messages, in the order of the layout.
    pub const ALL: [Self; 7] =
        [Self::Status, Self::Health, Self::Alarm, Self::Command, Self::Digest, Self::Reply, Self::Freshness];

    /// Name of the message in the DBC.
    pub const fn message(self) -> &'static str {
        match self {
            Self::Status => "PACKWATCH_Status",
            Self::Health => "PACKWATCH_Health",
            Self::Alarm => "PACKWATCH_Alarm",
            Self::Command => "PACKWATCH_Command",
            Self::Digest => "PACKWATCH_Digest",
            Self::Reply => "PACKWATCH_Reply",
            Self::Freshness => "PACKWATCH_Freshness",
        }
    }

    /// Name in the configuration (such as `output.status`) and in the program's texts.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Status => "status",
            Self::Health => "health",
            Self::Alarm => "alarm",
            Self::Command => "command",
            Self::Digest => "digest",
            Self::Reply => "reply",
            Self::Freshness => "freshness",
        }
    }

    const fn repetition(self) -> Repetition {
        match self {
            Self::Alarm => Repetition {
                count: Some(CHANGE_REPETITIONS),
                period_ms: Some(CHANGE_REPETITION_MS),
                delay_ms: Some(ALARM_DELAY_MS),
            },
            Self::Reply => Repetition { count: None, period_ms: None, delay_ms: Some(REPLY_DELAY_MS) },
            Self::Status | Self::Health | Self::Command | Self::Digest | Self::Freshness => {
                Repetition { count: None, period_ms: None, delay_ms: None }
            }
        }
    }

    const fn is_cyclic(self) -> bool {
        matches!(self, Self::Status | Self::Health | Self::Alarm | Self::Digest | Self::Freshness)
    }
}

/// End-to-end protection of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum E2eSetting {
    /// As in the base; the built-in base has no protection.
    #[default]
    AsBase,
    Off,
    On(Protection),
}

/// Settings of one message; `None` = as in the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MessageSettings {
    pub id: Option<CanId>,
    pub fd: Option<bool>,
    /// Whether the data phase uses the higher bit rate.
    pub brs: Option<bool>,
    pub period_ms: Option<u32>,
    pub e2e: E2eSetting,
    /// Authentication; `None` = not authenticated.
    pub secoc: Option<Authentication>,
}

/// Base of a layout.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LayoutBase<'d> {
    /// The shipped DBC, adapted to this rated capacity.
    BuiltIn { rated_capacity_ah: f64 },
    /// The user's own DBC, not adapted.
    Own(&'d Database),
}

/// Settings of all messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LayoutSettings {
    pub status: MessageSettings,
    pub health: MessageSettings,
    pub alarm: MessageSettings,
    /// `None` = commands are not accepted.
    pub command: Option<MessageSettings>,
    pub digest: MessageSettings,
    /// Sent only if commands are accepted.
    pub reply: MessageSettings,
    /// Sent only if commands are authenticated.
    pub freshness: MessageSettings,
}

impl LayoutSettings {
    fn of(&self, message: LayoutMessage) -> Option<&MessageSettings> {
        match message {
            LayoutMessage::Status => Some(&self.status),
            LayoutMessage::Health => Some(&self.health),
            LayoutMessage::Alarm => Some(&self.alarm),
            LayoutMessage::Command => self.command.as_ref(),
            LayoutMessage::Digest => Some(&self.digest),
            LayoutMessage::Reply => self.command.as_ref().map(|_| &self.reply),
            LayoutMessage::Freshness => self.command.and_then(|command| command.secoc).map(|_| &self.freshness),
        }
    }
}

/// A setting that does not fit its message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}: {what}", .message.message())]
pub struct SettingFault {
    pub message: LayoutMessage,
    /// `fd`, `brs`, `e2e`, `data_id` or `secoc`.
    pub key: &'static str,
    pub what: String,
}

/// Creates the layout, or returns all settings that do not fit. Messages that the base lacks are omitted; `OutputPlan`
/// and `CommandPlan` report them.
pub fn layout(base: LayoutBase<'_>, settings: &LayoutSettings) -> Result<Database, Vec<SettingFault>> {
    let (database, rated_capacity_ah) = match base {
        LayoutBase::BuiltIn { rated_capacity_ah } => (shipped(), Some(rated_capacity_ah)),
        LayoutBase::Own(database) => (database, None),
    };
    let mut faults = Vec::new();
    let mut messages = Vec::new();
    for which in LayoutMessage::ALL {
        if let (Some(settings), Some(message)) = (settings.of(which), database.message(which.message())) {
            let mut laid_out = message.clone();
            if let Some(rated_capacity_ah) = rated_capacity_ah {
                fit_steps(&mut laid_out, rated_capacity_ah);
            }
            let mut note = |key, what: String| faults.push(SettingFault { message: which, key, what });
            if rated_capacity_ah.is_some() && settings.secoc.is_some() && which == LayoutMessage::Command {
                move_down(&mut laid_out);
            }
            apply(&mut laid_out, settings, rated_capacity_ah.is_some(), &mut note);
            if which.is_cyclic() {
                laid_out.cycle_time_ms = laid_out.cycle_time_ms.or(Some(DEFAULT_PERIOD_MS));
            }
            laid_out.repetition = which.repetition();
            messages.push(laid_out);
        }
    }
    if !faults.is_empty() {
        return Err(faults);
    }
    Ok(Database { nodes: database.nodes.clone(), comment: database.comment.clone(), messages, left_out: Vec::new() })
}

/// `movable`: whether the message's signals may be moved.
fn apply(
    message: &mut Message,
    settings: &MessageSettings,
    movable: bool,
    fault: &mut impl FnMut(&'static str, String),
) {
    message.id = settings.id.unwrap_or(message.id);
    message.cycle_time_ms = settings.period_ms.or(message.cycle_time_ms);
    message.format = format(message, settings);
    let is_fd = message.format != FrameFormat::Classic;
    if settings.brs == Some(true) && !is_fd {
        fault("brs", "must have fd = true: classic frames have one bit rate".to_owned());
    }
    message.e2e = match settings.e2e {
        E2eSetting::AsBase => message.e2e,
        E2eSetting::Off => None,
        E2eSetting::On(protection) => Some(protection),
    };
    message.secoc = settings.secoc;
    let is_moved = movable && message.e2e.is_some_and(|e2e| e2e.profile == Profile::P05);
    if is_moved {
        move_up(message);
    }
    if let Some(authentication) = message.secoc.filter(|secoc| movable && secoc.profile != secoc::Profile::Announcement)
    {
        message.len_bytes += u16::try_from(authentication.profile.trailer_bytes()).unwrap_or(0);
    }
    set_header(message);
    if let Some(protection) = message.e2e {
        check_header(message, protection, fault);
    }
    if let Some(authentication) = message.secoc {
        check_trailer(message, authentication, fault);
    }
    if message.len_bytes > 8 && !is_fd {
        if movable && message.secoc.is_some() {
            let what = format!(
                "must have fd = true here and on the interface: freshness and authenticator make the message {} bytes long",
                message.len_bytes
            );
            fault("secoc", what);
        } else if is_moved {
            let what = format!(
                "must have fd = true here and on the interface: the header of profile 5 makes the message \
                 {MOVED_LEN_BYTES} bytes long; 1A and 1C fit classic frames"
            );
            fault("e2e", what);
        } else {
            fault("fd", format!("must be true: message {} has {} bytes", message.name, message.len_bytes));
        }
    }
}

fn format(message: &Message, settings: &MessageSettings) -> FrameFormat {
    let (was_fd, was_brs) = match message.format {
        // Without a format attribute, a message that is longer than a classic frame implies FD.
        FrameFormat::Classic => (message.len_bytes > 8, false),
        FrameFormat::Fd { brs } => (true, brs),
    };
    match settings.fd.unwrap_or(was_fd) {
        true => FrameFormat::Fd { brs: settings.brs.unwrap_or(was_brs) },
        false => FrameFormat::Classic,
    }
}

/// Makes room for the third byte of profile 5's header.
fn move_up(message: &mut Message) {
    for signal in &mut message.signals {
        signal.layout.start_bit += 8;
    }
    message.len_bytes = MOVED_LEN_BYTES;
}

/// An authenticated command has no header, so its signals move to the start.
fn move_down(message: &mut Message) {
    for signal in &mut message.signals {
        // The header has two bytes.
        signal.layout.start_bit = signal.layout.start_bit.saturating_sub(16);
    }
    // Without the header, the signals need 22 bits, so 4 of the 8 bytes are enough.
    message.len_bytes = 4;
    message.comment = Some("Authenticated command from another ECU: see PACKWATCH_Freshness.".to_owned());
}

fn set_header(message: &mut Message) {
    let mut header = message.e2e.map(header_signals).unwrap_or_default();
    header.extend(message.secoc.into_iter().flat_map(|secoc| trailer_signals(message.len_bytes, secoc)));
    let is_kept = |signal: &Signal| !HEADER_SIGNALS.contains(&signal.name.as_str());
    // Conditions refer to multiplexors by index, and the header changes the indices.
    let mut next = header.len();
    let places = message.signals.iter().map(|signal| {
        let place = is_kept(signal).then_some(next);
        next += usize::from(place.is_some());
        place
    });
    let places: Vec<Option<usize>> = places.collect();
    let kept = std::mem::replace(&mut message.signals, header).into_iter().filter(is_kept);
    message.signals.extend(kept.map(|mut signal| {
        for condition in &mut signal.conditions {
            condition.selector = places.get(condition.selector).copied().flatten().unwrap_or(condition.selector);
        }
        signal
    }));
}

/// Signals of the header, with which a consumer can check the header from the DBC alone.
fn header_signals(protection: Protection) -> Vec<Signal> {
    let Protection { profile, data_id } = protection;
    let crc = format!("CRC of end-to-end profile {}, data id {data_id}.", profile.name());
    let counter = format!("Increases by one with every frame, from 0 to {}, then from 0 again.", profile.max_counter());
    match profile {
        Profile::P01A => vec![header_signal("E2eCrc", 0, 8, &crc), header_signal("E2eCounter", 8, 4, &counter)],
        Profile::P01C => vec![
            header_signal("E2eCrc", 0, 8, &crc),
            header_signal("E2eCounter", 8, 4, &counter),
            header_signal("E2eDataIdNibble", 12, 4, "Low nibble of the data id's high byte."),
        ],
        Profile::P05 => vec![header_signal("E2eCrc", 0, 16, &crc), header_signal("E2eCounter", 16, 8, &counter)],
    }
}

fn trailer_signals(len_bytes: u16, authentication: Authentication) -> Vec<Signal> {
    let Authentication { profile, data_id } = authentication;
    let length = |bits: u32| u16::try_from(bits).unwrap_or(0);
    let (freshness, mac) = (length(profile.freshness_bits()), length(profile.mac_bits()));
    let first = 8 * len_bytes.saturating_sub(length(u32::from(freshness + mac) / 8));
    // A big-endian signal starts at its most significant bit. Bit 0 is the least significant bit of a byte.
    let place = |bit: u16| bit / 8 * 8 + 7 - bit % 8;
    let signal = |name, bit, length_bits, comment: &str| {
        let mut signal = header_signal(name, place(bit), length_bits, comment);
        signal.layout.byte_order = ByteOrder::BigEndian;
        signal
    };
    let covered = format!(
        "AES-128-CMAC over data id {data_id}, the bytes before the freshness, and the whole freshness; big-endian."
    );
    vec![
        signal("SecOCFreshness", first, freshness, "Low bits of the freshness (64 bits)."),
        signal("SecOCMac", first + freshness, mac, &format!("First bits of {covered}")),
    ]
}

fn header_signal(name: &str, start_bit: u16, length_bits: u16, comment: &str) -> Signal {
    Signal {
        name: name.to_owned(),
        layout: SignalLayout {
            start_bit,
            length_bits,
            byte_order: ByteOrder::LittleEndian,
            value_type: ValueType::Unsigned,
            factor: 1.0,
            offset: 0.0,
            minimum: 0.0,
            // 0 = not stated, because a float cannot represent the maximum exactly.
            maximum: if length_bits < 53 { ((1_u64 << length_bits) - 1) as f64 } else { 0.0 },
        },
        unit: String::new(),
        receivers: Vec::new(),
        conditions: Vec::new(),
        is_multiplexor: false,
        values: Vec::new(),
        comment: Some(comment.to_owned()),
    }
}

fn check_header(message: &Message, protection: Protection, fault: &mut impl FnMut(&'static str, String)) {
    let Protection { profile, data_id } = protection;
    let (name, len, word) = (&message.name, usize::from(message.len_bytes), profile.name());
    if data_id > profile.max_data_id() {
        fault("data_id", format!("must be 0 to {:#X} with profile {word}", profile.max_data_id()));
    }
    if !(profile.header_bytes()..=profile.max_bytes()).contains(&len) {
        let (least, most) = (profile.header_bytes(), profile.max_bytes());
        fault("e2e", format!("message {name} has {len} bytes, must have {least} to {most} for profile {word}"));
    } else if !is_frame_length(len) {
        fault(
            "e2e",
            format!("message {name} has {len} bytes, must have a valid CAN FD length: padding is not protected"),
        );
    }
    let in_header = |signal: &&Signal| {
        !HEADER_SIGNALS.contains(&signal.name.as_str()) && signal.layout.touches(profile.header_mask())
    };
    for signal in message.signals.iter().filter(in_header) {
        let what = format!(
            "signal {name}.{} begins at bit {}, must leave the {} bits of the header of profile {word} free",
            signal.name,
            signal.layout.start_bit,
            profile.header_mask().iter().map(|byte| byte.count_ones()).sum::<u32>(),
        );
        fault("e2e", what);
    }
}

fn check_trailer(message: &Message, authentication: Authentication, fault: &mut impl FnMut(&'static str, String)) {
    let (name, len, trailer) = (&message.name, usize::from(message.len_bytes), authentication.profile.trailer_bytes());
    let word = authentication.profile.name();
    if len < trailer || !is_frame_length(len) {
        let what = format!(
            "message {name} has {len} bytes, must have a valid frame length of at least {trailer} for profile {word}"
        );
        return fault("secoc", what);
    }
    let is_own = |signal: &&Signal| HEADER_SIGNALS.contains(&signal.name.as_str());
    for signal in message.signals.iter().filter(|signal| !is_own(signal)) {
        if signal.layout.plan().is_ok_and(|plan| plan.bytes_needed() > len - trailer) {
            let what =
                format!("signal {name}.{} must leave the last {trailer} bytes free for profile {word}", signal.name);
            fault("secoc", what);
        }
    }
}

/// Multiplies the steps of Ah signals by the smallest factor of 1, 2, 5, 10, ... with which the largest possible value
/// fits. The largest possible value is 2 times the rated capacity; for a standard deviation, it is 0.5 times the rated
/// capacity.
fn fit_steps(message: &mut Message, rated_capacity_ah: f64) {
    let largest_ah = |signal: &Signal| rated_capacity_ah * if signal.name.ends_with("Std") { 0.5 } else { 2.0 };
    for is_std in [false, true] {
        let belongs = |signal: &Signal| signal.unit == "Ah" && signal.name.ends_with("Std") == is_std;
        let needed = message.signals.iter().filter(|signal| belongs(signal));
        let needed = needed.map(|signal| times(largest_ah(signal) / signal.layout.maximum)).fold(1.0, f64::max);
        for signal in message.signals.iter_mut().filter(|signal| belongs(signal)) {
            signal.layout.factor = decimal(signal.layout.factor * needed);
            signal.layout.maximum = decimal(signal.layout.maximum * needed);
        }
    }
}

/// The smallest of 1, 2, 5, 10, ... that is at least `needed`; at most `LARGEST`.
fn times(needed: f64) -> f64 {
    /// Allows capacities up to a million times 40 Ah, more than any cell has.
    const LARGEST: f64 = 1e6;
    let ladder = std::iter::successors(Some(1.0), |decade| Some(decade * 10.0)).take_while(|decade| *decade < LARGEST);
    let mut ladder = ladder.flat_map(|decade| [decade, 2.0 * decade, 5.0 * decade]);
    ladder.find(|step| *step >= needed).unwrap_or(LARGEST)
}

/// Removes the digits that floating-point arithmetic adds to a decimal number.
fn decimal(value: f64) -> f64 {
    format!("{value:.6}").parse().unwrap_or(value)
}

impl FrameFormat {
    /// Kind of the frame to send.
    pub const fn kind(self) -> FrameKind {
        match self {
            Self::Classic => FrameKind::Classic,
            Self::Fd { brs } => FrameKind::Fd { brs, esi: false },
        }
    }
}

#[cfg(test)]
mod tests;
