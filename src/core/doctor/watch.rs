//! The doctor at work: takes frames and events, keeps what the judgement needs.

use std::collections::BTreeMap;

use super::judge;
use super::link::{BLOCKS_S, Link, Slope};
use super::plan::{InterfacePlan, Plan};
use super::report::Report;
use super::series::Series;
use crate::can::e2e::Status;
use crate::can::guard::Guards;
use crate::can::{CanId, Frame, FrameKind};
use crate::monitor::{BusEvent, Estimate};
use crate::quantity::{BusIndex, Channel, Timestamp};

/// Identifiers counted one by one per interface; a vehicle's bus has some hundreds.
const MAX_IDS: usize = 4096;
/// Silence of every interface for this long means that the buses slept, or the record has a hole, s.
const SLEEP_S: f64 = 30.0;
/// Payloads of a protected message kept to try other checks on.
const KEPT_PAYLOADS: usize = 12;

/// An identifier as seen on an interface.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Seen {
    pub(crate) count: u64,
    pub(crate) fd: u64,
    pub(crate) remote: u64,
    pub(crate) first: Timestamp,
    pub(crate) last: Timestamp,
    pub(crate) len: usize,
}

/// An interface as seen.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bus {
    pub(crate) name: String,
    pub(crate) frames: u64,
    pub(crate) ids: BTreeMap<CanId, Seen>,
    pub(crate) error_frames: u64,
    pub(crate) error_classes: u32,
    pub(crate) dropped: u64,
    pub(crate) is_missing: bool,
    pub(crate) is_down: bool,
}

/// A protected message as seen.
#[derive(Debug, Clone)]
pub(crate) struct Checked {
    pub(crate) counts: BTreeMap<&'static str, u64>,
    pub(crate) good: u64,
    pub(crate) bad: u64,
    pub(crate) payloads: Vec<Vec<u8>>,
}

/// What the estimator made of it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Estimated {
    pub(crate) estimates: u64,
    pub(crate) refused: u64,
    pub(crate) nis_sum: f64,
    pub(crate) innovation_sum: f64,
}

/// Listens; says at the end what it thinks.
#[derive(Debug)]
pub struct Doctor {
    pub(crate) plan: Plan,
    pub(crate) buses: Vec<Bus>,
    /// As `plan.signals`.
    pub(crate) series: Vec<Series>,
    /// As `plan.more_cells`.
    pub(crate) more_cells: Vec<Series>,
    by_id: BTreeMap<(BusIndex, CanId), Vec<(bool, usize)>>,
    guards: Guards,
    pub(crate) checked: BTreeMap<(BusIndex, CanId), Checked>,
    pub(crate) link: Link,
    /// The same over longer blocks.
    pub(crate) slow_link: Link,
    pub(crate) estimated: Estimated,
    pub(crate) first: Option<Timestamp>,
    pub(crate) last: Timestamp,
    pub(crate) awake_s: f64,
    /// How long somebody listened, s; `None` = a record, which tells by its frames.
    listened_s: Option<f64>,
    pub(crate) frames: u64,
}

impl Doctor {
    /// A doctor who has heard nothing yet.
    pub fn new(plan: Plan) -> Self {
        let mut by_id: BTreeMap<(BusIndex, CanId), Vec<(bool, usize)>> = BTreeMap::new();
        for (is_more, list) in [(false, &plan.signals), (true, &plan.more_cells)] {
            // The current of a frame before its voltages, as the channels' order has it.
            let mut order: Vec<usize> = (0..list.len()).collect();
            order.sort_by_key(|&index| list[index].binding.channel);
            for index in order {
                by_id.entry((list[index].binding.bus, list[index].binding.id)).or_default().push((is_more, index));
            }
        }
        let cells = if plan.is_pack_total { 1 } else { usize::from(plan.cells) };
        let pack_ah = plan.capacity_ah * f64::from(plan.strings.max(1));
        let bus = |interface: &InterfacePlan| Bus { name: interface.name.clone(), ..Bus::default() };
        Self {
            buses: plan.interfaces.iter().map(bus).collect(),
            series: plan
                .signals
                .iter()
                .map(|signal| Series::new(&signal.layout, band(&plan, signal.binding.channel)))
                .collect(),
            more_cells: plan.more_cells.iter().map(|signal| Series::new(&signal.layout, (0.0, 0.0))).collect(),
            by_id,
            guards: Guards::new(plan.guards.clone()),
            checked: BTreeMap::new(),
            link: Link::new(cells, 0.01 * pack_ah, BLOCKS_S[0]),
            slow_link: Link::new(cells, 0.01 * pack_ah, BLOCKS_S[1]),
            estimated: Estimated::default(),
            first: None,
            last: Timestamp::ZERO,
            awake_s: 0.0,
            listened_s: None,
            frames: 0,
            plan,
        }
    }

    /// Names an interface beyond the configured ones; its number is the next.
    pub fn add_interface(&mut self, name: &str) {
        self.buses.push(Bus { name: name.to_owned(), ..Bus::default() });
    }

    /// Takes a frame of any interface.
    pub fn handle_frame(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.note_time(time);
        self.frames += 1;
        let Some(seen_bus) = self.buses.get_mut(bus.index()) else { return };
        seen_bus.frames += 1;
        let known = seen_bus.ids.len();
        if known < MAX_IDS || seen_bus.ids.contains_key(&frame.id()) {
            let seen = seen_bus.ids.entry(frame.id()).or_insert(Seen { first: time, ..Seen::default() });
            seen.count += 1;
            seen.fd += u64::from(matches!(frame.kind(), FrameKind::Fd { .. }));
            seen.remote += u64::from(frame.kind() == FrameKind::Remote);
            (seen.last, seen.len) = (time, frame.len());
        }
        if frame.kind() == FrameKind::Remote {
            return;
        }
        self.check(time, bus, frame);
        self.read(time, bus, frame);
    }

