//! Tests `[j1939]`: the resulting settings, and the full text of every fault.

use super::*;
use crate::can::j1939::{Lamp, NameFields};

/// A table `[j1939]`. Appended to `PACK`, it starts at line 15.
pub(super) const TABLE: &str = r#"[j1939]
address = 249
identity_number = 1234
manufacturer_code = 2047
"#;

const ALARMS: &str = r#"[[alarm]]
rule = "capacity_low"
warning = 1.5
[[alarm]]
rule = "capacity_low"
severe = 1.2
spn = 7000
[[alarm]]
rule = "recharge_period_low"
info = 1000
[[alarm]]
rule = "input_missing"
warning = 5
"#;

fn with(table: &str) -> String {
    format!("{PACK}{table}{ALARMS}")
}

fn with_key(from: &str, to: &str) -> String {
    assert!(TABLE.contains(from), "{from}");
    with(&TABLE.replacen(from, to, 1))
}

#[test]
fn table_defines_node_and_alarm_codes() {
    let (config, description) = read_texts(&with(TABLE), CELL, DBC).unwrap();
    let j1939 = config.monitor.j1939.as_ref().unwrap();
    let fields = NameFields {
        identity_number: 1234,
        manufacturer_code: 2047,
        function: 255,
        vehicle_system: 127,
        ..Default::default()
    };
    assert_eq!(j1939.node.name, crate::can::j1939::Name::new(&fields).unwrap());
    assert_eq!((j1939.node.address, j1939.bus), (249, BusIndex(0)));
    let codes: Vec<_> = j1939.alarms.iter().map(|alarm| (alarm.code.spn(), alarm.code.fmi(), alarm.lamp)).collect();
    let wanted =
        [(520_193, 18, Lamp::Amber), (7000, 1, Lamp::Red), (520_195, 17, Lamp::Protect), (520_196, 9, Lamp::Amber)];
    assert_eq!(codes, wanted);
    assert_eq!(
        description.j1939[..2],
        [
            "address 249 (F9) on can0, NAME 00FEFF00FFE004D2; DM1 18FECAF9 every second and on change, DM2 18FECBF9 on request",
            "capacity_low warning: SPN 520193, FMI 18, amber lamp",
        ]
    );
}

#[test]
fn node_needs_table_and_enabled_outputs() {
    assert_eq!(good(PACK).monitor.j1939, None);
    assert_eq!(good(&with(&format!("[output]\nenabled = false\n{TABLE}"))).monitor.j1939, None);
    assert!(good(&with(&format!("[output]\nenabled = true\n{TABLE}"))).monitor.j1939.is_some());
}

#[test]
fn out_of_range_numbers_are_rejected() {
    for (from, to, fault) in [
        ("address = 249", "address = 254", "pack.toml:16: j1939.address = 254, must be 0 to 253"),
        (
            "identity_number = 1234",
            "identity_number = 2097152",
            "pack.toml:17: j1939.identity_number = 2097152, must be 0 to 2097151",
        ),
        (
            "manufacturer_code = 2047",
            "manufacturer_code = 2048",
            "pack.toml:18: j1939.manufacturer_code = 2048, must be 0 to 2047",
        ),
        (
            "manufacturer_code = 2047\n",
            "",
            "pack.toml:15: j1939.manufacturer_code is missing, must be a whole number, 0 to 2047: Manufacturer code in the NAME, assigned by SAE",
        ),
        ("[j1939]\n", "[j1939]\necu_instance = 8\n", "pack.toml:16: j1939.ecu_instance = 8, must be 0 to 7"),
        (
            "[j1939]\n",
            "[j1939]\nfunction_instance = 32\n",
            "pack.toml:16: j1939.function_instance = 32, must be 0 to 31",
        ),
        ("[j1939]\n", "[j1939]\nvehicle_system = 128\n", "pack.toml:16: j1939.vehicle_system = 128, must be 0 to 127"),
        (
            "[j1939]\n",
            "[j1939]\nvehicle_system_instance = 16\n",
            "pack.toml:16: j1939.vehicle_system_instance = 16, must be 0 to 15",
        ),
        ("[j1939]\n", "[j1939]\nindustry_group = 8\n", "pack.toml:16: j1939.industry_group = 8, must be 0 to 7"),
        ("[j1939]\n", "[j1939]\nfunction = 256\n", "pack.toml:16: j1939.function = 256, must be 0 to 255"),
        ("[j1939]\n", "[j1939]\ninterface = \"can1\"\n", "pack.toml:16: j1939.interface = \"can1\", must be can0"),
        ("[j1939]\n", "[j1939]\nadress = 1\n", "pack.toml:16: j1939.adress is not a known key, did you mean address"),
    ] {
        assert_eq!(faults(&with_key(from, to)), [fault]);
    }
    let alarms = with(TABLE).replace("spn = 7000", "spn = 524288");
    assert_eq!(faults(&alarms), ["pack.toml:25: alarm[2].spn = 524288, must be 1 to 524287"]);
}

#[test]
fn node_needs_interface_if_several_exist() {
    let two = |key: &str| {
        let inputs = PACK
            .replace("[input]\n", "[[interface]]\nname = \"can1\"\n[input]\n")
            .replace("signal =", "interface = \"can1\"\nsignal =");
        format!("{inputs}{}{ALARMS}", TABLE.replacen("[j1939]\n", &format!("[j1939]\n{key}"), 1))
    };
    assert_eq!(faults(&two("")), ["pack.toml:20: j1939.interface is not set, must be can0 or can1"]);
    assert_eq!(good(&two("interface = \"can1\"\n")).monitor.j1939.unwrap().bus, BusIndex(1));
}

#[test]
fn alarm_code_without_node_is_rejected() {
    let fault = "pack.toml:21: alarm[2].spn = 7000, requires a table [j1939]; without it nothing is sent on J1939";
    assert_eq!(faults(&with("")), [fault]);
}

#[test]
fn two_rules_with_one_code_are_rejected() {
    let shared = with(TABLE).replace("spn = 7000\n", "").replace("info = 1000\n", "info = 1000\nspn = 520196\n");
    good(&shared); // the two alarms share a parameter number but have different failure modes
    let shared = shared.replace("info = 1000", "warning = 1000").replace("spn = 520196", "spn = 520193");
    let what = "must be unique per rule, but alarm[1] in line 19 has the same code with FMI 18 (warning)";
    assert_eq!(faults(&shared), [format!("pack.toml:28: alarm[3].spn = 520193, {what}")]);
}

#[test]
fn node_frames_must_not_collide_with_inputs_or_outputs() {
    let dbc = DBC
        .replace("BO_ 256 Status", &format!("BO_ {} Status", 0x8000_0000_u32 | 0x18FE_CAF9))
        .replace("VAL_ 256 Current", &format!("VAL_ {} Current", 0x8000_0000_u32 | 0x18FE_CAF9));
    let fault =
        "pack.toml:16: j1939.address = 249, must not be the source address of an input, but Status has 18FECAF9";
    assert_eq!(read_texts(&with(TABLE), CELL, &dbc).unwrap_err(), [fault]);
    let output = format!("[output]\n[output.status]\nextended = true\nid = 0x18EEFFF9\n{TABLE}");
    let fault = "pack.toml:20: j1939.address = 249, must not be the source address of a frame of [output], 18EEFFF9";
    assert_eq!(faults(&with(&output)), [fault]);
}
