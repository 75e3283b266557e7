//! Tests that written text parses to an equal database and that the shipped DBC is up to date.

use proptest::prelude::*;

use super::*;
use crate::can::dbc::{Repetition, lowest};
use crate::can::e2e::{Profile, Protection};
use crate::can::encode::{LayoutBase, LayoutSettings, MessageSettings, default_database, layout};
use crate::can::secoc::{self, Authentication};
use crate::can::signal::SignalLayout;

const SHIPPED: &str = include_str!("../../../../../config/packwatch.dbc");

#[test]
fn shipped_dbc_matches_default_layout() {
    let settings = LayoutSettings { command: Some(MessageSettings::default()), ..Default::default() };
    let mut made = layout(LayoutBase::BuiltIn { rated_capacity_ah: 2.6 }, &settings).unwrap();
    // The default layout lacks this message, because it is sent only if commands are authenticated.
    made.messages.push(default_database().unwrap().message("PACKWATCH_Freshness").unwrap().clone());
    let written = made.to_dbc();
    for (number, (shipped, written)) in (1..).zip(SHIPPED.lines().zip(written.lines())) {
        assert_eq!(shipped, written, "line {number} of config/packwatch.dbc");
    }
    assert_eq!(SHIPPED, written);
}

#[test]
fn shipped_files_round_trip_unchanged() {
    let texts =
        [SHIPPED, include_str!("../../../../../config/pack96.dbc"), include_str!("../../../../../config/measured.dbc")];
    for text in texts {
        let database = Database::parse(text).unwrap();
        assert_eq!(Database::parse_bytes(&database.to_dbc_bytes()).unwrap(), database);
    }
}

#[test]
fn bytes_are_latin_1_unless_valid_utf_8() {
    let with_comment = |comment: &str| Database { comment: Some(comment.to_owned()), ..Default::default() };
    assert!(with_comment("\u{b0}C").to_dbc_bytes().windows(2).any(|bytes| bytes == b"\xB0C"));
    for comment in ["plain", "\u{b0}C", "\u{c3}\u{a9}", "\u{20ac} and \u{b0}"] {
        let database = with_comment(comment);
        assert_eq!(Database::parse_bytes(&database.to_dbc_bytes()).unwrap(), database, "{comment}");
    }
}

#[test]
fn quotes_in_text_are_escaped() {
    let database = Database { comment: Some("a \"b\" c\\".to_owned()), ..Default::default() };
    let read = Database::parse(&database.to_dbc()).unwrap();
    assert_eq!(read.comment.as_deref(), Some("a \\\"b\\\" c\\ "));
    assert_eq!(Database::parse(&read.to_dbc()).unwrap(), read);
}

/// Pattern of texts without quotation marks and backslashes, because writing changes these characters.
const TEXT: &str = "[ -!#-\\[\\]-~\u{b0}\u{b5}\u{20ac}]{0,12}";

fn layouts() -> impl Strategy<Value = SignalLayout> {
    let number =
        prop_oneof![Just(0.0), -1e6..1e6_f64, (-4000..4000_i32).prop_map(|n| f64::from(n) / 40.0), any::<f64>()];
    let number = number.prop_filter("a DBC's numbers are finite", |number| number.is_finite()).boxed();
    let kind = prop_oneof![
        Just(ValueType::Unsigned),
        Just(ValueType::Signed),
        Just(ValueType::Float32),
        Just(ValueType::Float64)
    ];
    let order = prop_oneof![Just(ByteOrder::LittleEndian), Just(ByteOrder::BigEndian)];
    (any::<u16>(), any::<u16>(), order, kind, [number.clone(), number.clone(), number.clone(), number]).prop_map(
        |(start_bit, length_bits, byte_order, value_type, [factor, offset, minimum, maximum])| {
            let layout =
                SignalLayout { start_bit, length_bits, byte_order, value_type, factor, offset, minimum, maximum };
            // The parser replaces the minimum of a range that states only magnitudes. Do the same here.
            SignalLayout { minimum: lowest(&layout), ..layout }
        },
    )
}

