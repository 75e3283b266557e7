//! Another configuration for a monitor that runs.
//!
//! In: a checked configuration. Out: what changed, and the events and frames that follow from it; or why it needs a
//! restart, with nothing changed. Taken over is what inputs are judged by and what is told: limits, thresholds, modes,
//! noises, outputs. Filters, what was learned, the states of alarms whose rule and severity are still there, counters and
//! schedules go on as they are, so estimates are the same as without it where nothing that makes them changed.
//!
//! What a value was measured by cannot be changed under it: another recharge window or another usable load begins
//! with "not known", except where the old value can be restated exactly. Initial values concern only cells of which
//! nothing is known: they wait for another pack.

use super::{Event, EventKind, Monitor, MonitorConfig, Outputs, j1939};
use crate::alarm::{Observation, Rule};
use crate::filter::ScalarGaussian;
use crate::health::{CapacityMethod, HealthConfig, RechargeConfig};
use crate::quantity::{BusIndex, CellIndex, Timestamp};

/// What a new configuration changed.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Reconfigured {
    /// The tables of the file whose settings are others now, as they are written there.
    pub changed: Vec<&'static str>,
    /// Alarms, raised or past, that ended because no threshold watches them any more.
    pub alarms_ended: usize,
}

/// A setting that cannot change while the program runs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: {found}, running with {allowed}: needs a restart")]
pub struct ReconfigureError {
    /// The key, or the table it is in.
    pub key: &'static str,
    /// In the new configuration.
    pub found: String,
    /// As it runs.
    pub allowed: String,
}

impl Monitor {
    /// Goes on with another configuration, as if between two inputs. `now` is when it was asked for: it stamps the event,
    /// and no time passes.
    ///
    /// # Errors
    /// The first setting that needs a restart; the monitor is as it was.
    pub fn reconfigure(
        &mut self,
        config: MonitorConfig,
        now: Timestamp,
        out: &mut Outputs,
    ) -> Result<Reconfigured, ReconfigureError> {
        self.config.check_fits(&config)?;
        let told = out.events.len();
        if !self.config.steps_as(&config) {
            // What was measured before is judged as it was then.
            self.make_steps(out);
        }
        let changed = self.config.changed_tables(&config);
        let old = std::mem::replace(&mut self.config, config);
        self.estimators.reconfigure(&self.config.model, &self.config.estimator);
        self.intake.reconfigure(&self.config);
        self.sampler.reconfigure(&self.config.sample);
        self.take_over_output(&old, out);
        if old.j1939 != self.config.j1939 {
            self.take_over_j1939(out);
        }
        self.forget_measures(&old.health, out);
        let (rules, cells) = (self.config.rules.clone(), self.config.sample.cells);
        self.all_valid_told = false;
        let alarms_ended = self.alarms.reconfigure(self.now, rules, cells, &mut self.scratch.alarm_changes);
        self.report_alarms(out);
        if old.health.recharge != self.config.health.recharge {
            let period = self.known_recharge_period().unwrap_or_default();
            self.observe_alarm(Rule::RechargePeriodLow, None, period, out);
        }
        if old.health.end_of_life_ah != self.config.health.end_of_life_ah {
            self.observe_life(true, out);
        }
        self.tell_j1939();
        let alarms = u32::try_from(alarms_ended).unwrap_or(u32::MAX);
        out.events.push(Event { time: now.max(self.now), kind: EventKind::Reconfigured { alarms_ended: alarms } });
        self.statistics.note_events(&out.events[told..]);
        self.due = self.find_due();
        Ok(Reconfigured { changed, alarms_ended })
    }

    /// A shorter period begins now, not when the longer one is over.
    fn take_over_output(&mut self, old: &MonitorConfig, out: &mut Outputs) {
        let Some(output) = &self.config.output else {
            // What a test sends has nowhere to go.
            return self.end_test(out);
        };
        if let Some(before) = &old.output {
            let period =
                |output: &super::OutputConfig| [output.status_period_s, output.health_period_s, output.alarm_period_s];
            self.schedule.take_over(self.now, period(before), period(output));
        }
    }

    /// The same node keeps its address; another one claims it.
    fn take_over_j1939(&mut self, out: &mut Outputs) {
        let Some(config) = self.config.j1939.clone() else {
            self.j1939 = None;
            return;
        };
        if !self.j1939.as_mut().is_some_and(|running| running.take_over(&config)) {
            self.j1939 = Some(j1939::J1939::new(config));
            if self.started {
                self.start_j1939(self.now, out);
            }
        }
    }

    /// What was measured by another window or load is not known in the new one, before new thresholds look at it.
    fn forget_measures(&mut self, old: &HealthConfig, out: &mut Outputs) {
        let new = self.config.health;
        if old.recharge != new.recharge {
            self.observe_alarm(Rule::RechargePeriodLow, None, Observation::default(), out);
            self.restate_recharge(&old.recharge, &new.recharge);
        }
        if old.end_of_life_ah != new.end_of_life_ah {
            self.restate_lives(out);
        }
        if old.usable == new.usable {
            return;
        }
        for (slot, cell) in self.cells.iter_mut().zip((0..).map(CellIndex)) {
            slot.usable = None;
            let unknown = Observation::default();
            self.alarms.observe(
                self.now,
                Rule::UsableCapacityLow,
                Some(cell),
                &unknown,
                &mut self.scratch.alarm_changes,
            );
        }
        self.report_alarms(out);
    }

