//! Applies a new configuration to a running monitor.
//!
//! In: a checked configuration. Out: the changes, with the resulting events and frames. If the new configuration needs
//! a restart, the result names the reason, and nothing changes. Otherwise, the new limits, thresholds, noise values and
//! outputs apply at once. The monitor keeps filters, learned values, counters, schedules, and alarms whose rule and
//! severity are still configured. Estimates therefore change only if their settings change.
//!
//! If the recharge window (the SOC range over which charges are timed) changes, the measured recharge periods become
//! unknown, unless they can be converted exactly. If the load of the usable capacity changes, the usable capacity
//! becomes unknown. Initial values affect only cells without learned values, so changed initial values apply when the
//! next pack is connected.

use crate::alarm::{Observation, Rule};
use crate::health::HealthConfig;
use crate::monitor::Monitor;
use crate::monitor::config::{MonitorConfig, ReconfigureError, Reconfigured};
use crate::monitor::message::{Event, EventKind, Outputs};
use crate::monitor::stage::publisher::Publisher;
use crate::quantity::Timestamp;

impl Monitor {
    /// Applies a new configuration between two inputs. `now` is the time of the request; it does not advance the
    /// monitor's clock. The event about the change gets the later of `now` and the clock's time.
    ///
    /// # Errors
    /// The first setting that needs a restart. The monitor is then unchanged.
    pub fn reconfigure(
        &mut self,
        config: MonitorConfig,
        now: Timestamp,
        out: &mut Outputs,
    ) -> Result<Reconfigured, ReconfigureError> {
        self.config.check_fits(&config)?;
        let old = std::mem::replace(&mut self.config, config.clone());
        let first_event = out.events.len();
        let at = self.clock.now;
        if !old.estimates_as(&config) {
            // Step the waiting samples with the old settings.
            self.stages.step_waiting(at, true, out);
        }
        let changed = old.changed_tables(&config);
        self.intake.reconfigure(&config);
        let stages = &mut self.stages;
        stages.modelling.reconfigure(&config);
        stages.estimation.reconfigure(&config, &stages.modelling, &stages.learning.state.learner);
        stages.findings.reconfigure(&config);
        stages.sampling.reconfigure(&config);
        stages.sleep.reconfigure(&config);
        stages.sending.reconfigure(at, config.output.as_ref(), &stages.alarming.engine, out);
        if old.j1939 != config.j1939 {
            stages.sending.reconfigure_j1939(at, &config, self.clock.has_started, out);
        }
        stages.learning.config = config.health;
        self.forget_measures(&old.health, out);
        let alarms_ended = self.stages.alarming.reconfigure(at, &config);
        let period = self.stages.learning.known_recharge_period().unwrap_or_default();
        let (learning, mut publisher) = self.stages.learning_and_publisher(at, out);
        publisher.publish_alarms();
        if old.health.recharge != config.health.recharge {
            publisher.observe(Rule::RechargePeriodLow, None, period);
        }
        if old.health.end_of_life_ah != config.health.end_of_life_ah {
            learning.lives.observe(true, &mut publisher);
        }
        publisher.update_trouble_codes();
        let alarms = u32::try_from(alarms_ended).unwrap_or(u32::MAX);
        out.events.push(Event { time: now.max(at), kind: EventKind::Reconfigured { alarms_ended: alarms } });
        self.stages.statistics.note_events(&out.events[first_event..]);
        self.find_due();
        Ok(Reconfigured { changed, alarms_ended })
    }

    /// Forgets values that were measured with another recharge window or another load of the usable capacity. Runs
    /// before the new thresholds are set.
    fn forget_measures(&mut self, old: &HealthConfig, out: &mut Outputs) {
        let now = self.clock.now;
        let cells = self.stages.estimation.cell_indices();
        let new = self.stages.learning.config;
        self.stages.packs.forget_measures(old.recharge != new.recharge, old.usable != new.usable);
        let (learning, mut publisher) = self.stages.learning_and_publisher(now, out);
        if old.recharge != new.recharge {
            publisher.observe(Rule::RechargePeriodLow, None, Observation::default());
            learning.restate_recharge(&old.recharge);
        }
        if old.end_of_life_ah != new.end_of_life_ah {
            learning.lives.restate(&new, &mut publisher);
        }
        if old.usable == new.usable {
            return;
        }
        learning.cells.iter_mut().for_each(|cell| cell.usable = None);
        let Publisher { alarming, .. } = &mut publisher;
        for cell in cells {
            let unknown = Observation::default();
            alarming.engine.observe(now, Rule::UsableCapacityLow, Some(cell), &unknown, &mut alarming.changes);
        }
        publisher.publish_alarms();
    }
}
