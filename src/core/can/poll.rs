//! Sends diagnostic requests to controllers, and stops when they could disturb the vehicle or another tester.
//!
//! In: frames, responses, the state of the car, the supply voltage and the time. Out: request and flow control frames,
//! and a [`PollChange`] when polling stops or starts, or when a controller permanently rejects a request. At most one
//! request is outstanding at a time. Polling stops while another tester is active, while the bus sleeps, while the
//! supply voltage is low or unknown, and on standby.
//!
//! Only requests of a [`Service`](super::uds::Service) can be sent, because the types cannot express a write, a session
//! or a routine. The module uses no clock and no socket.

use serde::{Deserialize, Serialize};

use super::isotp::{FLOW_CONTROL, segment};
use super::uds::{Controller, PENDING, Question, Refusal};
use super::{CanId, Frame};
use crate::quantity::{BusIndex, Timestamp};

/// Pause after another tester's request, ns. A workshop tester sends its next request sooner.
pub const FOREIGN_SILENCE_NS: i64 = 60_000_000_000;
/// A bus without frames from other nodes for this time (ns) is asleep. The nodes of a running car send many frames a
/// second.
pub const ASLEEP_AFTER_NS: i64 = 2_000_000_000;
/// Longest wait for the next frame of a response, ns. The standards allow 50 ms for the first frame (P2) and 1 s for
/// further frames (N_Cr).
const ANSWER_WITHIN_NS: i64 = 1_000_000_000;

/// State of the car, as derived from the pack current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
pub enum CarState {
    Drive,
    Charge,
    /// Also used while the current is unknown.
    #[default]
    Parked,
}

/// One request and how often it is sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PollRequest {
    pub question: Question,
    /// Period in each [`CarState`]; `None` = not sent in this state.
    pub every_s: [Option<f64>; 3],
    /// Whether the response contains the pack current.
    pub has_current: bool,
    /// Whether the response contains voltages. If so, the current is requested just before this request.
    pub has_voltages: bool,
}

/// Configuration of polling.
#[derive(Debug, Clone, PartialEq)]
pub struct PollConfig {
    /// Of several due requests, the first in this list is sent first.
    pub requests: Vec<PollRequest>,
    /// Maximum number of sent frames per second, including flow control.
    pub max_requests_per_s: f64,
    /// Whether a supply voltage is configured. If so, nothing is sent without a good reading of this voltage.
    pub watches_supply: bool,
}

/// Reason why polling is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PollSilence {
    Standby,
    /// Another tester sent a request less than a minute ago.
    OtherTester,
    LowSupply,
    BusAsleep,
}

impl PollSilence {
    /// Description for logs and status.
    pub fn words(self) -> &'static str {
        match self {
            Self::Standby => "on standby",
            Self::OtherTester => "another tester is active",
            Self::LowSupply => "the supply voltage is low or unknown",
            Self::BusAsleep => "the bus sleeps",
        }
    }
}

/// A change of polling, for the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "poll")]
pub enum PollChange {
    Silent {
        reason: PollSilence,
    },
    Asking,
    /// A controller permanently rejected a request, which is not sent again.
    Refused {
        /// Identifier of the controller's responses.
        id: CanId,
        service: u8,
        /// Identifier of the requested value.
        identifier: u16,
        code: u8,
    },
}

/// Outputs of the poller; the caller empties them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PollOutputs {
    pub frames: Vec<(BusIndex, Frame)>,
    pub changes: Vec<PollChange>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Item {
    due: Timestamp,
    failures: u32,
    /// Whether the request is not sent again.
    is_refused: bool,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Outstanding {
    index: usize,
    sent: Timestamp,
    deadline: Timestamp,
    /// Whether flow control was sent.
    #[serde(default)]
    has_flow_control: bool,
}

/// Sends diagnostic requests.
#[derive(Debug, Clone)]
pub struct Poller {
    config: PollConfig,
    progress: PollProgress,
}

/// Progress of polling, stored in a snapshot. Polling resumes from it if no frame was missed since the snapshot.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PollProgress {
    items: Vec<Item>,
    outstanding: Option<Outstanding>,
    latest: Option<usize>,
    rate_allows_at: Timestamp,
    state: CarState,
    is_standby: bool,
    /// When the latest good supply reading expires.
    supply_good_until: Timestamp,
    foreign_until: Timestamp,
    /// Latest frame from other nodes on each polled bus.
    heard: Vec<(BusIndex, Timestamp)>,
    silence: Option<PollSilence>,
}

impl PollProgress {
    /// Shifts the end of the silence after another tester's request, to another clock.
    pub(crate) fn rebase(&mut self, by_nanos: i64) {
        self.foreign_until = self.foreign_until.plus_nanos(by_nanos);
    }

