//! Tests tables in the formats of cyclers and applications. They must give the same estimates as a table in packwatch's
//! own format. A table with a wrong unit must be rejected.

mod exports;

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use exports::{Sample, all, drive, plain};
use packwatch::config::{self, Config};
use packwatch::io::log::{LogCounts, LogSource};
use packwatch::monitor::{Estimate, Monitor};
use packwatch::replay::{self, LogReading, ReplaySettings, Sinks};

fn configuration(folder: &Path, cells: usize) -> Config {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let signals: String =
        (1..=cells).map(|n| format!(" SG_ Cell{n} : {}|16@1+ (0.0001,0) [0|6.5] \"V\" X\n", 16 * (n - 1))).collect();
    let dbc = format!(
        "VERSION \"\"\nNS_ :\nBS_:\nBU_: X\nBO_ 256 Pack: 8 X\n SG_ Current : 0|32@1- (0.0001,0) [-2000|2000] \"A\" X\n \
         SG_ Temperature : 32|16@1- (0.01,0) [-273|327] \"degC\" X\nBO_ 257 Cells: 8 X\n{signals}"
    );
    std::fs::write(folder.join("pack.dbc"), dbc).unwrap();
    let cell = if cells == 1 { "Cells.Cell1" } else { "Cells.Cell{n}" };
    let text = format!(
        "[pack]\ncells = {cells}\ncell_model = {:?}\nambient_c = 25.0\n[[interface]]\nname = \"can0\"\n[input]\ndbc = \
         [\"pack.dbc\"]\n[input.current]\nsignal = \"Pack.Current\"\npositive = \"discharge\"\n[input.cell_voltage]\n\
         signal = \"{cell}\"\n[[input.temperature]]\nsignal = \"Pack.Temperature\"\n[limits.current]\nmax_discharge_a = \
         2000.0\nmax_charge_a = 2000.0\n",
        root.join("config/cells/example_nmc_2600.toml")
    );
    let path = folder.join("pack.toml");
    std::fs::write(&path, text).unwrap();
    config::load(&path).unwrap_or_else(|error| panic!("{error}"))
}

struct Bench {
    folder: tempfile::TempDir,
    config: Config,
}

impl Bench {
    fn new(cells: usize) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let config = configuration(folder.path(), cells);
        Self { folder, config }
    }

    fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }

    fn replay(&self, path: &Path, columns: &[(&str, &str)]) -> Result<(Vec<Estimate>, LogCounts), String> {
        let columns = columns.iter().map(|(role, name)| ((*role).to_owned(), (*name).to_owned())).collect();
        let reading = LogReading { columns, ..LogReading::default() };
        let mut source = LogSource::new([path.to_owned()], reading.options(&self.config));
        let estimates = Rc::new(RefCell::new(Vec::new()));
        let sink = Rc::clone(&estimates);
        let outputs = Box::new(move |out: &packwatch::monitor::Outputs| {
            sink.borrow_mut().extend(out.estimates.iter().copied());
        });
        let sinks = Sinks { outputs: Some(outputs), ..Sinks::default() };
        let settings = ReplaySettings::plain(30.0, self.config.interface_names());
        let monitor = Monitor::new(self.config.monitor.clone());
        replay::run(&mut source, monitor, sinks, settings, &mut |_| ()).map_err(|error| error.to_string())?;
        let counts = source.counts().clone();
        Ok((estimates.take(), counts))
    }
}

/// Compares estimates. The origins of their clocks may differ.
fn compare(name: &str, found: &[Estimate], expected: &[Estimate]) {
    assert_eq!(found.len(), expected.len(), "{name}: number of estimates");
    let (begin, origin) = (found[0].time, expected[0].time);
    for (found, expected) in found.iter().zip(expected) {
        let late_ns = (found.time.nanos() - begin.nanos()) - (expected.time.nanos() - origin.nanos());
        assert!(late_ns.abs() < 100_000, "{name}: time {late_ns} ns off");
        let pairs = [
            (found.measured.current_a, expected.measured.current_a),
            (found.measured.voltage_v, expected.measured.voltage_v),
            (found.measured.temperature_c, expected.measured.temperature_c),
            (found.soc, expected.soc),
            (found.soc_std, expected.soc_std),
        ];
        assert!(pairs.iter().all(|(a, b)| (a - b).abs() < 1e-5), "{name}: {found:?}, must be {expected:?}");
    }
}

