//! Tests `[[input.protected]]`: the resulting settings, and the full text of every fault.

use super::*;
use crate::can::e2e::CheckConfig;
use crate::can::guard::GuardConfig;

const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 16|16@1- (0.1,0) [-300|500] "A" A
 SG_ Low : 12|4@1+ (1,0) [0|0] "" A
 SG_ Temperature : 32|8@1+ (1,-40) [-40|100] "degC" A
BO_ 272 Cells: 8 A
 SG_ Page M : 8|8@1+ (1,0) [0|1] "" A
 SG_ Voltage1 m0 : 31|16@0+ (0.001,0) [0|0] "V" A
 SG_ Voltage2 m1 : 31|16@0+ (0.001,0) [0|0] "V" A
BO_ 288 Short: 2 A
 SG_ Temperature : 12|4@1+ (1,0) [0|0] "degC" A
BO_ 289 Long: 48 A
 SG_ Current : 100|16@1- (0.1,0) [0|0] "A" A
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 60000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 100;
"#;

/// A valid configuration of 15 lines.
const PACK: &str = r#"[pack]
cells = 2
cell_model = "cell.toml"
[[interface]]
name = "can0"
fd = true
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "charge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature"
"#;

fn read(pack: &str) -> Result<(Config, Description), Vec<String>> {
    read_texts(pack, CELL, DBC)
}

fn protected(table: &str) -> String {
    format!("{PACK}[[input.protected]]\n{table}")
}

fn faults(pack: &str) -> Vec<String> {
    read(pack).unwrap_err()
}

#[test]
fn guard_uses_cycle_time_of_dbc() {
    let (config, _) = read(&protected("message = \"Status\"\nprofile = \"1A\"\ndata_id = 0x0123\n")).unwrap();
    let protection = Protection { profile: Profile::P01A, data_id: 0x0123 };
    let guard = GuardConfig {
        bus: BusIndex(0),
        id: CanId::Standard(0x100),
        check: CheckConfig::new(protection),
        cycle_time_s: Some(0.1),
    };
    assert_eq!(config.monitor.guards, [guard], "the defaults are those of the check");
    assert_eq!(config.monitor.flood, crate::can::flood::FloodConfig::default(), "the frame limit has its default");
    let keys = "max_delta_counter = 3\nmax_repeated = 2\nsync_counter = 4\n";
    let (config, _) =
        read(&protected(&format!("message = \"Status\"\nprofile = \"1C\"\ndata_id = 7\n{keys}"))).unwrap();
    let check = config.monitor.guards[0].check;
    let counters = (check.max_delta_counter_init, check.max_no_new_or_repeated_data, check.sync_counter_init);
    assert_eq!((check.protection.profile, counters), (Profile::P01C, (3, 2, 4)));
}

#[test]
fn check_lists_protected_messages() {
    let (_, description) = read(&protected("message = \"Status\"\nprofile = \"1A\"\ndata_id = 0x0123\n")).unwrap();
    assert_eq!(
        description.intake,
        [
            "at most 2000 frames a second of one identifier, a tenth of them at once",
            "commands of other ECUs are not executed",
            "Status (100 on can0): end-to-end protected, profile 1A, data id 0x0123, allowed lost frames in a row: 1, a missing frame is counted every 100 ms"
        ]
    );
    let (_, description) = read(PACK).unwrap();
    assert!(description.intake[1].starts_with("no end-to-end protection"), "{:?}", description.intake);
}

#[test]
fn protection_faults_are_reported() {
    let table: &[(&str, &str)] = &[
        (
            "message = \"Stats\"\nprofile = \"1A\"\ndata_id = 1\n",
            "pack.toml:17: input.protected[1].message = \"Stats\", must be a message with a configured signal on this interface (Cells, Status), did you mean Status",
        ),
        (
            "message = \"Short\"\nprofile = \"1A\"\ndata_id = 1\n",
            "pack.toml:17: input.protected[1].message = \"Short\", must be a message with a configured signal on this interface (Cells, Status)",
        ),
        (
            "message = \"Status\"\nprofile = \"2\"\ndata_id = 1\n",
            "pack.toml:18: input.protected[1].profile = \"2\", must be one of 1A, 1C, 5",
        ),
        (
            "message = \"Status\"\nprofile = \"1A\"\ndata_id = 65536\n",
            "pack.toml:19: input.protected[1].data_id = 65536, must be 0 to 65535",
        ),
        (
            "message = \"Status\"\nprofile = \"1C\"\ndata_id = 0x1000\n",
            "pack.toml:19: input.protected[1].data_id = 0x1000, must be 0 to 0xFFF with profile \"1C\"",
        ),
        (
            "message = \"Status\"\nprofile = \"1C\"\ndata_id = 1\nmax_delta_counter = 15\n",
            "pack.toml:20: input.protected[1].max_delta_counter = 15, must be 0 to 14 with profile \"1C\"",
        ),
        (
            "message = \"Status\"\nprofile = \"1C\"\n",
            "pack.toml:16: input.protected[1].data_id is missing, must be a whole number, 0 to 65535: Data identifier agreed with the sender; at most 0xFFF for \"1C\"",
        ),
        (
            "message = \"Status\"\nprofile = \"1A\"\ndata_id = 1\ninterface = \"can1\"\n",
            "pack.toml:20: input.protected[1].interface = \"can1\", must be can0",
        ),
        (
            "message = \"Status\"\nprofile = \"5\"\ndata_id = 1\n",
            "pack.toml:18: input.protected[1].profile = \"5\", inputs must not overlap bytes 0 to 2, which profile \"5\" uses: Status.Current does",
        ),
        (
            "message = \"Cells\"\nprofile = \"1C\"\ndata_id = 1\n",
            "pack.toml:18: input.protected[1].profile = \"1C\", inputs must not overlap bytes 0 and 1, which profile \"1C\" uses: Cells.Page does",
        ),
        (
            "message = \"Status\"\nprofile = \"1A\"\ndata_id = 1\n[[input.protected]]\nmessage = \"Status\"\nprofile = \"1A\"\ndata_id = 2\n",
            "pack.toml:21: input.protected[2].message = \"Status\", must be listed once, but is also in line 17",
        ),
    ];
    for (text, fault) in table {
        assert_eq!(faults(&protected(text)), [*fault]);
    }
    let rate = PACK.replace("[\"pack.dbc\"]", "[\"pack.dbc\"]\nmax_frames_per_s = 5");
    assert_eq!(faults(&rate), ["pack.toml:9: input.max_frames_per_s = 5, must be 10 to 1000000"]);
}

