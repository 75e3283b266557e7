//! Tests valid syntax with implausible contents, and compares the full text of every fault and warning.

use super::*;

const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 6 A
 SG_ Current : 0|16@1- (0.1,0) [-300|500] "A" A
 SG_ Total : 16|16@1+ (0.1,0) [0|100] "V" A
 SG_ Temperature : 32|8@1+ (1,-40) [-40|100] "degC" A
 SG_ Spare : 40|8@1+ (1,0) [0|0] "" A
BO_ 272 Cells: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|1] "" A
 SG_ Cell1 m0 : 8|16@1+ (0.001,0) [0|5] "V" A
 SG_ Cell2 m0 : 24|16@1+ (0.001,0) [0|5] "V" A
 SG_ Cell3 m1 : 8|16@1+ (0.001,0) [0|5] "V" A
 SG_ Cell4 m1 : 24|16@1+ (0.001,0) [0|5] "V" A
"#;

/// A valid configuration of 14 lines.
const PACK: &str = r#"[pack]
cells = 4
cell_model = "cell.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "charge"
[input.cell_voltage]
signal = "Cells.Cell{n}"
[[input.temperature]]
signal = "Status.Temperature"
"#;

fn read(pack: &[(&str, &str)], dbc: &[(&str, &str)]) -> Result<(Config, Description), Vec<String>> {
    let replaced = |text: &str, edits: &[(&str, &str)]| {
        edits.iter().fold(text.to_owned(), |text, (from, to)| {
            assert!(text.contains(from), "{from}");
            text.replace(from, to)
        })
    };
    read_texts(&replaced(PACK, pack), CELL, &replaced(DBC, dbc))
}

fn faults(pack: &[(&str, &str)], dbc: &[(&str, &str)]) -> Vec<String> {
    read(pack, dbc).expect_err("the configuration must have a fault")
}

fn warnings(pack: &[(&str, &str)], dbc: &[(&str, &str)]) -> Vec<String> {
    read(pack, dbc).unwrap().0.warnings
}

#[test]
fn unchanged_file_is_valid() {
    assert_eq!(warnings(&[], &[]), [""; 0]);
}

#[test]
fn signal_beyond_message_end_is_rejected() {
    let fault = "pack.toml:14: input.temperature[1].signal = \"Status.Temperature\", Status.Temperature ends in byte 7 of \
                 its message, must end within the 6 bytes stated in pack.dbc";
    assert_eq!(faults(&[], &[("32|8@1+ (1,-40)", "41|8@1+ (1,-40)")]), [fault]);
    let selector = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", Cells.Page ends in byte 9 of its message, \
                    must end within the 8 bytes stated in pack.dbc";
    assert_eq!(faults(&[], &[("Page M : 0|8", "Page M : 64|8")]), [selector]);
}

#[test]
fn many_signals_beyond_message_end_suggest_byte_order() {
    let fault = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", Cells.Cell2 and 1 other end in byte 9 of \
                 their message, must end within the 8 bytes stated in pack.dbc; with the other byte order (@1) they would fit";
    assert_eq!(faults(&[], &[("24|16@1+", "48|16@0+")]), [fault]);
}

#[test]
fn empty_range_from_any_source_is_rejected() {
    let fault = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", Cells.Cell1 and 3 others in pack.dbc cannot be \
                 read: range is [1.35|0.1], the first must not be above the second";
    assert_eq!(faults(&[], &[("[0|5]", "[1.35|0.1]")]), [fault]);
    let limits = |keys: &str| {
        let pack = format!("Status.Temperature\"\n{keys}");
        faults(&[("Status.Temperature\"\n", &pack)], &[])
    };
    assert_eq!(
        limits("[limits.voltage]\nmax_v = 0.1\n"),
        ["pack.toml:16: limits.voltage.max_v = 0.1, must be above 1.25 V, the smallest plausible value of the DBC or \
          the cell model"]
    );
    assert_eq!(
        limits("[limits.voltage]\nmin_v = 6\n"),
        ["pack.toml:16: limits.voltage.min_v = 6, must be below 4.7 V, the largest plausible value of the DBC or the \
          cell model"]
    );
    assert_eq!(
        limits("[limits.temperature]\nmax_c = -50\n"),
        ["pack.toml:16: limits.temperature.max_c = -50, must be above -40 degrees C, the smallest plausible value of \
          the DBC"]
    );
}

