//! Restores learned values of the cells from a history, for use if the state of the last run is lost.
//!
//! In: capacities (Ah) and resistances (relative to a new cell) of cells, for a monitor that has not received an input.
//! Out: a monitor that has learned only these values.

use crate::filter::ScalarGaussian;
use crate::health::CapacityMethod;
use crate::monitor::Monitor;
use crate::monitor::message::LearnedCell;
use crate::monitor::stages::Stages;

impl Monitor {
    /// Sets the learned values of the cells. If a cell does not exist or a number is impossible, returns `false` and
    /// changes nothing, because the history does not fit this pack.
    pub fn relearn(&mut self, learned: &[LearnedCell]) -> bool {
        let Stages { estimation, learning, .. } = &mut self.stages;
        let is_valid =
            |x: ScalarGaussian| x.mean.is_finite() && x.mean > 0.0 && x.variance.is_finite() && x.variance > 0.0;
        let fits = |cell: &LearnedCell| {
            cell.cell.index() < learning.cells.len()
                && [Some(cell.capacity), cell.usable, cell.resistance].into_iter().flatten().all(is_valid)
        };
        if !learned.iter().all(fits) {
            return false;
        }
        let config = learning.config.capacity;
        for LearnedCell { cell, capacity, usable, resistance } in learned {
            let index = cell.index();
            let learner = &mut learning.state.learner;
            estimation.bank.change(index, |estimator| {
                if let Some(ratio) = resistance {
                    // Standard deviation of ln x: dx / x.
                    estimator.relearn_resistance(ScalarGaussian::from_std(ratio.mean.ln(), ratio.std() / ratio.mean));
                }
                match config.method {
                    CapacityMethod::Swing => estimator.restate_capacity(*capacity),
                    CapacityMethod::Nominal { .. } => estimator.hold_capacity(capacity.mean),
                }
                learner.relearn(&config, index, *capacity, estimator);
            });
            learning.cells[index].usable = *usable;
        }
        true
    }
}
