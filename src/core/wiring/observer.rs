//! Collects frames, interface events and estimates, and keeps the statistics that the checks in `judge` need.

use std::collections::BTreeMap;

use super::evidence::Series;
use super::evidence::Slope;
use super::evidence::response::{BLOCKS_S, VoltageResponse, best_response};
use super::evidence::usage::UsageRecord;
use super::other_current::OtherCurrent;
use super::plan::SignalPlan;
use super::plan::{InterfacePlan, Plan, Witness};
use crate::can::decode::{Binding, GroupFrame, GroupSenders, ParameterGroups};
use crate::can::e2e::Status;
use crate::can::guard::Guards;
use crate::can::uds::{Answer, FrameOutcome, Listener, Question};
use crate::can::{CanId, Frame, FrameKind};
use crate::monitor::{BusEvent, Estimate};
use crate::quantity::{BusIndex, Channel, Timestamp};

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct IdStats {
    pub(crate) count: u64,
    pub(crate) fd: u64,
    pub(crate) first: Timestamp,
    pub(crate) last: Timestamp,
    pub(crate) len: usize,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct BusStats {
    pub(crate) name: String,
    pub(crate) frames: u64,
    pub(crate) ids: BTreeMap<CanId, IdStats>,
    pub(crate) error_frames: u64,
    pub(crate) error_classes: u32,
    pub(crate) dropped: u64,
    pub(crate) is_missing: bool,
    pub(crate) is_down: bool,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct ProtectionStats {
    pub(crate) counts: BTreeMap<&'static str, u64>,
    pub(crate) good: u64,
    pub(crate) bad: u64,
    pub(crate) payloads: Vec<Vec<u8>>,
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct EstimatorStats {
    pub(crate) estimates: u64,
    pub(crate) rejected: u64,
    pub(crate) innovation_sum: f64,
}

/// A time in which no frame arrived on any interface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hole {
    pub(crate) from: Timestamp,
    pub(crate) to: Timestamp,
}

impl Hole {
    pub(crate) fn seconds(&self) -> f64 {
        self.to.since(self.from)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SignalList {
    Configured,
    MoreCells,
    Unconfigured,
}

/// Collects frames, events and estimates; [`WiringObserver::finish`] judges them.
#[derive(Debug)]
pub struct WiringObserver {
    pub(crate) plan: Plan,
    pub(crate) buses: Vec<BusStats>,
    pub(crate) series: Vec<Series>,
    pub(crate) more_cells: Vec<Series>,
    pub(crate) unconfigured: Vec<Series>,
    /// Indexes of the signals in each message.
    by_id: BTreeMap<(BusIndex, CanId), Vec<(SignalList, usize)>>,
    /// Reassembles diagnostic answers that carry signals.
    listener: Listener,
    /// Indexes of the signals in the answer to each diagnostic question.
    by_question: BTreeMap<Question, Vec<(SignalList, usize)>>,
    /// The identifier of the message with the pack current may also arrive on other interfaces than the configured one.
    /// Statistics of these frames, by interface.
    pub(crate) other_currents: BTreeMap<BusIndex, OtherCurrent>,
    /// Messages that any J1939 source address may send.
    groups: ParameterGroups,
    group_senders: GroupSenders,
    /// Latest direction of a current that is sent as a magnitude and a direction, with its time. The direction is 1 =
    /// discharge, -1 = charge, or `None` = unknown. The whole field is `None` if no direction signal is configured.
    direction: Option<(Timestamp, Option<f64>)>,
    guards: Guards,
    pub(crate) protected: BTreeMap<(BusIndex, CanId), ProtectionStats>,
    responses: [VoltageResponse; 2],
    pub(crate) estimator: EstimatorStats,
    pub(crate) usage: UsageRecord,
    /// The signals in which the pack reports its own state of charge or health, in the order of their values in
    /// `usage`.
    pub(super) witnesses: Vec<Witness>,
    /// The longest holes. `hole_count` counts all holes.
    pub(crate) holes: Vec<Hole>,
    pub(crate) hole_count: usize,
    pub(crate) first: Option<Timestamp>,
    pub(crate) latest: Option<Timestamp>,
    /// Sum of the times between frames (s). Gaps above 30 s are left out, because the buses sleep during such a gap.
    pub(crate) awake_s: f64,
    /// Time listened on live interfaces (s); `None` for a recording, which uses `awake_s` instead.
    listened_s: Option<f64>,
    pub(crate) frames: u64,
}

impl WiringObserver {
    /// Creates an observer for `plan`.
    pub fn new(plan: Plan) -> Self {
        let mut by_id: BTreeMap<(BusIndex, CanId), Vec<(SignalList, usize)>> = BTreeMap::new();
        let lists = [
            (SignalList::Configured, &plan.signals),
            (SignalList::MoreCells, &plan.more_cells),
            (SignalList::Unconfigured, &plan.unconfigured),
        ];
        let mut by_question: BTreeMap<Question, Vec<(SignalList, usize)>> = BTreeMap::new();
        for (name, list) in lists {
            // Ordered by channel, so that the electric current in a frame is handled before the voltages in the same
            // frame.
            let mut order: Vec<usize> = (0..list.len()).collect();
            order.sort_by_key(|&index| list[index].binding.channel);
            for index in order {
                match list[index].answer {
                    Some(answer) => by_question.entry(answer.question).or_default().push((name, index)),
                    None => {
                        by_id.entry((list[index].binding.bus, list[index].binding.id)).or_default().push((name, index));
                    }
                }
            }
        }
        let (cells, tolerance_a) = response_settings(&plan);
        let bus = |interface: &InterfacePlan| BusStats { name: interface.name.clone(), ..BusStats::default() };
        let signals = plan.signals.iter();
        let answers: Vec<Answer> =
            by_question.keys().map(|question| Answer { question: *question, signals: Vec::new() }).collect();
        Self {
            groups: ParameterGroups::new(plan.signals.iter().map(|signal| &signal.binding)),
            group_senders: GroupSenders::default(),
            direction: plan.has_direction().then(|| (Timestamp::default(), None)),
            listener: Listener::new(&answers),
            by_question,
            buses: plan.interfaces.iter().map(bus).collect(),
            series: signals.map(|s| Series::new(&s.layout, plan.plausible(s.binding.channel))).collect(),
            more_cells: plan.more_cells.iter().map(|signal| Series::new(&signal.layout, None)).collect(),
            unconfigured: plan.unconfigured.iter().map(|signal| Series::new(&signal.layout, None)).collect(),
            other_currents: BTreeMap::new(),
            by_id,
            guards: Guards::new(plan.guards.clone()),
            protected: BTreeMap::new(),
            responses: BLOCKS_S.map(|block_s| VoltageResponse::new(cells, tolerance_a, block_s)),
            estimator: EstimatorStats::default(),
            usage: UsageRecord::new(cells),
            witnesses: plan.witnesses(),
            holes: Vec::new(),
            hole_count: 0,
            first: None,
            latest: None,
            awake_s: 0.0,
            listened_s: None,
            frames: 0,
            plan,
        }
    }

    /// Adds an interface that is not configured; it gets the next number.
    pub fn add_interface(&mut self, name: &str) {
        self.buses.push(BusStats { name: name.to_owned(), ..BusStats::default() });
    }

    /// Handles a frame from any interface.
    pub fn handle_frame(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let found = self.groups.configured(time, bus, frame, &mut self.group_senders);
        let frame = if let GroupFrame::Configured(configured) = &found { configured } else { frame };
        self.note_time(time);
        self.frames += 1;
        let Some(stats) = self.buses.get_mut(bus.index()) else { return };
        stats.frames += 1;
        // Limits the memory. A vehicle's bus carries only a few hundred identifiers.
        if stats.ids.len() < 4096 || stats.ids.contains_key(&frame.id()) {
            let stats = stats.ids.entry(frame.id()).or_insert(IdStats { first: time, ..IdStats::default() });
            stats.count += 1;
            stats.fd += u64::from(matches!(frame.kind(), FrameKind::Fd { .. }));
            (stats.last, stats.len) = (time, frame.len());
        }
        if frame.kind() != FrameKind::Remote {
            self.check_protection(time, bus, frame);
            self.read(time, bus, frame);
            self.read_answer(time, bus, frame);
            self.read_other_current(time, bus, frame);
        }
    }

    /// If the frame has the identifier of the message with the pack current but arrives on another interface, reads
    /// the current from the frame.
    fn read_other_current(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let is_current = |signal: &&SignalPlan| signal.binding.channel == Channel::Current;
        let Some(signal) = self.plan.signals.iter().find(is_current) else { return };
        if signal.binding.id != frame.id() || signal.binding.bus == bus || signal.answer.is_some() {
            return;
        }
        let (cells, tolerance_a) = response_settings(&self.plan);
        let new = || OtherCurrent::new(&signal.layout, cells, tolerance_a);
        self.other_currents.entry(bus).or_insert_with(new).handle(time, frame.data(), &signal.binding);
    }

    fn check_protection(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let Some(status) = self.guards.check(time, bus, frame) else { return };
        self.guards.changes.clear();
        let stats = self.protected.entry((bus, frame.id())).or_default();
        *stats.counts.entry(status.name()).or_default() += 1;
        stats.good += u64::from(status.is_usable());
        stats.bad += u64::from(!status.is_usable() && status != Status::Initial);
        if stats.payloads.len() < 12 {
            stats.payloads.push(frame.data().to_vec());
        }
    }

    fn read(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        let key = (bus, frame.id());
        let Some(signals) = self.by_id.get_mut(&key).map(std::mem::take) else { return };
        self.read_signals(time, &signals, frame.data());
        self.by_id.insert(key, signals);
    }

    fn read_answer(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.listener.losses.clear();
        let FrameOutcome::Whole { answer, data, .. } = self.listener.handle(time, bus, frame) else { return };
        let (question, data) = (answer.question, data.to_vec());
        let Some(signals) = self.by_question.remove(&question) else { return };
        self.read_signals(time, &signals, &data);
        self.by_question.insert(question, signals);
    }

    fn read_signals(&mut self, time: Timestamp, wanted: &[(SignalList, usize)], data: &[u8]) {
        let Self {
            plan, series, more_cells, unconfigured, responses, other_currents, usage, witnesses, direction, ..
        } = self;
        let cells = f64::from(plan.pack.cells.max(1));
        for &(list, index) in wanted {
            let (signals, series) = match list {
                SignalList::Configured => (&plan.signals, &mut *series),
                SignalList::MoreCells => (&plan.more_cells, &mut *more_cells),
                SignalList::Unconfigured => (&plan.unconfigured, &mut *unconfigured),
            };
            let SignalPlan { binding, answer, .. } = &signals[index];
            let data = data.get(answer.map_or(0, |answer| answer.first_byte)..).unwrap_or_default();
            let is_configured = list == SignalList::Configured;
            let signed = match direction.filter(|_| is_configured && binding.channel == Channel::Current) {
                None => None,
                Some((since, Some(sign))) if time.since(since) <= plan.max_age_s(Channel::Current) => {
                    Some(Binding { scale: sign * binding.scale, offset: sign * binding.offset, ..binding.clone() })
                }
                Some(_) => continue,
            };
            let binding = signed.as_ref().unwrap_or(binding);
            let max_age_s = if is_configured { plan.max_age_s(binding.channel) } else { f64::INFINITY };
            let value = series[index].handle(time, data, binding, max_age_s);
            if let Some(value) = value.filter(|_| list != SignalList::MoreCells) {
                let witness = Witness { is_configured, index };
                let place = witnesses.iter().position(|other| *other == witness);
                place.into_iter().for_each(|place| usage.handle_reported(place, value));
            }
            let Some(value) = value.filter(|_| is_configured) else { continue };
            let (cell, voltage_v) = match binding.channel {
                Channel::Current => {
                    responses.iter_mut().for_each(|response| response.handle_current(time, value));
                    usage.handle_current(time, value);
                    continue;
                }
                Channel::PackVoltage => (0, value / cells),
                Channel::CellVoltage(cell) => (cell.index(), value),
                Channel::Temperature(_)
                | Channel::ReportedSoc
                | Channel::ReportedSoh
                | Channel::SupplyVoltage
                | Channel::Balancing(_)
                | Channel::PackIdentity
                | Channel::Contactor => continue,
                Channel::CurrentDirection => {
                    *direction = Some((time, binding.value(data).ok()));
                    continue;
                }
            };
            let others = other_currents.values_mut().flat_map(OtherCurrent::responses_mut);
            responses.iter_mut().chain(others).for_each(|response| response.handle_voltage(time, cell, voltage_v));
            usage.handle_voltage(time, cell, voltage_v);
        }
    }

    pub(super) fn end_blocks(&mut self) {
        self.responses.iter_mut().for_each(VoltageResponse::pause);
        self.other_currents.values_mut().for_each(OtherCurrent::pause);
    }

    pub(super) fn fast_response(&self) -> &VoltageResponse {
        &self.responses[0]
    }

    /// Slope of the median cell's voltage against the current. Both are averaged over blocks, with the block length
    /// that `best_response` selects.
    pub(super) fn slope(&self) -> Option<Slope> {
        best_response(&self.responses).slope()
    }

    pub(super) fn slope_of(&self, cell: usize) -> Option<Slope> {
        best_response(&self.responses).slope_of(cell)
    }

    pub(super) fn slope_block_s(&self) -> f64 {
        best_response(&self.responses).block_s()
    }

    pub(super) fn responses(&self) -> &[VoltageResponse; 2] {
        &self.responses
    }

    fn note_time(&mut self, time: Timestamp) {
        self.first.get_or_insert(time);
        let last = *self.latest.get_or_insert(time);
        let passed_s = time.since(last);
        // The buses slept, or the recording has a gap.
        if passed_s > 30.0 {
            self.note_hole(Hole { from: last, to: time });
            self.handle_gap();
        } else {
            self.awake_s += passed_s.max(0.0);
        }
        self.latest = Some(last.max(time));
    }

    fn note_hole(&mut self, hole: Hole) {
        /// Maximum number of holes that are kept. A report lists fewer.
        const MAX_HOLES: usize = 16;
        self.hole_count += 1;
        self.holes.push(hole);
        if self.holes.len() > MAX_HOLES
            && let Some(shortest) =
                (0..self.holes.len()).min_by(|a, b| self.holes[*a].seconds().total_cmp(&self.holes[*b].seconds()))
        {
            self.holes.remove(shortest);
        }
    }

    /// Handles a period of unknown length in which the observer did not listen.
    pub fn handle_gap(&mut self) {
        let Self { series, more_cells, unconfigured, .. } = self;
        series.iter_mut().chain(more_cells).chain(unconfigured).for_each(Series::pause);
        self.usage.pause();
        self.end_blocks();
        self.guards.restart();
        self.listener.restart();
    }

    /// Handles an event of an interface.
    pub fn handle_bus(&mut self, bus: BusIndex, event: BusEvent) {
        let Some(bus) = self.buses.get_mut(bus.index()) else { return };
        match event {
            BusEvent::Up => (bus.is_missing, bus.is_down) = (false, false),
            BusEvent::Down => bus.is_down = true,
            BusEvent::Missing => bus.is_missing = true,
            BusEvent::Dropped { frames } => bus.dropped = bus.dropped.saturating_add(frames),
            BusEvent::ErrorFrame { class } => {
                bus.error_frames += 1;
                bus.error_classes |= class;
            }
            BusEvent::SendFailed { .. } => {}
        }
    }

    /// Handles an estimate of the monitor.
    pub fn handle_estimate(&mut self, estimate: &Estimate) {
        if (estimate.innovation_v / estimate.innovation_std_v).powi(2).is_finite() {
            self.estimator.estimates += 1;
            self.estimator.rejected += u64::from(!estimate.accepted);
            self.estimator.innovation_sum += estimate.innovation_v;
        }
    }

    /// How long the observer has listened (s). For a recording, the time in which the buses slept is left out.
    pub fn seconds(&self) -> f64 {
        self.listened_s.unwrap_or(self.awake_s)
    }

    /// Sets how long the observer has listened on live interfaces (s) with or without frames.
    pub fn handle_listened(&mut self, seconds: f64) {
        self.listened_s = Some(seconds);
    }

    /// Number of frames received.
    pub fn frames(&self) -> u64 {
        self.frames
    }
}

/// Number of separately measured voltages, and the largest current change that does not count as a change of load (A).
fn response_settings(plan: &Plan) -> (usize, f64) {
    let cells = if plan.pack.is_total { 1 } else { usize::from(plan.pack.cells) };
    (cells, 0.01 * (plan.pack.capacity_ah * f64::from(plan.pack.strings.max(1))))
}