prop_compose! {
    fn signals()(
        layout in layouts(),
        unit in TEXT,
        receivers in prop::collection::vec("N[a-z0-9]{1,5}", 0..3),
        values in prop::collection::vec((any::<i64>(), TEXT), 0..3),
        comment in prop::option::of(TEXT),
    ) -> Signal {
        let (conditions, name) = (Vec::new(), String::new());
        Signal { name, layout, unit, receivers, conditions, is_multiplexor: false, values, comment }
    }
}

/// The condition under which a signal is present (an earlier multiplexor and ranges of its code), and whether the
/// signal itself is a multiplexor.
type MuxLink = (Option<(prop::sample::Index, Vec<(u64, u64)>)>, bool);

fn mux_links() -> impl Strategy<Value = MuxLink> {
    let range =
        prop_oneof![(0..300_u64).prop_map(|code| (code, code)), (0..300_u64, 0..9_u64).prop_map(|(a, n)| (a, a + n))];
    let condition = prop::option::of((any::<prop::sample::Index>(), prop::collection::vec(range, 1..3)));
    (condition, any::<bool>())
}

/// Joins signals and their conditions to the signals of a message. The nesting of multiplexors stays below the parser's
/// limit.
fn assemble(parts: Vec<(Signal, MuxLink)>) -> Vec<Signal> {
    let mut made: Vec<Signal> = Vec::new();
    for (number, (mut signal, (condition, is_multiplexor))) in parts.into_iter().enumerate() {
        signal.name = format!("S{number}");
        signal.is_multiplexor = is_multiplexor;
        let parents = made.iter().enumerate().filter(|(_, s)| s.is_multiplexor && s.conditions.len() < 4);
        let parents: Vec<usize> = parents.map(|(place, _)| place).collect();
        if let (Some((which, ranges)), false) = (condition, parents.is_empty()) {
            let selector = parents[which.index(parents.len())];
            signal.conditions.clone_from(&made[selector].conditions);
            signal.conditions.push(MuxCondition { selector, ranges });
        }
        made.push(signal);
    }
    made
}

prop_compose! {
    fn messages()(
        extended in any::<bool>(),
        len_bytes in any::<u16>(),
        sender in prop::option::of("N[a-z0-9]{1,5}"),
        format in prop_oneof![Just(FrameFormat::Classic), any::<bool>().prop_map(|brs| FrameFormat::Fd { brs })],
        e2e in prop::option::of((prop_oneof![Just(Profile::P01A), Just(Profile::P01C), Just(Profile::P05)], any::<u16>())),
        secoc in prop::option::of((prop::sample::select(secoc::Profile::ALL.to_vec()), any::<u16>())),
        parts in prop::collection::vec((signals(), mux_links()), 0..8),
        cycle_time_ms in prop::option::of(1..=3_600_000_u32),
        count in prop::option::of(1..=999_999_u32),
        times_ms in prop::array::uniform2(prop::option::of(1..=3_600_000_u32)),
        comment in prop::option::of(TEXT),
    ) -> (bool, Message) {
        let e2e = e2e.map(|(profile, data_id)| Protection { profile, data_id });
        let secoc = secoc.map(|(profile, data_id)| Authentication { profile, data_id });
        let (id, name, signals) = (CanId::Standard(0), String::new(), assemble(parts));
        let repetition = Repetition { count, period_ms: times_ms[0], delay_ms: times_ms[1] };
        let is_j1939 = extended && format == FrameFormat::Classic && count.is_some();
        (extended, Message { id, name, len_bytes, sender, format, is_j1939, e2e, secoc, signals, cycle_time_ms, repetition, comment })
    }
}

prop_compose! {
    fn databases()(
        nodes in prop::collection::vec("N[a-z0-9]{1,5}", 0..4),
        comment in prop::option::of(TEXT),
        made in prop::collection::vec(messages(), 0..5),
    ) -> Database {
        let name = |(number, (extended, message)): (u16, (bool, Message))| {
            let id = if extended { CanId::Extended(0x1FFF_FFFF - u32::from(number)) } else { CanId::Standard(number) };
            Message { id, name: format!("M{number}"), ..message }
        };
        Database { nodes, comment, messages: (0..).zip(made).map(name).collect(), left_out: Vec::new() }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    #[test]
    fn any_database_round_trips_unchanged(database in databases()) {
        let read = Database::parse_bytes(&database.to_dbc_bytes());
        prop_assert_eq!(read, Ok(database));
    }
}
