//! Tests that the parser reads complete DBC texts, leaves out faulty messages with a line number, and rejects texts
//! without a usable message.

use super::*;

const HEAD: &str = "VERSION \"\"\nNS_ :\nBS_:\nBU_: X\n";

fn parse(body: &str) -> Result<Database, DbcError> {
    Database::parse(&format!("{HEAD}{body}"))
}

#[test]
fn messages_and_signals_are_parsed_with_all_details() {
    let db = parse(
        r#"BO_ 2147484672 Ext: 64 X
 SG_ F : 0|32@1- (1,0) [0|0] "V" X
 SG_ S : 39|8@0- (0.5,-3) [-10|10] "A" X
BO_ 256 Std: 8 X
CM_ BO_ 256 "a message";
CM_ SG_ 2147484672 S "a signal";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
VAL_ 2147484672 S -1 "Not_Available" 1 "one" ;
SIG_VALTYPE_ 2147484672 F : 1;
"#,
    )
    .unwrap();
    let (message, f) = db.signal("Ext.F").unwrap();
    assert_eq!((message.id, message.len_bytes, message.cycle_time_ms), (CanId::Extended(1024), 64, None));
    assert_eq!((f.layout.value_type, f.unit.as_str()), (ValueType::Float32, "V"));
    let (_, s) = db.signal("Ext.S").unwrap();
    assert_eq!(
        s.layout,
        SignalLayout {
            start_bit: 39,
            length_bits: 8,
            byte_order: ByteOrder::BigEndian,
            value_type: ValueType::Signed,
            factor: 0.5,
            offset: -3.0,
            minimum: -10.0,
            maximum: 10.0
        }
    );
    assert_eq!(s.not_available_codes(), [0xFF]);
    assert_eq!(s.comment.as_deref(), Some("a signal"));
    let std = db.message("Std").unwrap();
    assert_eq!(
        (std.id, std.cycle_time_ms, std.comment.as_deref()),
        (CanId::Standard(256), Some(100), Some("a message"))
    );
    assert!(db.signal("Std.F").is_none() && db.signal("Ext").is_none() && db.message("ext").is_none());
}

#[test]
fn nested_multiplexing_gives_chain_of_conditions() {
    let db = parse(
        r#"BO_ 1 M: 8 X
 SG_ Inner m2M : 8|8@1+ (1,0) [0|0] "" X
 SG_ Outer M : 0|8@1+ (1,0) [0|0] "" X
 SG_ Deep m0 : 16|8@1+ (1,0) [0|0] "" X
 SG_ Plain : 24|8@1+ (1,0) [0|0] "" X
SG_MUL_VAL_ 1 Inner Outer 2-2;
SG_MUL_VAL_ 1 Deep Inner 0-3, 7-9;
"#,
    )
    .unwrap();
    let deep = &db.signal("M.Deep").unwrap().1.conditions;
    assert_eq!(
        deep,
        &[
            MuxCondition { selector: 1, ranges: vec![(2, 2)] },
            MuxCondition { selector: 0, ranges: vec![(0, 3), (7, 9)] }
        ]
    );
    assert!(db.signal("M.Plain").unwrap().1.conditions.is_empty());
    assert!(db.signal("M.Inner").unwrap().1.is_multiplexor);
}

#[test]
fn range_from_zero_to_negative_offset_has_both_signs() {
    for (numbers, minimum) in [
        ("(0.1,-819.2) [0|819.2]", -819.2),
        ("(0.1,-819.2) [0|800]", 0.0),
        ("(1,-40) [0|215]", 0.0),
        ("(0.1,0) [0|819.2]", 0.0),
    ] {
        let db = parse(&format!("BO_ 1 A: 8 X\n SG_ S : 0|16@1+ {numbers} \"\" X\n")).unwrap();
        assert_eq!(db.signal("A.S").unwrap().1.layout.minimum, minimum, "{numbers}");
    }
}