    fn check(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let Some(status) = self.guards.check(time, bus, frame) else { return };
        self.guards.take_changes().for_each(drop);
        let empty = || Checked { counts: BTreeMap::new(), good: 0, bad: 0, payloads: Vec::new() };
        let checked = self.checked.entry((bus, frame.id())).or_insert_with(empty);
        *checked.counts.entry(status.name()).or_default() += 1;
        checked.good += u64::from(status.is_usable());
        checked.bad += u64::from(!status.is_usable() && status != Status::Initial);
        if checked.payloads.len() < KEPT_PAYLOADS {
            checked.payloads.push(frame.data().to_vec());
        }
    }

    fn read(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let key = (bus, frame.id());
        let count = self.by_id.get(&key).map_or(0, Vec::len);
        let cells = f64::from(self.plan.cells.max(1));
        for position in 0..count {
            let Some(&(is_more, index)) = self.by_id.get(&key).and_then(|found| found.get(position)) else { return };
            if is_more {
                let binding = &self.plan.more_cells[index].binding;
                self.more_cells[index].handle(time, frame.data(), binding, f64::INFINITY);
                continue;
            }
            let binding = &self.plan.signals[index].binding;
            let max_age_s = judge::max_age_s(&self.plan, binding.channel);
            let Some(value) = self.series[index].handle(time, frame.data(), binding, max_age_s) else { continue };
            match binding.channel {
                Channel::Current => self.links().for_each(|link| link.handle_current(time, value)),
                Channel::PackVoltage => self.links().for_each(|link| link.handle_voltage(time, 0, value / cells)),
                Channel::CellVoltage(cell) => {
                    self.links().for_each(|link| link.handle_voltage(time, cell.index(), value));
                }
                Channel::Temperature(_) | Channel::ReportedSoc | Channel::ReportedSoh | Channel::PackIdentity => {}
            }
        }
    }

    fn links(&mut self) -> impl Iterator<Item = &mut Link> {
        [&mut self.link, &mut self.slow_link].into_iter()
    }

    /// How the pack's voltage follows its current, from the blocks that tell it best.
    pub(crate) fn slope(&self) -> Option<Slope> {
        self.best_link().slope()
    }

    /// The same for one cell.
    pub(crate) fn slope_of(&self, cell: usize) -> Option<Slope> {
        self.best_link().slope_of(cell)
    }

    fn best_link(&self) -> &Link {
        let certainty = |link: &Link| link.slope().map_or(0.0, |slope| slope.certainty());
        // The short blocks where they do: what is seen in them is the load and nothing slower.
        let fast = certainty(&self.link);
        if fast >= 1.0 || fast >= certainty(&self.slow_link) { &self.link } else { &self.slow_link }
    }

    fn note_time(&mut self, time: Timestamp) {
        if self.first.is_none() {
            (self.first, self.last) = (Some(time), time);
        }
        let passed_s = time.since(self.last);
        if passed_s > SLEEP_S {
            self.handle_gap();
        } else {
            self.awake_s += passed_s.max(0.0);
        }
        self.last = self.last.max(time);
    }

    /// How long passed between what came and what comes is unknown, or nobody listened.
    pub fn handle_gap(&mut self) {
        self.series.iter_mut().chain(&mut self.more_cells).for_each(Series::pause);
        self.links().for_each(Link::pause);
        self.guards.restart();
    }

    /// Takes what an interface reports.
    pub fn handle_bus(&mut self, bus: BusIndex, event: BusEvent) {
        let Some(bus) = self.buses.get_mut(bus.index()) else { return };
        match event {
            BusEvent::Up => (bus.is_missing, bus.is_down) = (false, false),
            BusEvent::Down => bus.is_down = true,
            BusEvent::Missing => bus.is_missing = true,
            BusEvent::Dropped { frames } => bus.dropped += frames,
            BusEvent::ErrorFrame { class } => {
                bus.error_frames += 1;
                bus.error_classes |= class;
            }
            BusEvent::SendFailed { .. } => {}
        }
    }

    /// Takes an estimate of the monitor's.
    pub fn handle_estimate(&mut self, estimate: &Estimate) {
        let of = &mut self.estimated;
        let nis = (estimate.innovation_v / estimate.innovation_std_v).powi(2);
        if nis.is_finite() {
            of.estimates += 1;
            of.refused += u64::from(!estimate.accepted);
            of.nis_sum += nis.min(1e6);
            of.innovation_sum += estimate.innovation_v;
        }
    }

    /// Seconds listened so far, sleep not counted.
    pub fn seconds(&self) -> f64 {
        self.listened_s.unwrap_or(self.awake_s)
    }

    /// For so long somebody listened, whether a frame came or not.
    pub fn handle_listened(&mut self, seconds: f64) {
        self.listened_s = Some(seconds);
    }

    /// Frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Says what it thinks.
    pub fn finish(mut self) -> Report {
        self.links().for_each(Link::pause);
        judge::judge(&self)
    }
}

/// What is plausible, in the signal's unit.
fn band(plan: &Plan, channel: Channel) -> (f64, f64) {
    let [current, voltage, temperature] = plan.limits;
    match channel {
        Channel::Current => current,
        Channel::CellVoltage(_) => voltage,
        Channel::PackVoltage => (voltage.0 * f64::from(plan.cells), voltage.1 * f64::from(plan.cells)),
        Channel::Temperature(_) => temperature,
        Channel::ReportedSoc | Channel::ReportedSoh | Channel::PackIdentity => (0.0, 0.0),
    }
}
