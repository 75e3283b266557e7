//! Tests the half-cell potentials and the ageing that is computed from electrodes.

use super::*;

/// The LG M50 of Chen et al. (2020), as fitted to its slow discharge.
pub(crate) const M50: Electrodes = Electrodes {
    positive: PositiveMaterial::Nmc811,
    negative: NegativeMaterial::GraphiteSiox,
    positive_content: [0.8531, 0.2679],
    negative_content: [0.0335, 0.9107],
};

/// An LFP cell.
pub(crate) const LFP: Electrodes = Electrodes {
    positive: PositiveMaterial::Lfp,
    negative: NegativeMaterial::GraphiteSiox,
    positive_content: [0.92, 0.03],
    negative_content: [0.02, 0.81],
};

#[test]
fn materials_fall_with_their_lithium_content() {
    // Some potential functions were fitted to measurements. They rise by a few millivolts at some points.
    let falls = |potential_v: &dyn Fn(f64) -> f64| {
        (1..=98).all(|k| potential_v(0.01 * f64::from(k)) > potential_v(0.01 * f64::from(k + 1)) - 0.004)
    };
    assert!(NegativeMaterial::ALL.iter().all(|(material, _)| falls(&|x| material.potential_v(x))));
    for (material, _) in PositiveMaterial::ALL {
        assert!(falls(&|y| material.potential_v(y)), "{material:?}");
        // The potential is constant where the function is not valid.
        assert_eq!(material.potential_v(0.0), material.potential_v(material.least_content()));
    }
}

#[test]
fn unaged_cell_equals_new_cell() {
    let same = M50.aged(LostMaterial::default(), 1.0).expect("a cell");
    assert!(same.lithium_lost().abs() < 1e-6, "{same:?}");
    for k in 0..=20 {
        let soc = f64::from(k) / 20.0;
        assert!((same.voltage_v(soc) - M50.voltage_v(soc)).abs() < 1e-6, "{soc}");
    }
}

#[test]
fn proportional_loss_of_everything_keeps_the_curve() {
    let lost = LostMaterial { negative: 0.2, positive: 0.2 };
    let aged = M50.aged(lost, 0.8).expect("a cell");
    assert!((aged.lithium_lost() - 0.2).abs() < 1e-6, "{aged:?}");
    assert!((0..=10).map(|k| 0.1 * f64::from(k)).all(|z| (aged.voltage_v(z) - M50.voltage_v(z)).abs() < 1e-6));
}

#[test]
fn lithium_loss_slides_electrodes() {
    let aged = M50.aged(LostMaterial::default(), 0.8).expect("a cell");
    assert!((aged.capacity() - 0.8).abs() < 1e-6);
    for end in [0.0, 1.0] {
        assert!((aged.voltage_v(end) - M50.voltage_v(end)).abs() < 1e-6);
    }
    // The last stage of graphite moves to a lower SOC, and the positive electrode contains less lithium at every SOC.
    assert!(aged.voltage_v(0.5) - M50.voltage_v(0.5) > 0.03, "{}", aged.voltage_v(0.5) - M50.voltage_v(0.5));
    assert!((0..100).all(|k| aged.voltage_v(0.01 * f64::from(k + 1)) > aged.voltage_v(0.01 * f64::from(k))));
}

#[test]
fn impossible_loss_gives_no_curve() {
    assert!(M50.aged(LostMaterial { negative: 0.5, positive: 0.0 }, 0.9).is_none());
    assert!(M50.aged(LostMaterial::default(), 3.0).is_none());
    // In a cell with excess lithium, a small loss of lithium does not reduce the capacity.
    let excess = Electrodes {
        negative: NegativeMaterial::Mcmb,
        negative_content: [0.035, 0.956],
        positive_content: [0.979, 0.376],
        ..LFP
    };
    assert!(excess.aged(LostMaterial::default(), 0.9).is_none());
}