#[test]
fn errors_state_their_line() {
    let line_and_text = |body: &str| {
        let error = parse(body).map_or_else(|error| error, |mut db| db.left_out.swap_remove(0));
        (error.line, error.to_string())
    };
    let (line, text) = line_and_text("BO_ 1 A: 8 X\n SG_ Broken : 0|8@1+ (1,0 [0|0] \"\" X\n");
    assert_eq!(line, 6, "{text}");
    assert!(text.contains("SG_ Broken"), "{text}");
    let (line, text) = line_and_text("BO_ 1 A: 8 X\nBO_ 4096 B: 8 X\n");
    assert_eq!((line, text.contains("4096")), (6, true));
    let (line, text) = line_and_text("BO_ 1 A: 8 X\nBO_ 2 A: 8 X\n");
    assert_eq!((line, text.contains("twice")), (6, true));
    let signal = " SG_ S m1 : 0|8@1+ (1,0) [0|0] \"\" X\n";
    let (line, text) = line_and_text(&format!("BO_ 1 A: 8 X\n{signal}"));
    assert_eq!((line, text.contains("no multiplexor")), (6, true));
    let (line, text) =
        line_and_text(&format!("BO_ 1 A: 8 X\n{}{}", signal.replace("m1 ", ""), signal.replace("m1 ", "")));
    assert_eq!((line, text.contains("A is left out: signal S is defined twice")), (7, true));
    for (numbers, found) in [
        ("(1e999,0) [0|0]", "factor inf"),
        ("(1,-1e999) [0|0]", "offset -inf"),
        ("(1,0) [-1e999|0]", "minimum -inf"),
        ("(1,0) [0|1e999]", "maximum inf"),
    ] {
        let (line, text) = line_and_text(&format!("BO_ 1 A: 8 X\n SG_ S : 0|8@1+ {numbers} \"\" X\n"));
        assert_eq!(
            (line, text.contains(&format!("A is left out: signal S: {found}, must be finite"))),
            (6, true),
            "{text}"
        );
    }
}

/// Parses a text with a valid message before and after `middle`, and checks both messages.
fn between_good_messages(middle: &str) -> Database {
    let good = |id: u32, name: &str| format!("BO_ {id} {name}: 8 X\n SG_ V : 0|8@1+ (1,0) [0|0] \"V\" X\n\n");
    let text = format!("{}{middle}{}CM_ SG_ 2 V \"two\nlines\";\n", good(1, "First"), good(2, "Last"));
    let db = parse(&text).unwrap();
    assert!(db.signal("First.V").is_some(), "{middle}");
    assert_eq!(db.signal("Last.V").unwrap().1.comment.as_deref(), Some("two\nlines"), "{middle}");
    db
}

#[test]
fn faulty_message_is_left_out_alone() {
    let signal = " SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n";
    let twice = format!("{signal}{signal}");
    for (middle, line, part) in [
        (format!("BO_ 316495015 Bad: 8 X\n{signal}"), 8, "message Bad is left out: identifier 316495015, must be"),
        (format!("BO_ 3758096385 Bad: 8 X\n{signal}"), 8, "message Bad is left out: identifier 3758096385, must be"),
        (format!("BO_ 99999999999999999999999 Bad: 8 X\n{signal}"), 8, "message Bad is left out: identifier 9999"),
        (format!("BO_ 3 Bad: 8 X\n{signal} SG_ T : 0|8@1+ (1,0 [0|0] \"\" X\n"), 10, "message Bad is left out: found"),
        (format!("BO_ 3 Bad 8 X\n{signal}"), 8, "message Bad is left out: found"),
        (format!("BO_ 3 Bad: 8 X\n{twice}"), 10, "message Bad is left out: signal S is defined twice"),
        (format!("BO_ 3 Last: 8 X\n{twice}"), 10, "message Last is left out: signal S is defined twice"),
        ("VAL_ 1 V 0 \"open ;\n".to_owned(), 8, "statement VAL_ is left out: found"),
    ] {
        let left_out = between_good_messages(&middle).left_out;
        assert_eq!((left_out.len(), left_out[0].line), (1, line), "{left_out:?}");
        assert!(left_out[0].what.starts_with(part), "{left_out:?}");
    }
}

#[test]
fn file_of_messages_without_usable_identifier_is_read_with_warnings() {
    let db = parse("BO_ 316495015 Bad: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n").unwrap();
    assert_eq!((db.messages.len(), db.left_out.len(), db.left_out[0].line), (0, 1, 5));
}

#[test]
fn second_message_of_one_name_is_left_out() {
    let db = between_good_messages("BO_ 3 First: 8 X\n SG_ Other : 0|8@1+ (1,0) [0|0] \"\" X\n");
    assert_eq!(db.message("First").unwrap().id, CanId::Standard(1));
    assert_eq!((db.left_out.len(), db.left_out[0].line), (1, 8), "{:?}", db.left_out);
}

