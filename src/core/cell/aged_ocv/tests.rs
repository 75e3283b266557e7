//! Offsets of aged curves: against the electrodes they come from, at their edges, and rising everywhere.

use super::*;
use crate::cell::electrodes::tests::{LFP, M50};

const SOC: [f64; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];

fn offset_v(table: &AgedOcv, s: usize, capacity_ah: f64) -> f64 {
    table.line(&SOC, table.segment(capacity_ah), s).at(SOC[s], capacity_ah)
}

fn rows(ocv_v: impl Fn(f64) -> f64) -> Vec<Vec<f64>> {
    vec![SOC.iter().map(|&z| ocv_v(z)).collect()]
}

fn m50() -> AgedOcv {
    AgedOcv::of_electrodes(&M50, &SOC, 5.0, &rows(|z| M50.voltage_v(z))).expect("a table")
}

#[test]
fn nothing_changes_without_capacities_and_for_a_new_cell() {
    let none = AgedOcv::default();
    assert_eq!((none.line(&SOC, 0, 2), none.error_v(2, 1.0)), (OffsetLine::default(), None));
    assert_eq!(AgedOcv::of_shift(0.0, &SOC, 2.0, &rows(|z| z)), none);
    for s in 0..5 {
        assert!(offset_v(&m50(), s, 5.0).abs() < 1e-12, "{s}");
        assert_eq!(m50().error_v(s, 5.0), Some(0.0));
        // Smooth through the new capacity, constant above 105 %.
        assert!((offset_v(&m50(), s, 5.25) + offset_v(&m50(), s, 4.75)).abs() < 1e-12, "{s}");
        assert_eq!(offset_v(&m50(), s, 5.3), offset_v(&m50(), s, 9.0));
    }
}

#[test]
fn offsets_are_the_aged_curve_less_the_new_one_and_continuous_over_capacity() {
    let table = m50();
    let lost = LostMaterial { negative: 0.3 * 0.2, positive: 0.3 * 0.2 };
    let aged = M50.aged(lost, 0.8).expect("a cell");
    for (s, z) in SOC.into_iter().enumerate().take(5) {
        let expected_v = aged.voltage_v(z) - M50.voltage_v(z);
        assert!((offset_v(&table, s, 4.0) - expected_v).abs() < 1e-9, "{z}");
        for border in table.borders_ah() {
            let (below, above) = (offset_v(&table, s, border - 1e-9), offset_v(&table, s, border + 1e-9));
            assert!((below - above).abs() < 1e-6, "{z} {border}");
        }
        let (least, edge) = (offset_v(&table, s, 0.5), offset_v(&table, s, 2.0));
        assert!((least - edge).abs() < 1e-9, "constant below the lowest capacity: {least} {edge}");
    }
    let error_v = |capacity_ah| table.error_v(2, capacity_ah).expect("known");
    assert!(error_v(4.0) > 0.002 && error_v(4.5) < error_v(4.0), "{}", error_v(4.0));
}

#[test]
fn a_shift_moves_the_inside_of_the_curve_only() {
    let table = AgedOcv::of_shift(0.8, &SOC, 2.0, &rows(|z| 3.0 + z));
    // A quarter lost: a = 0.8 x 0.25 = 0.2.
    assert!((offset_v(&table, 2, 1.5) - 0.2 * 0.4 * 0.6).abs() < 1e-12);
    assert_eq!(offset_v(&table, 0, 1.5), 0.0);
    assert!(table.line(&SOC, table.segment(1.5), 4).at(1.0, 1.5).abs() < 1e-12);
}

#[test]
fn an_aged_curve_rises_even_where_the_new_one_hardly_does() {
    // Flat in the middle, at one of two temperatures.
    let flat: Vec<f64> = vec![2.5, 3.28, 3.281, 3.2815, 3.33, 3.6];
    let both = [rows(|z| LFP.voltage_v(z)).remove(0), flat.clone()];
    let tables =
        [AgedOcv::of_electrodes(&LFP, &SOC, 2.0, &both).expect("a table"), AgedOcv::of_shift(1.0, &SOC, 2.0, &both)];
    for (table, row) in tables.iter().flat_map(|table| both.iter().map(move |row| (table, row))) {
        for capacity_ah in [0.1, 0.9, 1.3, 1.55, 1.6, 1.87, 2.0, 3.0] {
            let segment = table.segment(capacity_ah);
            let rises = (0..SOC.len() - 1).all(|s| {
                let line = table.line(&SOC, segment, s);
                row[s + 1] + line.at(SOC[s + 1], capacity_ah) > row[s] + line.at(SOC[s], capacity_ah)
            });
            assert!(rises, "{capacity_ah} Ah");
        }
    }
}
