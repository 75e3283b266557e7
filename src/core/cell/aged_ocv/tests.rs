//! An aged open-circuit curve is the new cell's curve plus an offset. Tests that the offsets agree with the model of
//! the electrodes, are continuous, and keep the curves rising.

use super::*;
use crate::cell::electrodes::tests::{LFP, M50};

const SOC: [f64; 6] = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0];

fn offset_v(table: &AgedOcv, s: usize, capacity_ah: f64) -> f64 {
    table.line(&SOC, s, capacity_ah).offset_v.at(SOC[s])
}

fn rows(ocv_v: impl Fn(f64) -> f64) -> Vec<Vec<f64>> {
    vec![SOC.iter().map(|&z| ocv_v(z)).collect()]
}

fn m50() -> AgedOcv {
    AgedOcv::of_electrodes(&M50, &SOC, 5.0, &rows(|z| M50.voltage_v(z))).expect("a table")
}

#[test]
fn new_cell_has_no_offset() {
    let none = AgedOcv::default();
    assert_eq!(none.line(&SOC, 2, 1.0), OffsetLine::default());
    for s in 0..5 {
        assert!(offset_v(&m50(), s, 5.0).abs() < 1e-12, "{s}");
        assert_eq!(m50().line(&SOC, s, 5.0).mixes_v, [SocLine::default(); MIXES]);
        // 5 % above and 5 % below the new cell's capacity of 5 Ah, the offsets are opposite. Above 105 %, the offset is
        // constant.
        assert!((offset_v(&m50(), s, 5.25) + offset_v(&m50(), s, 4.75)).abs() < 1e-12, "{s}");
        assert_eq!(offset_v(&m50(), s, 5.3), offset_v(&m50(), s, 9.0));
    }
}

#[test]
fn offsets_match_aged_curves_and_are_continuous() {
    let table = m50();
    let lost = LostMaterial { negative: 0.3 * 0.2, positive: 0.3 * 0.2 };
    let aged = M50.aged(lost, 0.8).expect("a cell");
    for (s, z) in SOC.into_iter().enumerate().take(5) {
        let expected_v = aged.voltage_v(z) - M50.voltage_v(z);
        assert!((offset_v(&table, s, 4.0) - expected_v).abs() < 1e-9, "{z}");
        for border in &table.capacity_ah {
            let (below, above) = (offset_v(&table, s, border - 1e-9), offset_v(&table, s, border + 1e-9));
            assert!((below - above).abs() < 1e-6, "{z} {border}");
        }
        let (least, edge) = (offset_v(&table, s, 0.5), offset_v(&table, s, 2.0));
        assert!((least - edge).abs() < 1e-9, "constant below the lowest capacity: {least} {edge}");
    }
    // The first mix is the change of the offset by one standard deviation of the share of lost negative material (0.3
    // +/- 0.3). It is half of the difference between the offsets at the shares 0.6 and 0.
    let with =
        |negative: f64| M50.aged(LostMaterial { negative: negative * 0.2, positive: 0.3 * 0.2 }, 0.8).expect("a cell");
    let expected_v = 0.5 * (with(0.6).voltage_v(SOC[2]) - with(0.0).voltage_v(SOC[2]));
    let mix_v = |capacity_ah: f64| table.line(&SOC, 2, capacity_ah).mixes_v[0].at(SOC[2]);
    assert!((mix_v(4.0) - expected_v).abs() < 1e-9, "{} {expected_v}", mix_v(4.0));
    assert!(mix_v(4.0).abs() > 0.001 && mix_v(4.5).abs() < mix_v(4.0).abs());
    let per_ah_v = (offset_v(&table, 2, 4.2) - offset_v(&table, 2, 4.1)) / 0.1;
    assert!((table.line(&SOC, 2, 4.15).per_ah_v.at(SOC[2]) - per_ah_v).abs() < 1e-9);
}

#[test]
fn shift_keeps_both_ends() {
    let table = AgedOcv::of_shift(0.8, &SOC, 2.0, &rows(|z| 3.0 + z));
    // A quarter of the capacity is lost, so the SOC s is shifted by 0.8 x 0.25 s (1 - s). The curve has a slope of 1 V
    // per unit of SOC.
    assert!((offset_v(&table, 2, 1.5) - 0.2 * 0.4 * 0.6).abs() < 1e-12);
    assert_eq!(offset_v(&table, 0, 1.5), 0.0);
    assert!(table.line(&SOC, 4, 1.5).offset_v.at(1.0).abs() < 1e-12);
    // One standard deviation of the shift (0.3) moves the curve by 0.3 x 0.25 s (1 - s).
    let mix_v = |table: &AgedOcv| table.line(&SOC, 2, 1.5).mixes_v[0].at(SOC[2]);
    assert!((mix_v(&table) - 0.075 * 0.4 * 0.6).abs() < 1e-12);
    let (mut other, mut electrodes) = (table.clone(), m50());
    other.set_shift_std(0.6);
    electrodes.set_shift_std(0.6);
    assert!((mix_v(&other) - 2.0 * mix_v(&table)).abs() < 1e-12);
    assert_eq!(electrodes, m50());
}

#[test]
fn aged_curve_rises_on_flat_parts() {
    // The curve is flat in the middle at one of the two temperatures.
    let flat: Vec<f64> = vec![2.5, 3.28, 3.281, 3.2815, 3.33, 3.6];
    let both = [rows(|z| LFP.voltage_v(z)).remove(0), flat.clone()];
    let tables =
        [AgedOcv::of_electrodes(&LFP, &SOC, 2.0, &both).expect("a table"), AgedOcv::of_shift(1.0, &SOC, 2.0, &both)];
    for (table, row) in tables.iter().flat_map(|table| both.iter().map(move |row| (table, row))) {
        for capacity_ah in [0.1, 0.9, 1.3, 1.55, 1.6, 1.87, 2.0, 3.0] {
            let rises = (0..SOC.len() - 1).all(|s| {
                let line = table.line(&SOC, s, capacity_ah).offset_v;
                row[s + 1] + line.at(SOC[s + 1]) > row[s] + line.at(SOC[s])
            });
            assert!(rises, "{capacity_ah} Ah");
        }
    }
}
