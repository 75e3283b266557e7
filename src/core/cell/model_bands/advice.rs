//! Finds the measurements that reduce a cell model's SOC error the most.
//!
//! In: [`ModelBands`]. Out: a list of up to [`MOST`] measurements, the most useful first. Each entry states the error
//! that remains after its measurement and all earlier measurements in the list.
//!
//! The expected error is the root mean square error of the SOC, averaged over SOC and over the temperatures of
//! [`USE_C`]. The SOC comes from one voltage under a usual load and from the charge counted since the last reliable
//! voltage. The capacity, which converts this charge to SOC, is uncertain.
//!
//! A measurement observes the curve, ln(resistance) or the capacity. Covariances fall with the distance in SOC and
//! temperature, so a measurement also improves neighbouring points. Their variance p becomes p - c^2 / (v + r)
//! (Gaussian conditioning). c is the covariance with the observed point, v is the variance at the observed point, and r
//! is the error variance of the observation.

use std::fmt;

use super::{ModelBands, ResistanceBand, soc_variance};
use crate::filter::{bell, square};

const MOST: usize = 3;

/// Temperatures at which cells are used (degrees C) with their weights, for a car outdoors in a temperate climate.
const USE_C: [(f64, f64); 4] = [(-7.0, 0.15), (3.0, 0.25), (20.0, 0.4), (35.0, 0.2)];
/// SOC values over which the errors are averaged.
const USE_SOC: [f64; 10] = [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95];
/// SOC values at which the vehicle can rest.
const REST_SOC: [f64; 9] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9];

/// A measurement that the vehicle can make.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Measurement {
    /// A rest of an hour at this SOC.
    Rest(f64),
    /// A drive at this temperature (degrees C).
    Drive(f64),
    /// A charge from below 20 % to full.
    Charge,
}

impl fmt::Display for Measurement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Rest(soc) => write!(f, "one rest of an hour near {:.0} %", 100.0 * soc),
            // A cold drive may be up to 2 K warmer, or colder by any amount.
            Self::Drive(temperature_c) if *temperature_c < 10.0 => {
                write!(f, "a drive below {:.0} \u{b0}C", temperature_c + 2.0)
            }
            Self::Drive(temperature_c) => write!(f, "a drive near {temperature_c:.0} \u{b0}C"),
            Self::Charge => f.write_str("one charge from below 20 % to full"),
        }
    }
}

/// A measurement and its benefit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Advice {
    /// The measurement.
    pub measurement: Measurement,
    /// Expected SOC error (percentage points) after this measurement and all measurements before it in the list.
    pub left_points: f64,
}

/// Expected SOC error with the model (percentage points), and the measurements that reduce it. `None` if the model
/// states no error. The list is empty if no measurement helps much.
pub fn advise(bands: &ModelBands<'_>) -> Option<(f64, Vec<Advice>)> {
    let mut belief = Belief::of(bands)?;
    let first_points = belief.points();
    let candidates: Vec<Measurement> = (REST_SOC.iter().map(|soc| Measurement::Rest(*soc)))
        .chain(USE_C.iter().map(|(temperature_c, _)| Measurement::Drive(*temperature_c)))
        .chain([Measurement::Charge])
        .collect();
    let (mut points, mut advice) = (first_points, Vec::new());
    while advice.len() < MOST {
        let tried = candidates.iter().map(|measurement| (*measurement, belief.after(measurement)));
        let best = tried.map(|(measurement, after)| (after.points(), measurement, after));
        let Some((left_points, measurement, after)) = best.min_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        // A measurement must reduce the error by at least 0.1 points and by at least 5 % of the initial error.
        if points - left_points < f64::max(0.1, 0.05 * first_points) {
            break;
        }
        advice.push(Advice { measurement, left_points });
        (belief, points) = (after, left_points);
    }
    Some((first_points, advice))
}

/// Uncertainty of a model at the points at which the error is averaged, and at the points that can be measured.
#[derive(Clone)]
struct Belief {
    /// Slope of the curve (V per unit of SOC) at [`USE_SOC`], and at [`REST_SOC`].
    slope_v: Vec<f64>,
    rest_slope_v: Vec<f64>,
    /// Covariance of the curve (V^2) over [`USE_SOC`] and then [`REST_SOC`].
    curve: Vec<Vec<f64>>,
    /// Voltage drop of a usual load (V), by temperature of [`USE_C`] and SOC of [`USE_SOC`].
    drop_v: Vec<Vec<f64>>,
    resistance: Vec<Vec<Vec<f64>>>,
    capacity_std: f64,
}

