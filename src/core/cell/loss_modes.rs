//! Computes the loss modes of an aged cell from its capacity: loss of lithium inventory (LLI) and loss of active
//! material of each electrode (LAM).
//!
//! In: the learned capacity C (Ah) and the lithium inventories of [`super::aged_ocv`]. Out: losses as fractions (0 to
//! 1) of the model's new cell, each with its standard deviation.
//!
//! LAM_NE = s_n d,  LAM_PE = s_p d,  LLI = 1 - L(C, s_n, s_p) / L(C_new, 0, 0)
//!
//! d = 1 - C / C_new is the lost capacity. s_n and s_p are the shares of lost material per lost capacity in the
//! negative and the positive electrode. L is the inventory of [`super::electrodes`].
//!
//! C, s_n and s_p are independent. The standard deviations include the products of their errors. The total loss is
//! learned, but its split between material and lithium is an assumption ([`MATERIAL_SHARE`] with
//! [`MATERIAL_SHARE_STD`]).
//!
//! Source: Birkl et al., J. Power Sources 341 (2017) 373 (modes and their names).
//!
//! [`MATERIAL_SHARE`]: super::aged_ocv::MATERIAL_SHARE
//! [`MATERIAL_SHARE_STD`]: super::aged_ocv::MATERIAL_SHARE_STD

use super::aged_ocv::{AgedOcv, LithiumLoss, MATERIAL_SHARE, MATERIAL_SHARE_STD};
use crate::filter::ScalarGaussian;

/// Losses of a cell, as fractions of the model's new cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossModes {
    /// Loss of lithium inventory (LLI).
    pub lithium: ScalarGaussian,
    /// Loss of active material of the negative electrode (LAM_NE).
    pub negative: ScalarGaussian,
    /// Loss of active material of the positive electrode (LAM_PE).
    pub positive: ScalarGaussian,
}

