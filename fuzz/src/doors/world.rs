//! Defines the configuration that the core's entry points share: three cells, protected inputs, all kinds of alarms,
//! commands, a J1939 node and diagnostic requests.

use std::io::{Error, ErrorKind};
use std::path::Path;
use std::sync::OnceLock;

use packwatch::config::{self, Config, ConfigFaults, ConfigFiles};

pub(super) const CELL: &str = include_str!("../../../config/cells/example_nmc_2600.toml");

pub(super) const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Status: 8 A
 SG_ Current : 16|16@1- (0.01,0) [-300|300] "A" A
 SG_ Temperature1 : 32|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Temperature2 : 40|8@1+ (1,-40) [-40|200] "degC" A
 SG_ Contactor : 48|4@1+ (1,0) [0|14] "" A
BO_ 257 Pack: 8 A
 SG_ Soc : 0|16@1+ (0.01,0) [0|120] "%" A
BO_ 272 Cells: 8 A
 SG_ Voltage1 : 0|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Voltage2 : 16|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Voltage3 : 32|16@1+ (0.0001,0) [0|5] "V" A
 SG_ Serial : 48|16@1+ (1,0) [0|0] "" A
"#;

pub(super) const PACK: &str = r#"
[pack]
cells = 3
cell_model = "cell.toml"
[[interface]]
name = "can0"
[input]
dbc = ["pack.dbc"]
[input.current]
signal = "Status.Current"
positive = "discharge"
[input.cell_voltage]
signal = "Cells.Voltage{n}"
[[input.temperature]]
signal = "Status.Temperature1"
cells = "1"
[[input.temperature]]
signal = "Status.Temperature2"
cells = "2-3"
[input.reported_soc]
signal = "Pack.Soc"
[limits.temperature]
max_age_s = 2.0
[transition]
min_duration_s = 5.0
[output]
[output.alarm]
period_ms = 500
[commands]
enabled = true
e2e = "1A"
data_id = 0x0321
"#;

const MORE: &str = r#"
[input.contactor]
signal = "Status.Contactor"
open = [0]
[input.pack_identity]
signal = "Cells.Serial"
accept_unprotected = true
[[input.protected]]
message = "Status"
profile = "1A"
data_id = 0x0123
[[input.diagnostic]]
name = "Bms"
request = 0x79B
response = 0x7BB
service = 0x21
identifier = 0x01
parked_every_s = 3
drive_every_s = 2
charge_every_s = 2
signals = [{ name = "Soh", bit = 0, length = 16, factor = 0.01, unit = "%", minimum = 0, maximum = 100 }]
[input.reported_soh]
signal = "Bms.Soh"
[poll]
enabled = true
[j1939]
address = 249
identity_number = 1234
manufacturer_code = 2047
[[alarm]]
rule = "cell_leak"
warning = 0.001
[[alarm]]
rule = "connection_resistance"
warning = 0.2
[[alarm]]
rule = "channel_faulty"
warning = 0.5
[[alarm]]
rule = "thermal_event"
severe = 0.5
[[alarm]]
rule = "capacity_low"
warning = 5.0
[[alarm]]
rule = "estimate_untrusted"
warning = 4
[[alarm]]
rule = "input_missing"
warning = 1
severe = 5
[[alarm]]
rule = "input_implausible"
warning = 0.3
debounce_s = 2
[[alarm]]
rule = "temperature_high"
warning = { set = 50, clear = 45 }
severe = 60
debounce_s = 1
latched = true
[[alarm]]
rule = "soc_low"
info = 0.5
warning = 0.2
[[alarm]]
rule = "cell_imbalance"
warning = 0.05
[[alarm]]
rule = "bms_disagrees"
warning = 0.1
[[alarm]]
rule = "bus_fault"
warning = 1
[[alarm]]
rule = "store_failed"
warning = 10
[[alarm]]
rule = "recharge_period_low"
info = 1000
"#;

pub(super) fn load(pack: &[u8], dbc: &str, cell: &[u8]) -> Result<Config, ConfigFaults> {
    let read = |path: &Path| match path.to_str() {
        Some("pack.toml") => Ok(pack.to_vec()),
        Some("pack.dbc") => Ok(dbc.as_bytes().to_vec()),
        Some("cell.toml") => Ok(cell.to_vec()),
        _ => Err(Error::from(ErrorKind::NotFound)),
    };
    config::load_with(&ConfigFiles::alone(Path::new("pack.toml")), &read)
}

pub(super) fn config() -> &'static Config {
    static CONFIG: OnceLock<Config> = OnceLock::new();
    let faults = |faults: ConfigFaults| panic!("{}", faults.0.join("\n"));
    CONFIG.get_or_init(|| load(format!("{PACK}{MORE}").as_bytes(), DBC, CELL.as_bytes()).unwrap_or_else(faults))
}
