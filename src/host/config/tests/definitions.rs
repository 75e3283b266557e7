//! Tests signal definitions of the kinds that real DBC files contain: a faulty message, J1939 source addresses, and a
//! current whose direction is in another signal.

use packwatch_core::can::decode::{GroupFrame, GroupSenders};

use super::*;

fn read(pack: &str, dbc: &str) -> Result<Config, Vec<String>> {
    read_texts(pack, CELL, dbc).map(|(config, _)| config)
}

#[test]
fn faulty_message_gives_warning_with_file_and_line() {
    let bad = "BO_ 316495015 Camera: 8 A\n SG_ X : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let config = read(PACK, &format!("{DBC}{bad}")).unwrap();
    let expected = "pack.dbc:18: message Camera is left out: identifier 316495015, must be 0 to 2047, or";
    assert!(config.warnings.iter().any(|warning| warning.starts_with(expected)), "{:?}", config.warnings);
    assert_eq!(config.monitor.input.bindings().len(), 6);
}

#[test]
fn signal_of_left_out_message_names_the_reason() {
    let faults = read(PACK, &DBC.replace("BO_ 272 ", "BO_ 4000 ")).unwrap_err();
    let [signal, reason] = &faults[..] else { unreachable!("{faults:?}") };
    assert!(
        signal.starts_with("pack.toml:12: input.cell_voltage.signal = \"Cells.CellVoltage{n}\", must be"),
        "{signal}"
    );
    assert!(reason.starts_with("pack.dbc:9: message Cells is left out: identifier 4000, must be"), "{reason}");
}

#[test]
fn faulty_message_of_output_dbc_is_fault() {
    let own = include_str!("../../../../config/packwatch.dbc").to_owned() + "BO_ 4096 Bad: 8 A\n";
    let text = PACK.to_owned() + "[output]\ndbc = \"twin.dbc\"\n";
    let names = [("pack.toml", text.as_str()), ("cell.toml", CELL), ("pack.dbc", DBC), ("twin.dbc", own.as_str())];
    let read = |path: &Path| {
        let found = names.iter().find(|(name, _)| path.to_str() == Some(name));
        found.map(|(_, text)| text.as_bytes().to_vec()).ok_or_else(|| std::io::ErrorKind::NotFound.into())
    };
    let faults = describe_with(&ConfigFiles::alone(Path::new("pack.toml")), &read).unwrap_err().0;
    assert!(faults.iter().any(|fault| fault.contains("twin.dbc:") && fault.contains("Bad is left out")), "{faults:?}");
}

fn j1939(format: &str) -> String {
    let dbc = DBC.replace("BO_ 256 ", "BO_ 2566869246 ").replace("BO_ 272 ", "BO_ 2566869502 ");
    let dbc = dbc.replace("VAL_ 256 ", "VAL_ 2566869246 ");
    let formats = "\"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"J1939PG\"";
    format!("{dbc}BA_DEF_ BO_ \"VFrameFormat\" ENUM {formats};\nBA_DEF_DEF_ \"VFrameFormat\" \"{format}\";\n")
}

/// Looks up the parameter group of a frame with the identifier `sent`. Returns the identifier under which the
/// configuration knows this group.
fn configured(config: &Config, sent: u32) -> u32 {
    let frame = Frame::classic(CanId::Extended(sent), &[0; 8]).unwrap();
    match config.monitor.input.groups().configured(
        crate::quantity::Timestamp::from_secs(0.0),
        BusIndex(0),
        &frame,
        &mut GroupSenders::default(),
    ) {
        GroupFrame::Configured(frame) => frame.id().raw(),
        GroupFrame::Other | GroupFrame::OfAnotherSender => sent,
    }
}

