//! Converts OBDb addresses to the CAN identifiers of requests and answers.
//!
//! | form of `hdr` | request | answer |
//! | --- | --- | --- |
//! | 3 digits | identifier of 11 bits: `hdr` | identifier `rax`; if `rax` is missing, `hdr` + 8 (as in ISO 15765-4), except for requests to all controllers (7DF) |
//! | 3 digits, with `eax` | also the first data byte `eax` | also the first data byte `tst`; if `tst` is missing, the low byte of `hdr` (F1 for 6F1) |
//! | 4 digits, `TTAA` | identifier of 29 bits: `pri` (default 18), `TT`, `AA`, `tst` (default F1) | see below |
//!
//! The answer to a request with 4 digits depends on `rax`. If `rax` has 6 digits, the identifier is `pri`, `rax`. If
//! `rax` is shorter, the identifier is `pri`, DA, `tst`, last byte of `rax`. If `rax` is missing and `TT` is DA, `AA`
//! replaces the last byte of `rax` (ISO 15765-2, normal fixed).
//!
//! Volvo and Polestar (`hdr` D0xx, `pri` 1D, without `rax`) use another rule: the answer to 1DD0xxyy is 1C000E80 + 2^13
//! xxyy. Recorded pairs: 1DD01630 and 1EC60E80, 1DD01635 and 1EC6AE80, 1DD01601 and 1EC02E80, 1DD01650 and 1ECA0E80,
//! 1DD01701 and 1EE02E80, 1DD01A01 and 1F402E80.

use super::document::AddressDocument;
use crate::can::CanId;

/// Identifier of requests to all controllers (ISO 15765-4).
const FUNCTIONAL: u32 = 0x7DF;
/// Value of `TT` in requests to one controller.
const PHYSICAL: u32 = 0xDA;

/// First byte and second byte of Volvo's requests.
const VOLVO_PRIORITY: u32 = 0x1D;
const VOLVO: u32 = 0xD0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Addresses {
    pub(super) request: CanId,
    pub(super) response: CanId,
    /// First data byte of requests and of answers; `None` = addressing is not extended.
    pub(super) extension: Option<(u8, u8)>,
}

impl Addresses {
    pub(super) fn new(document: &AddressDocument) -> Result<Self, String> {
        if let Some(protocol) = document.proto.as_deref().filter(|name| !name.starts_with("15765-4")) {
            return Err(format!("proto is {protocol}, must be 15765-4 (CAN)"));
        }
        match document.hdr.len() {
            3 => standard(document),
            4 => extended(document),
            _ => Err(format!("hdr is \"{}\", must have 3 or 4 hexadecimal digits", document.hdr)),
        }
    }
}

fn standard(document: &AddressDocument) -> Result<Addresses, String> {
    let request = hexadecimal("hdr", &document.hdr)?;
    let response = match &document.rax {
        Some(rax) => hexadecimal("rax", rax)?,
        None if request == FUNCTIONAL => {
            return Err(format!("hdr is {} (all controllers) without rax, must be one controller", document.hdr));
        }
        // ISO 15765-4 defines this difference of 8 for 7E0 to 7E7. Other controllers of a car use it too.
        None => request + 8,
    };
    let extension = match (byte("eax", document.eax.as_ref())?, byte("tst", document.tst.as_ref())?) {
        (None, _) => None,
        (Some(target), tester) => Some((target, tester.unwrap_or(request.to_le_bytes()[0]))),
    };
    let id = |field: &str, id: u32| {
        CanId::standard(id).ok_or_else(|| format!("{field} is {id:X}, must be at most 7FF with a hdr of 3 digits"))
    };
    Ok(Addresses { request: id("hdr", request)?, response: id("rax", response)?, extension })
}

fn extended(document: &AddressDocument) -> Result<Addresses, String> {
    if document.eax.is_some() {
        return Err("eax with a hdr of 4 digits, must have 3".to_owned());
    }
    let middle = hexadecimal("hdr", &document.hdr)?;
    let priority = byte("pri", document.pri.as_ref())?.map_or(0x18, u32::from);
    let tester = byte("tst", document.tst.as_ref())?.map_or(0xF1, u32::from);
    let of_sender = |sender: u32| PHYSICAL << 16 | tester << 8 | sender & 0xFF;
    let response = match &document.rax {
        Some(rax) if rax.len() == 6 => hexadecimal("rax", rax)?,
        // A shorter `rax` ends with the address of the controller.
        Some(rax) => of_sender(hexadecimal("rax", rax)?),
        None if middle >> 8 == PHYSICAL => of_sender(middle),
        None if middle >> 8 == VOLVO && priority == VOLVO_PRIORITY => {
            return Ok(Addresses {
                request: CanId::Extended(priority << 24 | middle << 8 | tester),
                response: CanId::Extended(0x1C00_0E80 + ((middle & 0xFF) << 8 | tester) * 0x2000),
                extension: None,
            });
        }
        None => return Err(format!("hdr is {} without rax, must be DA and the address for that", document.hdr)),
    };
    let id = |number: u32| {
        CanId::extended(number).ok_or_else(|| format!("pri is {priority:02X}, must be at most 1F: 29 bits"))
    };
    let request = id(priority << 24 | middle << 8 | tester)?;
    let response = id(priority << 24 | response)?;
    Ok(Addresses { request, response, extension: None })
}