#[test]
fn profile_1a_leaves_upper_nibble_of_byte_1_free() {
    let pack =
        protected("message = \"Status\"\nprofile = \"1A\"\ndata_id = 1\n").replace("Status.Temp", "Status.Low\" #");
    assert!(read(&pack).is_ok(), "{:?}", read(&pack).err());
    let fault = &faults(&pack.replace("\"1A\"", "\"1C\""))[0];
    assert!(fault.ends_with("which profile \"1C\" uses: Status.Low does"), "{fault}");
}

#[test]
fn message_length_must_fit_profile() {
    let pack = protected("message = \"Short\"\nprofile = \"5\"\ndata_id = 1\n");
    let all = faults(&pack.replace("Status.Temperature", "Short.Temperature"));
    assert_eq!(
        all[0],
        "pack.toml:17: input.protected[1].message = \"Short\", must have 3 to 64 bytes with profile \"5\", but has 2 in pack.dbc"
    );
    let pack = protected("message = \"Long\"\nprofile = \"1A\"\ndata_id = 1\n");
    assert_eq!(
        faults(&pack.replace("Status.Current", "Long.Current")),
        [
            "pack.toml:17: input.protected[1].message = \"Long\", must have 2 to 30 bytes with profile \"1A\", but has 48 in pack.dbc"
        ]
    );
}

#[test]
fn table_needs_interface_if_several_exist() {
    let pack = protected("message = \"Status\"\nprofile = \"1A\"\ndata_id = 1\n")
        .replace("[input]", "[[interface]]\nname = \"can1\"\n[input]");
    let pack = pack.replace("positive = \"charge\"", "positive = \"charge\"\ninterface = \"can0\"");
    let pack = pack.replace("Voltage{n}\"", "Voltage{n}\"\ninterface = \"can0\"");
    let pack = pack.replace("Status.Temperature\"", "Status.Temperature\"\ninterface = \"can0\"");
    assert_eq!(faults(&pack), ["pack.toml:21: input.protected[1].interface is not set, must be can0 or can1"]);
    let on_the_other = format!("{pack}interface = \"can1\"\n");
    assert_eq!(
        faults(&on_the_other),
        [
            "pack.toml:22: input.protected[1].message = \"Status\", must be a message with a configured signal on this interface (there is none)"
        ]
    );
    assert_eq!(read(&format!("{pack}interface = \"can0\"\n")).unwrap().0.monitor.guards.len(), 1);
}

#[test]
fn missing_signal_causes_no_protection_fault() {
    let pack = protected("message = \"Status\"\nprofile = \"1A\"\ndata_id = 1\n")
        .replace("signal = \"Status.", "signal = \"Stats.");
    assert!(faults(&pack).iter().all(|fault| !fault.contains("protected")), "{:?}", faults(&pack));
}

#[test]
fn pack_identity_must_be_protected_or_accepted() {
    let identity = "[input.pack_identity]\nsignal = \"Status.Low\"\n";
    let open = format!("{PACK}{identity}");
    assert_eq!(
        faults(&open),
        [
            "pack.toml:17: input.pack_identity.signal = \"Status.Low\", must be in a message of [[input.protected]] if accept_unprotected is not true: forged frames of Status would set aside all learned values"
        ]
    );
    assert!(read(&format!("{open}accept_unprotected = true\n")).is_ok());
    assert!(read(&format!("{open}[[input.protected]]\nmessage = \"Status\"\nprofile = \"1A\"\ndata_id = 1\n")).is_ok());
}