#[test]
fn dbc_range_empty_after_scaling_is_rejected() {
    let mv = [("(0.001,0) [0|5] \"V\"", "(0.1,0) [0|5] \"mV\"")];
    let fault = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", the DBC's range is 0 to 0.005 V after scale, \
                 must contain plausible values (set [limits.voltage] to override it)";
    assert_eq!(faults(&[("Cell{n}\"\n", "Cell{n}\"\nscale = 0.001\n")], &mv), [fault]);
}

#[test]
fn limits_must_include_cell_model_voltages() {
    let keys = "Status.Temperature\"\n[limits.voltage]\nmin_v = 0.1\nmax_v = 1.35\n";
    let fault =
        "pack.toml:17: limits.voltage.max_v = 1.35, allows 0.1 to 1.35 V, must overlap the cell model's 2.5 to 4.2 V";
    assert_eq!(faults(&[("Status.Temperature\"\n", keys)], &[]), [fault]);
}

#[test]
fn unconverted_unit_suggests_scale() {
    let table: &[(&str, &str, &[&str])] = &[
        (
            "(0.001,0) [0|5] \"V\"",
            "(1,0) [0|0] \"mV\"",
            &[
                "pack.toml:11: input.cell_voltage.scale is not set, must be 0.001: the unit of Cells.Cell1 is \"mV\" (set 1.0 if the DBC is wrong and the unit is V)",
            ],
        ),
        (
            "\"A\"",
            "\"mA\"",
            &[
                "pack.toml:8: input.current.scale is not set, must be 0.001: the unit of Status.Current is \"mA\" (set 1.0 if the DBC is wrong and the unit is A)",
            ],
        ),
        (
            "(1,-40) [-40|100] \"degC\"",
            "(1.5,0) [0|0] \"K\"",
            &[
                "pack.toml:13: input.temperature[1].offset is not set, must be -273.15: the unit of Status.Temperature is \
               \"K\" (set 0.0 if the DBC is wrong and the unit is degrees C)",
            ],
        ),
        (
            "\"degC\"",
            "\"F\"",
            &[
                "pack.toml:13: input.temperature[1].scale is not set, must be 0.5555555556, with offset = -17.77777778: the \
               unit of Status.Temperature is \"F\" (set 1.0 if the DBC is wrong and the unit is degrees C)",
            ],
        ),
        (
            "\"degC\"",
            "\"Deg\"",
            &["pack.toml:14: input.temperature[1].signal = \"Status.Temperature\", the unit of Status.Temperature is \
               \"Deg\", an angle, must be degrees C (set scale = 1.0 if the DBC is wrong)"],
        ),
        (
            "[0|5] \"V\"",
            "[0|5] \"A\"",
            &[
                "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", the unit of Cells.Cell1 is \"A\", a current, \
               must be V (set scale = 1.0 if the DBC is wrong)",
            ],
        ),
    ];
    for (from, to, expected) in table {
        assert_eq!(faults(&[], &[(from, to)]), *expected, "{to}");
    }
}

#[test]
fn reported_soc_must_be_a_fraction() {
    let with_soc = ("[[input.temperature]]", "[input.reported_soc]\nsignal = \"Status.Spare\"\n[[input.temperature]]");
    let spare = |unit: &str| ("(1,0) [0|0] \"\" A\nBO_ 272".to_owned(), format!("(1,0) [0|0] \"{unit}\" A\nBO_ 272"));
    let (from, percent) = spare("%");
    assert_eq!(warnings(&[with_soc], &[(&from, &percent)]), [""; 0]);
    let (from, volt) = spare("V");
    let fault = "pack.toml:14: input.reported_soc.signal = \"Status.Spare\", the unit of Status.Spare is \"V\", a voltage, must \
                 be % or a fraction (set scale = 1.0 if the DBC is wrong)";
    assert_eq!(faults(&[with_soc], &[(&from, &volt)]), [fault]);
}