    /// Drops everything that does not outlive the process. Returns whether polling is still stopped by standby or by
    /// another tester's request.
    pub(crate) fn restart(&mut self, now: Timestamp) -> bool {
        (self.outstanding, self.latest, self.silence) = (None, None, None);
        self.items.clear();
        self.heard.clear();
        self.is_standby || self.hears_tester(now)
    }

    fn hears_tester(&self, now: Timestamp) -> bool {
        now < self.foreign_until
    }
}

impl Poller {
    /// Creates a poller, which is silent until it receives frames.
    pub fn new(config: &PollConfig) -> Self {
        let item = Item { due: Timestamp::LONG_AGO, failures: 0, is_refused: false };
        let mut buses: Vec<BusIndex> = config.requests.iter().map(|request| request.question.controller.bus).collect();
        buses.sort_unstable();
        buses.dedup();
        Self {
            progress: PollProgress {
                items: vec![item; config.requests.len()],
                outstanding: None,
                latest: None,
                rate_allows_at: Timestamp::LONG_AGO,
                state: CarState::default(),
                is_standby: false,
                supply_good_until: Timestamp::LONG_AGO,
                foreign_until: Timestamp::LONG_AGO,
                heard: buses.into_iter().map(|bus| (bus, Timestamp::LONG_AGO)).collect(),
                silence: Some(PollSilence::BusAsleep),
            },
            config: config.clone(),
        }
    }

    /// The progress to store.
    pub fn progress(&self) -> &PollProgress {
        &self.progress
    }

    /// Restores standby and the silence after another tester's request. This silence starts again, because the tester
    /// may have sent further requests. `taken`: time of the stored progress.
    pub fn restore_silence(&mut self, stored: &PollProgress, taken: Timestamp, now: Timestamp) {
        self.progress.is_standby = stored.is_standby;
        if stored.hears_tester(taken) {
            self.progress.foreign_until = now.plus_nanos(FOREIGN_SILENCE_NS);
        }
    }

    /// Resumes stored progress of the same configuration.
    pub fn resume(&mut self, stored: &PollProgress) {
        let questions = self.progress.items.len();
        let exists = |index: usize| index < questions;
        let fits = stored.items.len() == questions
            && stored.outstanding.is_none_or(|outstanding| exists(outstanding.index))
            && stored.latest.is_none_or(exists)
            && stored.heard.iter().map(|(bus, _)| bus).eq(self.progress.heard.iter().map(|(bus, _)| bus));
        if fits {
            self.progress.clone_from(stored);
        }
    }

    /// Whether the poller uses this bus and must receive all its frames.
    pub fn is_on(&self, bus: BusIndex) -> bool {
        self.progress.heard.iter().any(|(other, _)| *other == bus)
    }

    /// Why nothing is sent; `None` = polling is active.
    pub fn silence(&self) -> Option<PollSilence> {
        self.progress.silence
    }

    /// Number of requests that are not sent again.
    pub fn refused(&self) -> usize {
        self.progress.items.iter().filter(|item| item.is_refused).count()
    }

    /// Sets the state of the car, which determines the periods.
    pub fn set_state(&mut self, now: Timestamp, state: CarState) {
        if state == self.progress.state {
            return;
        }
        self.progress.state = state;
        for index in 0..self.progress.items.len() {
            // A shorter period applies at once, before the longer period has ended.
            if let Some(period_s) = self.period_s(index) {
                self.progress.items[index].due = self.progress.items[index].due.min(now.plus_secs(period_s));
            }
        }
    }

    /// Handles a reading of the supply voltage. `good_until`: when the reading expires; `None` = the voltage is low or
    /// the reading is bad.
    pub fn set_supply(&mut self, good_until: Option<Timestamp>) {
        self.progress.supply_good_until = good_until.unwrap_or(Timestamp::LONG_AGO);
    }

    /// Starts or ends standby.
    pub fn set_standby(&mut self, is_standby: bool) {
        self.progress.is_standby = is_standby;
    }

    /// Forgets received frames and the outstanding request. Called after a time without listening.
    pub fn restart(&mut self) {
        self.progress.outstanding = None;
        self.progress.heard.iter_mut().for_each(|(_, at)| *at = Timestamp::LONG_AGO);
    }

    /// Handles a frame of another node. The caller must not pass frames that the poller sent.
    pub fn handle_frame(&mut self, now: Timestamp, bus: BusIndex, frame: &Frame, out: &mut PollOutputs) {
        let Some(heard) = self.progress.heard.iter_mut().find(|(other, _)| *other == bus) else { return };
        let of_polled = |wanted: fn(&Controller) -> CanId| {
            let same = |request: &PollRequest| request.question.controller.bus == bus;
            self.config
                .requests
                .iter()
                .filter(|request| same(request))
                .any(|request| wanted(&request.question.controller) == frame.id())
        };
        if of_polled(|controller| controller.request) || is_tester(frame.id()) {
            self.progress.foreign_until = now.plus_nanos(FOREIGN_SILENCE_NS);
            self.progress.outstanding = None;
        } else if !of_polled(|controller| controller.response) {
            // A response to packwatch's own request does not prove that the car is awake.
            heard.1 = now;
        }
        self.poll(now, out);
    }

