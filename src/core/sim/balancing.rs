//! Simulates passive balancing: the BMS bleeds (discharges through a resistor) the cells whose voltage is above the
//! lowest cell voltage.
//!
//! The BMS bleeds cells near the end of a charge and during the first rest after the charge, even while the buses
//! sleep. If the car drives before this rest, balancing pauses during the drive. The BMS compares the voltages that its
//! own channels measure. These voltages include the channels' constant offsets but no noise, because a BMS averages its
//! readings.

use super::truth::Pack;

/// Settings of a BMS's balancing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Balancing {
    /// Current of a balancing resistor (A).
    pub bleed_a: f64,
    /// Difference to the lowest cell voltage (V) at which the BMS starts to bleed a cell.
    pub start_v: f64,
    /// Difference to the lowest cell voltage (V) below which the BMS stops bleeding a cell.
    pub stop_v: f64,
    /// If the fullest cell has at least this SOC, a charge is near its end.
    pub from_soc: f64,
}

impl Balancing {
    /// Settings of a typical BMS for cells of `capacity_ah`: it bleeds 1 mA per Ah, starts at 10 mV and stops at 5 mV.
    pub fn usual(capacity_ah: f64) -> Self {
        Self { bleed_a: 1e-3 * capacity_ah, start_v: 0.010, stop_v: 0.005, from_soc: 0.7 }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Balancer {
    settings: Balancing,
    charging_s: f64,
    /// True from near the end of a charge until the end of the first rest after it.
    is_armed: bool,
    has_rested: bool,
}

impl Balancer {
    pub(crate) fn new(settings: Balancing) -> Self {
        Self { settings, charging_s: 0.0, is_armed: false, has_rested: false }
    }

    /// Switches the resistors for the next step. The last step had `dt_s` seconds with the current `current_a`.
    /// `offset_v` returns a channel's offset (V).
    pub(crate) fn update(&mut self, pack: &mut Pack, current_a: f64, dt_s: f64, offset_v: impl Fn(usize) -> f64) {
        // A current of at most 0.002 C counts as rest.
        let is_rest = current_a.abs() <= 0.002 * pack.lowest_capacity_ah();
        self.charging_s = if current_a < 0.0 && !is_rest { self.charging_s + dt_s } else { 0.0 };
        // Regenerative braking is shorter than 60 s, so it does not count as a charge.
        let ends_charge = self.charging_s >= 60.0 && pack.highest_soc() >= self.settings.from_soc;
        if ends_charge {
            (self.is_armed, self.has_rested) = (true, false);
        } else if is_rest {
            self.has_rested |= self.is_armed;
        } else if self.has_rested {
            (self.is_armed, self.has_rested) = (false, false);
        }
        if !(ends_charge || is_rest && self.is_armed) {
            pack.set_bleeds(|_, _| 0.0);
            return;
        }
        let seen_v: Vec<f64> = pack.voltages_v(current_a).enumerate().map(|(i, v)| v + offset_v(i)).collect();
        let lowest_v = seen_v.iter().copied().fold(f64::INFINITY, f64::min);
        let Balancing { bleed_a, start_v, stop_v, .. } = self.settings;
        pack.set_bleeds(|i, cell| {
            let limit_v = if cell.bleed_a > 0.0 { stop_v } else { start_v };
            if seen_v[i] - lowest_v > limit_v { bleed_a } else { 0.0 }
        });
    }
}
