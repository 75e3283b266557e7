//! Tests the conversion of small signal sets.

#![allow(clippy::unwrap_used, reason = "in a test a panic is the message")]

use super::*;

fn command(fields: &str, signals: &str) -> String {
    format!(r#"{{"hdr": "7E4", "rax": "7EC", "freq": 1, {fields}, "signals": [{signals}]}}"#)
}

fn signal(id: &str, fmt: &str) -> String {
    format!(r#"{{"id": "{id}", "name": "text", "fmt": {{{fmt}}}}}"#)
}

fn converted(commands: &[String], year: Option<i64>) -> ImportResult {
    let text = format!(r#"{{"commands": [{}]}}"#, commands.join(","));
    import(&text, &ObdbSettings { source: "own.json".to_owned(), year, name: None }).unwrap()
}

fn reasons(result: &ImportResult) -> Vec<ExclusionReason> {
    result.exclusions.iter().map(|exclusion| exclusion.reason).collect()
}

const VOLT: &str = r#""bix": 8, "len": 8, "max": 5.1, "div": 50, "unit": "volts""#;

#[test]
fn cells_of_several_answers_become_one_pattern() {
    let cells = |from: u32, to: u32| {
        let cell = |n: u32| {
            let fmt = format!(r#""bix": {}, "len": 8, "max": 5.1, "div": 50, "unit": "volts""#, 32 + 8 * (n - from));
            signal(&format!("X1_CMU{n:03}_VOLT"), &fmt)
        };
        (from..=to).map(cell).collect::<Vec<_>>().join(",")
    };
    let result = converted(
        &[command(r#""cmd": {"22": "0102"}"#, &cells(1, 32)), command(r#""cmd": {"22": "0103"}"#, &cells(33, 98))],
        None,
    );
    assert_eq!(result.signals, 98);
    for line in [
        "[[input.diagnostic]]\nname = \"X1\"\nrequest = 0x7E4\nresponse = 0x7EC\nservice = 0x22\nidentifier = 0x0102\n",
        "  { name = \"CMU{n}_VOLT\", numbers = \"1-32\", step = 8, bit = 32, length = 8, factor = 0.02, unit = \"V\" },\n",
        "  { name = \"CMU{n}_VOLT\", numbers = \"33-98\", step = 8, bit = 32, length = 8, factor = 0.02, unit = \"V\" },\n",
    ] {
        assert!(result.text.contains(line), "{line}\n{}", result.text);
    }
}

#[test]
fn series_ends_where_step_or_form_changes() {
    let signals = [
        signal("A_T1", r#""bix": 0, "len": 8, "max": 255, "unit": "celsius""#),
        signal("A_T2", r#""bix": 8, "len": 8, "max": 255, "unit": "celsius""#),
        signal("A_T3", r#""bix": 24, "len": 8, "max": 255, "unit": "celsius""#),
        signal("A_T4", r#""bix": 32, "len": 8, "max": 255, "unit": "celsius", "add": -40"#),
        signal("A_T6", r#""bix": 40, "len": 8, "max": 255, "unit": "celsius", "add": -40"#),
    ];
    let text = converted(&[command(r#""cmd": {"22": "0101"}"#, &signals.join(","))], None).text;
    assert!(text.contains("\"T{n}\", numbers = \"1-2\", step = 8, bit = 0"), "{text}");
    for alone in ["\"T3\", bit = 24", "\"T4\", bit = 32", "\"T6\", bit = 40"] {
        assert!(text.contains(alone), "{alone}\n{text}");
    }
}

#[test]
fn ranges_and_unavailable_values_are_kept() {
    let signals = [
        signal("A_FLAG", r#""bix": 7, "len": 1, "max": 1, "unit": "offon""#),
        signal("A_SOC", r#""bix": 8, "len": 24, "max": 100, "div": 8192, "add": -17, "unit": "percent""#),
        signal("A_T", r#""bix": 32, "len": 8, "min": -40, "max": 215, "add": -40, "nullmax": 214, "unit": "celsius""#),
        signal("A_ID", r#""bix": 40, "len": 8, "max": 255, "nullmax": 200, "unit": "scalar""#),
        signal(
            "A_I",
            r#""bix": 48, "len": 16, "sign": true, "blsb": true, "min": -230, "max": 230, "mul": -1, "div": 10, "unit": "amps""#,
        ),
        signal(
            "A_S",
            r#""bix": 64, "len": 8, "sign": true, "min": -128, "max": 127, "nullmin": -128, "unit": "fahrenheit""#,
        ),
    ];
    let text = converted(&[command(r#""cmd": {"21": "01"}"#, &signals.join(","))], None).text;
    for line in [
        "identifier = 0x01\n",
        "{ name = \"FLAG\", bit = 7, length = 1 }",
        "{ name = \"SOC\", bit = 8, length = 24, factor = 0.0001220703125, offset = -17, unit = \"%\", minimum = 0, maximum = 100 }",
        "{ name = \"T\", bit = 32, length = 8, offset = -40, unit = \"degC\", not_available = [254, 255] }",
        "{ name = \"ID\", bit = 40, length = 8, minimum = 0, maximum = 199 }",
        "{ name = \"I\", bit = 48, length = 16, signed = true, byte_order = \"little\", factor = -0.1, unit = \"A\", minimum = -230, maximum = 230 }",
        "{ name = \"S\", bit = 64, length = 8, signed = true, unit = \"degF\", not_available = [128] }",
    ] {
        assert!(text.contains(line), "{line}\n{text}");
    }
}

#[test]
fn commands_of_other_years_are_left_out() {
    let commands = [
        command(r#""cmd": {"22": "0001"}, "dbgfilter": {"to": 2001, "from": 2040}"#, &signal("A_ONE", VOLT)),
        command(r#""cmd": {"22": "0002"}, "filter": {"to": 2019}"#, &signal("A_TWO", VOLT)),
        command(r#""cmd": {"22": "0003"}, "filter": {"from": 2020, "to": 2022}"#, &signal("A_THREE", VOLT)),
        command(
            r#""cmd": {"22": "0004"}, "filter": {"from": 2030, "to": 2010, "years": [2021]}"#,
            &signal("A_FOUR", VOLT),
        ),
    ];
    let of_2021 = converted(&commands, Some(2021));
    assert_eq!(reasons(&of_2021), [ExclusionReason::OtherYear]);
    assert!(of_2021.exclusions[0].detail.contains("up to 2019"), "{:?}", of_2021.exclusions);
    assert_eq!(converted(&commands, Some(2029)).signals, 1, "only the one without years");
    assert_eq!(converted(&commands, None).signals, 4);
}

#[test]
fn unconvertible_parts_are_listed_and_the_rest_is_kept() {
    let first = [
        signal("A_GOOD", VOLT),
        signal("A_OVERLAP", r#""bix": 12, "len": 8, "max": 255, "unit": "volts""#),
        signal("A_NEGATIVE", r#""bix": -8, "len": 8, "max": 255, "unit": "volts""#),
        signal("A_LONG", r#""bix": 16, "len": 65, "max": 255, "unit": "volts""#),
        signal("A_FAR", r#""bix": 4294967296, "len": 8, "max": 255, "unit": "volts""#),
        signal("A_DIV", r#""bix": 16, "len": 8, "max": 255, "div": 0, "unit": "volts""#),
        signal("A_MAP", r#""bix": 16, "len": 8, "map": {"0": "OFF"}"#),
        signal("A_TEXT", r#""bix": 16, "len": 64, "max": 255, "unit": "ascii""#),
        signal("A_HALF", r#""bix": 20, "len": 16, "blsb": true, "max": 255, "unit": "volts""#),
        signal("A \\\"x", VOLT),
        r#"{"id": "A_NO_LEN", "fmt": {"bix": 16, "max": 1, "unit": "volts"}}"#.to_owned(),
        "17".to_owned(),
        signal("A_GOOD", r#""bix": 64, "len": 8, "max": 255, "unit": "volts""#),
        signal("A_NEW", r#""bix": 72, "len": 8, "max": 255, "unit": "volts", "colour": 1"#),
    ];
    let commands = [
        command(r#""cmd": {"22": "0001"}, "shade": 2"#, &first.join(",")),
        command(r#""cmd": {"22": "0001"}"#, &signal("A_AGAIN", VOLT)),
        command(r#""cmd": {"2E": "0001"}"#, &signal("A_WRITE", VOLT)),
        command(r#""cmd": {"22": "01"}"#, &signal("A_SHORT", VOLT)),
        command(r#""cmd": {"22": "0009"}, "proto": "9141-2""#, &signal("A_K", VOLT)),
        "{}".to_owned(),
        command(r#""cmd": {"22": "0009"}, "tst": "\n[output]""#, &signal("A_LINE", VOLT)).replace("7E4", "DA01"),
    ];
    let result = converted(&commands, None);
    use ExclusionReason::{Address, Duplicate, Enumeration, InvalidField, OtherService, Overlap, Text};
    let expected = [
        Overlap,
        InvalidField,
        InvalidField,
        InvalidField,
        InvalidField,
        Enumeration,
        Text,
        InvalidField,
        InvalidField,
        InvalidField,
        InvalidField,
        Duplicate,
        Duplicate,
        OtherService,
        InvalidField,
        Address,
        InvalidField,
        Address,
    ];
    assert_eq!(reasons(&result), expected, "{:#?}", result.exclusions);
    assert_eq!(result.signals, 2);
    assert_eq!(result.warnings.len(), 2, "{:?}", result.warnings);
    assert!(result.warnings[0].contains("commands[0] (7E4 22 0001): unknown field \"shade\""), "{:?}", result.warnings);
    assert!(result.exclusions[0].to_string().contains("signals[1] (A_OVERLAP): bits of another signal: bits 12 to 19"));
    assert!(result.text.parse::<toml::Table>().is_ok(), "{}", result.text);
    assert!(result.text.lines().filter(|line| line.contains("A_")).all(|line| line.starts_with("# ")));
}

#[test]
fn unsuitable_texts_are_rejected_with_their_place() {
    let fault = |text: &str| {
        import(text, &ObdbSettings { source: "own.json".to_owned(), ..ObdbSettings::default() })
            .unwrap_err()
            .to_string()
    };
    for (text, part) in [
        ("", "own.json:1:0"),
        ("[1]", "own.json:1:"),
        ("{\"commands\": [\n{", "own.json:2:"),
        ("{\"signals\": []}", "missing field `commands`"),
        ("{\"commands\": []}", "commands is empty"),
        ("{\"commands\": [{}]}", "commands[0]"),
    ] {
        assert!(fault(text).contains(part), "{text}: {}", fault(text));
    }
}

#[test]
fn names_are_kept_without_a_common_word() {
    let commands = [
        command(r#""cmd": {"22": "0001"}"#, &signal("A_ONE", VOLT)),
        command(r#""cmd": {"22": "0002"}"#, &signal("B_TWO", VOLT)),
    ];
    let text = converted(&commands, None).text;
    assert!(text.contains("name = \"Car\"") && text.contains("\"A_ONE\"") && text.contains("\"B_TWO\""), "{text}");
}

proptest::proptest! {
    #[test]
    fn any_format_gives_valid_toml(fmt in "(\"(bix|len|max|min|mul|div|add|nullmin|nullmax|unit)\": (-?[0-9]{1,5}|\"[a-z]{1,9}\"|true|1e300),){0,9}") {
        let fmt = format!("{fmt}\"sign\": false");
        let text = format!(r#"{{"commands": [{}]}}"#, command(r#""cmd": {"22": "0001"}"#, &signal("A_ONE", &fmt)));
        if let Ok(result) = import(&text, &ObdbSettings::default()) {
            proptest::prop_assert!(result.text.parse::<toml::Table>().is_ok(), "{}", result.text);
        }
    }
}