#[test]
fn exports_of_cyclers_give_estimates_of_plain_table() {
    let (bench, rows) = (Bench::new(1), drive());
    let [without, with] = [false, true].map(|has_temperature| {
        let path = bench.file("plain.csv", &plain(&rows, has_temperature));
        bench.replay(&path, &[]).expect("reads").0
    });
    assert_eq!(with.len(), rows.len());
    let exports = all(&rows);
    for export in &exports {
        let path = bench.file(export.file, &export.bytes);
        let (found, counts) = bench.replay(&path, &[]).unwrap_or_else(|error| panic!("{}: {error}", export.name));
        eprintln!("{}: {}", export.name, counts.tables[0]);
        assert_eq!((counts.bad_lines, counts.tables.len()), (0, 1), "{}: {:?}", export.name, counts.first_bad_line);
        compare(export.name, &found, if export.has_temperature { &with } else { &without });
    }
    assert!(exports.len() >= 25);
}

/// The table `time_s,current_a,voltage_v` with each value multiplied by a factor.
fn scaled(rows: &[Sample], head: &str, factors: [f64; 3]) -> Vec<u8> {
    let mut text = format!("{head}\n");
    for row in rows {
        let values = [f64::from(row.second), f64::from(row.current_ma) / 1000.0, f64::from(row.voltage_mv) / 1000.0];
        let fields: Vec<String> =
            values.iter().zip(factors).map(|(value, factor)| (value * factor).to_string()).collect();
        text += &format!("{}\n", fields.join(","));
    }
    text.into_bytes()
}

#[test]
fn values_in_wrong_unit_are_refused_by_name() {
    let (bench, rows) = (Bench::new(1), drive());
    let own = "time_s,current_a,voltage_v";
    let magnitude: Vec<Sample> = rows.iter().map(|row| Sample { current_ma: row.current_ma.abs(), ..*row }).collect();
    let since_1970: Vec<u8> = {
        let row = |row: &Sample| {
            format!("{},{},{}\n", 1_700_000_000_000_i64 + 1000 * i64::from(row.second), row.current_ma, row.voltage_mv)
        };
        format!("time_s,current_ma,voltage_mv\n{}", rows.iter().map(row).collect::<String>()).into_bytes()
    };
    for (name, bytes, columns, expected) in [
        ("mA", scaled(&rows, own, [1.0, 1000.0, 1.0]), &[][..], "probably mA"),
        ("A as mA", scaled(&rows, "time_s,current_ma,voltage_v", [1.0; 3]), &[], "probably A"),
        ("mV", scaled(&rows, own, [1.0, 1.0, 1000.0]), &[], "probably mV"),
        ("V as mV", scaled(&rows, "time_s,current_a,voltage_mv", [1.0; 3]), &[], "probably V"),
        ("ms", scaled(&rows, own, [1000.0, 1.0, 1.0]), &[], "probably ms"),
        ("ns", scaled(&rows, own, [1e9, 1.0, 1.0]), &[], "probably ns"),
        ("ms since 1970", since_1970, &[], "probably ms"),
        ("magnitude", scaled(&magnitude, own, [1.0; 3]), &[], "the current is never negative"),
        ("wrong column", scaled(&rows, own, [1.0; 3]), &[("current", "voltage_v")], "cannot be the current"),
        (
            "unknown unit",
            scaled(&rows, "time_s,Current (furlong),voltage_v", [1.0; 3]),
            &[],
            "unknown unit \"furlong\"",
        ),
        (
            "unknown unit in a row",
            scaled(&rows, "Time,Current,Voltage\ns,furlong,V", [1.0; 3]),
            &[],
            "unknown unit \"furlong\"",
        ),
        ("constant time", scaled(&rows, own, [0.0, 1.0, 1.0]), &[], "less than 1 us per row"),
        ("less than a microsecond", scaled(&rows, own, [1e-8, 1.0, 1.0]), &[], "less than 1 us per row"),
        ("no cell", scaled(&rows, own, [1.0, 1.0, 0.05]), &[], "half of the readings are below"),
        (
            "unknown header",
            scaled(&rows, "time_s,stroom,voltage_v", [1.0; 3]),
            &[],
            "no column for current, found time_s,stroom,voltage_v; name it with --column current=NAME",
        ),
    ] {
        let path = bench.file("x.csv", &bytes);
        let error = bench.replay(&path, columns).err().unwrap_or_else(|| panic!("{name}: read without an error"));
        eprintln!("{name}: {error}");
        assert!(error.contains(expected) && error.contains("x.csv:1: "), "{name}: {error}");
    }
    // Times in minutes could also be seconds, so the table is read and a remark is printed.
    let path = bench.file("x.csv", &scaled(&rows, own, [1.0 / 60.0, 1.0, 1.0]));
    let (_, counts) = bench.replay(&path, &[]).expect("reads");
    assert!(counts.tables[0].to_string().contains("advances like min"), "{}", counts.tables[0]);
    // If the temperatures are impossible, only their column is left out.
    let text = String::from_utf8(plain(&rows, true)).unwrap().replace(",25\n", ",850\n");
    let (_, counts) = bench.replay(&bench.file("x.csv", text.as_bytes()), &[]).expect("reads");
    assert!(counts.tables[0].to_string().contains("temperature_c is left out: 850"), "{}", counts.tables[0]);
}