#[test]
fn explicit_scale_overrides_unit_with_warning() {
    let mv = [("(0.001,0) [0|5] \"V\"", "(1,0) [0|0] \"mV\"")];
    assert_eq!(warnings(&[("Cell{n}\"\n", "Cell{n}\"\nscale = 0.001\n")], &mv), [""; 0]);
    let warning =
        "pack.toml:13: input.cell_voltage.scale = 0.01, should be 0.001 according to the unit \"mV\" of Cells.Cell1";
    assert_eq!(warnings(&[("Cell{n}\"\n", "Cell{n}\"\nscale = 0.01\n")], &mv), [warning]);
    let kelvin = [("(1,-40) [-40|100] \"degC\"", "(1.5,0) [0|0] \"K\"")];
    let offset = |offset: &str| {
        warnings(&[("Status.Temperature\"\n", &format!("Status.Temperature\"\noffset = {offset}\n"))], &kelvin)
    };
    assert_eq!((offset("-273.15").len(), offset("-272.5").len(), offset("-100").len()), (0, 0, 1));
    let shunt = [("\"A\"", "\"mV\"")];
    let warning = "pack.toml:11: input.current.scale = 12.5, the unit of Status.Current is \"mV\", a voltage, where A is \
                   expected";
    assert_eq!(warnings(&[("\"charge\"\n", "\"charge\"\nscale = 12.5\n")], &shunt), [warning]);
}

#[test]
fn unit_without_plausible_values_is_rejected() {
    let mislabelled = [("[0|5] \"V\"", "[0|0] \"mV\"")];
    let warning = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", the unit of Cells.Cell1 is \"mV\", but its bits cannot carry a plausible value in that unit: read as V";
    assert_eq!(warnings(&[], &mislabelled), [warning]);
    let fault = "pack.toml:13: input.cell_voltage.scale = 0.001, Cells.Cell1 can carry only 0 to 0.06553 V after factor and scale, must overlap 2.5 to 4.2 V";
    assert_eq!(faults(&[("Cell{n}\"\n", "Cell{n}\"\nscale = 0.001\n")], &mislabelled), [fault]);
}

#[test]
fn inputs_share_bits_only_on_different_multiplexer_pages() {
    let fault = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", Cells.Cell1 and Cells.Cell2 share bits of one message, must not overlap";
    assert_eq!(faults(&[], &[("Cell2 m0 : 24|16", "Cell2 m0 : 16|16")]), [fault]);
    assert_eq!(faults(&[], &[("Cell2 m0 : 24|16", "Cell2 m0 : 8|16")]), [fault], "both signals use the same bits");
    let across = "pack.toml:14: input.temperature[1].signal = \"Status.Temperature\", Status.Current and \
                  Status.Temperature share bits of one message, must not overlap";
    assert_eq!(faults(&[], &[("32|8@1+ (1,-40)", "15|8@0+ (1,-40)")]), [across]);
    let page = "pack.toml:12: input.cell_voltage.signal = \"Cells.Cell{n}\", Cells.Page and Cells.Cell1 (and 1 other pair) \
                share bits of one message, must not overlap";
    assert_eq!(faults(&[], &[("8|16@1+ (0.001", "4|16@1+ (0.001")]), [page]);
}

#[test]
fn rated_capacity_must_fit_cell_model() {
    let rated = |ah: &str, strings: &str| {
        vec![("cells = 4".to_owned(), format!("cells = 4\nstrings = {strings}\nrated_capacity_ah = {ah}"))]
    };
    let read_rated = |ah: &str, strings: &str| {
        let edits = rated(ah, strings);
        let edits: Vec<(&str, &str)> = edits.iter().map(|(from, to)| (from.as_str(), to.as_str())).collect();
        read(&edits, &[]).map(|(config, _)| config.warnings)
    };
    let fault = "pack.toml:4: pack.rated_capacity_ah = 60, is 30 times the 2 Ah of the cell model \"test\", must be the capacity of one cell of this model, 0.6667 to 6 Ah";
    assert_eq!(
        read_rated("60", "1").unwrap_err(),
        [format!("{fault}; for 30 cells in parallel set strings = 30 and remove this key")]
    );
    assert_eq!(
        read_rated("7", "1").unwrap_err(),
        [
            "pack.toml:4: pack.rated_capacity_ah = 7, is 3.5 times the 2 Ah of the cell model \"test\", must be the capacity of one cell of this model, 0.6667 to 6 Ah; no number of parallel cells explains it"
        ]
    );
    assert_eq!(
        read_rated("60", "30").unwrap_err(),
        [format!("{fault}; it seems to be the capacity of all 30 strings together")]
    );
    assert_eq!(read_rated("0.5", "1").unwrap_err().len(), 1);
    assert_eq!(
        read_rated("4", "1").unwrap(),
        [
            "pack.toml:4: pack.rated_capacity_ah = 4, is 2 times the 2 Ah of the cell model \"test\": SOH starts at 47.5 %, \
          and the resistances are for a cell of 2 Ah; for 2 cells in parallel set strings = 2 and remove this key"
        ]
    );
    assert_eq!(read_rated("2.1", "1").unwrap(), [""; 0]);
}

