//! Compares the predicted energy, time and power with measured drives, charges and pulses.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use packwatch::config;
use packwatch::monitor::PackView;
use packwatch::quantity::catalogue::{Estimate, Quantity};
use packwatch::quantity::{CellIndex, Channel, SensorIndex, Timestamp};
use packwatch::replay::MonitorDriver;

use crate::support::measured;

/// A row of a measured file. Some rows also have the monitor's pack view.
struct Row {
    cycle: u32,
    time_s: f64,
    current_a: f64,
    voltage_v: f64,
    pack: Option<PackView>,
}

impl Row {
    fn value(&self, quantity: Quantity) -> Option<Estimate> {
        self.pack.as_ref()?.values.get(quantity)
    }
}

fn fit(folder: &Path, args: &[&str]) -> PathBuf {
    let model = folder.join("model.toml");
    let files = args.iter().map(|word| if word.contains('/') { measured::path(word) } else { PathBuf::from(word) });
    let mut command = Command::cargo_bin("packwatch").unwrap();
    command.args(["fit", "--name", "cell", "-o"]).arg(&model).args(files).assert().success();
    model
}

/// Feeds a file to a monitor with the given model. `every_s`: time between two pack views (s).
fn run(model: &Path, more: &str, file: &str, cycles: u32, every_s: f64) -> Vec<Row> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let text = std::fs::read_to_string(root.join("score.toml")).unwrap();
    let text = text.replace("cells/example_nmc_2600.toml", &model.display().to_string());
    let text = text.replace("\"measured.dbc\"", &format!("\"{}\"", root.join("measured.dbc").display()));
    let path = model.with_file_name("pack.toml");
    std::fs::write(&path, format!("{text}\n[outlook]\n{more}\n")).unwrap();
    let mut driver = MonitorDriver::new(config::load(&path).unwrap().monitor, 1e9);
    driver.out.want_estimates = false;
    let file = flate2::read::MultiGzDecoder::new(std::fs::File::open(measured::path(file)).unwrap());
    let mut reader = csv::Reader::from_reader(file);
    let head = reader.headers().unwrap().clone();
    let column = |name: &str| head.iter().position(|found| found == name);
    let [time, current, voltage, temperature] =
        ["time_s", "current_a", "voltage_v", "temperature_c"].map(|name| column(name).unwrap());
    let (mut rows, mut base_s, mut latest_s, mut shown_s): (Vec<Row>, f64, f64, f64) = (Vec::new(), 0.0, -1.0, -1e9);
    for record in reader.records() {
        let record = record.unwrap();
        let number = |field: usize| record[field].parse::<f64>().unwrap_or(f64::NAN);
        let cycle = column("cycle").map_or(0, |field| record[field].parse().unwrap());
        if cycle >= cycles {
            break;
        }
        if rows.last().is_some_and(|row| row.cycle != cycle) {
            base_s = latest_s + 1.0;
        }
        let time_s = base_s + number(time);
        if time_s <= latest_s {
            continue;
        }
        latest_s = time_s;
        let (current_a, voltage_v) = (number(current), number(voltage));
        let values = [
            (Channel::Current, Some(current_a)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
            (Channel::Temperature(SensorIndex(0)), Some(number(temperature))),
        ];
        driver.handle_row(Timestamp::from_secs(1000.0 + time_s), &values);
        driver.out.clear();
        let pack = (time_s >= shown_s + every_s).then(|| driver.monitor.pack_view());
        shown_s = if pack.is_some() { time_s } else { shown_s };
        rows.push(Row { cycle, time_s, current_a, voltage_v, pack });
    }
    rows
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn share(values: &[bool]) -> f64 {
    values.iter().filter(|value| **value).count() as f64 / values.len() as f64
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn remaining_energy_agrees_with_measured_drives() {
    let folder = tempfile::tempdir().unwrap();
    let lg = |name: &str| format!("lg_18650hg2/{name}.csv.gz");
    let slow = ["40C/555", "25C/549", "10C/575", "0C/585", "n10C/593"].map(|name| lg(&format!("{name}_C20DisCh")));
    let drives = ["40C/556", "25C/551", "10C/567", "0C/589", "n10C/601"].map(|name| lg(&format!("{name}_Mixed1")));
    let mut args = vec!["--capacity", "2.781"];
    args.extend(slow.iter().flat_map(|file| ["--ocv", file]).chain(drives.iter().map(String::as_str)));
    let model = fit(folder.path(), &args);
    // Drive, and largest RMS error as a fraction of the full energy.
    for (drive, most) in [("25C/552_Mixed8", 0.05), ("10C/571_Mixed8", 0.07), ("0C/590_Mixed8", 0.08)] {
        let rows = run(&model, "", &lg(drive), 1, 60.0);
        let end = rows.iter().rposition(|row| row.current_a.abs() > 0.05).unwrap();
        let mut energy_wh = vec![0.0];
        for pair in rows.windows(2) {
            let seconds = (pair[1].time_s - pair[0].time_s).min(60.0);
            energy_wh.push(energy_wh.last().unwrap() + pair[0].voltage_v * pair[0].current_a * seconds / 3600.0);
        }
        let full_wh = energy_wh[end];
        let known = (0..end).filter(|&k| energy_wh[k] > 0.02 * full_wh);
        let known = known.filter_map(|k| Some((full_wh - energy_wh[k], rows[k].value(Quantity::RemainingEnergy)?)));
        let (errors, inside): (Vec<f64>, Vec<bool>) = known
            .map(|(truth, it)| ((it.mean - truth) / full_wh, (it.mean - truth).abs() < 1.96 * it.std.unwrap()))
            .unzip();
        let rms = (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
        println!("{drive}: RMS error {:.1} % of full, {:.0} % inside", 100.0 * rms, 100.0 * share(&inside));
        assert!(rms < most && share(&inside) >= 0.9, "{drive}: {rms} {}", share(&inside));
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn time_to_full_agrees_with_measured_charges() {
    let folder = tempfile::tempdir().unwrap();
    let model = fit(folder.path(), &["--first-cycles", "10", "nasa_pcoe_aging/B0006.csv.gz"]);
    let rows = run(&model, "", "nasa_pcoe_aging/B0006.csv.gz", 30, 30.0);
    let (mut errors, mut inside) = (Vec::new(), Vec::new());
    for charge in rows.chunk_by(|a, b| a.cycle == b.cycle) {
        // By default a charge is complete when the current falls to C/20.
        let is_held = |row: &&Row| row.voltage_v > 4.18 && -row.current_a > 0.1;
        let Some(end) = charge.iter().rposition(|row| is_held(&row)).filter(|end| end + 1 < charge.len()) else {
            continue;
        };
        for row in &charge[..end] {
            let Some(it) = row.value(Quantity::TimeToFull) else { continue };
            let truth_s = charge[end + 1].time_s - row.time_s;
            if row.value(Quantity::Soc).is_some_and(|soc| (0.2..0.8).contains(&soc.mean)) {
                errors.push(((it.mean - truth_s) / truth_s).abs());
                inside.push((it.mean - truth_s).abs() < 1.645 * it.std.unwrap());
            }
        }
    }
    let error = median(errors);
    println!("B0006: median error {:.1} %, {:.0} % inside 90 %", 100.0 * error, 100.0 * share(&inside));
    assert!(error < 0.15 && share(&inside) >= 0.85, "{error} {}", share(&inside));
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn power_agrees_with_measured_pulses() {
    let folder = tempfile::tempdir().unwrap();
    let files = ["25C/ocv_c20", "25C/hppc", "10C/hppc", "0C/hppc", "25C/Cycle_1"];
    let files = files.map(|name| format!("panasonic_18650pf/{name}.csv.gz"));
    let mut args = vec!["--capacity", "2.995", "--ocv"];
    args.extend(files.iter().map(String::as_str));
    let model = fit(folder.path(), &args);
    for (folder, most) in [("25C", 0.10), ("10C", 0.10)] {
        let rows = run(&model, "min_voltage_v = 2.8", &format!("panasonic_18650pf/{folder}/hppc.csv.gz"), 1, 5.0);
        let (mut errors, mut kept, mut latest) = (Vec::new(), Vec::new(), None);
        for (k, pair) in rows.windows(2).enumerate() {
            latest = pair[0].value(Quantity::DischargePower10s).or(latest);
            let begins =
                pair[0].current_a.abs() < 0.02 && pair[1].current_a > 0.3 && pair[1].time_s - pair[0].time_s < 5.0;
            let end = rows[k..].iter().take_while(|row| row.time_s < pair[1].time_s + 9.5).last();
            let (Some(it), Some(end), true) = (latest, end, begins) else { continue };
            let resistance_ohm = (pair[0].voltage_v - end.voltage_v) / end.current_a;
            let limit_a = (pair[0].voltage_v - 2.8) / resistance_ohm;
            // Only pulses near the current limit show the resistance at the limit.
            if end.current_a > 0.35 * limit_a {
                errors.push((it.mean / (2.8 * limit_a) - 1.0).abs());
                kept.push(it.mean - 1.645 * it.std.unwrap() <= 2.8 * limit_a);
            }
        }
        let (pulses, error) = (errors.len(), median(errors));
        println!(
            "{folder}: {pulses} pulses, median error {:.1} %, limit kept in {:.0} %",
            100.0 * error,
            100.0 * share(&kept)
        );
        assert!(pulses > 20 && error < most && share(&kept) >= 0.85, "{folder}: {error} {}", share(&kept));
    }
}
