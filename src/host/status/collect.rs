//! Fills in the status document from the core, the interfaces and the loop's counts: structs are copied, nothing is
//! written down here.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};

use super::counters::LoopCounters;
use super::document::{
    Alarms, Cell, Clients, ConfigFile, Counters, Document, Flooded, Interface, Pack, Protected, StatusCount, Store,
    VERSION,
};
use super::server::Draft;
use crate::can::flood::FloodCount;
use crate::can::guard::GuardCounts;
use crate::control::answer;
use crate::filter::ScalarGaussian;
use crate::health::{Remaining, RemainingLife};
use crate::io::clock::Reading;
use crate::io::socket::{LinkCounters, LinkOutput};
use crate::monitor::{BusStatistics, CellView, Event, EventKind, Monitor, Statistics};
use crate::quantity::{BusIndex, Timestamp};
use crate::sample::ReadingCounts;

/// Events kept for those who look: a screenful.
const MAX_EVENTS: usize = 32;

/// Half the width of an interval that holds the truth with 95 %, in standard deviations.
const Z95: f64 = 1.96;

/// The latest events, but those that come once per cell and half-cycle: they would leave nothing else.
#[derive(Debug, Default)]
pub struct RecentEvents(VecDeque<Event>);

impl RecentEvents {
    /// Takes one.
    pub fn note(&mut self, event: &Event) {
        if matches!(event.kind, EventKind::HalfCycle { .. } | EventKind::Capacity { .. }) {
            return;
        }
        if self.0.len() == MAX_EVENTS {
            self.0.pop_front();
        }
        self.0.push_back(*event);
    }
}

/// What stays the same while the daemon runs, or until its configuration is read again.
#[derive(Debug, Clone)]
pub struct Identity {
    pub started: Timestamp,
    pub config: Option<ConfigFile>,
    pub interfaces: Vec<String>,
}

/// What had been counted before this program, by those whose counts are part of the stored state.
#[derive(Debug, Clone, Default)]
pub struct Before {
    statistics: Statistics,
    readings: ReadingCounts,
    time_backwards: u64,
    protected: Vec<GuardCounts>,
    floods: Vec<FloodCount>,
}

impl Before {
    /// As a monitor has it that has just taken up its stored state, if there is one. What it tells in the very tick in which
    /// it does (an alarm about an input that has been silent meanwhile) counts as before.
    pub fn of(monitor: &Monitor) -> Self {
        let mut statistics = monitor.statistics().clone();
        if statistics.restores == 0 {
            return Self::default();
        }
        // This one is this program's.
        statistics.restores -= 1;
        Self {
            statistics,
            readings: monitor.reading_counts(),
            time_backwards: monitor.time_backwards(),
            protected: monitor.protected().collect(),
            floods: monitor.dropped().collect(),
        }
    }
}

/// What a document is made of.
pub struct Sources<'a> {
    pub identity: &'a Identity,
    pub monitor: &'a Monitor,
    pub links: &'a [LinkOutput],
    pub before: &'a Before,
    pub counters: &'a LoopCounters,
    pub clients: Clients,
    pub events: &'a RecentEvents,
    pub store: Option<Store>,
}

impl Sources<'_> {
    /// The document, not yet written down.
    pub fn draft(self, now: Timestamp) -> Draft {
        let events = self.events.0.iter().copied().collect();
        Draft { document: self.document(now), events }
    }

    fn document(self, now: Timestamp) -> Document {
        let Self { identity, monitor, before, counters, .. } = self;
        let pack = pack(monitor);
        let core = monitor.statistics().since(&before.statistics);
        Document {
            version: VERSION,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            pid: std::process::id(),
            time: now,
            wall_time: Timestamp::from_nanos(Reading::now().realtime_ns),
            started: identity.started,
            uptime_s: now.since(identity.started),
            config: identity.config.clone(),
            state: pack.validity,
            interfaces: self.interfaces(&core),
            pack,
            cells: monitor.cell_views().map(cell).collect(),
            alarms: alarms(monitor),
            counters: Counters {
                core,
                // By their index: another order of the interfaces would exchange their past.
                lifetime: Statistics { buses: Vec::new(), ..monitor.statistics().clone() },
                readings: monitor.reading_counts().since(&before.readings),
                time_backwards: monitor.time_backwards().saturating_sub(before.time_backwards),
                service: counters.service,
                clients: self.clients,
            },
            protection: self.protection(),
            floods: self.floods(),
            latency: counters.latency.document(),
            store: self.store,
            events: Vec::new(),
        }
    }

    fn name(&self, bus: BusIndex) -> String {
        self.identity.interfaces.get(bus.index()).cloned().unwrap_or_default()
    }

    fn interfaces(&self, core: &Statistics) -> Vec<Interface> {
        let each = self.identity.interfaces.iter().zip(self.links).enumerate();
        each.map(|(bus, (name, link))| interface(name, link.counters(), core.buses.get(bus))).collect()
    }

    fn protection(&self) -> Vec<Protected> {
        let each = self.monitor.protected().map(|guard| {
            let before = self.before.protected.iter().find(|it| (it.bus, it.id) == (guard.bus, guard.id));
            let checks = guard.counts.iter().map(|(status, count)| {
                let before = before.map_or(0, |before| before.counts.get(status));
                StatusCount { status: status.name().to_owned(), count: count.saturating_sub(before) }
            });
            Protected { interface: self.name(guard.bus), id: guard.id.to_string(), checks: checks.collect() }
        });
        each.collect()
    }

    fn floods(&self) -> Vec<Flooded> {
        let each = self.monitor.dropped().map(|flood| {
            let before = self.before.floods.iter().find(|it| (it.bus, it.id) == (flood.bus, flood.id));
            let dropped = flood.dropped.saturating_sub(before.map_or(0, |before| before.dropped));
            Flooded { interface: self.name(flood.bus), id: flood.id.to_string(), dropped }
        });
        each.filter(|flood| flood.dropped > 0).collect()
    }
}