fn hexadecimal(field: &str, text: &str) -> Result<u32, String> {
    let number = u32::from_str_radix(text, 16).ok().filter(|number| *number <= 0xFF_FFFF && !text.starts_with('+'));
    number.ok_or_else(|| format!("{field} is \"{text}\", must be 1 to 6 hexadecimal digits"))
}

fn byte(field: &str, text: Option<&String>) -> Result<Option<u8>, String> {
    let Some(text) = text else { return Ok(None) };
    let number = hexadecimal(field, text)?;
    u8::try_from(number).map(Some).map_err(|_| format!("{field} is \"{text}\", must be one byte"))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "in a test a panic is the message")]
mod tests {
    use super::*;

    type Numbers = (u32, u32, Option<(u8, u8)>);

    fn addresses(fields: [Option<&str>; 6]) -> Result<Numbers, String> {
        let [hdr, rax, eax, pri, tst, proto] = fields.map(|field| field.map(str::to_owned));
        let document = AddressDocument { hdr: hdr.unwrap(), rax, eax, pri, tst, proto };
        Addresses::new(&document)
            .map(|found| (found.request.dbc_number(), found.response.dbc_number(), found.extension))
    }

    #[test]
    fn eleven_bit_identifiers_are_converted() {
        let none = None;
        assert_eq!(addresses([Some("79B"), Some("7BB"), none, none, none, none]), Ok((0x79B, 0x7BB, None)));
        assert_eq!(addresses([Some("7E4"), none, none, none, none, none]), Ok((0x7E4, 0x7EC, None)));
        assert_eq!(addresses([Some("7A0"), none, none, none, none, none]), Ok((0x7A0, 0x7A8, None)));
        let bmw = addresses([Some("6F1"), Some("607"), Some("07"), none, none, none]);
        assert_eq!(bmw, Ok((0x6F1, 0x607, Some((0x07, 0xF1)))));
    }

    #[test]
    fn twenty_nine_bit_identifiers_are_converted() {
        let none = None;
        let honda = addresses([Some("DA01"), Some("01"), none, none, none, none]);
        assert_eq!(honda, Ok((0x98DA_01F1, 0x98DA_F101, None)));
        assert_eq!(addresses([Some("DA10"), none, none, none, none, none]), Ok((0x98DA_10F1, 0x98DA_F110, None)));
        let volkswagen = addresses([Some("FC00"), Some("FE007B"), none, Some("17"), Some("7B"), none]);
        assert_eq!(volkswagen, Ok((0x97FC_007B, 0x97FE_007B, None)));
        let volvo = |hdr, tst| addresses([Some(hdr), none, none, Some("1D"), Some(tst), none]);
        assert_eq!(volvo("D016", "30"), Ok((0x9DD0_1630, 0x9EC6_0E80, None)));
        assert_eq!(volvo("D016", "35"), Ok((0x9DD0_1635, 0x9EC6_AE80, None)));
        assert_eq!(volvo("D01A", "01"), Ok((0x9DD0_1A01, 0x9F40_2E80, None)));
        let toyota = addresses([Some("DA10"), Some("DAF110"), none, none, none, none]);
        assert_eq!(toyota, Ok((0x98DA_10F1, 0x98DA_F110, None)));
        let other = addresses([Some("DB33"), Some("F11D"), none, Some("0C"), Some("FA"), Some("15765-4-29bit")]);
        assert_eq!(other, Ok((0x8CDB_33FA, 0x8CDA_FA1D, None)));
    }

    #[test]
    fn other_forms_are_rejected_with_allowed_ones() {
        let none = None;
        for (fields, part) in [
            ([Some("7DF"), none, none, none, none, none], "one controller"),
            ([Some("9FF"), Some("7EC"), none, none, none, none], "at most 7FF"),
            ([Some("7E4"), Some("18DA"), none, none, none, none], "at most 7FF"),
            ([Some("7E4"), Some("xyz"), none, none, none, none], "hexadecimal"),
            ([Some("DB33"), none, none, none, none, none], "DA and the address"),
            ([Some("DA10"), none, none, Some("FF"), none, none], "29 bits"),
            ([Some("DA10"), none, Some("07"), none, none, none], "must have 3"),
            ([Some("686A"), none, none, none, none, Some("9141-2")], "CAN"),
            ([Some(""), none, none, none, none, none], "3 or 4"),
            ([Some("6F1"), Some("607"), Some("107"), none, none, none], "one byte"),
        ] {
            let fault = addresses(fields).unwrap_err();
            assert!(fault.contains(part), "{fields:?}: {fault}");
        }
    }
}
