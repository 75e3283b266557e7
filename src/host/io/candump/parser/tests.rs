//! Tests the candump parser with every form of a line, every byte at every place, and random lines.

use proptest::prelude::*;

use super::*;

/// Text that follows the line in the log.
const MORE: &str = "\n(1700000000.123456) can0 123#1122334455667788\n(1700000000.123457) can0 123#\n";

/// Parses the line in two ways and checks that the results are equal. A new parser parses only this line and takes no
/// fast path. Another parser knows the interface and gets more text after the line. It parses the line twice, because
/// it remembers the seconds of the first stamp and then parses them faster.
fn read(line: &[u8]) -> Result<Line<'_>, LineError> {
    let plain = crate::io::candump::parse_line(line);
    let name = match plain {
        Ok(Line::Frame { interface, .. }) => String::from_utf8_lossy(interface).into_owned(),
        _ => "can0".to_owned(),
    };
    let mut parser = LineParser::new(&["none".to_owned(), name.clone()]);
    let text = [line, MORE.as_bytes()].concat();
    for _ in 0..2 {
        let found = parser.parse(&text);
        assert_eq!(found.map(|found| found.line), plain, "{:?}", String::from_utf8_lossy(line));
        if let Ok(Line::Frame { interface, .. }) = plain {
            assert_eq!(found.map(|found| found.len), Ok(line.len()), "{:?}", String::from_utf8_lossy(line));
            let head = parser.parse_head(&text).expect("as before");
            if let Some((frame, len)) = head.rest.usual_frame_and_end() {
                let usual = Line::Frame { time: head.time, interface, frame, transmitted: false };
                assert_eq!((Ok(usual), len), (plain, line.len()), "{:?}", String::from_utf8_lossy(line));
            }
            let is_short = name.as_bytes() == interface && (1..8).contains(&name.len());
            let number = BusIndex(u8::from(name != "none"));
            // If there is more than one space before the interface, the parser looks the interface up by its name.
            let has_more = line.windows(2).any(|two| two == b"  ");
            let is_right = head.bus.map_or(!is_short || has_more, |bus| is_short && bus == number);
            assert!(is_right, "{:?}", String::from_utf8_lossy(line));
        }
    }
    plain
}

fn digit() -> impl Strategy<Value = u8> {
    prop::sample::select(b"0123456789ABCDEFabcdef".to_vec())
}

/// Usual lines with parts of different lengths.
fn usual_line() -> impl Strategy<Value = Vec<u8>> {
    let stamp = (0..9_223_371_999u64, prop_oneof!["[0-9]{6}", "[0-9]{9}"]);
    let id = prop_oneof!["[0-7][0-9A-Fa-f]{2}", "[01][0-9A-Fa-f]{7}"];
    let payload = (0..=8usize).prop_flat_map(|len| prop::collection::vec(digit(), 2 * len));
    (stamp, "[!-~]{1,9}", id, payload, prop::sample::select(vec!["", "\r"])).prop_map(
        |((s, f), name, id, payload, end)| {
            [format!("({s:010}.{f}) {name} {id}#").as_bytes(), &payload, end.as_bytes()].concat()
        },
    )
}

proptest! {
    #[test]
    fn usual_lines_are_frames(line in usual_line()) {
        prop_assert!(matches!(read(&line), Ok(Line::Frame { .. })), "{}", String::from_utf8_lossy(&line));
    }

    #[test]
    fn fast_paths_agree_on_damaged_lines(
        line in usual_line(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let mut changed = line.clone();
        for (at, byte) in changes {
            let at = at.index(changed.len());
            changed[at] = if byte == b'\n' { b' ' } else { byte };
        }
        changed.truncate(cut.map_or(changed.len(), |cut| cut.index(changed.len() + 1)));
        let _ = read(&changed);
    }

    #[test]
    fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = LineParser::new(&[]).parse(&bytes);
    }
}

#[test]
fn fast_paths_agree_for_any_byte_at_any_place() {
    for line in [
        &b"(1700000000.123456) can0 7FF#00112233445566fF"[..],
        b"(9223371999.999999999) vcan10 1FFFFFFf#aB\r",
        b"(1700000000.123456) can0 7FF##10011223344556677",
    ] {
        assert!(read(line).is_ok());
        for at in 0..line.len() {
            for byte in (0..=u8::MAX).filter(|byte| *byte != b'\n') {
                let mut changed = line.to_vec();
                changed[at] = byte;
                let _ = read(&changed);
            }
        }
    }
}

#[test]
fn only_names_of_up_to_seven_bytes_are_known() {
    let mut parser = LineParser::new(&["can1".to_owned(), "a name".to_owned(), "vcan10".to_owned(), String::new()]);
    let mut bus = |name: &str| {
        let line = format!("(1700000000.123456) {name} 123#11{MORE}");
        parser.parse_head(line.as_bytes()).ok().and_then(|head| head.bus)
    };
    assert_eq!((bus("can1"), bus("vcan10")), (Some(BusIndex(0)), Some(BusIndex(2))));
    for name in ["can0", "can", "can10", "vcan1", "vcan100", "a name", "a", "", "can1\n"] {
        assert_eq!(bus(name), None, "{name:?}");
    }
}

#[test]
fn line_ends_at_first_line_feed() {
    let mut parser = LineParser::new(&["can0".to_owned()]);
    let whole = b"(1700000000.123456) can0 123#1122334455667788\n";
    assert!(parser.parse(whole).is_ok());
    for at in 0..whole.len() - 1 {
        let mut torn = whole.to_vec();
        torn[at] = b'\n';
        let alone = crate::io::candump::parse_line(&torn[..at]);
        match parser.parse(&torn) {
            Ok(found) if found.len > 0 => assert_eq!((Ok(found.line), found.len), (alone, at), "{at}"),
            found => assert!(alone.is_err() == found.is_err(), "{at}: {found:?}"),
        }
    }
}

#[test]
fn stamps_beyond_range_are_rejected() {
    assert!(read(b"(9223371999.999999999) can0 123#").is_ok());
    assert!(read(b"(-123456789.999999999) can0 123#").is_ok());
    for (line, is_time) in [
        ("(9223372036.854775807) can0 123#", true),
        ("(9223372036.854775808) can0 123#", false),
        ("(9999999999.999999) can0 123#", false),
    ] {
        assert_eq!(read(line.as_bytes()).is_ok(), is_time, "{line}");
    }
}
