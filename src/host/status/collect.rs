//! Collects the status document from the core, the interfaces and the counters of the service loop. The functions copy
//! values and serialise nothing.

use std::collections::VecDeque;
use std::time::Instant;

use super::MAX_SILENCE;
use super::counters::{ClientCounts, Latency, ServiceCounters};
use super::document::{
    AlarmStatus, CommandStatus, ConfigFile, ControllerStatus, InterfaceStatus, Intruder, IntruderKind, MessageFlood,
    MessageProtection, PollStatus, StatusCount, StatusCounters, StatusDocument, StoreStatus, VERSION,
};
use super::server::Draft;
use crate::can::CanId;
use crate::can::flood::FloodCount;
use crate::can::guard::GuardCounts;
use crate::config::VehicleIdentity;
use crate::control::answer;
use crate::io::clock::Reading;
use crate::io::socket::{LinkHealth, LinkOutput};
use crate::monitor::{BusStatistics, CommandCounts, ControllerCount, Event, EventKind, Monitor, Statistics};
use crate::quantity::{BusIndex, Timestamp};
use crate::sample::ReadingCounts;

/// Number of events that the document lists if nothing happened lately. This many events fill one screen.
const MAX_EVENTS: usize = 32;
/// Maximum number of events in the document after a burst: about 200 KB of JSON.
const MAX_BURST: usize = 1024;

/// The latest events, and their number since the start of the daemon. Events that occur once per cell and half-cycle
/// are left out, because they would displace all other events.
#[derive(Debug, Default)]
pub struct RecentEvents {
    /// Each event with the time at which it was noted. An event itself may be older.
    latest: VecDeque<(Instant, Event)>,
    count: u64,
}

impl RecentEvents {
    /// Adds an event.
    pub fn note(&mut self, now: Instant, event: &Event) {
        if matches!(event.kind, EventKind::HalfCycle { .. } | EventKind::Capacity { .. } | EventKind::LossModes { .. })
        {
            return;
        }
        if self.latest.len() == MAX_BURST {
            self.latest.pop_front();
        }
        self.latest.push_back((now, *event));
        self.count += 1;
    }

    /// The events to list at `now`: the latest [`MAX_EVENTS`], and all events of the last [`MAX_SILENCE`], so that a
    /// reader that misses a few documents still receives each event.
    fn listed(&self, now: Instant) -> Vec<Event> {
        let older = self.latest.iter().take_while(|(noted, _)| now.duration_since(*noted) > MAX_SILENCE).count();
        let skipped = older.min(self.latest.len().saturating_sub(MAX_EVENTS));
        self.latest.iter().skip(skipped).map(|(_, event)| *event).collect()
    }
}

/// Properties of the daemon that change only with a reload.
#[derive(Debug, Clone)]
pub struct ServiceIdentity {
    pub started: Timestamp,
    pub config: Option<ConfigFile>,
    pub vehicle: VehicleIdentity,
    pub interfaces: Vec<String>,
}

/// Counts of earlier runs, which the restored state contained.
#[derive(Debug, Clone, Default)]
pub struct CounterBaseline {
    statistics: Statistics,
    readings: ReadingCounts,
    time_backwards: u64,
    protected: Vec<GuardCounts>,
    commands: CommandCounts,
    floods: Vec<FloodCount>,
    controllers: Vec<ControllerCount>,
}

impl CounterBaseline {
    /// Returns the counts of a monitor that has just restored a state, or zeros if it has restored none. Events of the
    /// tick that restored the state count as events of the earlier runs. An example is an alarm about an input that is
    /// missing after the downtime.
    pub fn of(monitor: &Monitor) -> Self {
        let mut statistics = monitor.statistics().clone();
        if statistics.restores == 0 {
            return Self::default();
        }
        // This restore itself belongs to the current run.
        statistics.restores -= 1;
        Self {
            statistics,
            readings: monitor.reading_counts(),
            time_backwards: monitor.time_backwards(),
            protected: monitor.protected().collect(),
            commands: monitor.authenticated_commands().map(|(_, _, counts)| counts).unwrap_or_default(),
            floods: monitor.dropped().collect(),
            controllers: monitor.controllers().collect(),
        }
    }
}

/// The sources of a document.
pub struct Sources<'a> {
    pub identity: &'a ServiceIdentity,
    pub monitor: &'a Monitor,
    pub links: &'a [LinkOutput],
    pub before: &'a CounterBaseline,
    pub counters: ServiceCounters,
    pub latency: &'a Latency,
    pub clients: ClientCounts,
    pub events: &'a RecentEvents,
    pub store: Option<StoreStatus>,
}