#[test]
fn missing_interface_does_not_hide_other_faults() {
    let second = ("name = \"can0\"", "name = \"can0\"\n[[interface]]\nname = \"can1\"");
    let wanted = "pack.toml:10: input.current.interface is not set, must be can0 or can1";
    for broken in [("positive = \"charge\"\n", ""), ("\"charge\"", "\"in\""), ("signal = \"Status.Current\"\n", "")] {
        let all = faults(&[second, broken], &[]);
        assert!(all.iter().any(|fault| fault == wanted) && all.len() == 4, "{all:#?}");
    }
    let absent = faults(&[second, ("[input.current]\nsignal = \"Status.Current\"\npositive = \"charge\"\n", "")], &[]);
    let wanted = "pack.toml:8: input.current.interface is missing, must be can0 or can1";
    assert!(absent.iter().any(|fault| fault == wanted), "{absent:#?}");
    let unnamed = faults(&[second, ("name = \"can1\"", "nam = \"can1\"")], &[]);
    let wanted = "pack.toml:10: input.current.interface is not set, must be the name of one of 2 interfaces";
    assert!(unnamed.iter().any(|fault| fault == wanted), "{unnamed:#?}");
}

#[test]
fn misspelt_signal_does_not_hide_faults_of_its_table() {
    let all = faults(&[("positive = \"charge\"\n", ""), ("Status.Current", "Status.Curent")], &[]);
    assert_eq!(all.len(), 2, "{all:#?}");
    assert!(all[1].contains("did you mean Status.Current"), "{all:#?}");
}

#[test]
fn byte_order_mark_is_skipped_utf_16_rejected() {
    let read_bytes = |dbc: Vec<u8>| {
        let read = |path: &Path| match path.to_str() {
            Some("pack.toml") => Ok(PACK.as_bytes().to_vec()),
            Some("cell.toml") => Ok(CELL.as_bytes().to_vec()),
            _ => Ok(dbc.clone()),
        };
        let files = ConfigFiles { main: "pack.toml".into(), drop_ins: vec![] };
        describe_with(&files, &read).map(|_| ()).map_err(|faults| faults.0)
    };
    let marked = |bytes: &[u8]| [b"\xEF\xBB\xBF", bytes].concat();
    assert_eq!(read_bytes(marked(DBC.as_bytes())), Ok(()));
    let latin_1: Vec<u8> = DBC.replace("degC", "\u{b0}C").chars().map(|c| c as u8).collect();
    assert_eq!(read_bytes(marked(&latin_1)), Ok(()), "a byte order mark before Latin-1 text is skipped");
    let utf_16: Vec<u8> = "\u{feff}".chars().chain(DBC.chars()).flat_map(|c| (c as u16).to_le_bytes()).collect();
    let fault = "pack.dbc:1: the file is UTF-16 text, must be UTF-8 or Latin-1: save it in one of these encodings";
    for text in [utf_16.clone(), utf_16[2..].to_vec()] {
        assert_eq!(read_bytes(text), Err(vec![fault.to_owned()]));
    }
}

#[test]
fn shared_bits_in_answers_are_rejected() {
    let answer = |keys: &str| {
        format!(
            "{}\n[[input.diagnostic]]\nname = \"Car\"\nrequest = 0x7E4\nresponse = 0x7EC\nservice = 0x22\nidentifier = 1\n\
             signals = [{{ name = \"Cell{{n}}\", numbers = \"1-4\", bit = 32, length = 8, factor = 0.02{keys} }}]\n",
            PACK.replace("Cells.Cell{n}", "Car.Cell{n}")
        )
    };
    assert!(read_texts(&answer(""), CELL, DBC).is_ok(), "each signal begins at the first bit of its own byte");
    let fault = "pack.toml:12: input.cell_voltage.signal = \"Car.Cell{n}\", Car.Cell1 and Car.Cell2 (and 2 other pairs) share bits of one message, must not overlap";
    assert_eq!(read_texts(&answer(", step = 4"), CELL, DBC).unwrap_err(), [fault]);
    let unit = "pack.toml:11: input.cell_voltage.scale is not set, must be 0.001: the unit of Car.Cell1 is \"mV\" (set 1.0 if the DBC is wrong and the unit is V)";
    let all = read_texts(&answer(", unit = \"mV\"").replace("0.02", "20.0"), CELL, DBC).unwrap_err();
    assert_eq!(all, [unit]);
}