    fn restate_recharge(&mut self, old: &RechargeConfig, new: &RechargeConfig) {
        if (old.from_soc, old.to_soc) != (new.from_soc, new.to_soc) {
            self.recharge.change_window();
            self.recharge_period_s = None;
        }
        // Both are the same capacity over another window or current.
        let seconds_per_ah = |config: &RechargeConfig| (config.to_soc - config.from_soc) / config.reference_current_a;
        let ratio = seconds_per_ah(new) / seconds_per_ah(old);
        self.normalised_recharge = self
            .normalised_recharge
            .map(|period| ScalarGaussian { mean: ratio * period.mean, variance: ratio * ratio * period.variance });
    }
}

impl MonitorConfig {
    /// Whether a monitor of this configuration can go on with `new`.
    fn check_fits(&self, new: &Self) -> Result<(), ReconfigureError> {
        let (old_sample, new_sample) = (&self.sample, &new.sample);
        let counts = [
            ("[[interface]]", new.interfaces, self.interfaces),
            ("pack.cells", usize::from(new_sample.cells), usize::from(old_sample.cells)),
            ("pack.strings", usize::from(new_sample.strings), usize::from(old_sample.strings)),
            ("pack.cell_model: branches", new.model.branches.len(), self.model.branches.len()),
        ];
        if let Some((key, found, allowed)) = counts.into_iter().find(|(_, found, allowed)| found != allowed) {
            return Err(ReconfigureError { key, found: found.to_string(), allowed: allowed.to_string() });
        }
        // The rated capacity only scales what is told.
        let same_model = super::CellModel { rated_capacity_ah: self.model.rated_capacity_ah, ..new.model.clone() };
        let reported = |sample: &super::SampleConfig| (sample.reported_soc.is_some(), sample.reported_soh.is_some());
        let is_nominal = |config: &Self| matches!(config.health.capacity.method, CapacityMethod::Nominal { .. });
        let buses = || (0..=u8::MAX).map(BusIndex).take(self.interfaces);
        let same = [
            ("[input.cell_voltage] or [input.pack_voltage]", old_sample.voltage_source == new_sample.voltage_source),
            ("[[input.temperature]]", old_sample.sensor_of_cell == new_sample.sensor_of_cell),
            ("[input.reported_soc] and [input.reported_soh]", reported(old_sample) == reported(new_sample)),
            ("[input]", self.input == new.input),
            ("[commands]", buses().all(|bus| self.wanted_ids(bus) == new.wanted_ids(bus))),
            ("[j1939]", buses().all(|bus| self.wanted_patterns(bus) == new.wanted_patterns(bus))),
            ("pack.cell_model", self.model == same_model),
            ("estimator.capacity_state", self.estimator.capacity_state == new.estimator.capacity_state),
            ("capacity.method", is_nominal(self) == is_nominal(new)),
        ];
        match same.into_iter().find(|(_, same)| !same) {
            None => Ok(()),
            Some((key, _)) => Err(ReconfigureError {
                key,
                found: "other frames, signals or tables".to_owned(),
                allowed: "those it was started with".to_owned(),
            }),
        }
    }

    /// Whether `new` makes the same of a sample.
    fn steps_as(&self, new: &Self) -> bool {
        self.model == new.model
            && self.estimator == new.estimator
            && self.health.usable == new.health.usable
            && self.sample.ambient_c == new.sample.ambient_c
    }

    /// The tables whose settings are others in `new`.
    fn changed_tables(&self, new: &Self) -> Vec<&'static str> {
        let (old_sample, new_sample) = (&self.sample, &new.sample);
        let limits = |sample: &super::SampleConfig| {
            (sample.current, sample.voltage, sample.temperature, sample.reported_soc, sample.reported_soh)
        };
        let capacity = |config: &Self| (config.health.capacity, config.health.end_of_life_ah);
        let same = [
            ("[pack]", self.model == new.model && old_sample.ambient_c == new_sample.ambient_c),
            ("[input]", self.flood == new.flood && self.guards == new.guards),
            ("[limits]", limits(old_sample) == limits(new_sample)),
            ("[estimator]", self.estimator == new.estimator),
            ("[transition]", self.health.transition == new.health.transition),
            ("[capacity]", capacity(self) == capacity(new)),
            ("[recharge]", self.health.recharge == new.health.recharge),
            ("[usable]", self.health.usable == new.health.usable),
            ("[[alarm]]", self.rules == new.rules),
            ("[output]", self.output == new.output),
            ("[commands]", self.commands == new.commands),
            ("[j1939]", self.j1939 == new.j1939),
        ];
        same.into_iter().filter(|(_, same)| !same).map(|(table, _)| table).collect()
    }
}
