//! Computes the current of the scenario `random-walk`: blocks of 5-minute loads of random current within voltage
//! limits. After each block, reference cycles (a full charge and a full discharge) follow.

use super::demand::Demand;
use crate::sim::noise::Noise;
use crate::sim::scenario::Settings;
use crate::sim::truth::Pack;

/// Load currents (A) for a cell of 2.1 Ah.
const LOADS_A: [f64; 12] = [-4.5, -3.75, -3.0, -2.25, -1.5, -0.75, 0.75, 1.5, 2.25, 3.0, 3.75, 4.5];
/// Voltage range of the loads (V), narrowed to the cell's own limits.
const RANGE_V: (f64, f64) = (3.2, 4.2);
/// Reference current in both directions (A) for a cell of 2.1 Ah.
const REFERENCE_A: f64 = 2.0;
/// Rest after each half of a reference cycle (s).
const REST_S: f64 = 1800.0;

#[derive(Debug, Clone, Copy, PartialEq)]
enum WalkPhase {
    Walk { steps_left: u32, current_a: f64, left_s: f64 },
    Charge { cycles_left: u32 },
    Discharge { cycles_left: u32 },
    Rest { is_full: bool, cycles_left: u32, left_s: f64 },
}

/// Blocks of random loads. A block and the reference cycles after it count as one cycle.
#[derive(Debug, Clone)]
pub(crate) struct WalkCourse {
    phase: WalkPhase,
    noise: Noise,
    scale: f64,
    steps: u32,
    cycles: Option<u32>,
    end_capacity_ah: f64,
}

impl WalkCourse {
    pub(super) fn new(settings: &Settings, scale: f64, noise: Noise) -> Self {
        Self {
            phase: WalkPhase::Walk { steps_left: settings.walk_steps, current_a: 0.0, left_s: 0.0 },
            noise,
            scale,
            steps: settings.walk_steps,
            cycles: settings.cycles,
            end_capacity_ah: settings.end_capacity_ah,
        }
    }

    pub(super) fn next(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        let low_v = RANGE_V.0.max(pack.model().voltage_min_v);
        let high_v = RANGE_V.1.min(pack.model().voltage_max_v);
        match self.phase {
            WalkPhase::Walk { steps_left, current_a, left_s } => {
                let inside = pack.lowest_v(current_a) > low_v && pack.highest_v(current_a) < high_v;
                if inside && left_s > 0.0 {
                    self.phase = WalkPhase::Walk { steps_left, current_a, left_s: left_s - dt_s };
                    return Demand::Current(current_a);
                }
                if steps_left == 0 {
                    // Two reference cycles follow each block of loads.
                    return self.enter(WalkPhase::Charge { cycles_left: 2 }, pack, dt_s);
                }
                let current_a = self.draw_load(pack, low_v, high_v);
                // A load lasts 300 s, unless a voltage limit ends it earlier.
                self.phase = WalkPhase::Walk { steps_left: steps_left - 1, current_a, left_s: 300.0 - dt_s };
                Demand::Current(current_a)
            }
            WalkPhase::Charge { cycles_left } => {
                let current_a = pack.current_at_highest_a(high_v).max(-REFERENCE_A * self.scale);
                // Charging at constant voltage ends at this current (A, for a cell of 2.1 Ah).
                if current_a > -0.05 * self.scale {
                    let rest = WalkPhase::Rest { is_full: true, cycles_left, left_s: REST_S };
                    return self.enter(rest, pack, dt_s);
                }
                Demand::Current(current_a)
            }
            WalkPhase::Rest { is_full, cycles_left, left_s } if left_s > 0.0 => {
                self.phase = WalkPhase::Rest { is_full, cycles_left, left_s: left_s - dt_s };
                Demand::Current(0.0)
            }
            WalkPhase::Rest { is_full: true, cycles_left, .. } => {
                self.enter(WalkPhase::Discharge { cycles_left }, pack, dt_s)
            }
            WalkPhase::Rest { cycles_left: 0, .. } => self.next_block(pack, dt_s),
            WalkPhase::Rest { cycles_left, .. } => self.enter(WalkPhase::Charge { cycles_left }, pack, dt_s),
            WalkPhase::Discharge { cycles_left } => {
                let current_a = REFERENCE_A * self.scale;
                if pack.lowest_v(current_a) <= low_v {
                    let rest = WalkPhase::Rest { is_full: false, cycles_left: cycles_left - 1, left_s: REST_S };
                    return self.enter(rest, pack, dt_s);
                }
                Demand::Current(current_a)
            }
        }
    }

    fn enter(&mut self, phase: WalkPhase, pack: &mut Pack, dt_s: f64) -> Demand {
        self.phase = phase;
        self.next(pack, dt_s)
    }

    fn next_block(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        pack.complete_cycle();
        if self.cycles.is_some_and(|cycles| pack.cycles() >= cycles) || pack.lowest_capacity_ah() < self.end_capacity_ah
        {
            return Demand::Finished;
        }
        self.enter(WalkPhase::Walk { steps_left: self.steps, current_a: 0.0, left_s: 0.0 }, pack, dt_s)
    }

    fn draw_load(&mut self, pack: &Pack, low_v: f64, high_v: f64) -> f64 {
        // Tries up to 32 random loads. If none stays within the voltage range, the pack rests.
        (0..32)
            .map(|_| self.scale * self.noise.choose(&LOADS_A))
            .find(|&a| pack.lowest_v(a) > low_v && pack.highest_v(a) < high_v)
            .unwrap_or(0.0)
    }
}