    /// Handles the first frame of a multi-frame response. Sends flow control only once per request, so that a
    /// controller that repeats first frames gets no further answer.
    pub fn handle_begun(&mut self, now: Timestamp, controller: &Controller, out: &mut PollOutputs) {
        let Some(question) = self.outstanding_of(controller) else { return };
        let is_first = |outstanding: &mut Outstanding| !std::mem::replace(&mut outstanding.has_flow_control, true);
        if !self.progress.outstanding.as_mut().is_some_and(is_first) {
            return;
        }
        self.extend_wait(now, ANSWER_WITHIN_NS);
        self.progress.rate_allows_at = self.progress.rate_allows_at.max(now).plus_secs(self.frame_period_s());
        let Controller { bus, request, request_extension, .. } = question.controller;
        let mut payload = [0; 8];
        let bytes = request_extension.iter().chain(&FLOW_CONTROL);
        payload.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        out.frames.extend(Frame::classic(request, &payload).map(|frame| (bus, frame)));
    }

    /// Handles a further frame of the response.
    pub fn handle_continued(&mut self, now: Timestamp, controller: &Controller) {
        if self.outstanding_of(controller).is_some() {
            self.extend_wait(now, ANSWER_WITHIN_NS);
        }
    }

    /// Handles a complete response.
    pub fn handle_answer(&mut self, now: Timestamp, question: &Question, out: &mut PollOutputs) {
        if let Some(Outstanding { index, .. }) = self.progress.outstanding
            && self.config.requests[index].question == *question
        {
            self.progress.items[index].failures = 0;
            self.progress.outstanding = None;
            self.poll(now, out);
        }
    }

    /// Handles a negative response.
    pub fn handle_refusal(&mut self, now: Timestamp, controller: &Controller, refusal: Refusal, out: &mut PollOutputs) {
        let Refusal { service, code } = refusal;
        let Some(question) = self.outstanding_of(controller).filter(|question| question.service as u8 == service)
        else {
            return;
        };
        if code == PENDING {
            // Longest wait after "response pending": 5 s (P2*), in ns.
            return self.extend_wait(now, 5_000_000_000);
        }
        let Some(Outstanding { index, .. }) = self.progress.outstanding.take() else { return };
        // Permanent rejections: service not supported, request out of range, security access denied.
        if [0x11, 0x31, 0x33].contains(&code) {
            self.progress.items[index].is_refused = true;
            let (id, service) = (controller.response, question.service as u8);
            out.changes.push(PollChange::Refused { id, service, identifier: question.identifier, code });
        } else {
            self.fail(now, index);
        }
        self.poll(now, out);
    }

    /// Sends the next request if it is due. Reports when polling stops or starts.
    pub fn poll(&mut self, now: Timestamp, out: &mut PollOutputs) {
        let silence = self.silence_at(now);
        if silence != self.progress.silence {
            self.progress.silence = silence;
            out.changes.push(silence.map_or(PollChange::Asking, |reason| PollChange::Silent { reason }));
        }
        if silence.is_some() {
            self.progress.outstanding = None;
            return;
        }
        if let Some(Outstanding { index, deadline, .. }) = self.progress.outstanding {
            if now < deadline {
                return;
            }
            self.progress.outstanding = None;
            self.fail(now, index);
        }
        if now < self.progress.rate_allows_at {
            return;
        }
        if let Some((index, due)) = self.next()
            && due <= now
        {
            self.send(now, self.with_current_before(index), out);
        }
    }

    /// Time of the next [`poll`](Self::poll); `None` = not before a frame, a command or a reading arrives.
    pub fn next_due(&self) -> Option<Timestamp> {
        match self.progress.silence {
            Some(PollSilence::OtherTester) => return Some(self.progress.foreign_until),
            Some(_) => return None,
            None => {}
        }
        let asleep = self.progress.heard.iter().map(|(_, at)| at.plus_nanos(ASLEEP_AFTER_NS)).min();
        let request = match self.progress.outstanding {
            Some(outstanding) => Some(outstanding.deadline),
            None => self.next().map(|(_, due)| due.max(self.progress.rate_allows_at)),
        };
        let supply = self.config.watches_supply.then_some(self.progress.supply_good_until);
        asleep.into_iter().chain(supply).chain(request).min()
    }

    /// Whether a polled bus is asleep.
    pub fn is_bus_asleep(&self, now: Timestamp) -> bool {
        let is_asleep = |(_, at): &(BusIndex, Timestamp)| now.nanos().saturating_sub(at.nanos()) >= ASLEEP_AFTER_NS;
        self.progress.heard.iter().any(is_asleep)
    }