impl Sources<'_> {
    /// Collects the document, which is serialised later.
    pub fn draft(self, now: Timestamp) -> Draft {
        let events = self.events.listed(Instant::now());
        Draft { document: self.document(now), events }
    }

    fn document(self, now: Timestamp) -> StatusDocument {
        let Self { identity, monitor, before, counters, .. } = self;
        let pack = monitor.pack_view();
        let core = monitor.statistics().since(&before.statistics);
        StatusDocument {
            version: VERSION,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            pid: std::process::id(),
            time: now,
            wall_time: Timestamp::from_nanos(Reading::now().realtime_ns),
            started: identity.started,
            uptime_s: now.since(identity.started),
            config: identity.config.clone(),
            vehicle: identity.vehicle.clone(),
            state: pack.validity,
            interfaces: self.interfaces(&core),
            pack,
            cells: monitor.cell_views().collect(),
            alarms: alarms(monitor),
            counters: StatusCounters {
                core,
                // The counts are stored by interface number. If the configuration changed the order of the interfaces,
                // the counts of different interfaces would be mixed. Therefore these counts are left out.
                lifetime: Statistics { buses: Vec::new(), ..monitor.statistics().clone() },
                readings: monitor.reading_counts().since(&before.readings),
                time_backwards: monitor.time_backwards().saturating_sub(before.time_backwards),
                service: counters,
                clients: self.clients,
            },
            protection: self.protection(),
            commands: self.commands(),
            controllers: self.controllers(),
            asleep_since: self.monitor.asleep_since(),
            poll: self.monitor.poll().map(|(silent, refused)| PollStatus { silent, refused }),
            floods: self.floods(),
            intruders: self.intruders(),
            current_frozen: self.monitor.is_current_frozen(),
            findings: self.monitor.findings().to_vec(),
            latency: self.latency.clone(),
            store: self.store,
            event_count: self.events.count,
            events: Vec::new(),
        }
    }

    fn name(&self, bus: BusIndex) -> String {
        self.identity.interfaces.get(bus.index()).cloned().unwrap_or_default()
    }

    fn interfaces(&self, core: &Statistics) -> Vec<InterfaceStatus> {
        let each = self.identity.interfaces.iter().zip(self.links).enumerate();
        each.map(|(bus, (name, link))| interface(name, link.health(), core.buses.get(bus).copied().unwrap_or_default()))
            .collect()
    }

    fn protection(&self) -> Vec<MessageProtection> {
        let each = self.monitor.protected().map(|guard| {
            let before = self.before.protected.iter().find(|it| (it.bus, it.id) == (guard.bus, guard.id));
            let checks = guard.counts.iter().map(|(status, count)| {
                let before = before.map_or(0, |before| before.counts.get(status));
                StatusCount { status: status.name().to_owned(), count: count.saturating_sub(before) }
            });
            MessageProtection { interface: self.name(guard.bus), id: guard.id.to_string(), checks: checks.collect() }
        });
        each.chain(self.authentication()).collect()
    }

    /// Checks of the authenticated command message, by outcome.
    fn authentication(&self) -> Option<MessageProtection> {
        let (bus, id, counts) = self.monitor.authenticated_commands()?;
        let counts = counts.since(&self.before.commands);
        let checks = [
            ("authentic", counts.authentic),
            ("forged", counts.forged),
            ("old", counts.old),
            ("unconfirmed", counts.unconfirmed),
        ];
        let checks = checks.map(|(status, count)| StatusCount { status: status.to_owned(), count });
        Some(MessageProtection { interface: self.name(bus), id: id.to_string(), checks: checks.to_vec() })
    }

    fn commands(&self) -> Option<CommandStatus> {
        let commands = self.monitor.commands()?;
        Some(CommandStatus {
            interface: self.name(commands.bus),
            id: commands.plan.id().to_string(),
            secoc: commands.plan.authentication().map(|secoc| secoc.profile.name().to_owned()),
        })
    }

    fn controllers(&self) -> Vec<ControllerStatus> {
        let each = self.monitor.controllers().map(|ControllerCount { controller, counts }| {
            let before = self.before.controllers.iter().find(|it| it.controller == controller);
            ControllerStatus {
                interface: self.name(controller.bus),
                id: controller.response.to_string(),
                counts: before.map_or(counts, |before| counts.since(&before.counts)),
            }
        });
        each.collect()
    }

    fn intruders(&self) -> Vec<Intruder> {
        let of = |kind| move |(bus, id): (BusIndex, CanId)| (bus, id, kind);
        let second = self.monitor.second_senders().map(of(IntruderKind::SecondSender));
        let own = self.monitor.own_id_uses().map(of(IntruderKind::OwnIdentifier));
        let all = second.chain(own);
        all.map(|(bus, id, kind)| Intruder { interface: self.name(bus), id: id.to_string(), kind }).collect()
    }

    fn floods(&self) -> Vec<MessageFlood> {
        let each = self.monitor.dropped().map(|flood| {
            let before = self.before.floods.iter().find(|it| (it.bus, it.id) == (flood.bus, flood.id));
            let dropped = flood.dropped.saturating_sub(before.map_or(0, |before| before.dropped));
            MessageFlood { interface: self.name(flood.bus), id: flood.id.to_string(), dropped }
        });
        each.filter(|flood| flood.dropped > 0).collect()
    }
}

fn interface(name: &str, health: LinkHealth, received: BusStatistics) -> InterfaceStatus {
    let LinkHealth { state, ups, counts } = health;
    InterfaceStatus { name: name.to_owned(), state, reconnects: ups.saturating_sub(1), received, link: counts }
}

fn alarms(monitor: &Monitor) -> AlarmStatus {
    let engine = monitor.alarms();
    let list = answer::alarm_list(engine, monitor.now(), false);
    let mut rules: Vec<_> = engine.thresholds().map(|threshold| threshold.rule).collect();
    rules.dedup();
    AlarmStatus {
        thresholds: list.thresholds,
        rules,
        raised: engine.count(),
        highest_severity: engine.highest_severity(),
        unknown: list.unknown,
        list: list.alarms,
        omitted: list.omitted,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn burst_is_listed_until_every_reader_had_time() {
        let (mut recent, start) = (RecentEvents::default(), Instant::now());
        let event = Event { time: Timestamp::ZERO, kind: EventKind::Gap { seconds: None } };
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        for seconds in [0, 100] {
            (0..1000).for_each(|_| recent.note(after(seconds), &event));
        }
        let listed = |seconds: u64| recent.listed(after(seconds)).len();
        assert_eq!((recent.count, listed(101), listed(106)), (2000, 1000, 32));
        (0..MAX_BURST).for_each(|_| recent.note(after(107), &event));
        assert_eq!(recent.listed(after(107)).len(), MAX_BURST, "the burst before is dropped");
    }
}
