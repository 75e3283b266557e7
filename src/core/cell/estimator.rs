//! Estimates one cell's state, sample by sample, with an unscented Kalman filter.
//!
//! State x = [SOC, ln rho, C, U_1 .. U_n]: state of charge (fraction), logarithm of the resistance relative to a new
//! cell, capacity (Ah), branch voltages (V); n = 1 to 3 branches. P is the covariance of x. The branch voltages come
//! last, because a linear map moves their sigma points.
//!
//! Prediction over the charge q (A s) and the time dt (s) since the last sample: SOC -= q / (3600 C). Each U_i follows
//! `circuit::BranchAt` with the mean current q/dt.
//!
//! Update with the voltage V = OCV(SOC, T) - sum U_i - rho R0(SOC, T) I.
//!
//! Source: "Battery Predictions for Electronic Prognostics", section 3.3.3, called "the paper" below.
//!
//! Deviation 1: ln rho is a state (random walk). Reason: in an aged cell, a filter with a fixed resistance mistakes the
//! higher resistance for lost charge. Effect: without this state, the end of life of the measured cells is reported 14
//! to 23 cycles early.
//!
//! Deviation 2: C is a state ([`CapacityState::Joint`](crate::cell::CapacityState::Joint)). Reason: an error of the
//! capacity causes an error of the SOC in proportion to the charge moved, so the two errors are correlated. Without
//! this correlation, the filter would treat its assumed capacity as if it had been measured. `Held` gives the paper's
//! filter (C known, variance 1e-12 Ah^2).
//!
//! Deviation 3: process noises are densities per second. The measurement variance is sensor^2 + model^2 / dt, with the
//! standard deviations of the sensor's noise and of the model's error over one second. Reason: the model error changes
//! slowly, so information is counted per second and not per sample. Effect: the sample rate does not change the result.
//!
//! Deviation 4: model^2 = base^2 + (k drop)^2 + (k' load)^2. The base is the error that the cell model states, or a
//! configured constant. The drop is the present voltage drop in the cell. The load is the voltage drop caused by the
//! load of the last minutes. Reason: most of the model error comes from the resistances and from diffusion that is
//! slower than the branches. Effect: voltages have less weight when a log starts under load, in the constant-voltage
//! part of a charge, and in cold cells. During a rest, all readings have nearly the same model error, so it does not
//! average out. A rest of duration t therefore gives only as much information as the time t_r ln(1 + t/t_r) under load,
//! with t_r = 1000 s.
//!
//! Deviation 5: the OCV curve changes with the lost capacity ([`AgedOcv`](crate::cell::AgedOcv)). The curve belongs to
//! the capacity that was learned up to the end of the last half-cycle (charge or discharge). Effect: readings at the
//! top and at the bottom of an aged cell's curve give the same capacity.
//!
//! Deviation 6: the filter allows for use of the cell while the program did not run, see [`downtime`].
//!
//! Deviation 7: the filter tracks the effects of constant errors, which are errors of the sensors and of the model that
//! do not change with time. The gain takes the errors of [`SensorErrors`](crate::cell::SensorErrors) into account (see
//! below).
//!
//! Deviation 8: the offset of the current sensor is learned ([`crate::health::offset`]).
//!
//! Deviation 9: the slowest branch has its own learned resistance ratio ([`slow_branch`]), which multiplies U_n in the
//! equation of V.
//!
//! The filter has additive noise and a scalar measurement. The sigma points are x and x +/- sqrt(N + lambda) L_i. L_i
//! is column i of the lower Cholesky factor of P, and lambda = alpha^2 (N + kappa) - N. The weights follow Wan and van
//! der Merwe (2000), equations 15. An update **redraws** the points from the predicted mean and covariance.
//!
//! For each constant error, the filter keeps a column: the shift of each state that one standard deviation of this
//! error has caused. The gain considers the first [`CONSIDERED`](state_vector::CONSIDERED) constant errors (Schmidt
//! 1966): the weight of a voltage in an update depends also on the shifts that these errors cause. This gain is not
//! optimal for P alone, so P is updated in Joseph's form. The remaining constant errors do not change the mean
//! (Friedland 1969).
//!
//! The gate is a bound on measured minus predicted voltage. A reading beyond the gate does not change the state. If all
//! readings during `lost_after_s` were beyond the gate, the filter restarts: it determines SOC and branch voltages from
//! the voltage, and keeps resistance and capacity.

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
mod voltage_reach;

pub use bank::EstimatorBank;
pub use cell_estimator::{AdoptedState, CellEstimator};
pub use pack_bank::{CellModule, PackBank};
pub use state::CellState;
pub use step::{CellStep, StepResult, Update};
pub use voltage_reach::reach_of_error;

#[cfg(test)]
pub(crate) mod tests;