#[test]
fn stated_seconds_draw_no_remark() {
    let (bench, rows) = (Bench::new(1), drive());
    for (step_s, wobble_s) in [(0.1, 0.0), (0.1, 0.003), (0.5, 0.0), (0.5, 0.02), (1.0, 0.03), (60.0, 0.0), (60.0, 0.4)]
    {
        let row = |(n, s): (usize, &Sample)| {
            let time_s = n as f64 * step_s + wobble_s * (n as f64 * 2.4).sin().abs();
            format!("{time_s:.3},{},{}\n", f64::from(s.current_ma) / 1000.0, f64::from(s.voltage_mv) / 1000.0)
        };
        let text =
            format!("time_s,current_a,voltage_v\n{}", rows.iter().take(300).enumerate().map(row).collect::<String>());
        let (_, counts) = bench.replay(&bench.file("x.csv", text.as_bytes()), &[]).expect("reads");
        assert!(!counts.tables[0].to_string().contains("--column"), "{step_s} s: {}", counts.tables[0]);
    }
}

#[test]
fn damaged_time_costs_its_row() {
    let (bench, rows) = (Bench::new(1), drive());
    for damaged in ["99999999999999", "x", "5", "9000000", "-7"] {
        let text = String::from_utf8(plain(&rows, false)).unwrap().replace("\n300,", &format!("\n{damaged},"));
        let (found, counts) = bench.replay(&bench.file("x.csv", text.as_bytes()), &[]).expect("reads");
        assert_eq!((counts.bad_lines, counts.time_backwards), (1, 0), "{damaged}");
        assert!(
            counts.first_bad_line.is_some_and(|bad| bad.contains("x.csv:302: column time_s: found"))
                && found.len() >= 899
        );
    }
}

#[test]
fn user_names_unit_of_column() {
    let (bench, rows) = (Bench::new(1), drive());
    let expected = bench.replay(&bench.file("plain.csv", &plain(&rows, false)), &[]).expect("reads").0;
    let path = bench.file("x.csv", &scaled(&rows, "a,b,c", [1.0 / 60.0, 1000.0, 1000.0]));
    let columns = [("time", "a[min]"), ("current", "b[mA]"), ("voltage", "c[mV]")];
    let (found, _) = bench.replay(&path, &columns).expect("reads");
    compare("named columns", &found, &expected);
    let wrong = bench.replay(&path, &[("time", "a[min]"), ("current", "b[mV]"), ("voltage", "c[mV]")]);
    assert!(wrong.is_err_and(|error| error.contains("b is in mV, so it cannot be the current")));
}

type Row<'a> = &'a dyn Fn(&Sample) -> String;