fn interface(name: &str, counters: &LinkCounters, core: Option<&BusStatistics>) -> Interface {
    let of = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let core = core.copied().unwrap_or_default();
    Interface {
        name: name.to_owned(),
        state: counters.state(),
        reconnects: counters.reconnects(),
        frames: core.frames,
        error_frames: core.error_frames,
        bus_offs: core.bus_offs,
        kernel_dropped: of(&counters.kernel_dropped),
        queue_dropped: of(&counters.inbox_full),
        malformed: of(&counters.malformed),
        sent: of(&counters.sent),
        send_queue_full: of(&counters.send_queue_full),
        send_failed: of(&counters.send_failed),
    }
}

/// A number that is one.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn mean(belief: Option<&ScalarGaussian>) -> Option<f64> {
    belief.and_then(|belief| finite(belief.mean))
}

fn std(belief: Option<&ScalarGaussian>) -> Option<f64> {
    belief.and_then(|belief| finite(belief.std()))
}

/// Cycles and days, as far as they are known.
fn remaining(life: Option<RemainingLife>) -> (Option<Remaining>, Option<Remaining>) {
    (life.and_then(|life| life.cycles), life.and_then(|life| life.days))
}

fn pack(monitor: &Monitor) -> Pack {
    let view = monitor.pack_view();
    let soc = view.soc.as_ref();
    let edge = |sign: f64| soc.and_then(|soc| finite((soc.mean + sign * Z95 * soc.std()).clamp(0.0, 1.0)));
    let weakest = view.weakest.as_ref();
    let normalised = view.normalised_recharge_period.as_ref();
    let (cycles, days) = remaining(view.remaining_life.map(|(_, life)| life));
    Pack {
        validity: view.validity,
        mode: view.mode,
        soc: mean(soc),
        soc_std: std(soc),
        soc_low: edge(-1.0),
        soc_high: edge(1.0),
        limiting_cell: view.limiting_cell.map(|cell| cell.0),
        voltage_v: view.voltage_v.and_then(finite),
        current_a: view.current_a.and_then(finite),
        temperature_max_c: view.temperature_max_c.and_then(finite),
        weakest_cell: weakest.map(|(cell, _)| cell.0),
        capacity_ah: mean(weakest.map(|(_, capacity)| capacity)),
        capacity_std_ah: std(weakest.map(|(_, capacity)| capacity)),
        soh: view.soh.and_then(finite),
        shortest_lived_cell: view.remaining_life.map(|(cell, _)| cell.0),
        remaining_cycles: cycles.map(|cycles| cycles.median).and_then(finite),
        remaining_cycles_low: cycles.map(|cycles| cycles.low).and_then(finite),
        remaining_cycles_high: cycles.map(|cycles| cycles.high).and_then(finite),
        remaining_days: days.map(|days| days.median).and_then(finite),
        usable_capacity_ah: mean(view.usable_capacity.as_ref()),
        usable_capacity_std_ah: std(view.usable_capacity.as_ref()),
        recharge_period_s: view.recharge_period_s.and_then(finite),
        normalised_recharge_period_s: mean(normalised),
        normalised_recharge_period_std_s: std(normalised),
        reported_soc: view.reported_soc.and_then(finite),
        reported_soh: view.reported_soh.and_then(finite),
    }
}

fn cell(view: CellView) -> Cell {
    let (cycles, days) = remaining(view.remaining_life.ok());
    Cell {
        cell: view.cell.0,
        voltage_v: view.voltage_v.and_then(finite),
        current_a: view.current_a.and_then(finite),
        temperature_c: view.temperature_c.and_then(finite),
        soc: mean(view.soc.as_ref()),
        soc_std: std(view.soc.as_ref()),
        capacity_ah: mean(view.capacity.as_ref()),
        capacity_std_ah: std(view.capacity.as_ref()),
        usable_capacity_ah: mean(view.usable_capacity.as_ref()),
        usable_capacity_std_ah: std(view.usable_capacity.as_ref()),
        remaining_cycles: cycles.map(|cycles| cycles.median).and_then(finite),
        remaining_cycles_low: cycles.map(|cycles| cycles.low).and_then(finite),
        remaining_cycles_high: cycles.map(|cycles| cycles.high).and_then(finite),
        remaining_days: days.map(|days| days.median).and_then(finite),
        remaining_unknown: view.remaining_life.err().map(|why| why.to_string()),
        resistance_ratio: mean(view.resistance_ratio.as_ref()),
        resistance_ratio_std: std(view.resistance_ratio.as_ref()),
        trusted: view.trusted,
    }
}

fn alarms(monitor: &Monitor) -> Alarms {
    let engine = monitor.alarms();
    let list = answer::alarm_list(engine, monitor.now(), false);
    Alarms {
        thresholds: list.thresholds,
        raised: engine.count(),
        highest_severity: engine.highest_severity(),
        unknown: list.unknown,
        list: list.alarms,
        omitted: list.omitted,
    }
}
