//! Tests the tables of sample documents.

use super::*;
use crate::cli::status::sample::sample;

#[test]
fn short_pack_lists_all_cells_with_dashes_for_unknown() {
    let text = table(&sample(3), false);
    let wanted = "\
packwatch 1.2.3, process 4711, up 3 h 12 min, 2027-01-15T08:00:00Z, configuration pack.toml (01234567)
found      cell 1: loses charge by itself, 0.15 ± 0.01 % of its capacity a day, for 2 d 7 h
pack       valid: SOC 63.2 % (95 %: 60.8 to 65.6 %), discharge, 10.95 V, 12.50 A, at most 31.2 °C
energy     remaining 541.0 ± 23.0 Wh, to full -, 1 h 12 min ± 10 min 0 s to empty
power      for 10 s: discharge 8.2 ± 0.4 kW (cell 1), charge - (cell 1)
health     capacity 2.412 ± 0.021 Ah (cell 1), SOH 92.8 %, usable 2.310 ± 0.040 Ah, recharge period -, with the \
reference charger 5432 ± 61 s
offset     current sensor -0.034 ± 0.011 A (reading minus true current)
model      learning
losses     lithium 6.1 ± 1.2 %, negative electrode 2.2 ± 2.3 %, positive electrode 2.1 ± 2.4 %
life       412 equivalent full cycles (90 %: 208 to 933) (cell 1), 533 days at the recent use
use        events beyond limits -, fast charges 12, at rest above 80 % -
interface  can0 up: 86400 frames in, 6 lost, 1200 out, 17 not sent, 4 errors, 1 bus-off, 1 reconnects
interface  can1 missing: 86400 frames in, 6 lost, 1200 out, 17 not sent, 4 errors, 1 bus-off, 1 reconnects
counted    123456 readings used, 7 rejected; 3 late ticks; 99 % of frames processed within 5.00 ms
store      works, 21 commits, 0.1 MB
commands   can0 6B3: unauthenticated
requests   silent: another tester is active; 1 rejected permanently
answers    can0 7EC: 120 answers, 3 rejections (latest code 31), 2 lost: wrong sequence
alarms     1 raised of 4 thresholds, 1 unknown
           severe capacity_low cell 1 active: 2.412 Ah, threshold 2.500 Ah, 97 % sure
           warning soc_low pack cleared: 63.2 %, threshold 10.0 %, acknowledged
cell  voltage    temp.           SOC          capacity   resistance  trusted
   1  3.600 V  25.0 °C  60.0 ± 1.2 %  2.400 ± 0.020 Ah  1.10 ± 0.03      yes
   2  3.604 V  25.2 °C  60.8 ± 1.2 %  2.402 ± 0.020 Ah  1.11 ± 0.03       NO
   3        -        -             -                 -            -        -
";
    assert_eq!(text, wanted);
}

#[test]
fn findings_beyond_limit_are_counted() {
    let mut document = sample(3);
    document.findings = vec![document.findings[0]; 11];
    let text = table(&document, false);
    assert_eq!(text.lines().filter(|line| line.starts_with("found ")).count(), 8);
    assert!(text.contains("\n           and 3 more: `packwatch status --json` lists all\n"), "{text}");
}

#[test]
fn intruders_and_frozen_current_are_shown() {
    let mut document = sample(1);
    let intruder = |id: &str, kind| Intruder { interface: "can0".to_owned(), id: id.to_owned(), kind };
    document.intruders =
        vec![intruder("100", IntruderKind::SecondSender), intruder("6B0", IntruderKind::OwnIdentifier)];
    document.current_frozen = true;
    let text = table(&document, false);
    for line in [
        "intruder   can0 100 has a second sender: its values cannot be trusted",
        "intruder   can0 6B0 is an identifier of packwatch, but another node sends it",
        "current    frozen: its reading does not change, but the voltages show a changing load",
    ] {
        assert!(text.lines().any(|found| found == line), "{line}\n{text}");
    }
    assert!(!table(&sample(1), false).contains("intruder"));
}

#[test]
fn stated_vehicle_is_second_line() {
    let mut document = sample(1);
    document.vehicle.name = Some("Bus 12".to_owned());
    document.vehicle.pack = Some("rear".to_owned());
    assert_eq!(table(&document, false).lines().nth(1), Some("vehicle    Bus 12, pack rear"));
}

#[test]
fn failing_store_and_late_estimates_are_shown() {
    let mut document = sample(1);
    let store = document.store.as_mut().unwrap();
    (store.works, store.failures, store.late) = (Some(false), 3, 2);
    document.latency.buckets.last_mut().unwrap().frames = 100;
    document.latency.frames += 100;
    let text = table(&document, false);
    assert!(
        text.contains(
            "store      CANNOT BE WRITTEN, 21 commits, 0.1 MB, 3 failed, 2 announced before they were stored\n"
        ),
        "{text}"
    );
    assert!(text.contains("99 % of frames processed within more than 1 s\n"), "{text}");
    (document.store, document.latency) = (None, Default::default());
    let text = table(&document, false);
    assert!(text.contains("store      none\n") && text.contains("99 % of frames processed within -\n"), "{text}");
}

#[test]
fn differences_within_sensor_error_give_no_outliers() {
    let mut document = sample(96);
    for cell in &mut document.cells {
        for (quantity, value) in [
            (Quantity::Voltage, 3.7),
            (Quantity::Soc, 0.5),
            (Quantity::Temperature, 25.0),
            (Quantity::Capacity, 2.4),
            (Quantity::ResistanceRatio, 1.0),
        ] {
            cell.values.set(quantity, Some(value));
        }
        cell.trusted = Some(true);
    }
    document.cells[7].values.set(Quantity::Voltage, Some(3.709));
    document.cells[8].values.set(Quantity::Soc, Some(0.508));
    document.cells[9].values.set(Quantity::Temperature, Some(26.5));
    document.cells[10].values.set(Quantity::Capacity, Some(2.38));
    document.cells[11].values.set(Quantity::ResistanceRatio, Some(1.04));
    assert!(table(&document, false).contains("no outliers"), "{}", table(&document, false));
    document.cells[7].values.set(Quantity::Voltage, Some(3.711));
    let text = table(&document, false);
    assert!(text.contains("outliers (--cells lists all):\n") && text.contains("\n   8  3.711 V"), "{text}");
}

#[test]
fn large_pack_lists_outliers_only() {
    let mut document = sample(96);
    document.cells[40].values.set(Quantity::Soc, Some(0.1));
    let text = table(&document, false);
    assert!(text.contains("SOC        10.0 % (cell 41) to 79.2 % (cell 24), known for 95 of 96\n"), "{text}");
    let listed: Vec<&str> = text
        .lines()
        .skip_while(|line| !line.starts_with("cell "))
        .skip(1)
        .filter_map(|line| line.split_whitespace().next())
        .collect();
    // The SOC of cell 41 is an outlier, cell 95 is not trusted, and cell 96 is silent.
    assert_eq!(listed, ["41", "95", "96"]);
    assert_eq!(table(&document, true).lines().filter(|line| line.contains(" °C  ")).count(), 95);
}