#[test]
fn details_of_left_out_message_reach_no_other_message() {
    // The low 16 bits of this identifier equal the identifier of the message First.
    let bad = format!("BO_ {} Bad: 8 X\n SG_ V : 0|8@1+ (1,0) [0|0] \"\" X\n", 0x10001);
    let db = between_good_messages(&format!("{bad}CM_ SG_ {} V \"wrong\";\n", 0x10001));
    assert_eq!(db.signal("First.V").unwrap().1.comment, None);
}

#[test]
fn pseudo_message_is_skipped_without_warning() {
    for id in [0xC000_0000_u32, 0x4000_0000] {
        let pseudo = format!("BO_ {id} VECTOR__INDEPENDENT_SIG_MSG: 0 X\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n");
        let db = between_good_messages(&pseudo);
        assert_eq!((db.messages.len(), db.left_out), (2, vec![]));
    }
}

#[test]
fn long_list_of_left_out_messages_is_counted() {
    let db = between_good_messages(&"BO_ 4096 Bad: 8 X\n".repeat(MAX_LISTED + 5));
    assert_eq!(db.left_out.len(), MAX_LISTED + 1);
    assert_eq!(db.left_out[MAX_LISTED].what, "5 more messages or statements from here on are left out");
}

#[test]
fn cut_file_keeps_messages_before_cut() {
    let body = "BO_ 1 First: 8 X\n SG_ V : 0|8@1+ (1,0) [0|0] \"V\" X\nBO_ 2 Last: 8 X\n SG_ V : 0|8@1+ (1,0) [0|0";
    let db = parse(body).unwrap();
    assert_eq!((db.messages.len(), db.left_out.len(), db.left_out[0].line), (1, 1, 8), "{:?}", db.left_out);
}

#[test]
fn multiplexor_loops_are_rejected() {
    let db = parse(
        r#"BO_ 1 M: 8 X
 SG_ A m0M : 0|8@1+ (1,0) [0|0] "" X
 SG_ B m0M : 8|8@1+ (1,0) [0|0] "" X
SG_MUL_VAL_ 1 A B 0-0;
SG_MUL_VAL_ 1 B A 0-0;
"#,
    );
    assert!(db.unwrap().left_out[0].what.contains("in a loop"));
}

#[test]
fn latin_1_bytes_are_decoded() {
    let bytes = [HEAD.as_bytes(), b"BO_ 1 A: 8 X\n SG_ T : 0|8@1+ (1,0) [0|0] \"\xB0C\" X"].concat();
    let db = Database::parse_bytes(&bytes).unwrap();
    assert_eq!(db.signal("A.T").unwrap().1.unit, "\u{b0}C");
}

#[test]
fn arbitrary_text_never_panics() {
    let mut text = format!("{HEAD}BO_ 1 A: 8 X\n SG_ T M : 0|8@1+ (1,0) [0|0] \"\" X\nSG_MUL_VAL_ 1 T T 0-0;\n");
    assert_eq!(Database::parse(&text).unwrap().left_out.len(), 1, "a multiplexor that selects itself");
    while text.pop().is_some() {
        let _ = Database::parse(&text);
    }
    for bad in ["", "\u{feff}", "hello", "BO_", "BO_ 99999999999999999999 A: 8 X", "\0\0"] {
        let _ = Database::parse(bad);
    }
}

#[test]
fn utf_8_byte_order_mark_is_skipped_and_utf_16_rejected() {
    let text = format!("{HEAD}BO_ 256 M: 8 X\n SG_ T : 0|8@1+ (1,0) [0|0] \"\u{b0}C\" X\n");
    let marked = |bytes: Vec<u8>| Database::parse_bytes(&[b"\xEF\xBB\xBF", bytes.as_slice()].concat());
    let unit = |read: Result<Database, DbcError>| read.unwrap().signal("M.T").unwrap().1.unit.clone();
    let latin_1 = text.chars().map(|c| u8::try_from(u32::from(c)).unwrap()).collect();
    assert_eq!((unit(marked(text.clone().into_bytes())), unit(marked(latin_1))), ("\u{b0}C".into(), "\u{b0}C".into()));
    let utf_16: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
    let error = Database::parse_bytes(&utf_16).unwrap_err();
    assert!(error.line == 1 && error.what.starts_with("the file is UTF-16 text"), "{error}");
}
