//! Reads message attributes of a DBC.
//!
//! DBC editors define the attribute names and the order of the values of `VFrameFormat`. The attributes for end-to-end
//! protection and authentication are packwatch's own. An invalid attribute counts as missing.

use can_dbc::{AttributeDefinition, AttributeValue, AttributeValueType, Dbc, MessageId};

use super::{FrameFormat, Repetition};
use crate::can::e2e::{Profile, Protection};
use crate::can::secoc::{self, Authentication};

pub(super) const CYCLE_TIME: &str = "GenMsgCycleTime";
pub(super) const REPETITIONS: &str = "GenMsgNrOfRepetition";
pub(super) const FAST_CYCLE_TIME: &str = "GenMsgCycleTimeFast";
pub(super) const DELAY_TIME: &str = "GenMsgDelayTime";
pub(super) const FRAME_FORMAT: &str = "VFrameFormat";
pub(super) const FRAME_FORMATS: [&str; 16] = {
    let mut words = ["reserved"; 16];
    (words[0], words[1], words[J1939_FORMAT]) = ("StandardCAN", "ExtendedCAN", "J1939PG");
    (words[FIRST_FD_FORMAT], words[FIRST_FD_FORMAT + 1]) = ("StandardCAN_FD", "ExtendedCAN_FD");
    words
};
/// Index in [`FRAME_FORMATS`].
pub(super) const J1939_FORMAT: usize = 3;
/// Attribute of the whole bus.
const PROTOCOL: &str = "ProtocolType";
/// Index in [`FRAME_FORMATS`].
pub(super) const FIRST_FD_FORMAT: usize = 14;
pub(super) const BIT_RATE_SWITCH: &str = "CANFD_BRS";
pub(super) const NO_YES: [&str; 2] = ["0", "1"];
pub(super) const E2E_PROFILE: &str = "E2EProfile";
pub(super) const E2E_PROFILES: [&str; 4] = ["off", "1A", "1C", "5"];
pub(super) const E2E_DATA_ID: &str = "E2EDataId";
pub(super) const SECOC_PROFILE: &str = "SecOCProfile";
pub(super) const SECOC_PROFILES: [&str; 5] = ["off", "1", "3", "fd", "announcement"];
pub(super) const SECOC_DATA_ID: &str = "SecOCDataId";

pub(super) fn profile_index(profile: Profile) -> usize {
    E2E_PROFILES.iter().position(|name| *name == profile.name()).unwrap_or(0)
}

pub(super) fn secoc_index(profile: secoc::Profile) -> usize {
    SECOC_PROFILES.iter().position(|name| *name == profile.name()).unwrap_or(0)
}

pub(super) fn repetition(dbc: &Dbc, id: MessageId) -> Repetition {
    let [count, period_ms, delay_ms] = [REPETITIONS, FAST_CYCLE_TIME, DELAY_TIME].map(|name| positive(dbc, id, name));
    Repetition { count, period_ms, delay_ms }
}

/// A numeric attribute; `None` = missing, invalid or 0.
pub(super) fn positive(dbc: &Dbc, id: MessageId, name: &str) -> Option<u32> {
    let whole = match dbc.resolved_message_attribute(id, name)? {
        AttributeValue::Uint(ms) => u32::try_from(*ms).ok(),
        AttributeValue::Int(ms) => u32::try_from(*ms).ok(),
        // Some editors export every number as a float, such as 100.0 for 100.
        AttributeValue::Double(ms) => format!("{:.0}", ms.round()).parse().ok(),
        AttributeValue::String(ms) => ms.parse().ok(),
    };
    whole.filter(|ms| *ms > 0)
}

/// Frame format of the message; classic unless the attribute names an FD format.
pub(super) fn format(dbc: &Dbc, id: MessageId) -> FrameFormat {
    match word(dbc, id, FRAME_FORMAT).as_deref() {
        Some("StandardCAN_FD" | "ExtendedCAN_FD") => {
            FrameFormat::Fd { brs: word(dbc, id, BIT_RATE_SWITCH).as_deref() == Some(NO_YES[1]) }
        }
        _ => FrameFormat::Classic,
    }
}

/// Whether the message is a J1939 parameter group. If the frame format is missing, the protocol of the bus decides.
pub(super) fn is_j1939(dbc: &Dbc, id: MessageId) -> bool {
    let of_bus = || {
        let value = dbc.attribute_values_database.iter().find(|value| value.name == PROTOCOL)?;
        if let AttributeValue::String(word) = &value.value { Some(word.clone()) } else { None }
    };
    matches!(id, MessageId::Extended(_))
        && match word(dbc, id, FRAME_FORMAT) {
            Some(format) => format == FRAME_FORMATS[J1939_FORMAT],
            None => of_bus().is_some_and(|protocol| protocol.eq_ignore_ascii_case("J1939")),
        }
}

/// `None` if profile or data ID is missing or invalid.
pub(super) fn e2e(dbc: &Dbc, id: MessageId) -> Option<Protection> {
    let name = word(dbc, id, E2E_PROFILE)?;
    let profile = [Profile::P01A, Profile::P01C, Profile::P05].into_iter().find(|profile| profile.name() == name)?;
    Some(Protection { profile, data_id: data_id(dbc, id, E2E_DATA_ID)? })
}

/// `None` if profile or data ID is missing or invalid.
pub(super) fn secoc(dbc: &Dbc, id: MessageId) -> Option<Authentication> {
    let name = word(dbc, id, SECOC_PROFILE)?;
    let profile = secoc::Profile::ALL.into_iter().find(|profile| profile.name() == name)?;
    Some(Authentication { profile, data_id: data_id(dbc, id, SECOC_DATA_ID)? })
}

fn data_id(dbc: &Dbc, id: MessageId, name: &str) -> Option<u16> {
    match dbc.resolved_message_attribute(id, name)? {
        AttributeValue::Uint(id) => u16::try_from(*id).ok(),
        AttributeValue::Int(_) | AttributeValue::Double(_) | AttributeValue::String(_) => None,
    }
}

/// Name of an enumeration attribute's value, which the DBC gives by name or by index.
fn word(dbc: &Dbc, id: MessageId, name: &str) -> Option<String> {
    let place = match dbc.resolved_message_attribute(id, name)? {
        AttributeValue::String(word) => return Some(word.clone()),
        AttributeValue::Uint(place) => usize::try_from(*place).ok()?,
        AttributeValue::Int(_) | AttributeValue::Double(_) => return None,
    };
    dbc.attribute_definitions.iter().find_map(|definition| match definition {
        AttributeDefinition::Message(defined, AttributeValueType::Enum(words)) if defined == name => {
            words.get(place).cloned()
        }
        _ => None,
    })
}
