//! Passes the pack's values to the record of use (counters of how the pack was used), every 0.1 s while the buses are
//! not silent.
//!
//! While the current is doubtful, current and SOC are passed as unknown. While two nodes send the same input message,
//! all values are passed as unknown. The limits come from `[outlook]`. If `[outlook]` has no voltage limits, the widest
//! limits of the cell models apply.

use super::Stages;
use crate::health::{OutlookConfig, UseLimits, UseSample};
use crate::quantity::{Mode, Timestamp};

impl Stages {
    pub(crate) fn count_use(&mut self, now: Timestamp) {
        let limits = self.use_limits();
        let sample = if self.sampling.has_second_sender { UseSample::default() } else { self.use_sample(now) };
        self.learning.state.use_counter.observe(now, &limits, &sample);
    }

    fn use_limits(&self) -> UseLimits {
        let OutlookConfig { min_voltage_v, max_voltage_v, max_discharge_a, max_charge_a, .. } =
            self.learning.config.outlook;
        let OutlookConfig { min_temperature_c, max_temperature_c, .. } = self.learning.config.outlook;
        let models = || self.estimation.bank.kinds().map(|(model, _)| model);
        let lowest_v = || models().map(|model| model.voltage_min_v).reduce(f64::min);
        let highest_v = || models().map(|model| model.voltage_max_v).reduce(f64::max);
        UseLimits {
            temperature_c: [min_temperature_c, max_temperature_c],
            voltage_v: [min_voltage_v.or_else(lowest_v), max_voltage_v.or_else(highest_v)],
            current_a: [max_charge_a.map(|charge_a| -charge_a), max_discharge_a],
            max_age_s: self.sampling.sampler.max_ages_s(),
            rest_a: self.learning.config.transition.dead_band_a / self.sampling.sampler.strings(),
            rated_ah: self.estimation.bank.own_model().rated_capacity_ah,
        }
    }

    fn use_sample(&self, now: Timestamp) -> UseSample {
        let Self { sampling, estimation, learning, alarming, .. } = self;
        let is_certain = !estimation.is_current_doubtful;
        let soc = learning.state.pack.filter(|_| is_certain && estimation.all_trusted).map(|pack| pack.soc);
        UseSample {
            temperature_c: sampling.sampler.temperature_range_c(now),
            voltage_v: sampling.sampler.voltage_range_v(now, &alarming.faulty_channels),
            current_a: sampling.sampler.cell_current_a(now).filter(|_| is_certain),
            soc,
            is_charging: learning.mode() == Mode::Charge,
        }
    }
}
