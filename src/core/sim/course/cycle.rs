//! Computes the current of the scenarios `paper` and `reference`, which cycle between two SOC limits.

use super::demand::Demand;
use crate::sim::noise::Noise;
use crate::sim::scenario::Settings;
use crate::sim::truth::Pack;

/// Range of the pulse currents (A) for a cell of 30 Ah. The currents are uniformly distributed.
const PULSE_A: (f64, f64) = (0.0, 30.0);
const PULSE_S: f64 = 60.0;

#[derive(Debug, Clone)]
enum Load {
    Constant { current_a: f64 },
    Pulses(Box<Pulses>),
}

/// A load whose current changes every [`PULSE_S`].
#[derive(Debug, Clone)]
struct Pulses {
    noise: Noise,
    scale: f64,
    current_a: f64,
    left_s: f64,
}

impl Load {
    fn next_a(&mut self, dt_s: f64) -> f64 {
        match self {
            Self::Constant { current_a } => *current_a,
            Self::Pulses(pulses) => {
                if pulses.left_s <= 0.0 {
                    pulses.current_a = pulses.scale * pulses.noise.between(PULSE_A.0, PULSE_A.1);
                    pulses.left_s = PULSE_S;
                }
                pulses.left_s -= dt_s;
                pulses.current_a
            }
        }
    }
}

/// Discharges to the low SOC, charges to the high SOC, ages the pack, and repeats.
#[derive(Debug, Clone)]
pub(crate) struct CycleCourse {
    load: Load,
    charge_a: f64,
    charging: bool,
    soc_window: (f64, f64),
    cycles: Option<u32>,
    loss_ah: f64,
    end_capacity_ah: f64,
}

impl CycleCourse {
    pub(super) fn paper(settings: &Settings, scale: f64) -> Self {
        // Current in both directions (A) for a cell of 2.6 Ah. 48 cycles then take 2.23e5 s, as in "Battery Predictions
        // for Electronic Prognostics", whose cycles the scenario `paper` repeats.
        let current_a = 1.325 * scale;
        Self::new(settings, Load::Constant { current_a }, current_a)
    }

    pub(super) fn reference(settings: &Settings, scale: f64, noise: Noise) -> Self {
        let load = Pulses { noise, scale, current_a: 0.0, left_s: 0.0 };
        // Charging current (A) for a cell of 30 Ah: 0.5 C. The published example does not state this current.
        Self::new(settings, Load::Pulses(Box::new(load)), 15.0 * scale)
    }

    fn new(settings: &Settings, load: Load, charge_a: f64) -> Self {
        Self {
            load,
            charge_a,
            charging: false,
            soc_window: settings.soc_window,
            cycles: settings.cycles,
            loss_ah: settings.pack.ageing.capacity_loss_ah_per_cycle,
            end_capacity_ah: settings.end_capacity_ah,
        }
    }

    pub(super) fn next(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        if self.charging && pack.highest_soc() >= self.soc_window.1 {
            if self.is_last_cycle(pack) {
                return Demand::Finished;
            }
            pack.complete_cycle();
            self.charging = false;
        } else if !self.charging && pack.lowest_soc() <= self.soc_window.0 {
            self.charging = true;
        }
        Demand::Current(if self.charging { -self.charge_a } else { self.load.next_a(dt_s) })
    }

    /// Whether this cycle is the last. The end capacity has a tolerance of half the loss per cycle, because of
    /// rounding: 47 losses of 0.05 Ah do not add up to exactly 2.35 Ah.
    fn is_last_cycle(&self, pack: &Pack) -> bool {
        self.cycles.is_some_and(|cycles| pack.cycles() + 1 >= cycles)
            || pack.lowest_capacity_ah() - 0.5 * self.loss_ah < self.end_capacity_ah
    }
}
