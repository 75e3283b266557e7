//! Defines the named scenarios and their settings.
//!
//! Currents and charges in the table apply to a cell with the nominal capacity. They scale with the capacity of the
//! configured cell model.
//!
//! | scenario | nominal capacity | source | course |
//! | --- | --- | --- | --- |
//! | `paper` | 2.6 Ah | "Battery Predictions for Electronic Prognostics" | 1.325 A between SOC 0.3 and 0.9; 48 cycles (2.23e5 s) |
//! | `reference` | 30 Ah | a published example | random discharge pulses to SOC 0.3, charge with 15 A to SOC 0.9; -1 Ah per cycle |
//! | `random-walk` | 2.1 Ah | NASA's randomized set | loads of 5 min (-4.5 to 4.5 A, 3.2 to 4.2 V); 2 reference cycles after 1,500 loads |
//! | `ev-day` | 50 Ah | packwatch | drive, park (buses asleep), drive, fast charge, drive, park; 96 cells |

use super::sensor::{SensorError, Sensors};
use super::truth::{Ageing, Hysteresis, PackSettings, Spread};

/// A named scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scenario {
    /// The run in the paper "Battery Predictions for Electronic Prognostics": 2.6 Ah, -0.05 Ah per cycle, SOC 30-90 %,
    /// until 0.25 Ah.
    Paper,
    /// A published example with a cell of 30 Ah: random discharge pulses, -1 Ah per cycle.
    Reference,
    /// Random 5-minute loads, with reference cycles between blocks of loads.
    RandomWalk,
    /// A day of an electric car: drive, park, fast charge; 96 cells.
    EvDay,
}

/// All settings of a simulation. [`Settings::of`] gives the defaults.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// The scenario, which determines the course of the current.
    pub scenario: Scenario,
    /// Seed of all randomness.
    pub seed: u64,
    /// Properties of the simulated pack.
    pub pack: PackSettings,
    /// Errors of the sensors.
    pub sensors: Sensors,
    /// Time between current samples (ns).
    pub current_period_ns: i64,
    /// Time between samples of voltages and temperatures (ns); a multiple of `current_period_ns`.
    pub cell_period_ns: i64,
    /// The simulation ends after this number of the scenario's cycles; `None` = no limit.
    pub cycles: Option<u32>,
    /// The simulation ends after this time (s); `None` = no limit.
    pub duration_s: Option<f64>,
    /// The simulation ends after the cycle in which the weakest cell reaches this capacity (Ah); 0 = no limit. `ev-day`
    /// ignores this limit.
    pub end_capacity_ah: f64,
    /// SOC window of the cycling scenarios: charging starts at the lower SOC, discharging at the upper SOC.
    pub soc_window: (f64, f64),
    /// Only for the random walk: number of loads between two blocks of reference cycles.
    pub walk_steps: u32,
}

impl Scenario {
    /// Capacity of the cell in the scenario's source (Ah).
    pub const fn nominal_ah(self) -> f64 {
        match self {
            Self::Paper => 2.6,
            Self::Reference => 30.0,
            Self::RandomWalk => 2.1,
            Self::EvDay => 50.0,
        }
    }
}

const SECOND_NS: i64 = 1_000_000_000;

impl Settings {
    /// The scenario's defaults for a cell of `capacity_ah`.
    pub fn of(scenario: Scenario, capacity_ah: f64) -> Self {
        let scale = capacity_ah / scenario.nominal_ah();
        let mut s = Self {
            scenario,
            seed: 1,
            pack: PackSettings {
                cells: 1,
                capacity_ah,
                initial_soc: 0.9,
                spread: Spread::default(),
                ageing: Ageing { capacity_loss_ah_per_cycle: 0.05 * scale, ..Ageing::default() },
                hysteresis: Hysteresis::default(),
                leakage_a: 0.0,
                ambient_c: 25.0,
            },
            // The accuracy requirement assumes these sensor errors for the paper's scenario.
            sensors: Sensors {
                current: SensorError { noise_std: 0.02, offset: 0.01, gain: 0.005, ..SensorError::NONE },
                voltage: SensorError { noise_std: 0.005, ..SensorError::NONE },
                temperature: SensorError { noise_std: 0.1, ..SensorError::NONE },
            },
            current_period_ns: SECOND_NS,
            cell_period_ns: SECOND_NS,
            cycles: None,
            duration_s: None,
            end_capacity_ah: 0.25 * scale,
            soc_window: (0.30, 0.90),
            walk_steps: 1500,
        };
        match scenario {
            Scenario::Paper => {}
            // The only sensor error is the voltage noise that the example's filter assumes (R = 1e-3, which is 32 mV).
            Scenario::Reference => {
                s.pack.initial_soc = 1.0;
                s.pack.ageing.capacity_loss_ah_per_cycle = scale;
                let voltage = SensorError { noise_std: 0.032, ..SensorError::default() };
                s.sensors = Sensors { voltage, ..Sensors::default() };
                (s.end_capacity_ah, s.cycles) = (0.0, Some(10));
            }
            // In the measured cells, 1,500 loads (about 310 Ah) cost about 5 % capacity and add about 10 % resistance.
            Scenario::RandomWalk => {
                s.pack.ageing = Ageing {
                    capacity_loss_ah_per_ah: 3.4e-4,
                    resistance_growth_per_ah: 3.2e-4 / (s.pack.capacity_ah / 2.1),
                    ..Ageing::default()
                };
                (s.end_capacity_ah, s.cycles) = (0.0, Some(1));
            }
            Scenario::EvDay => s.set_ev_day(),
        }
        s
    }

    /// Sampling periods, sensor errors and differences between cells of a typical pack.
    fn set_ev_day(&mut self) {
        let capacity_ah = self.pack.capacity_ah;
        self.pack.cells = 96;
        self.pack.initial_soc = 0.85;
        self.pack.spread = Spread { capacity: 0.01, resistance: 0.03, soc: 0.005 };
        self.pack.ageing =
            Ageing { capacity_loss_ah_per_ah: 1e-5, resistance_growth_per_ah: 1e-5, ..Ageing::default() };
        let (noise_std, offset) = (0.002 * capacity_ah, 0.0005 * capacity_ah);
        self.sensors.current = SensorError { noise_std, offset, gain: 0.005, ..SensorError::default() };
        self.sensors.voltage.noise_std = 0.001;
        // At ten samples a second, more noise would look like a temperature change of 5 K/s, which is a usual limit.
        self.sensors.temperature.noise_std = 0.02;
        (self.current_period_ns, self.cell_period_ns) = (SECOND_NS / 100, SECOND_NS / 10);
        (self.end_capacity_ah, self.duration_s) = (0.0, Some(86_400.0));
    }
}