    fn silence_at(&self, now: Timestamp) -> Option<PollSilence> {
        if self.progress.is_standby {
            Some(PollSilence::Standby)
        } else if self.progress.hears_tester(now) {
            Some(PollSilence::OtherTester)
        } else if self.config.watches_supply && now >= self.progress.supply_good_until {
            Some(PollSilence::LowSupply)
        } else {
            self.is_bus_asleep(now).then_some(PollSilence::BusAsleep)
        }
    }

    /// The next request: index and due time.
    fn next(&self) -> Option<(usize, Timestamp)> {
        let waiting = self
            .progress
            .items
            .iter()
            .enumerate()
            .filter(|(index, item)| !item.is_refused && self.period_s(*index).is_some());
        waiting.map(|(index, item)| (index, item.due)).min_by_key(|(_, due)| *due)
    }

    /// Minimum average time between two sent frames, s.
    fn frame_period_s(&self) -> f64 {
        1.0 / self.config.max_requests_per_s
    }

    fn period_s(&self, index: usize) -> Option<f64> {
        self.config.requests[index].every_s[self.progress.state as usize]
    }

    /// Index of the request to send now. If the response to request `index` contains voltages but not the current, the
    /// request for the current is sent first. It is not sent first if it was the last request sent, if it failed the
    /// last time, or if it was rejected.
    fn with_current_before(&self, index: usize) -> usize {
        let wanted = &self.config.requests[index];
        if !wanted.has_voltages || wanted.has_current {
            return index;
        }
        let current = self
            .config
            .requests
            .iter()
            .zip(&self.progress.items)
            .position(|(request, item)| request.has_current && !item.is_refused && item.failures == 0);
        current.filter(|current| self.progress.latest != Some(*current)).unwrap_or(index)
    }

    fn send(&mut self, now: Timestamp, index: usize, out: &mut PollOutputs) {
        let Question { controller: Controller { bus, request, request_extension, .. }, .. } =
            self.config.requests[index].question;
        let message = self.config.requests[index].question.request();
        let payload = segment(request_extension, &message, 0);
        out.frames
            .extend(payload.first().and_then(|payload| Frame::classic(request, payload)).map(|frame| (bus, frame)));
        let deadline = now.plus_nanos(ANSWER_WITHIN_NS);
        self.progress.outstanding = Some(Outstanding { index, sent: now, deadline, has_flow_control: false });
        self.progress.latest = Some(index);
        self.progress.rate_allows_at = now.plus_secs(self.frame_period_s());
        // Without a period in this state, the request is sent only because it precedes a request for voltages.
        let period_s = self.period_s(index).unwrap_or(0.0);
        let item = &mut self.progress.items[index];
        let next = item.due.plus_secs(period_s);
        // If the request is less than a period late, it keeps its cycle.
        item.due = if item.due <= now && next > now { next } else { now.plus_secs(period_s) };
    }

    /// Extends the wait up to a limit.
    fn extend_wait(&mut self, now: Timestamp, by_ns: i64) {
        if let Some(outstanding) = &mut self.progress.outstanding {
            // At most 30 s (in ns) in total, because a gateway may respond "pending" forever.
            outstanding.deadline = now.plus_nanos(by_ns).min(outstanding.sent.plus_nanos(30_000_000_000));
        }
    }

    /// Delays a failed request. The pause doubles with each consecutive failure.
    fn fail(&mut self, now: Timestamp, index: usize) {
        let period_s = self.period_s(index).unwrap_or(1.0);
        let item = &mut self.progress.items[index];
        item.failures = item.failures.saturating_add(1);
        let pause_s = period_s * 2.0_f64.powi(item.failures.min(16).cast_signed());
        // At most 600 s, unless the period is longer.
        item.due = item.due.max(now.plus_secs(pause_s.clamp(period_s, period_s.max(600.0))));
    }

    fn outstanding_of(&self, controller: &Controller) -> Option<Question> {
        let question = self.config.requests[self.progress.outstanding?.index].question;
        (question.controller == *controller).then_some(question)
    }
}

/// Whether only testers use the identifier: requests of ISO 15765-4 (physical or functional), BMW (6F1), Volkswagen
/// (710, 17FC00xx) and Renault-Nissan (743).
fn is_tester(id: CanId) -> bool {
    match id {
        CanId::Standard(raw) => matches!(raw, 0x7DF..=0x7E7 | 0x6F1 | 0x710 | 0x743),
        CanId::Extended(raw) => {
            matches!(raw & 0x1FFF_00FF, 0x18DA_00F1 | 0x18DB_00F1) || raw & 0x1FFF_FF00 == 0x17FC_0000
        }
    }
}

#[cfg(test)]
mod tests;
