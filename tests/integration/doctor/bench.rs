//! Creates healthy packs for the tests of `packwatch doctor`: configurations, DBC files and simulated logs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex};

use assert_cmd::Command;
use packwatch::replay::LogReading;
use packwatch::wiring::{WiringObserver, WiringReport};
use packwatch::wiring_check::{self, Interrupt};

/// A kind of healthy pack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Bench {
    /// 12 cells in a drive: current at 100 Hz, cells at 10 Hz.
    Pack12,
    /// 96 cells, the shipped example.
    Pack96,
    /// One cell, protected end to end.
    Protected,
    /// Only a temperature sensor and the total voltage of 96 cells.
    Total,
    /// One cell, discharged with random pulses; the voltage has 32 mV of noise.
    Pulses,
    /// One cell, discharged steadily.
    Steady,
    /// One cell, charged steadily.
    Charge,
    /// One cell with random five-minute loads.
    Walk,
    /// 4 cells in a drive of 55 minutes. The simulation ends while the car is parked.
    Day,
}

/// A message of 8 bytes: a profile 1A header, then the values of one cell.
const PROTECTED_DBC: &str = r#"VERSION ""
BU_: BMS
BO_ 256 MeasuredCell: 8 BMS
 SG_ Voltage : 16|16@1+ (0.0001,0) [0|6.5] "V" Vector__XXX
 SG_ Current : 32|16@1- (0.001,0) [-32|32] "A" Vector__XXX
 SG_ Temperature : 48|16@1- (0.01,0) [-100|200] "degC" Vector__XXX
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 1000;
"#;

fn shipped(name: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name)).unwrap()
}

/// `example.toml` with fewer cells and their temperature sensors.
fn fewer_cells(cells: usize) -> String {
    let text = shipped("example.toml");
    let (head, rest) = text.split_once("[[input.temperature]]").unwrap();
    let (_, tail) = rest.split_once("# If a sender protects").unwrap();
    let sensor = |n: usize| {
        let (first, last) = (8 * n + 1, (8 * n + 8).min(cells));
        format!("[[input.temperature]]\nsignal = \"Temperatures.Temperature{}\"\ncells = \"{first}-{last}\"\n", n + 1)
    };
    let sensors: String = (0..cells.div_ceil(8)).map(sensor).collect();
    format!("{head}{sensors}\n# If a sender protects{tail}").replace("cells = 96 ", &format!("cells = {cells} "))
}

fn total() -> String {
    let text = fewer_cells(96);
    let (head, rest) = text.split_once("[input.cell_voltage]").unwrap();
    let (_, tail) = rest.split_once("# If a sender protects").unwrap();
    let inputs = "[input.pack_voltage]\nsignal = \"PackStatus.PackVoltage\"\n\n[[input.temperature]]\nsignal = \"Temperatures.Temperature1\"\n";
    let head = head.replace("[input.cell_voltage]", "");
    // Remove the parts that need individual cell voltages.
    let (before, rest) = tail.split_once("[[alarm]]\nrule = \"cell_imbalance\"").unwrap();
    let (_, after) = rest.split_once("\n[[alarm]]").unwrap();
    format!("{head}{inputs}\n# If a sender protects{before}[[alarm]]{after}")
}

fn protected() -> String {
    let table =
        "[[input.protected]]\nmessage = \"MeasuredCell\"\nprofile = \"1A\"\ndata_id = 0x123\n\n[limits.current]";
    shipped("paper.toml").replacen("[limits.current]", table, 1)
}

impl Bench {
    pub(crate) fn config(self) -> String {
        match self {
            Self::Pack12 => fewer_cells(12),
            Self::Day => fewer_cells(4),
            Self::Pack96 => shipped("example.toml"),
            Self::Total => total(),
            Self::Protected => protected(),
            Self::Pulses | Self::Walk => shipped("measured.toml"),
            Self::Steady | Self::Charge => shipped("paper.toml"),
        }
    }

    pub(crate) fn dbc_name(self) -> &'static str {
        match self {
            Self::Pack12 | Self::Pack96 | Self::Total | Self::Day => "pack96.dbc",
            _ => "measured.dbc",
        }
    }

    pub(crate) fn dbc(self) -> String {
        match self {
            Self::Protected => PROTECTED_DBC.to_owned(),
            // Match the cycle time in the DBC to the simulated period.
            Self::Day => shipped("pack96.dbc").replace("BO_ 256 10;", "BO_ 256 100;"),
            _ => shipped(self.dbc_name()),
        }
    }

    fn simulation(self) -> &'static [&'static str] {
        match self {
            Self::Pack12 => &["ev-day", "--duration", "100"],
            Self::Pack96 => &["ev-day", "--duration", "70"],
            Self::Total => &["ev-day", "--duration", "100"],
            Self::Day => &[
                "ev-day",
                "--duration",
                "14000",
                "--period",
                "100",
                "--cell-period",
                "200",
                "--noise-temperature",
                "0.05",
            ],
            Self::Protected => &["reference", "--duration", "400", "--noise-voltage", "0.002"],
            Self::Pulses => &["reference", "--duration", "700"],
            Self::Steady => &["paper", "--duration", "600"],
            Self::Charge => &["paper", "--duration", "600", "--initial-soc", "0.3"],
            Self::Walk => &["random-walk", "--duration", "2400"],
        }
    }
}