impl LossModes {
    /// Losses of a cell with this capacity (Ah). `None` if the model has no electrode data, or if its aged open-circuit
    /// curves end above this capacity.
    pub fn of_capacity(aged_ocv: &AgedOcv, new_capacity_ah: f64, capacity: ScalarGaussian) -> Option<Self> {
        let LithiumLoss { lost, per_ah, mixes, mixes_per_ah } = aged_ocv.lithium_loss(capacity.mean)?;
        let by_mixes =
            mixes.iter().zip(mixes_per_ah).map(|(mix, per_ah)| mix * mix + per_ah * per_ah * capacity.variance);
        let lithium =
            ScalarGaussian { mean: lost, variance: per_ah * per_ah * capacity.variance + by_mixes.sum::<f64>() };
        let part = (1.0 - capacity.mean / new_capacity_ah).max(0.0);
        let part_variance = capacity.variance / (new_capacity_ah * new_capacity_ah);
        let share_variance = MATERIAL_SHARE_STD * MATERIAL_SHARE_STD;
        let material = ScalarGaussian {
            mean: MATERIAL_SHARE * part,
            variance: (MATERIAL_SHARE * MATERIAL_SHARE + share_variance) * part_variance + share_variance * part * part,
        };
        let lithium = ScalarGaussian { mean: lithium.mean.clamp(0.0, 1.0), ..lithium };
        Some(Self { lithium, negative: material, positive: material })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::electrodes::tests::M50;
    use crate::cell::electrodes::{Electrodes, LostMaterial};

    const NEW_AH: f64 = 5.0;

    fn table(electrodes: &Electrodes) -> AgedOcv {
        let soc: Vec<f64> = (0..=20).map(|k| f64::from(k) / 20.0).collect();
        let row: Vec<f64> = soc.iter().map(|&z| electrodes.voltage_v(z)).collect();
        AgedOcv::of_electrodes(electrodes, &soc, NEW_AH, &[row]).expect("says how it ages")
    }

    fn losses(capacity: ScalarGaussian) -> Option<LossModes> {
        LossModes::of_capacity(&table(&M50), NEW_AH, capacity)
    }

    /// Lithium lost by an LG M50 cell that has kept the fraction `part` of its capacity, computed without the table.
    /// `negative` and `positive` are the shares of lost material per lost capacity.
    fn lithium(part: f64, negative: f64, positive: f64) -> f64 {
        let lost = LostMaterial { negative: negative * (1.0 - part), positive: positive * (1.0 - part) };
        M50.aged(lost, part).expect("such a cell").lithium_lost()
    }

    #[test]
    fn losses_match_electrodes_and_shares() {
        for part in [0.95, 0.8, 0.7] {
            let found = losses(ScalarGaussian::from_std(part * NEW_AH, 0.0)).expect("known");
            assert!((found.lithium.mean - lithium(part, 0.3, 0.3)).abs() < 1e-9, "{found:?}");
            let by_negative = 0.5 * (lithium(part, 0.6, 0.3) - lithium(part, 0.0, 0.3));
            let by_positive = 0.5 * (lithium(part, 0.3, 0.6) - lithium(part, 0.3, 0.0));
            assert!((found.lithium.std() - by_negative.hypot(by_positive)).abs() < 1e-9, "{found:?}");
            assert!((found.negative.mean - 0.3 * (1.0 - part)).abs() < 1e-12);
            assert!((found.positive.std() - 0.3 * (1.0 - part)).abs() < 1e-12);
        }
    }

    /// Simulated lives of an LG M50 cell (PyBaMM 26.10, OKane2022): remaining capacity, LLI, LAM_NE, LAM_PE. In the
    /// last life, the cell loses only lithium. In the other lives, it also loses material by stress.
    const SIMULATED: [[f64; 4]; 6] = [
        [0.9365, 0.0496, 0.0214, 0.0100],
        [0.8723, 0.0985, 0.0440, 0.0233],
        [0.8263, 0.1353, 0.0749, 0.0388],
        [0.7850, 0.1687, 0.1060, 0.0536],
        [0.7341, 0.2119, 0.1621, 0.0781],
        [0.8768, 0.0880, 0.0, 0.0],
    ];

    #[test]
    fn simulated_losses_lie_within_the_intervals() {
        for [part, lithium, negative, positive] in SIMULATED {
            let found = losses(ScalarGaussian::from_std(part * NEW_AH, 0.005 * NEW_AH)).expect("known");
            for (mode, truth) in [(found.lithium, lithium), (found.negative, negative), (found.positive, positive)] {
                assert!((mode.mean - truth).abs() < 1.96 * mode.std(), "{part}: {truth} {mode:?}");
            }
        }
    }

    #[test]
    fn uncertain_capacity_widens_all_losses() {
        let [sure, vague] = [0.0, 0.2].map(|std_ah| losses(ScalarGaussian::from_std(4.0, std_ah)).expect("known"));
        let slope = (lithium(0.85, 0.3, 0.3) - lithium(0.8, 0.3, 0.3)) / 0.05;
        let least = slope.abs() * 0.2 / NEW_AH;
        assert!(vague.lithium.std() > sure.lithium.std().hypot(0.9 * least), "{vague:?} {least}");
        assert!(vague.negative.std() > sure.negative.std(), "{vague:?}");
        assert_eq!(vague.lithium.mean, sure.lithium.mean);
    }

    #[test]
    fn cell_above_new_capacity_has_no_losses() {
        let found = losses(ScalarGaussian::from_std(5.1, 0.1)).expect("known");
        assert_eq!((found.lithium.mean, found.negative.mean, found.positive.mean), (0.0, 0.0, 0.0));
        assert!(found.lithium.std() > 0.01 && found.negative.std() > 0.005, "{found:?}");
    }

    #[test]
    fn losses_are_unknown_outside_the_table() {
        let capacity = ScalarGaussian::from_std(4.0, 0.1);
        assert_eq!(LossModes::of_capacity(&AgedOcv::default(), NEW_AH, capacity), None);
        let rows = [vec![3.0, 3.6, 4.1]];
        let shift = AgedOcv::of_shift(0.5, &[0.0, 0.5, 1.0], NEW_AH, &rows);
        assert_eq!(LossModes::of_capacity(&shift, NEW_AH, capacity), None);
        assert_eq!(losses(ScalarGaussian::from_std(1.0, 0.1)), None);
    }
}
