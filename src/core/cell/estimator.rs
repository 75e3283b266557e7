//! Estimates one cell's state, sample by sample, with an unscented Kalman filter.
//!
//! State x = [SOC, ln rho, C, U_1 .. U_n]: state of charge (fraction), logarithm of the resistance relative to a new
//! cell, capacity (Ah), branch voltages (V); n = 1 to 3 branches. States in which the circuit is not linear come first, so
//! that the sigma points of the branches are moved by a linear map.
//! Predict over the charge q (A s) and time dt since the last sample:
//! SOC -= q / (3600 C); U_i by `circuit::BranchAt` with the mean current q/dt; ln rho and C stay.
//! Update with the voltage: V = OCV(SOC, T) - sum U_i - rho R0(SOC, T) I. Source: the paper, section 3.3.3.
//!
//! Deviation 1: ln rho is a state (random walk). Reason: a fixed model attributes grown resistance to lost charge in an
//! aged cell. Effect: without it the end of life of the measured cells comes 14-23 cycles early.
//! Deviation 2: C is a state ([`CapacityState::Joint`]). Reason: SOC error grows with the capacity's error in
//! proportion to the charge moved, and is correlated with it; a filter without that correlation counts its own
//! assumption as a measurement. `Held` gives the paper's filter (C known, variance 1e-12 Ah^2).
//! Deviation 3: process noises are densities per second, and the measurement variance is
//! sensor^2 + model^2 / dt: model error is slow, so information is counted per second, not per sample.
//! Effect: the sample rate does not change the result.
//!
//! Deviation 4: model^2 = base^2 + (k drop)^2 + (k' load)^2. The base is the cell model's own error over SOC and
//! temperature where its fit states one; the drop is the present voltage drop in the cell, the load that of the last
//! minutes: model error is mostly error of the resistances and of diffusion slower than the branches. Effect: a record
//! that begins under load, the constant-voltage part of a charge, and cold cells no longer count as exact.
//! At rest the error repeats instead of averaging out: a rest of t counts as t_r ln(1 + t/t_r) under load.
//! Deviation 5: the OCV curve changes with the capacity lost by the last half-cycle ([`AgedOcv`](crate::cell::AgedOcv)).
//! Effect: the top and the bottom of an aged cell's curve give the same capacity.
//!
//! Use of the cell while the program does not run (deviation 6): [`downtime`].
//!
//! Deviation 7: constant errors of sensors and model are followed, those of [`SensorErrors`](crate::cell::SensorErrors) also
//! considered (see below); deviation 8: the current's offset is learned ([`crate::health::offset`]).
//! Deviation 9: the slowest branch has a resistance ratio of its own, also learned ([`slow_branch`]): U_n counts in the voltage
//! with that ratio.
//!
//! The filter is unscented, with additive noise and a scalar measurement. Sigma points are x and x +/- sqrt(N + lambda) L_i with L
//! the lower Cholesky factor of P and lambda = alpha^2 (N + kappa) - N; weights as in Wan and van der Merwe (2000), equations
//! 15. An update **redraws** the points from the predicted mean and covariance. (Reusing the propagated points, as some
//! packages do, differs by up to 3e-4 of SOC on drive data.) Each constant error has a column: the error of every state that one
//! standard deviation of it has caused. The first [`CONSIDERED`](state_vector::CONSIDERED) are considered in the gain (Schmidt
//! 1966): an update weighs the voltage by the covariance with them, and P is updated in Joseph's form, as the gain is not the best
//! one for P alone. The others change no mean (Friedland 1969).
//!
//! A reading beyond the gate leaves the state unchanged. After every reading has been beyond it for `lost_after_s`, the
//! filter restarts: SOC and branches from the voltage, resistance and capacity are kept.

mod bank;
mod cell_estimator;
mod downtime;
mod gaussian;
mod memory;
mod pack_bank;
mod slow_branch;
mod state;
mod state_vector;
mod step;

pub use bank::EstimatorBank;
pub use cell_estimator::{AdoptedState, CellEstimator};
pub use pack_bank::{CellModule, PackBank};
pub use state::CellState;
pub use step::{CellStep, StepResult, Update};

#[cfg(test)]
pub(crate) mod tests;
