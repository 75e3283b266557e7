//! Tests the sample stage on a measured life (NASA B0005) with uneven time steps and glitches. It must reject exactly
//! the glitches, and each cycle's charge must match the data set's table.

use std::collections::BTreeMap;
use std::path::Path;

use packwatch::quantity::{CellIndex, Channel, Reading, SensorIndex, Timestamp};
use packwatch::sample::{CellSample, Limits, SampleConfig, Sampler, VoltageSource};

fn config() -> SampleConfig {
    let limits = |min, max| Limits { min, max, max_rate_per_s: None, stuck_after_s: None, max_age_s: 60.0 };
    SampleConfig {
        voltage_noise_v: 0.005,
        cells: 1,
        voltage_source: VoltageSource::Cells,
        strings: 1,
        current: limits(-10.0, 10.0),
        voltage: Limits { stuck_after_s: Some(120.0), ..limits(1.5, 4.5) },
        temperature: limits(-40.0, 85.0),
        reported_soc: None,
        reported_soh: None,
        direction: None,
        contactor: None,
        sensor_of_cell: vec![Some(SensorIndex(0))],
        ambient_c: 24.0,
    }
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn measured_life_loses_only_glitches() {
    let folder = crate::support::measured::path("nasa_pcoe_aging");
    let mut sampler = Sampler::new(config());
    let (mut changes, mut refused) = (Vec::new(), Vec::new());
    let mut charges_ah: BTreeMap<u32, (f64, f64)> = BTreeMap::new();
    let mut now_s = 0.0;
    let mut cycle_start_s = 0.0;
    let file = std::fs::File::open(folder.join("B0005.csv.gz")).expect("the data set exists");
    for row in csv::Reader::from_reader(flate2::read::GzDecoder::new(file)).records() {
        let row = row.expect("a row");
        let number = |field: usize| row[field].parse::<f64>().unwrap_or(f64::NAN);
        let cycle: u32 = row[0].parse().expect("a cycle");
        if !charges_ah.contains_key(&cycle) {
            cycle_start_s = now_s;
            sampler.handle_gap(Timestamp::from_secs(now_s));
        }
        now_s = cycle_start_s + number(2);
        let time = Timestamp::from_secs(now_s);
        let mut give = |channel, value| -> Option<CellSample> {
            sampler.handle_reading(time, Reading { channel, value: Ok(value) }, &mut changes)
        };
        give(Channel::Temperature(SensorIndex(0)), number(5));
        give(Channel::Current, number(3));
        if give(Channel::CellVoltage(CellIndex(0)), number(4)).is_none() {
            refused.push((cycle, number(4)));
        }
        let (charge_as, _) = sampler.counted(time);
        charges_ah.entry(cycle).or_insert((charge_as / 3600.0, 0.0)).1 = charge_as / 3600.0;
    }
    assert_eq!(refused, [(84, 8.393141), (615, 0.236356), (615, 0.003365), (615, 4.985137), (615, 4.98472)]);
    let compared = compare(&folder, &charges_ah);
    assert!(compared > 300, "compared only {compared} cycles");
}

fn compare(folder: &Path, charges_ah: &BTreeMap<u32, (f64, f64)>) -> usize {
    let mut compared = 0;
    let mut table = csv::Reader::from_path(folder.join("B0005_cycles.csv")).expect("the table exists");
    for row in table.records() {
        let row = row.expect("a row");
        let (Ok(cycle), Ok(published_ah)) = (row[0].parse::<u32>(), row[9].parse::<f64>()) else { continue };
        let Some((from, to)) = charges_ah.get(&cycle) else { continue };
        let ours_ah = to - from;
        assert!((ours_ah - published_ah).abs() < 2e-4, "cycle {cycle}: {ours_ah} Ah, table {published_ah} Ah");
        compared += 1;
    }
    compared
}