static LOGS: LazyLock<Mutex<BTreeMap<(Bench, u64), String>>> = LazyLock::new(Mutex::default);

/// The healthy log, simulated once per bench and seed.
fn log(bench: Bench, seed: u64) -> String {
    let mut logs = LOGS.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let made = logs.entry((bench, seed)).or_insert_with(|| {
        let folder = tempfile::tempdir().unwrap();
        let broken =
            BrokenPack { bench, config: bench.config(), dbc: bench.dbc(), log: String::new(), extra: Vec::new() };
        let config = broken.write(folder.path());
        let mut command = Command::cargo_bin("packwatch").unwrap();
        command.arg("simulate").args(bench.simulation()).arg("-c").arg(config).args([
            "-o",
            "-",
            "--seed",
            &seed.to_string(),
        ]);
        String::from_utf8(command.assert().success().get_output().stdout.clone()).unwrap()
    });
    made.clone()
}

/// A pack into which a test puts a fault.
#[derive(Debug, Clone)]
pub(crate) struct BrokenPack {
    pub(crate) bench: Bench,
    pub(crate) config: String,
    pub(crate) dbc: String,
    pub(crate) log: String,
    /// Further files in the configuration's folder.
    pub(crate) extra: Vec<(&'static str, String)>,
}

impl BrokenPack {
    pub(crate) fn of(bench: Bench, seed: u64) -> Self {
        Self { bench, config: bench.config(), dbc: bench.dbc(), log: log(bench, seed), extra: Vec::new() }
    }

    /// Replaces a text in the configuration. The text must exist.
    pub(crate) fn config(&mut self, from: &str, to: &str) {
        assert!(self.config.contains(from), "{:?} does not contain {from}", self.bench);
        self.config = self.config.replace(from, to);
    }

    /// Adds keys to a table.
    pub(crate) fn table(&mut self, table: &str, keys: &str) {
        self.config(&format!("{table}\n"), &format!("{table}\n{keys}\n"));
    }

    pub(crate) fn dbc(&mut self, from: &str, to: &str) {
        assert!(self.dbc.contains(from), "{:?} does not contain {from}", self.bench);
        self.dbc = self.dbc.replace(from, to);
    }

    /// Changes every frame. `change` receives (stamp, interface, identifier, data) and returns the new line; `None`
    /// removes the frame.
    pub(crate) fn frames(&mut self, mut change: impl FnMut(&str, &str, &str, &str) -> Option<String>) {
        let line = |line: &str| {
            let mut words = line.split(' ');
            let (stamp, interface, frame) = (words.next()?, words.next()?, words.next()?);
            let (id, data) = frame.split_once('#')?;
            change(stamp, interface, id, data)
        };
        let lines: Vec<String> = self.log.lines().filter_map(line).collect();
        self.log = lines.join("\n") + "\n";
    }

    /// Changes the data bytes of an identifier's frames.
    pub(crate) fn data(&mut self, wanted: &str, mut change: impl FnMut(&mut Vec<u8>)) {
        self.frames(|stamp, interface, id, data| {
            if id != wanted {
                return Some(format!("{stamp} {interface} {id}#{data}"));
            }
            let mut bytes: Vec<u8> =
                (0..data.len() / 2).map(|n| u8::from_str_radix(&data[2 * n..2 * n + 2], 16).unwrap()).collect();
            change(&mut bytes);
            let hex: String = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
            Some(format!("{stamp} {interface} {id}#{hex}"))
        });
    }

    /// Writes all files. Returns the configuration's path.
    pub(crate) fn write(&self, folder: &Path) -> PathBuf {
        std::fs::create_dir_all(folder.join("cells")).unwrap();
        for cell in ["example_nmc_2600", "nasa_b0005"] {
            let name = format!("cells/{cell}.toml");
            std::fs::write(folder.join(&name), shipped(&name)).unwrap();
        }
        for (name, text) in &self.extra {
            std::fs::write(folder.join(name), text).unwrap();
        }
        std::fs::write(folder.join(self.bench.dbc_name()), &self.dbc).unwrap();
        std::fs::write(folder.join("pack.log"), &self.log).unwrap();
        let path = folder.join("pack.toml");
        std::fs::write(&path, &self.config).unwrap();
        path
    }

    /// A doctor that has not received any frame yet.
    pub(crate) fn doctor(&self) -> WiringObserver {
        let folder = tempfile::tempdir().unwrap();
        WiringObserver::new(wiring_check::survey(&self.write(folder.path())).unwrap().plan)
    }

    /// The doctor's report.
    pub(crate) fn report(&self) -> WiringReport {
        let folder = tempfile::tempdir().unwrap();
        let path = self.write(folder.path());
        let survey = wiring_check::survey(&path).unwrap();
        let logs = [folder.path().join("pack.log")];
        let (report, _) =
            wiring_check::replay(&survey, &logs, &LogReading::default(), None, &Interrupt::default(), &mut |_| {})
                .unwrap();
        report
    }
}