#[test]
fn frame_format_decides_about_source_address() {
    let by_group = read(PACK, &j1939("J1939PG")).unwrap();
    assert_eq!(configured(&by_group, 0x18FF_50F4), 0x18FF_50FE);
    assert_eq!(configured(&by_group, 0x18FF_51F4), 0x18FF_51FE);
    assert_eq!(configured(&by_group, 0x18FF_52F4), 0x18FF_52F4, "a group that is not configured");
    assert_eq!(by_group.monitor.wanted_patterns(BusIndex(0)).len(), 2);
    let exact = read(PACK, &j1939("ExtendedCAN")).unwrap();
    assert_eq!(configured(&exact, 0x18FF_50F4), 0x18FF_50F4);
    assert_eq!(exact.monitor.wanted_patterns(BusIndex(0)), []);
}

#[test]
fn source_address_key_overrides_frame_format() {
    let with = |key: &str| PACK.replace("[input]\n", &format!("[input]\nsource_address = \"{key}\"\n"));
    let any = read(&with("any"), &j1939("ExtendedCAN")).unwrap();
    assert_eq!(configured(&any, 0x18FF_50F4), 0x18FF_50FE);
    let exact = read(&with("exact"), &j1939("J1939PG")).unwrap();
    assert_eq!(configured(&exact, 0x18FF_50F4), 0x18FF_50F4);
    let faults = read(&with("all"), &j1939("J1939PG")).unwrap_err();
    assert!(faults[0].contains("input.source_address = \"all\", must be one of auto, any, exact"), "{faults:?}");
}

#[test]
fn messages_of_one_group_keep_their_source_address() {
    let second = "BO_ 2566869235 Other: 8 A\n SG_ X : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let config = read(PACK, &format!("{}{second}", j1939("J1939PG"))).unwrap();
    assert_eq!(configured(&config, 0x18FF_50F4), 0x18FF_50F4, "18FF50F3 may be another battery");
    assert_eq!(configured(&config, 0x18FF_51F4), 0x18FF_51FE);
}

fn magnitude() -> String {
    let signed = " SG_ Current : 0|16@1- (0.1,0) [-300|500] \"A\" A\n";
    let parts = " SG_ Current : 0|15@1+ (0.1,0) [0|500] \"A\" A\n SG_ Charging : 15|1@1+ (1,0) [0|1] \"\" A\n";
    DBC.replace(signed, parts).replace("VAL_ 256 Current -32768 \"not available\" ;\n", "")
}

fn with_sign(sign: &str) -> String {
    PACK.replace("positive = \"charge\"\n", &format!("sign = {sign}\n"))
}

#[test]
fn sign_key_reads_direction_of_magnitude() {
    let config = read(&with_sign("{ signal = \"Status.Charging\", charge = [1] }"), &magnitude()).unwrap();
    let input = &config.monitor.input;
    let direction = input.bindings().iter().find(|binding| binding.channel == Channel::CurrentDirection).unwrap();
    assert_eq!((direction.value(&[0, 0x80]), direction.value(&[0, 0])), (Ok(-1.0), Ok(1.0)));
    let sample = &config.monitor.sample;
    assert!(sample.direction.is_some());
    assert_eq!((sample.current.min, sample.current.max), (-500.0, 500.0), "the magnitude limits both directions");
    // `positive` changes nothing, because the current is a magnitude and its direction is in another signal.
    let both = with_sign("{ signal = \"Status.Charging\", charge = [1] }\npositive = \"charge\"");
    assert_eq!(read(&both, &magnitude()).unwrap().monitor.input, *input);
}

#[test]
fn bad_sign_is_reported() {
    let faults = |sign: &str| read(&with_sign(sign), &magnitude()).unwrap_err().join("\n");
    assert!(faults("{ signal = \"Status.Chargin\", charge = [1] }").contains("did you mean Status.Charging"));
    assert!(faults("{ signal = \"Status.Charging\" }").contains("input.current.sign.charge is missing"));
    assert!(faults("{ signal = \"Status.Charging\", charge = [] }").contains("input.current.sign.charge = []"));
    let missing = read(&PACK.replace("positive = \"charge\"\n", ""), DBC).unwrap_err();
    let expected = "pack.toml:8: input.current.positive is missing, must be charge or discharge";
    assert!(missing[0].starts_with(expected), "{missing:?}");
}
