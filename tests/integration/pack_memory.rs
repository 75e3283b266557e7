//! Tests that learned values belong to a pack's identity number, and are restored when the pack is connected again.

use packwatch::alarm::{Change, Rule};
use packwatch::monitor::{CellView, Command, Downtime, EventKind, Record};
use packwatch::quantity::catalogue::Quantity;

use crate::support::rig::Rig;

const IDENTITY: &str = "[[alarm]]\nrule = \"capacity_low\"\nwarning = 5.0\n[estimator]\ngate_sigma = 1000\n\
                        [input.pack_identity]\nsignal = \"Cells.Serial\"\nreadings = 5\naccept_unprotected = true\n";
const A: f64 = 1001.0;
const B: f64 = 1002.0;

/// Exact learned values of each cell: capacity, usable capacity, remaining life, loss modes.
fn learned(rig: &Rig) -> Vec<String> {
    let quantities = [
        Quantity::Capacity,
        Quantity::UsableCapacity,
        Quantity::RemainingCycles,
        Quantity::RemainingDays,
        Quantity::LithiumLoss,
        Quantity::NegativeLoss,
        Quantity::PositiveLoss,
    ];
    let cell = |view: CellView| {
        format!("{:?} {:?}", quantities.map(|quantity| view.values.get(quantity)), view.remaining_unknown)
    };
    rig.monitor.cell_views().map(cell).collect()
}

/// Feeds one more round of voltages. Returns the resistances relative to a new cell.
fn resistances(rig: &mut Rig) -> Vec<f64> {
    rig.tick_with_frames();
    rig.monitor.cell_views().map(|view| view.values.mean(Quantity::ResistanceRatio).unwrap()).collect()
}

fn assert_near(found: &[f64], wanted: &[f64]) {
    assert!(
        found.iter().zip(wanted).all(|(found, wanted)| (found - wanted).abs() < 0.01 * wanted),
        "found {found:?}, wanted {wanted:?}"
    );
}

fn connect(rig: &mut Rig, number: f64) {
    rig.identity = Some(number);
    (0..5).for_each(|_| rig.tick_with_frames());
    assert_eq!(rig.monitor.pack_identity(), Some(number));
}

/// A rig with pack A, after some half-cycles.
fn with_pack_a() -> Rig {
    let mut rig = Rig::new(IDENTITY);
    connect(&mut rig, A);
    for _ in 0..2 {
        rig.discharge();
        recharge(&mut rig);
    }
    rig
}

fn recharge(rig: &mut Rig) {
    rig.current_a = Some(-5.0);
    for step in 0..60 {
        let voltage_v = 3.35 + 0.007 * f64::from(step);
        rig.voltages_v = [Some(voltage_v), Some(voltage_v + 0.004)];
        rig.seconds(10);
    }
    rig.current_a = Some(0.0);
    rig.seconds(30);
}

fn returned(rig: &Rig) -> Vec<f64> {
    let of = |kind| if let EventKind::PackReturned { identity, .. } = kind { Some(identity) } else { None };
    rig.events.iter().filter_map(|event| of(event.kind)).collect()
}

#[test]
fn returning_pack_restores_learned_values() {
    let mut rig = with_pack_a();
    let resistances_of_a = resistances(&mut rig);
    let of_a = learned(&rig);
    connect(&mut rig, B);
    assert_ne!(learned(&rig), of_a, "another pack must start from the configuration");
    assert!(rig.monitor.cell_views().all(|view| view.values.get(Quantity::Capacity).is_none()));
    assert!(
        (resistances(&mut rig)[0] - resistances_of_a[0]).abs() > 0.02 * resistances_of_a[0],
        "{resistances_of_a:?}"
    );
    rig.voltages_v = [Some(3.9); 2];
    rig.discharge();
    let of_b = learned(&rig);
    assert_ne!(of_b, of_a);
    rig.restart(Downtime::Seconds(60.0));
    rig.events.clear();
    connect(&mut rig, A);
    assert_eq!((learned(&rig), returned(&rig)), (of_a.clone(), vec![A]));
    assert_near(&resistances(&mut rig), &resistances_of_a);
    assert_eq!(rig.changes(Rule::CapacityLow).last(), Some(&Change::Raised), "the pack's alarms return too");
    connect(&mut rig, B);
    assert_eq!((learned(&rig), returned(&rig)), (of_b, vec![A, B]));
    connect(&mut rig, A);
    assert_eq!(learned(&rig), of_a);
    rig.seconds(60);
    assert!(
        rig.monitor
            .cell_views()
            .all(|view| view.values.mean(Quantity::Soc).is_some_and(|soc| (0.0..1.0).contains(&soc)))
    );
}

#[test]
fn forged_numbers_lose_no_learned_values() {
    let mut rig = with_pack_a();
    let of_a = learned(&rig);
    for forged in 0..40 {
        connect(&mut rig, 5000.0 + f64::from(forged));
    }
    connect(&mut rig, A);
    assert_eq!(learned(&rig), of_a);
}

#[test]
fn least_recently_connected_pack_is_evicted() {
    let mut rig = with_pack_a();
    for number in 1..=8 {
        connect(&mut rig, f64::from(number));
        rig.voltages_v = [Some(3.65); 2];
        rig.discharge();
    }
    // In addition to the connected pack, the monitor keeps eight packs. A ninth pack would exceed this limit.
    let snapshot = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    let numbers = |value: &serde_json::Value| {
        value["packs"]["packs"]
            .as_array()
            .unwrap()
            .iter()
            .map(|pack| pack["number"].as_f64().unwrap())
            .collect::<Vec<_>>()
    };
    assert_eq!(numbers(&snapshot), [A, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    let bytes = serde_json::to_string(&snapshot["packs"]).unwrap().len();
    // A cell takes 2.6 kB. The limit also allows for the data of the pack, which has only two cells here.
    assert!(bytes < 8 * 2 * 4200, "{bytes} bytes for 16 cells");
    connect(&mut rig, 9.0);
    connect(&mut rig, A);
    assert!(returned(&rig).is_empty(), "the ninth pack must replace A");
}

#[test]
fn forget_command_clears_pack_of_any_number() {
    let mut rig = with_pack_a();
    let of_a = learned(&rig);
    rig.give(Record::command(rig.now(), Command::PackReplaced));
    let nothing = learned(&rig);
    assert_ne!(nothing, of_a);
    connect(&mut rig, B);
    connect(&mut rig, A);
    assert_eq!((learned(&rig), returned(&rig)), (nothing, vec![]));
}
