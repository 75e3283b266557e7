//! Computes the current of the scenario `ev-day`: a day of an electric car with drives, sleep while parked, and a fast
//! charge.
//!
//! The car is a point mass that follows random target speeds with bounded acceleration. The power of a 60 kWh car is
//! scaled to the simulated pack, so that the cells have the C-rate of that car.

use super::demand::Demand;
use crate::quantity::DAY_S;
use crate::sim::noise::Noise;
use crate::sim::truth::Pack;

const AUXILIARY_W: f64 = 600.0;
/// Largest acceleration and deceleration (m/s^2).
const ACCELERATION_M_S2: (f64, f64) = (1.2, 1.5);
/// Largest currents during regeneration and during traction (C).
const CURRENT_LIMIT_C: (f64, f64) = (0.8, 2.5);
const CHARGE_TO_SOC: f64 = 0.80;
/// Fast charging current (C). The first value applies up to SOC 0.4. From there, the current falls linearly to the
/// second value at SOC 0.8.
const CHARGE_C: (f64, f64) = (1.5, 0.6);

#[derive(Debug, Clone, Copy, PartialEq)]
enum DayPhase {
    Drive {
        left_s: f64,
    },
    /// Asleep until this time of the day (s).
    Park {
        until_s: f64,
    },
    FastCharge,
}

/// A day from 7:30: drive to work, drive back at 17:00 with a stop at the charger, park overnight.
const DAY: [DayPhase; 6] = [
    DayPhase::Drive { left_s: 3300.0 },
    DayPhase::Park { until_s: 9.5 * 3600.0 },
    DayPhase::Drive { left_s: 3300.0 },
    DayPhase::FastCharge,
    DayPhase::Drive { left_s: 900.0 },
    DayPhase::Park { until_s: DAY_S },
];

/// Repeated days. Each completed day counts as a cycle.
#[derive(Debug, Clone)]
pub(crate) struct DayCourse {
    plan: usize,
    phase: DayPhase,
    day_s: f64,
    noise: Noise,
    capacity_ah: f64,
    speed_m_s: f64,
    target_m_s: f64,
    hold_s: f64,
}

impl DayCourse {
    pub(super) fn new(capacity_ah: f64, noise: Noise) -> Self {
        Self { plan: 0, phase: DAY[0], day_s: 0.0, noise, capacity_ah, speed_m_s: 0.0, target_m_s: 0.0, hold_s: 0.0 }
    }

    pub(super) fn next(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        // If a drive empties the pack below SOC 10 %, the drive ends early, and the car charges.
        if matches!(self.phase, DayPhase::Drive { .. }) && pack.lowest_soc() < 0.10 {
            self.phase = DayPhase::FastCharge;
        }
        match self.phase {
            DayPhase::Drive { left_s } if left_s <= 0.0 => {
                self.speed_m_s = 0.0;
                self.next_phase(pack, dt_s)
            }
            DayPhase::Drive { left_s } => {
                self.phase = DayPhase::Drive { left_s: left_s - dt_s };
                self.day_s += dt_s;
                Demand::Current(self.drive_a(pack, dt_s))
            }
            DayPhase::FastCharge if pack.highest_soc() >= CHARGE_TO_SOC => self.next_phase(pack, dt_s),
            DayPhase::FastCharge => {
                self.day_s += dt_s;
                Demand::Current(self.charge_a(pack))
            }
            DayPhase::Park { until_s } => {
                // The car sleeps for at least 60 s, even if drives and charges took longer than planned.
                let duration_s = (until_s - self.day_s).max(60.0);
                self.day_s += duration_s;
                self.advance_plan(pack);
                Demand::Asleep { duration_s }
            }
        }
    }

    fn next_phase(&mut self, pack: &mut Pack, dt_s: f64) -> Demand {
        self.advance_plan(pack);
        self.next(pack, dt_s)
    }

    fn advance_plan(&mut self, pack: &mut Pack) {
        self.plan = (self.plan + 1) % DAY.len();
        self.phase = DAY[self.plan];
        if self.plan == 0 {
            self.day_s -= DAY_S;
            pack.complete_cycle();
        }
    }

    fn drive_a(&mut self, pack: &Pack, dt_s: f64) -> f64 {
        if self.hold_s <= 0.0 {
            // Target speeds (km/h) in town, on country roads and on the motorway.
            self.target_m_s = self.noise.choose(&[0.0, 30.0, 50.0, 50.0, 70.0, 90.0, 110.0, 120.0]) / 3.6;
            self.hold_s = self.noise.between(15.0, 120.0);
        }
        self.hold_s -= dt_s;
        let wanted = (self.target_m_s - self.speed_m_s) / dt_s.max(1.0); // closes a small speed difference in 1 s
        let acceleration = wanted.clamp(-ACCELERATION_M_S2.1, ACCELERATION_M_S2.0);
        self.speed_m_s = (self.speed_m_s + acceleration * dt_s).max(0.0);
        // `power_w` applies to a car with a 60,000 Wh pack.
        let capacities_per_hour = power_w(self.speed_m_s, acceleration) / 60_000.0;
        let (lowest_v, highest_v) = pack.extremes_v(0.0);
        // The cells of the 60 kWh car have a nominal voltage of 3.65 V.
        let current_c = capacities_per_hour * 3.65 / (0.5 * (lowest_v + highest_v));
        let current_a = self.capacity_ah * current_c.clamp(-CURRENT_LIMIT_C.0, CURRENT_LIMIT_C.1);
        if current_a > 0.0 {
            return current_a;
        }
        let floor_a = pack.current_at_highest_a(pack.model().voltage_max_v); // regeneration never overcharges
        current_a.max(floor_a.min(0.0))
    }

    fn charge_a(&self, pack: &Pack) -> f64 {
        let along = ((pack.highest_soc() - 0.4) / (CHARGE_TO_SOC - 0.4)).clamp(0.0, 1.0);
        let current_c = CHARGE_C.0 + along * (CHARGE_C.1 - CHARGE_C.0);
        (-self.capacity_ah * current_c).max(pack.current_at_highest_a(pack.model().voltage_max_v))
    }
}

/// Electric power (W), negative when braking feeds the battery.
fn power_w(speed_m_s: f64, acceleration_m_s2: f64) -> f64 {
    if speed_m_s == 0.0 {
        return AUXILIARY_W;
    }
    // The mass is 1900 kg with two people. The rolling resistance is 1 % of the weight. The last factor is half of the
    // air density, times the drag coefficient, times the frontal area.
    let force_n = 1900.0 * (acceleration_m_s2 + 9.81 * 0.010) + (0.5 * 1.2 * 0.25 * 2.3) * speed_m_s * speed_m_s;
    let wheel_w = force_n * speed_m_s;
    AUXILIARY_W + if wheel_w > 0.0 { wheel_w / 0.90 } else { wheel_w * 0.70 }
}
