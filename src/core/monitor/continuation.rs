//! The part of a snapshot that holds only where the same clock continues: with it a restored monitor continues byte-identical.
//!
//! In: a monitor between two inputs. Out: sequence counters, budgets, messages under way, shown values. A program that was
//! restarted ([`Downtime::Seconds`](super::Downtime), [`Downtime::Unknown`](super::Downtime)) has missed frames and has another
//! clock: it leaves this part out, waits for first frames again, and compares every value again.
//!
//! Deviation: with authenticated frames the freshness begins again in either case, because another run may have continued from
//! the same state and accepted commands. All else is byte-identical.

use serde::{Deserialize, Serialize};

use super::Monitor;
use super::alarming::StoreHealth;
use super::intake::IntakeProgress;
use super::pack_memory::StoredPack;
use super::sampling::Identity;
use super::sender::AlarmTest;
use crate::alarm::RunningAlarm;
use crate::can::j1939::Node;
use crate::can::poll::PollProgress;
use crate::quantity::Timestamp;

/// See the module.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Continuation {
    intake: IntakeProgress,
    identity_candidate: Option<(f64, u32)>,
    /// The connected pack while readings give another number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pack_aside: Option<Box<StoredPack>>,
    has_usable_reading: bool,
    has_second_sender: bool,
    is_current_doubtful: bool,
    rest_since: Option<Timestamp>,
    fit_since: Option<Timestamp>,
    has_row: bool,
    /// Every alarm, also those at rest, with the latest value.
    alarms: Vec<RunningAlarm>,
    inputs_shown_at: Timestamp,
    innovations_shown_at: Timestamp,
    knows_all_valid: bool,
    store: StoreHealth,
    test: Option<AlarmTest>,
    poller: Option<PollProgress>,
    node: Option<Node>,
}

impl Monitor {
    /// What [`Self::resume`] needs.
    pub(super) fn continuation(&self) -> Continuation {
        let (sampling, alarming, sender) = (&self.stages.sampling, &self.stages.alarming, &self.stages.sender);
        Continuation {
            intake: self.intake.progress(),
            identity_candidate: sampling.identity.candidate,
            pack_aside: self.stages.packs.aside.clone(),
            has_usable_reading: sampling.has_usable_reading,
            has_second_sender: sampling.has_second_sender,
            is_current_doubtful: self.stages.estimation.is_current_doubtful,
            rest_since: self.stages.modelling.rest_since,
            fit_since: self.stages.modelling.fit_since,
            has_row: self.stages.modelling.has_row,
            alarms: alarming.engine.running(),
            inputs_shown_at: alarming.inputs_shown_at,
            innovations_shown_at: alarming.innovations_shown_at,
            knows_all_valid: alarming.knows_all_valid,
            store: alarming.store,
            test: sender.test,
            poller: sender.poller.as_ref().map(|poller| poller.progress().clone()),
            node: sender.j1939.as_ref().map(|j1939| j1939.node.clone()),
        }
    }

    /// Continues as if the monitor had not stopped; all else is restored before.
    pub(super) fn resume(&mut self, stored: &Continuation) {
        self.intake.resume(&stored.intake);
        let (sampling, alarming, sender) =
            (&mut self.stages.sampling, &mut self.stages.alarming, &mut self.stages.sender);
        self.stages.packs.aside.clone_from(&stored.pack_aside);
        sampling.identity = Identity { candidate: stored.identity_candidate, ..sampling.identity };
        (sampling.has_usable_reading, sampling.has_second_sender) =
            (stored.has_usable_reading, stored.has_second_sender);
        self.stages.estimation.is_current_doubtful = stored.is_current_doubtful;
        let modelling = &mut self.stages.modelling;
        (modelling.rest_since, modelling.fit_since) = (stored.rest_since, stored.fit_since);
        modelling.has_row = stored.has_row;
        alarming.engine.resume(&stored.alarms);
        (alarming.inputs_shown_at, alarming.innovations_shown_at) =
            (stored.inputs_shown_at, stored.innovations_shown_at);
        (alarming.knows_all_valid, alarming.store) = (stored.knows_all_valid, stored.store);
        sender.test = stored.test;
        if let (Some(poller), Some(stored)) = (&mut sender.poller, &stored.poller) {
            poller.resume(stored);
        }
        if let (Some(j1939), Some(stored)) = (&mut sender.j1939, &stored.node) {
            j1939.node.resume(stored);
        }
    }
}