#[test]
fn cells_of_applications_are_read_by_number() {
    let (bench, rows) = (Bench::new(2), drive());
    let cells = |head: &str, row: &dyn Fn(&Sample) -> String| {
        format!("{head}\n{}", rows.iter().map(|sample| row(sample) + "\n").collect::<String>()).into_bytes()
    };
    let volt = |mv: i32| f64::from(mv) / 1000.0;
    let own = cells("time_s,current_a,voltage1_v,voltage2_v", &|s| {
        format!("{},{},{},{}", s.second, volt(s.current_ma), volt(s.voltage_mv), volt(s.voltage_mv - 7))
    });
    let expected = bench.replay(&bench.file("own.csv", &own), &[]).expect("reads").0;
    let in_mv = |s: &Sample| format!("{},{},{},{}", s.second, volt(s.current_ma), s.voltage_mv, s.voltage_mv - 7);
    let in_v =
        |s: &Sample| format!("{},{},{},{}", s.second, volt(s.current_ma), volt(s.voltage_mv), volt(s.voltage_mv - 7));
    let row: [(&str, &str, Row<'_>); 6] = [
        ("LeafSpy", "epoch time,Pack Amps,CP1,CP2", &in_mv),
        ("cells in mV by size", "Time (s),Current (A),V1,V2", &in_mv),
        ("V1", "Time (s),Current (A),V1,V2", &in_v),
        ("Cell 01 (mV)", "Time (s),Current (A),Cell 01 (mV),Cell 02 (mV)", &in_mv),
        ("cell_0", "time,current,cell_0,cell_1", &in_v),
        ("Cell Voltage 1", "Time [s],Current [A],Cell Voltage 1 [V],Cell Voltage 2 [V]", &in_v),
    ];
    for (name, head, row) in row {
        let path = bench.file("cells.csv", &cells(head, row));
        let (found, _) = bench.replay(&path, &[]).unwrap_or_else(|error| panic!("{name}: {error}"));
        compare(name, &found, &expected);
    }
    let path = bench.file("cells.csv", &cells("time,current,V1,V2,V3", &|s| in_v(s) + ",3.7"));
    assert!(bench.replay(&path, &[]).is_err_and(|error| error.contains("3 columns of cell voltages, must be 2")));
}

#[test]
fn control_bytes_of_header_are_escaped() {
    let bench = Bench::new(1);
    let path = bench.file("x.csv", "time_s,\u{1b}[31mred\u{7},\u{202e}voltage\n0,1,2\n".as_bytes());
    let error = bench.replay(&path, &[]).expect_err("no current");
    assert!(!error.chars().any(|c| c.is_control() || c == '\u{202e}'), "{error:?}");
    assert!(error.contains("\\u{1b}[31mred"), "{error}");
    let path = bench.file("x.csv", "time_s\u{7},Current\u{1b}[31m (A),voltage_v\n0,1,3.7\n1,1,3.7\n".as_bytes());
    let columns = [("time", "time_s\\u{7}"), ("current", "Current\\u{1b}[31m (A)")];
    let said = bench.replay(&path, &columns).expect("reads").1.tables[0].to_string();
    assert!(!said.chars().any(char::is_control), "{said:?}");
}

#[test]
fn single_impossible_current_is_refused_alone() {
    let (bench, rows) = (Bench::new(1), drive());
    let mut text = String::from_utf8(plain(&rows, false)).unwrap();
    text += "900,65535,3.7\n901,0,3.7\n";
    let (_, counts) = bench.replay(&bench.file("x.csv", text.as_bytes()), &[]).expect("reads");
    let said = counts.tables[0].to_string();
    assert_eq!((counts.tables[0].refused_currents, counts.bad_lines), (1, 0));
    assert!(said.contains("99.8 % of 902 rows accepted, 1 currents refused (beyond 260 A"), "{said}");
}

#[cfg(feature = "lab")]
fn parquet(path: &Path, names: [&str; 3], rows: &[[f64; 3]]) {
    use parquet::data_type::DoubleType;
    let fields: String = names.iter().map(|name| format!("required double {name}; ")).collect();
    let schema = parquet::schema::parser::parse_message_type(&format!("message m {{ {fields} }}")).unwrap();
    let file = std::fs::File::create(path).unwrap();
    let mut writer = parquet::file::writer::SerializedFileWriter::new(file, schema.into(), Default::default()).unwrap();
    let mut group = writer.next_row_group().unwrap();
    let mut index = 0;
    while let Some(mut column) = group.next_column().unwrap() {
        let values: Vec<f64> = rows.iter().map(|row| row[index]).collect();
        column.typed::<DoubleType>().write_batch(&values, None, None).unwrap();
        column.close().unwrap();
        index += 1;
    }
    group.close().unwrap();
    writer.close().unwrap();
}

#[test]
#[cfg(feature = "lab")]
fn parquet_gives_estimates_of_plain_table() {
    let (bench, rows) = (Bench::new(1), drive());
    let expected = bench.replay(&bench.file("plain.csv", &plain(&rows, false)), &[]).expect("reads").0;
    let path = bench.folder.path().join("drive.parquet");
    let values: Vec<[f64; 3]> = rows
        .iter()
        .map(|s| [f64::from(s.second), f64::from(-s.current_ma), f64::from(s.voltage_mv) / 1000.0])
        .collect();
    parquet(&path, ["test_time_second", "current_milliampere", "voltage_volt"], &values);
    let (found, _) = bench.replay(&path, &[]).expect("reads");
    compare("Parquet", &found, &expected);
    // A truncated file must give an error, not a panic.
    let whole = std::fs::read(&path).unwrap();
    for length in [4, 100, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        assert!(bench.replay(&path, &[]).is_err_and(|error| error.contains("Parquet")));
    }
}