impl Belief {
    fn of(bands: &ModelBands<'_>) -> Option<Self> {
        let places: Vec<f64> = USE_SOC.iter().chain(&REST_SOC).copied().collect();
        let rest_v = places.iter().map(|&soc| bands.curve_rest_v(soc)).collect::<Option<Vec<f64>>>()?;
        let modes_v: Vec<[f64; 2]> = places.iter().map(|&soc| bands.modes_v(soc)).collect();
        let covariance = |i: usize, k: usize| {
            let modes: f64 = modes_v[i].iter().zip(modes_v[k]).map(|(a, b)| a * b).sum();
            // The correlation lengths are 15 % of SOC for the curve and 20 K for resistances.
            modes + rest_v[i] * rest_v[k] * bell((places[i] - places[k]) / 0.15)
        };
        let all = 0..places.len();
        let temperatures = || USE_C.iter().map(|(temperature_c, _)| *temperature_c);
        let of_soc = |&soc: &f64| -> Vec<Vec<f64>> {
            let of: Vec<(f64, ResistanceBand)> = temperatures().map(|t| (t, bands.resistance(soc, t))).collect();
            let covariance = |(t, a): &(f64, ResistanceBand), (u, b): &(f64, ResistanceBand)| {
                a.common * b.common + a.local * b.local * bell((t - u) / 20.0)
            };
            of.iter().map(|a| of.iter().map(|b| covariance(a, b)).collect()).collect()
        };
        let drop_v = |t: f64| USE_SOC.iter().map(move |&soc| bands.usual_drop_v(&bands.model.grid_position(soc, t)));
        Some(Self {
            slope_v: USE_SOC.iter().map(|&soc| bands.slope_v(soc)).collect(),
            rest_slope_v: REST_SOC.iter().map(|&soc| bands.slope_v(soc)).collect(),
            curve: all.clone().map(|i| all.clone().map(|k| covariance(i, k)).collect()).collect(),
            drop_v: temperatures().map(|t| drop_v(t).collect()).collect(),
            resistance: USE_SOC.iter().map(of_soc).collect(),
            capacity_std: bands.capacity_std(),
        })
    }

    fn points(&self) -> f64 {
        // Assumption: since the last reliable voltage, the cell was charged or discharged by half of its capacity. Even
        // with the right capacity, the counted SOC has an error of 6 %, because of its initial value and the current
        // sensor.
        let counted = square(0.06) + square(0.5 * self.capacity_std);
        let at = |t: usize, s: usize| {
            let of_drop = self.resistance[s][t][t] * square(self.drop_v[t][s]);
            soc_variance((self.curve[s][s] + of_drop).max(f64::MIN_POSITIVE), self.slope_v[s], counted)
        };
        let mean = |t: usize| (0..USE_SOC.len()).map(|s| at(t, s)).sum::<f64>() / USE_SOC.len() as f64;
        let variance: f64 = USE_C.iter().enumerate().map(|(t, (_, weight))| weight * mean(t)).sum();
        100.0 * variance.sqrt()
    }

    fn after(&self, measurement: &Measurement) -> Self {
        let mut after = self.clone();
        match measurement {
            Measurement::Rest(soc) => {
                let place = REST_SOC.iter().position(|known| known == soc).unwrap_or(0);
                // Two errors: the voltage after an hour of rest (5 mV), and the SOC, which was counted since another
                // rest (2 %).
                let noise_v = f64::hypot(0.005, 0.02 * self.rest_slope_v[place]);
                condition(&mut after.curve, USE_SOC.len() + place, square(noise_v));
            }
            Measurement::Drive(temperature_c) => {
                let place = USE_C.iter().position(|(known, _)| known == temperature_c).unwrap_or(0);
                // A drive determines the resistance to 10 %. A charge from below 20 % to full determines the capacity
                // to 2 %.
                after.resistance.iter_mut().for_each(|of_soc| condition(of_soc, place, square(0.1)));
            }
            Measurement::Charge => after.capacity_std = self.capacity_std.min(0.02),
        }
        after
    }
}

/// Updates a covariance with an observation of element `at`. `variance` is the error variance of the observation.
fn condition(covariance: &mut [Vec<f64>], at: usize, variance: f64) {
    let column: Vec<f64> = covariance.iter().map(|row| row[at]).collect();
    let total = column[at] + variance;
    for (row, a) in covariance.iter_mut().zip(&column) {
        row.iter_mut().zip(&column).for_each(|(value, b)| *value -= a * b / total);
    }
}
