//! Tests the core's counters and the values that it shows.

use crate::support::rig::{Rig, learned};
use packwatch::monitor::{BusStatistics, CellView, Downtime, Statistics, Validity};
use packwatch::quantity::catalogue::{CellValues, PackValues, Quantity};
use packwatch::quantity::{CellIndex, Mode};

#[test]
fn readings_are_counted_by_outcome() {
    let mut rig = Rig::new("");
    rig.seconds(10);
    // 100 frames with four configured signals each, and 100 frames with two.
    let before = rig.monitor.reading_counts();
    assert_eq!((before.accepted, before.out_of_range), (600, 0));
    assert_eq!(rig.monitor.statistics().buses[0].frames, 200);
    assert_eq!(rig.monitor.statistics().voltages.used, 200);
    // The voltage is above the pack's limits for long enough to be reported once.
    rig.voltages_v[1] = Some(4.9);
    rig.seconds(2);
    let after = rig.monitor.reading_counts();
    let refused = after.out_of_range + after.rate_too_high - before.out_of_range - before.rate_too_high;
    assert_eq!((refused, after.accepted - before.accepted), (20, 100));
    // A missing input is counted as stale once, not on every check.
    (rig.voltages_v, rig.temperatures_c, rig.current_a) = ([None; 2], [None; 2], None);
    rig.seconds(20);
    assert!((1..=6).contains(&rig.monitor.reading_counts().stale), "{:?}", rig.monitor.reading_counts());
}

#[test]
fn counts_continue_after_restart() {
    let mut rig = learned();
    let (before, readings) = (rig.monitor.statistics().clone(), rig.monitor.reading_counts());
    assert_eq!(
        (before.learning.half_cycles, before.learning.capacity_updates, before.learning.capacity_measurements),
        (2, 2, 2)
    );
    assert_eq!((before.alarms_raised.warning, before.restores), (2, 0));
    rig.restart(Downtime::Seconds(3600.0));
    rig.seconds(1);
    let after = rig.monitor.statistics();
    assert_eq!((after.learning.half_cycles, after.alarms_raised.warning, after.restores), (2, 2, 1));
    assert_eq!(after.gaps, before.gaps + 1);
    assert_eq!(after.buses[0].frames, before.buses[0].frames + 20);
    assert!(rig.monitor.reading_counts().accepted > readings.accepted);
    let added = after.since(&before);
    assert_eq!((added.learning.half_cycles, added.restores, added.gaps, added.buses[0].frames), (0, 1, 1, 20));
    assert_eq!(rig.monitor.reading_counts().since(&readings).accepted, 60);
    assert_eq!(before.since(after), Statistics { buses: vec![BusStatistics::default()], ..Statistics::default() });
}

#[test]
fn bad_commands_are_counted_and_reports_limited() {
    let mut rig = Rig::new("");
    rig.seconds(1);
    for _ in 0..5 {
        // Command code 0 and rule number 30 do not exist.
        rig.command(0, 30, 0x7FF);
    }
    let reported = rig.events.iter().filter(|event| format!("{event:?}").contains("BadCommand")).count();
    assert_eq!((reported, rig.monitor.statistics().bad_commands), (1, 5));
}

#[test]
fn stale_values_are_not_shown() {
    let mut rig = learned();
    let pack = rig.monitor.pack_view();
    assert_eq!((pack.validity, pack.mode), (Validity::Valid, Mode::Rest));
    let voltage_v = pack.values.mean(Quantity::Voltage).unwrap();
    assert!((voltage_v - rig.voltages_v.iter().flatten().sum::<f64>()).abs() < 1e-3, "{voltage_v}");
    assert!(pack.weakest_cell.is_some() && pack.values.mean(Quantity::Soh).is_some_and(|soh| soh > 0.0));
    // One cell is silent. Pack values that depend on it are not shown.
    rig.voltages_v[1] = None;
    rig.seconds(20);
    let cells: Vec<_> = rig.monitor.cell_views().collect();
    let known = |cell: &CellView, quantity| cell.values.get(quantity).is_some();
    assert!(known(&cells[0], Quantity::Voltage) && known(&cells[0], Quantity::Soc));
    let silent = &cells[1];
    assert_eq!(silent.cell, CellIndex(1));
    for quantity in [Quantity::Voltage, Quantity::Soc, Quantity::ResistanceRatio] {
        assert!(!known(silent, quantity), "{quantity:?}");
    }
    assert_eq!((cells[0].trusted, silent.trusted), (Some(true), None));
    assert!(known(silent, Quantity::Capacity));
    let pack = rig.monitor.pack_view();
    let values = [Quantity::Soc, Quantity::Voltage].map(|quantity| pack.values.get(quantity));
    assert_eq!((pack.validity, values), (Validity::Unavailable, [None; 2]));
}

#[test]
fn silent_sensor_hides_highest_temperature() {
    let mut rig = Rig::new("");
    rig.temperatures_c = [Some(25.0), Some(60.0)];
    rig.seconds(3);
    assert_eq!(rig.monitor.pack_view().values.mean(Quantity::TemperatureMax), Some(60.0));
    // The hot sensor is silent. The other sensor gives no upper bound of the pack's temperature.
    rig.temperatures_c[1] = None;
    rig.seconds(10);
    assert_eq!(
        rig.monitor.cell_views().map(|cell| cell.values.mean(Quantity::Temperature)).collect::<Vec<_>>(),
        [Some(25.0), None]
    );
    assert_eq!(rig.monitor.pack_view().values.mean(Quantity::TemperatureMax), None);
}

#[test]
fn values_are_unknown_before_first_frame() {
    let rig = Rig::new("");
    let is_unknown = |cell: CellView| cell.values == CellValues::default() && cell.trusted.is_none();
    assert!(rig.monitor.cell_views().all(is_unknown));
    let pack = rig.monitor.pack_view();
    assert_eq!((pack.validity, pack.values), (Validity::Unavailable, PackValues::default()));
}
